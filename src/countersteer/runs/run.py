"""`Run`: the record of one drive, read from its folder."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import car_from_tables, library, load_car
from countersteer.errors import InputError
from countersteer.reading.content import read_text, reading
from countersteer.reading.documents import json_object, toml
from countersteer.runs.declared import telemetry_in_si, truth_at_centre
from countersteer.runs.files import (
    ESTIMATE,
    LONGEST,
    ROLLOUTS,
    SLOWEST_CLOCK,
    Table,
    read_commands,
    read_measurements,
)
from countersteer.runs.keys import check_about, check_summary
from countersteer.text import checked_format

LARGEST = 10  # MB, of run.toml and summary.json


@dataclasses.dataclass(frozen=True)
class Run:
    """A drive of a simulated or a real car. Missing tables are None."""

    path: Path
    about: dict[str, Any]  # run.toml
    commands: Table  # time_s, throttle or speed (negative in reverse), steering (rad)
    telemetry: Table | None
    truth: Table | None
    summary: dict[str, Any] = dataclasses.field(default_factory=dict)  # summary.json
    estimate: Table | None = None  # what the pilot took for its motion
    rollouts: Table | None = None  # paths that a planner looked at

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


def refuse_long(run: Run) -> None:
    """Raise `InputError` for a run that goes on beyond `LONGEST`.

    Each instant from 0 on would be simulated.
    """
    for name, table in (
        ("commands", run.commands), ("telemetry", run.telemetry), ("truth", run.truth),
    ):  # fmt: skip
        if table is not None and len(table) and table["time_s"][-1] > LONGEST:
            first, last = float(table["time_s"][0]), float(table["time_s"][-1])
            advice = "convert milliseconds, or cut the log into pieces"
            if last - first <= min(LONGEST, SLOWEST_CLOCK * len(table)):
                advice = "'countersteer import run' moves the clock of all its tables to 0"
            raise InputError(
                f"{run.path}/{name}.csv: goes on to {last:g} s, over {LONGEST:g} s: {advice}"
            )


def read_summary(path: Path) -> dict[str, Any]:
    """Read a `summary.json`. Raises `InputError` if it is not one."""
    found = json_object(read_text(path, LARGEST), str(path))
    check_summary(found, str(path))
    return found


def read_about(path: Path) -> dict[str, Any]:
    """Read a `run.toml`. Raises `InputError`, with the key, if one that is used is wrong."""
    tables = toml(read_text(path, LARGEST), str(path))
    if isinstance(tables.get("format"), str):  # the first importers named the log's format so
        tables["log_format"] = tables.pop("format")
    about = checked_format(tables, str(path))
    check_about(about, str(path))
    return about


def read_run(path: Path) -> Run:
    """Read a run's folder. Raises `InputError` if it is not one."""
    with reading(path):
        if not path.is_dir():
            raise InputError(f"{path}: no such run folder")
        if not (path / "run.toml").exists():
            raise InputError(f"{path}: not a run: it has no run.toml")
        return _read(path)


def _read(path: Path) -> Run:
    recorded = (path / "run.mcap").exists()  # no table that was written by hand
    telemetry, truth, summary = (path / n for n in ("telemetry.csv", "truth.csv", "summary.json"))
    estimate, rollouts = path / "estimate.csv", path / "rollouts.csv"
    about = read_about(path / "run.toml")
    pose = ("time_s", "x_m", "y_m", "heading_rad")
    return Run(
        path,
        about,
        read_commands(path / "commands.csv", recorded),
        telemetry_in_si(about, read_measurements(telemetry, ("time_s",), recorded))
        if telemetry.exists()
        else None,
        truth_at_centre(about, read_measurements(truth, pose, recorded))
        if truth.exists()
        else None,
        read_summary(summary) if summary.exists() else {},
        read_measurements(estimate, ESTIMATE, recorded) if estimate.exists() else None,
        read_measurements(rollouts, ROLLOUTS, recorded) if rollouts.exists() else None,
    )
