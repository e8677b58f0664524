"""Drivers by their names on the command line, and by their tables in `run.toml`."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import require_speed_controller
from countersteer.course.course import Course
from countersteer.drivers import DRIVERS, optimum, own, plan, policy, ppo, stored, tabular
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.driver import Driver
from countersteer.drivers.plan import Read
from countersteer.drivers.pursuit import pursuit
from countersteer.drivers.replay import Replay
from countersteer.drivers.straighten import straighten
from countersteer.errors import InputError
from countersteer.reading.values import short, shown
from countersteer.signals import Command, SpeedCommand
from countersteer.text import nearest, read_toml

KINDS = (policy.KIND, "plan")  # of a file
LEARNED = (ppo.KIND, tabular.KIND)  # of an .npz


def make_driver(
    name: str,
    course: Course,
    car: Car,
    speed: float | None,
    laps: int,
    read: Read,
) -> tuple[Driver, dict[str, Any]]:
    """A driver for a course and a nominal car, and its tables for `driver_of_tables`.

    `name` is one of the library, a policy `.npz`, a policy or plan `.toml`, a `commands.csv`, which
    `read` reads, or `FILE.py:CLASS`.
    `speed` (m/s) is the speed that it should bring to a turn. The tables of a `commands.csv` are a
    record only: they make no driver. Raises `InputError`.
    """
    if name.endswith(".csv") or name == "optimum":
        if speed is not None:
            raise InputError(f"--speed-mps: {name} holds commands, and is asked for no speed")
        file = Path(name) if name != "optimum" else optimum.commands_for(course, car, laps)
        commands = read(file)
        if "speed" in commands:
            require_speed_controller(car, name)
        return replay(commands), {"kind": "replay"}
    tables: dict[str, Any] = {} if speed is None else {"speed_mps": speed}
    # Looking for what is installed takes longer than making a driver of the library.
    theirs = name not in DRIVERS and not name.endswith(".toml") and name in own.installed()
    if own.is_code(name) or theirs:
        return own.own_driver(name, course, car, speed, laps), {"kind": "python", "name": name}
    if name in ("straighten", "pursuit"):
        tables = {"kind": name, **tables}
    elif name in LEARNED:
        tables = {"kind": name, "file": str(stored.policy_for(name, course, car)), **tables}
    elif name.endswith(".npz"):
        tables = {"kind": stored.about_of(Path(name))["kind"], "file": name, **tables}
    elif name.endswith(".toml") or name in (policy.KIND, *plan.library()):
        numbers, where = read_toml(name, plan.LIBRARY, "driver")
        kind = numbers.get("kind")
        if kind not in KINDS:
            raise InputError(f"{where}: kind must be one of {', '.join(KINDS)}, not {shown(kind)}")
        tables = {"kind": kind, "file": where, **tables, "numbers": numbers}
    else:
        known = [*DRIVERS, *plan.library(), *own.installed()]
        raise InputError(
            f"no driver {short(name)}{nearest(name, known)}: give one of {', '.join(known)}, a "
            "policy .npz, a policy or plan .toml, a commands.csv, or FILE.py:CLASS"
        )
    return driver_of_tables(tables, course, car, laps, read), tables


def driver_of_tables(
    tables: Mapping[str, Any], course: Course, car: Car, laps: int, read: Read
) -> Driver:
    """The driver of the table `[pilot]` in `run.toml`. Raises `InputError` for an unknown kind."""
    kind, speed = tables.get("kind"), tables.get("speed_mps")
    where, numbers = str(tables.get("file", "run.toml")), tables.get("numbers", {})
    if kind == "plan":
        return plan.plan(numbers, where, course, car, read, speed, laps)
    if kind == "straighten":
        return straighten(course, car, speed)
    if kind == "pursuit":
        return pursuit(course, car, speed)
    if kind in LEARNED:
        if speed is not None:
            raise InputError(
                f"--speed-mps: {short(where)} has its own speed, and is asked for none"
            )
        return learned(str(kind), Path(where), course, car)
    if kind == policy.KIND and numbers:
        return drift_turn(course, car, speed, laps, *policy.policy_of_tables(numbers, where))
    raise InputError(f"{short(where)}: no driver of kind {shown(kind)} can be made from plain data")


def learned(kind: str, file: Path, course: Course, car: Car) -> Driver:
    """The driver of a learned policy's file. Raises `InputError`."""
    if kind == ppo.KIND:
        layers, about = ppo.read_network(file)
        stored.check_for(short(str(file)), about, course, car)
        return ppo.network_driver(course, car, layers)
    arrays, about, table = tabular.read_table(file)
    stored.check_for(short(str(file)), about, course, car)
    return tabular.table_driver(course, car, arrays, about, table)


def steers_by(tables: Mapping[str, Any]) -> str:
    """What a driver steers by, in a few words, by its table."""
    kind = tables.get("kind")
    if kind in ("straighten", policy.KIND):
        return "sonar, and the estimate's velocities"
    if kind in (*LEARNED, "pursuit"):
        return "the estimate's pose"
    return {"replay": "the clock", "plan": "its plan"}.get(str(kind), "what its code asks for")


def learned_at(tables: Mapping[str, Any]) -> dict[str, Any]:
    """What a driver cost to learn, by its file: `samples` and `cpu_s`, as far as it says so."""
    kind = tables.get("kind")
    if kind not in LEARNED:
        return {}
    about = stored.about_of(Path(str(tables["file"])))
    parts = [about.get("learned_with"), about.get("cost")]
    told = {key: value for part in parts if isinstance(part, dict) for key, value in part.items()}
    return {
        key: float(told[key])
        for key in ("samples", "cpu_s")
        if isinstance(told.get(key), int | float) and math.isfinite(told[key])
    }


def replay(commands: Mapping[str, np.ndarray]) -> Replay:
    """A driver that replays the columns of `runs.files.read_commands`."""
    kind, drive = (SpeedCommand, "speed") if "speed" in commands else (Command, "throttle")
    return Replay(times=commands["time_s"], commands=kind(commands[drive], commands["steering"]))
