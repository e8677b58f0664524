"""Where the user's cache is."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """The folder of compiled programs, and of what else makes a second start faster."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "countersteer"
