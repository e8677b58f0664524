"""Run folders that a person's own script has written.

A folder holds `commands.csv`, and `telemetry.csv` or `truth.csv` or both, as `docs/
bring_your_own_log.md` describes them, on any clock. `run.toml` may be missing. The import moves the
clock to 0, checks every table as `read_run` does, and writes `run.mcap`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.content import reading
from countersteer.runs.files import Table, read_commands, read_measurements
from countersteer.runs.importers.imported import Imported, with_encoder, write_run
from countersteer.runs.run import read_about

POSE = ("time_s", "x_m", "y_m", "heading_rad")


def import_run(log: Path, out: Path) -> dict[str, Any]:
    """Write the run folder `out`/<name of the log>. Returns a report for JSON.

    Raises `InputError` if a table is missing or wrong.
    """
    if (out / log.stem).resolve() == log.resolve():
        raise InputError(f"{log}: --out {out} would write over it: give another --out")
    with reading(log):
        if not log.is_dir():
            raise InputError(f"{log}: no such run folder")
        about = read_about(log / "run.toml") if (log / "run.toml").exists() else {}
        commands = read_commands(log / "commands.csv", any_clock=True)
        telemetry, truth = (
            read_measurements(log / name, columns, any_clock=True)
            if (log / name).exists()
            else None
            for name, columns in (("telemetry.csv", ("time_s",)), ("truth.csv", POSE))
        )
        tables = [table for table in (commands, telemetry, truth) if table]
        begin = min(float(table["time_s"][0]) for table in tables)
        _move(log, tables, begin)
    about = {"log_format": "run", **about, "repairs": {"clock_moved_s": begin}}
    if telemetry is not None and "wheel_speed_mps" in telemetry:
        about = with_encoder(about)
    by_speed = "speed" in commands
    drive = commands["speed" if by_speed else "throttle"]
    rows = max(map(len, tables))
    imported = Imported(
        about, rows, commands["time_s"], drive, commands["steering"], telemetry, truth, by_speed
    )
    return write_run(log, out, imported)


def _move(log: Path, tables: list[Table], begin: float) -> None:
    """Move the clocks by `begin`, in place. Raises `InputError` if they are not one clock."""
    for table in tables:
        table["time_s"] = np.round(table["time_s"] - begin, 6)
    first = [table["time_s"][0] for table in tables]
    last = [table["time_s"][-1] for table in tables]
    if max(first) > min(last):
        raise InputError(f"{log}: the tables do not overlap in time: they need one clock")
