"""Where the user's cache is."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """The folder of compiled programs, and of what else makes a second start faster.

    For a user without a home it is one that cannot be made: a cache in a folder that others can
    write to would be theirs.
    """
    home = os.environ.get("XDG_CACHE_HOME")
    if not home:
        try:
            home = str(Path.home() / ".cache")
        except RuntimeError:
            home = os.devnull
    return Path(home) / "countersteer"
