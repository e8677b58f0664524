"""Mappings: which column of a log is which signal, in which unit, with which sign.

A mapping is a TOML file. The key of an entry is a signal of `units`:

    wheel_speed = { column = "erpm", unit = "erpm", sign = -1 }

Its value is `sign * scale * factor * (raw - zero) / span`, where `factor`, and the defaults of
`zero` and `span`, belong to the unit. Formats with fixed columns have a mapping of their own, in a
file beside this one.
"""

import dataclasses
import importlib.resources
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from countersteer.car.parameter import unknown_key
from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.content import read_text
from countersteer.reading.values import short, shown
from countersteer.runs.importers.units import SIGNALS, UNITS, Unit
from countersteer.runs.keys import ABOUT
from countersteer.text import LARGEST_TOML, tables_of

MOST_COLUMNS = 16  # of an entry
LARGEST = 1e12  # of a number of a mapping
LONGEST = 200  # characters of a name
LIBRARY = importlib.resources.files(__package__)

NUMBERS = {  # numbers of the whole mapping, with their ranges
    "full_lock_deg": (0.1, 90.0),
    "wheel_radius_m": (0.001, 2.0),
    "gear_ratio": (0.001, 1000.0),
    "pole_pairs": (1.0, 100.0),
}
TABLES = ("car_name", "battery_charge", "sensors")  # go to `run.toml`


@dataclasses.dataclass(frozen=True)
class Entry:
    """How one signal is read."""

    columns: tuple[str, ...] = ()
    table: str = ""  # file, topic or message type that has the columns; empty: the log's only one
    units: tuple[str, ...] = ("",)  # one for all columns, or one for each
    zero: float | None = None  # raw value at 0; None: the unit's
    span: float | None = None  # raw distance from there to 1; None: the unit's
    sign: float = 1.0
    scale: float = 1.0
    low: float = -math.inf  # raw values outside are no reading
    high: float = math.inf
    held: bool = False  # the log repeats the last reading; only changes are readings
    above: float = 0.5  # of a switch: raw values above are 1
    reverse: tuple[str, ...] = ("reverse",)  # of a direction: words for reverse
    period: float | None = None  # s, of time: rows are so far apart

    def unit_of(self, signal: str, place: int = 0) -> Unit:
        """The unit of a column, with this entry's zero and span."""
        unit = UNITS[SIGNALS[signal].dimension][self.units[min(place, len(self.units) - 1)]]
        return unit._replace(
            zero=unit.zero if self.zero is None else self.zero,
            span=unit.span if self.span is None else self.span,
        )


@dataclasses.dataclass(frozen=True)
class Recipe:
    """A mapping: entries by signal, in the order of preference, and numbers of the whole log."""

    where: str  # file, for messages
    entries: Mapping[str, tuple[Entry, ...]]
    optional: frozenset[str]  # signals that a log may lack
    numbers: dict[str, float]
    about: dict[str, Any]  # goes to `run.toml`

    @property
    def columns(self) -> set[str]:
        """All columns that it names."""
        return {name for entries in self.entries.values() for e in entries for name in e.columns}


def read_mapping(path: Path | None, built_in: str | None = None) -> Recipe:
    """A mapping from a file, laid over that of a format, if it has one.

    A key of the file replaces the whole key of the format's. Raises `InputError`, with file and
    key, if one is wrong.
    """
    own: dict[str, Any] = {}
    if built_in is not None:
        own = tables_of(read_text(LIBRARY / f"{built_in}.toml"), built_in)  # type: ignore[arg-type]  # a path
    given = {} if path is None else tables_of(read_text(path, LARGEST_TOML), str(path))
    for key, other in (("speed", "throttle"), ("throttle", "speed")):
        if key in given:
            own.pop(other, None)
    recipe = recipe_of({**own, **given}, str(path) if path else f"the mapping of {built_in}")
    return dataclasses.replace(recipe, optional=frozenset(own) - frozenset(given))


def recipe_of(tables: Mapping[str, Any], where: str) -> Recipe:
    """The mapping of a file's tables. Raises `InputError`."""
    known = {*SIGNALS, *NUMBERS, *TABLES}
    for key in tables:
        if key not in known:
            raise unknown_key(where, key, dict.fromkeys(known))
    if "time" not in tables:
        raise InputError(f"{where}: time is missing: say which column holds it, and its unit")
    if "throttle" in tables and "speed" in tables:
        raise InputError(f"{where}: throttle and speed both command the motor: give one of them")
    numbers = {
        key: values.number(tables[key], f"{where}: {key}", *NUMBERS[key])
        for key in NUMBERS
        if key in tables
    }
    about = {key: tables[key] for key in TABLES if key in tables}
    ABOUT(about, where, ": ")
    for sensor in ("gyroscope", "voltmeter"):  # else the unit would count twice
        if "unit" in about.get("sensors", {}).get(sensor, {}):
            raise InputError(f"{where}: sensors.{sensor}.unit: give the signal its unit instead")
    entries = {}
    for signal in SIGNALS:
        if signal in tables:
            given = tables[signal] if isinstance(tables[signal], list) else [tables[signal]]
            if not 1 <= len(given) <= MOST_COLUMNS:
                raise InputError(f"{where}: {signal} must be an entry, or up to {MOST_COLUMNS}")
            entries[signal] = tuple(
                _entry(signal, entry, f"{where}: {signal}", numbers) for entry in given
            )
    return Recipe(where, entries, frozenset(), numbers, about)


