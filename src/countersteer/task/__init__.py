"""What a drive is for: its goal, how it ends, and what its turns were like."""
