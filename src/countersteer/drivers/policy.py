"""Policies in TOML files: the numbers of a driver, as plain data.

    kind = "drift-turn"
    [stop_angle]
    speed_mps = [1.0, 1.6]
    offset_deg = [0.0, 0.0]
    slope_s = [0.12, 0.12]
    deviation_deg = [5.7, 5.7]
    [turning]
    ...
    [source]
    stop_angle = "where these numbers are from"

A list holds a number for each speed; where one has a default, a single number is for all.
Numbers with a default in `Turning` may be left out. An absent table is replaced by that of the
library's `drift-turn.toml`, which has all tables.
"""

import dataclasses
import functools
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.car.parameter import EDGE, Declaration, read_value, unknown_key, write_value
from countersteer.drivers.stop_angle import StopAngle
from countersteer.drivers.turning import Turning
from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.content import reading
from countersteer.reading.values import short, shown
from countersteer.text import read_toml, toml_of
from countersteer.writing import write_whole

LIBRARY = importlib.resources.files("countersteer.drivers") / "library"
KIND = "drift-turn"
MOST_SPEEDS = 32


class Entry(NamedTuple):
    """How a file holds a field: key, unit and range."""

    key: str
    by_speed: bool  # True: a list with a number for each speed
    unit: str  # inside; `EDGE` has that of the file
    low: float  # in the unit of the file
    high: float

    @property
    def declared(self) -> Declaration:
        """The declaration, with the range in the unit used inside."""
        factor = EDGE[self.unit][1]
        return Declaration(self.unit, self.low * factor, self.high * factor, self.key, "policy")

    @property
    def name(self) -> str:
        """The key with its unit."""
        return self.key + EDGE[self.unit][0]


# By the names of the classes' fields.
TABLES: dict[str, tuple[type, dict[str, Entry]]] = {
    "stop_angle": (
        StopAngle,
        {
            "speeds": Entry("speed", True, "m/s", 0, 20),
            "offset": Entry("offset", True, "rad", -180, 180),
            "slope": Entry("slope", True, "s", -2, 2),
            "deviation": Entry("deviation", True, "rad", 0, 180),
        },
    ),
    "turning": (
        Turning,
        {
            "speeds": Entry("speed", True, "m/s", 0, 20),
            "lead": Entry("lead", True, "m", -2, 10),
            "lock": Entry("lock", True, "rad", -90, 90),
            "rate": Entry("rate", True, "rad/s", 0, 1500),
            "throttle": Entry("throttle", True, "1", -1, 1),
            "counter": Entry("counter", True, "rad", -90, 90),
            "rate_gain": Entry("rate_gain", False, "s", -10, 10),
            "stop_gain": Entry("stop_gain", False, "1", -100, 100),
            "settled": Entry("settled", False, "rad/s", 0, 1500),
            "hold_p": Entry("hold_p", False, "1", -100, 100),
            "hold_d": Entry("hold_d", False, "s", -10, 10),
            "hold_slip": Entry("hold_slip", False, "1", -10, 10),
            "hold_throttle": Entry("hold_throttle", False, "1", -1, 1),
            "slip_aim": Entry("slip_aim", True, "rad", 0, 90),
            "slip_gain": Entry("slip_gain", False, "1", -10, 10),
            "lead_grip": Entry("lead_grip", False, "1", -10, 10),
            "rate_grip": Entry("rate_grip", False, "1", -10, 10),
            "rate_servo": Entry("rate_servo", False, "1", -10, 10),
            "stop_servo": Entry("stop_servo", False, "1", -10, 10),
            "aim_servo": Entry("aim_servo", False, "1", -10, 10),
            "lead_arc": Entry("lead_arc", False, "1", 0, 2),
            "power": Entry("power", True, "1", -1, 1),
        },
    ),
}


class Policy(NamedTuple):
    """The numbers of the drift-turn driver."""

    turning: Turning
    stop_angle: StopAngle


def load_policy(name: str) -> Policy:
    """A policy from the library or a file. Raises `InputError` naming file, key and range."""
    with reading(short(name)):
        return policy_of_tables(*read_toml(name, LIBRARY, "policy"))


