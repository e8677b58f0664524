"""Logs that an EdgeTX or OpenTX radio writes to its card.

`Date` and `Time` are the radio's clock. Channels are pulses in microseconds, sticks count from
-1024 to 1024. Telemetry of the receiver follows, with the unit in the name. Steering is taken from
channel 1 and throttle from channel 2; to the right is positive on a radio, so the sign is turned.

Source of the columns' names: https://github.com/EdgeTX/edgetx, radio/src/logs.cpp.
"""

from pathlib import Path
from typing import Any

from countersteer.runs.importers.csv import text_tables
from countersteer.runs.importers.mapped import import_mapped
from countersteer.runs.importers.mapping import read_mapping


def import_edgetx(log: Path, out: Path, mapping: Path | None) -> dict[str, Any]:
    """Write a radio's log as a run folder. Keys of `mapping` replace those of `edgetx.toml`."""
    return import_mapped(log, out, "edgetx", read_mapping(mapping, "edgetx"), text_tables(log))
