"""Studies that make pages of the docs; nobody else runs them, so they are not in the package."""
