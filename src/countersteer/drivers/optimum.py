"""The best open-loop commands that were found for a course and a car, kept as data.

`optima/` holds what `learn optimum COURSE` wrote: a list of commands, and beside it what the drive
was judged to be. They are a yardstick, not a driver for the road: nothing corrects them.
"""

import importlib.resources
import json
from pathlib import Path

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.stored import fingerprint
from countersteer.errors import InputError


def commands_for(course: Course, car: Car, laps: int) -> Path:
    """The `commands.csv` for a course and a car. Raises `InputError` if there is none."""
    mine = fingerprint(course, car)
    for path in library():
        about = json.loads(path.with_suffix(".json").read_text())
        if about["fingerprint"] == mine and about["laps"] == laps:
            return path
    lap = "" if laps == 1 else f" --laps {laps}"
    raise InputError(
        f"no optimum is stored for {laps} lap{'s' if laps > 1 else ''} of {course.name} with this "
        f"car; find one: countersteer learn optimum {course.name}{lap} --out BEST.csv, "
        "then give --driver BEST.csv"
    )


def library() -> list[Path]:
    """The stored lists of commands."""
    folder = Path(str(importlib.resources.files("countersteer.drivers") / "optima"))
    return sorted(folder.glob("*.csv"))