def _entry(signal: str, table: Any, where: str, numbers: Mapping[str, float]) -> Entry:
    """One way to read a signal. Raises `InputError`."""
    if not isinstance(table, dict):
        raise InputError(f'{where} must be a table such as {{ column = "…", unit = "…" }}')
    found: dict[str, Any] = {}
    for key, value in table.items():
        if key not in _KEYS:
            raise unknown_key(where, key, _KEYS)
        name, check = _KEYS[key]
        found |= dict(zip(name.split(), check(value, f"{where}.{key}"), strict=True))
    entry = Entry(**found)
    if signal == "time" and entry.period is not None:
        return entry
    if not entry.columns:
        raise InputError(f"{where}.column is missing")
    units = UNITS.get(SIGNALS[signal].dimension)
    if units is None:  # a switch, or words
        return entry
    for place, unit in enumerate(entry.units):
        if unit not in units:
            raise InputError(f"{where}.unit must be one of {', '.join(units)}, not {shown(unit)}")
        for number in units[unit].needs:
            if number not in numbers:
                raise InputError(f"{where}: the unit {unit} needs {number} in the mapping")
        if not entry.unit_of(signal, place).span:
            raise InputError(f"{where}.span must not be 0")
        if math.isnan(entry.unit_of(signal, place).span):
            raise InputError(f"{where}.span is missing: the counts from zero to full")
    if len(entry.units) not in (1, len(entry.columns)):
        raise InputError(f"{where}.unit must be one for all columns, or one for each")
    if "quaternion" in entry.units and len(entry.columns) != 4:
        raise InputError(f"{where}: a quaternion has four columns: x, y, z, w")
    return entry


def _texts(value: Any, where: str, each: bool = False) -> tuple[Any]:
    """A text or a list of texts."""
    found = value if isinstance(value, list) else [value]
    if not 1 <= len(found) <= MOST_COLUMNS or (each and not isinstance(value, list)):
        raise InputError(f"{where} must be a list of up to {MOST_COLUMNS} texts")
    for one in found:
        if not isinstance(one, str) or len(one) > LONGEST or not one.isprintable():
            raise InputError(f"{where} must be a text, not {shown(one)}")
    return (tuple(found),)


def _number(value: Any, where: str, low: float = -LARGEST, high: float = LARGEST) -> tuple[float]:
    return (values.number(value, where, low, high),)


def _sign(value: Any, where: str) -> tuple[float]:
    if value not in (1, -1) or isinstance(value, bool):
        raise InputError(f"{where} must be 1 or -1, not {shown(value)}")
    return (float(value),)


def _within(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"{where} must be [lowest, highest], not {shown(value)}")
    low, high = (_number(one, where)[0] for one in value)
    if low >= high:
        raise InputError(f"{where} must rise")
    return low, high


def _flag(value: Any, where: str) -> tuple[bool]:
    return (values.flag(value, where),)


def _table(value: Any, where: str) -> tuple[str]:
    (texts,) = _texts(value, where)
    return (str(texts[0]),)


_KEYS: dict[str, tuple[str, Callable[[Any, str], Sequence[Any]]]] = {
    "column": ("columns", _texts),
    "columns": ("columns", partial(_texts, each=True)),
    "from": ("table", _table),
    "unit": ("units", _texts),
    "zero": ("zero", _number),
    "span": ("span", _number),
    "sign": ("sign", _sign),
    "scale": ("scale", _number),
    "within": ("low high", _within),
    "held": ("held", _flag),
    "above": ("above", _number),
    "reverse": ("reverse", _texts),
    "period_s": ("period", partial(_number, low=1e-5, high=10.0)),
}


def column_missing(recipe: Recipe, signal: str, column: str, known: Sequence[str]) -> InputError:
    """The error for a column that the log does not have."""
    names = short(", ".join(map(repr, known)))
    return InputError(
        f"{recipe.where}: {signal}: the log has no column {shown(column)}; it has {names}"
    )
