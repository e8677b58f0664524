"""Importers of other people's logs as run folders, one format in each file."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from countersteer.errors import InputError


class Format(NamedTuple):
    """A format of logs."""

    meaning: str
    mapped: bool  # whether it takes a mapping


FORMATS = {
    "csv": Format("any CSV, by a mapping", True),
    "rosbag": Format("ROS 1 and 2 bags, MCAP", True),
    "edgetx": Format("logs of EdgeTX radios", True),
    "vesc": Format("CSV logs of VESC Tool", True),
    "donkeycar": Format("Donkeycar's tub v2", True),
    "run": Format("a run folder of your own", False),
    "dart": Format("TU Delft's DART", False),
    "eth": Format("ETH Zürich's RC car", False),
}


def importer(name: str, mapping: Path | None = None) -> Callable[[Path, Path], dict[str, Any]]:
    """The importer of a format. It writes a log as a run folder, and returns a report.

    Raises `InputError` if the format takes no mapping and one is given.
    """
    module = importlib.import_module(f"{__name__}.{name}")
    made: Callable[..., dict[str, Any]] = getattr(module, f"import_{name}")
    if FORMATS[name].mapped:
        return lambda log, out: made(log, out, mapping)
    if mapping is not None:
        raise InputError(f"--map {mapping}: {name} has fixed columns, and takes no mapping")
    return made
