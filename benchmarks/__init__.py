"""Scripts for the pages on speed and accuracy. Nobody else runs them: not part of the package."""
