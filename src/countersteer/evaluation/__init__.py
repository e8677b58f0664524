"""What a drive was worth: turns, laps, errors against a log."""
