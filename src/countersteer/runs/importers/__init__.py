"""Other people's logs to run folders: one format a file."""
