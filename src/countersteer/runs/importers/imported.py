"""What every importer makes of a log, and the one writer of the run's folder."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.runs.files import COMMANDS, SPEED_COMMANDS
from countersteer.runs.recorder import Recorder, whole_folder

# Where the encoder of a log sits and what it counts over, unless the log says so: not what the
# sensors of the car that is compared are. Lag and step are then 0 or what the log tells.
ENCODER = {"on": "wheels", "over_s": 0.0}

Columns = dict[str, np.ndarray]  # by the name in the file; `time_s` is the first


def with_encoder(about: dict[str, Any]) -> dict[str, Any]:
    """The content of a `run.toml` that says where the encoder sits (`ENCODER`)."""
    sensors = about.get("sensors", {})
    return about | {"sensors": sensors | {"encoder": ENCODER | sensors.get("encoder", {})}}


class Imported(NamedTuple):
    """A log in the project's units. Times start at 0."""

    about: dict[str, Any]  # content of `run.toml`, without `source` and `rows`
    rows: int  # of the log
    time: np.ndarray  # s, of the commands
    drive: np.ndarray  # throttle (negative in reverse), or with `by_speed` a speed (m/s)
    steering: np.ndarray  # rad
    telemetry: Columns | None = None
    truth: Columns | None = None
    by_speed: bool = False


def write_run(log: Path, out: Path, imported: Imported) -> dict[str, Any]:
    """Write the run folder `out`/<name of the log>: tables, `run.toml` and `run.mcap`.

    Returns a report for JSON. The folder appears whole or not at all.
    """
    headers: dict[str, tuple[str, ...]] = {
        "commands": SPEED_COMMANDS if imported.by_speed else COMMANDS
    }
    tables: dict[str, tuple[np.ndarray, ...]] = {
        "commands": (imported.time, imported.drive, imported.steering)
    }
    for name, columns in (("telemetry", imported.telemetry), ("truth", imported.truth)):
        if columns is not None:
            headers[name], tables[name] = tuple(columns), tuple(columns.values())
    rows = {name: len(columns[0]) for name, columns in tables.items()}
    about = {
        **imported.about,
        "source": log.name,
        "rows": {"log": imported.rows, **rows},
    }
    folder = out / log.stem
    with whole_folder(folder) as part, Recorder(part, about, headers) as recorder:
        recorder.write(tables)
    last = max(float(columns[0][-1]) for columns in tables.values() if len(columns[0]))
    return {"run": str(folder), "duration_s": last, **about}
