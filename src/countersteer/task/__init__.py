"""The task of a drive: its goal, its outcome, and the measures of its turns."""