def policy_of_tables(tables: Mapping[str, Any], where: str) -> Policy:
    """A policy from the tables of the file `where`. Raises `InputError`."""
    known = {"kind": 0, "description": 0, "car": 0, "source": 0, **TABLES}
    for key in tables:
        if key not in known:
            raise unknown_key(where, key, known)
    if tables.get("kind") != KIND:
        raise InputError(f'{where}: kind must be "{KIND}", not {shown(tables.get("kind"))}')
    texts = {"description": tables.get("description", "")}
    source = tables.get("source", {})
    if not isinstance(source, dict):
        raise InputError(f"{where}: [source] must be a table of texts")
    for key, value in (texts | {f"source.{k}": v for k, v in source.items()}).items():
        if not isinstance(value, str):
            raise InputError(f"{where}: {short(key)} must be a text, not {shown(value)}")
    if "car" in tables:
        values.name(tables["car"], f"{where}: car")
    if not set(TABLES) & set(tables):
        raise InputError(f"{where}: holds no number: give {' or '.join(f'[{t}]' for t in TABLES)}")
    read = {part: _read(where, part, tables[part]) for part in TABLES if part in tables}
    return library()._replace(**read) if len(read) < len(TABLES) else Policy(**read)


@functools.cache
def library() -> Policy:
    """The driver's default policy, `drift-turn.toml`."""
    return load_policy(KIND)


def _read(where: str, part: str, table: Any) -> Any:
    """A table as an instance of its class in `TABLES`."""
    made, entries = TABLES[part]
    if not isinstance(table, dict):
        raise InputError(f"{where}: {part} must be a table of numbers")
    names = {entry.name: 0 for entry in entries.values()}
    for key in table:
        if key not in names:
            raise unknown_key(where, f"{part}.{key}", {f"{part}.{k}": 0 for k in names})
    found: dict[str, Any] = {}
    optional = {f.name for f in dataclasses.fields(made) if f.default is not dataclasses.MISSING}
    for field, entry in entries.items():
        key = f"{part}.{entry.name}"
        if entry.name not in table:
            if field in optional:
                continue
            raise InputError(f"{where}: {key} is missing")
        value = table[entry.name]
        if not entry.by_speed:
            found[field] = read_value(where, key, entry.declared, value)
            continue
        if field in optional and not isinstance(value, list):
            found[field] = np.full(
                len(found["speeds"]), read_value(where, key, entry.declared, value)
            )
            continue
        if not isinstance(value, list) or not 1 <= len(value) <= MOST_SPEEDS:
            raise InputError(f"{where}: {key} must be a list of 1 to {MOST_SPEEDS} numbers")
        found[field] = np.array(
            [read_value(where, f"{key}[{i}]", entry.declared, v) for i, v in enumerate(value)]
        )
        if len(value) != len(found["speeds"]):
            count = len(found["speeds"])
            raise InputError(f"{where}: {key} must hold {count} numbers, as {part}.speed_mps does")
    if np.any(np.diff(found["speeds"]) <= 0):
        raise InputError(f"{where}: {part}.speed_mps must rise")
    return made(**found)


def policy_tables(
    turning: Turning | None = None, stop_angle: StopAngle | None = None
) -> dict[str, Any]:
    """The tables of a file with the parts that are given."""
    tables = {}
    for part, value in (("stop_angle", stop_angle), ("turning", turning)):
        if value is not None:
            tables[part] = {
                entry.name: _written(
                    entry.declared,
                    np.broadcast_to(getattr(value, field), np.shape(value.speeds))
                    if entry.by_speed
                    else getattr(value, field),
                )
                for field, entry in TABLES[part][1].items()
            }
    return tables


def _written(declared: Declaration, value: Any) -> Any:
    """A number or a list of numbers, rounded to 9 digits: degrees from radians are not exact."""
    if np.ndim(value):
        return [_written(declared, one) for one in np.asarray(value)]
    return float(f"{write_value(declared, value):.9g}")


def for_another_car(pilot: Mapping[str, Any], car: str) -> str | None:
    """A line that says so, where the policy of a `[pilot]` table was learned for another car."""
    learned = pilot.get("numbers", {}).get("car")
    own = Path(car).stem
    if learned in (None, own):
        return None
    return (
        f"{Path(str(pilot.get('file', KIND))).stem} was learned for {learned}, not for {own}: "
        f"'countersteer learn turn COURSE --car {car} --out POLICY.toml' learns one for it"
    )


def save_policy(
    path: Path,
    source: Mapping[str, str],
    turning: Turning | None = None,
    stop_angle: StopAngle | None = None,
    car: str | None = None,
) -> None:
    """Write a policy for a car. `source` says where its numbers are from."""
    whose = {} if car is None else {"car": car}
    tables = {"kind": KIND, **whose, **policy_tables(turning, stop_angle), "source": dict(source)}
    write_whole(path, toml_of(tables))
