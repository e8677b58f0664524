"""CSV logs of VESC Tool, as its app writes them.

Cells are separated by semicolons. `ms_today` is the time of day, `erpm` the electrical speed of the
motor, `duty_cycle` what the motor is given, `gyroZ` a yaw rate in deg/s, `accX` in g. A VESC knows
no steering, so every command is straight ahead unless a mapping names another column.

Source of the columns' names: https://github.com/vedderb/vesc_tool.
"""

from pathlib import Path
from typing import Any

from countersteer.runs.importers.csv import text_tables
from countersteer.runs.importers.mapped import import_mapped
from countersteer.runs.importers.mapping import read_mapping


def import_vesc(log: Path, out: Path, mapping: Path | None) -> dict[str, Any]:
    """Write a log of VESC Tool as a run folder. Keys of `mapping` replace those of `vesc.toml`."""
    return import_mapped(log, out, "vesc", read_mapping(mapping, "vesc"), text_tables(log))
