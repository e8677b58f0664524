"""Importers of other people's logs as run folders, one format in each file."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

FORMATS = {"dart": "TU Delft's DART", "eth": "ETH Zürich's RC car"}


def importer(name: str) -> Callable[[Path, Path], dict[str, Any]]:
    """The importer of a format. It writes a log as a run folder, and returns a report."""
    made: Callable[[Path, Path], dict[str, Any]] = getattr(
        importlib.import_module(f"{__name__}.{name}"), f"import_{name}"
    )
    return made
