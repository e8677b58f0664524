"""What `countersteer new` writes: files that run as they are."""
