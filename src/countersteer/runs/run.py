"""`Run`: the record of one drive, read from its folder."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import car_from_tables, library, load_car
from countersteer.errors import InputError
from countersteer.runs.files import Table, read_commands, read_table
from countersteer.text import read_text, tables_of


@dataclasses.dataclass(frozen=True)
class Run:
    """A drive of a simulated or a real car. Missing tables are None."""

    path: Path
    about: dict[str, Any]  # run.toml
    commands: Table  # time_s, throttle (negative in reverse), steering (rad)
    telemetry: Table | None
    truth: Table | None
    summary: dict[str, Any] = dataclasses.field(default_factory=dict)  # summary.json

    @property
    def car(self) -> Car | None:
        """The car of a simulated drive, else None."""
        tables = self.about.get("car")
        return (
            car_from_tables(tables, f"{self.path}/run.toml") if isinstance(tables, dict) else None
        )

    @property
    def outcome(self) -> str:
        """How the drive ended, in words. A drive whose process was killed is "not finished"."""
        unknown = "not finished" if "pilot" in self.about else "not judged"
        return str(self.summary.get("outcome", unknown))

    @property
    def walls(self) -> np.ndarray:
        """Ends (x, y, x, y) of the course's walls (m): (n, 4)."""
        walls = self.about.get("course", {}).get("walls_m", [])
        return np.array(walls, float).reshape(-1, 4)


def drawn_car(about: Mapping[str, Any]) -> Car:
    """The car of a `run.toml`: its own in full, else the library's of that name, else rx7.

    The latter two may differ from the real car. Drawing needs only a size, but `measure` of the
    experiments computes with the car too.
    """
    if isinstance(about.get("car"), dict):
        return car_from_tables(about["car"], "run.toml")
    name = about.get("car_name")
    return load_car(name if name in library() else "rx7")


def read_summary(path: Path) -> dict[str, Any]:
    """Read a `summary.json`. Raises `InputError` if it is not one."""
    try:
        found = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: must hold one JSON object")
    return found


def read_run(path: Path) -> Run:
    """Read a run's folder. Raises `InputError` if it is not one."""
    if not path.is_dir():
        raise InputError(f"{path}: no such run folder")
    if not (path / "run.toml").exists():
        raise InputError(f"{path}: not a run: it has no run.toml")
    about = tables_of(read_text(path / "run.toml"), f"{path}/run.toml")
    recorded = (path / "run.mcap").exists()  # no table that was written by hand
    telemetry, truth, summary = (path / n for n in ("telemetry.csv", "truth.csv", "summary.json"))
    return Run(
        path,
        about,
        read_commands(path / "commands.csv", recorded),
        read_table(telemetry, ("time_s",), recorded=recorded) if telemetry.exists() else None,
        read_table(truth, ("time_s", "x_m", "y_m", "heading_rad"), recorded=recorded)
        if truth.exists()
        else None,
        read_summary(summary) if summary.exists() else {},
    )
