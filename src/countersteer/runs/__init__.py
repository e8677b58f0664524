"""`Run`: the record of one drive, and the files that hold it."""
