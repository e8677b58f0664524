"""What makes the pages on speed and accuracy, and nobody else runs."""
