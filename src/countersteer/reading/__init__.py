"""Reading of the user's files: one reader a format, with limits, and one line for what is wrong."""
