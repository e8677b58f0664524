"""Studies that make pages of the docs. Nobody else runs them, so they are not in the package."""
