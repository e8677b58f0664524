"""The cockpit: a live page on which a person drives, watches and records."""
