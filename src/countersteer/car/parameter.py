"""One declaration for each number of a car: unit, range, meaning, default and its source.

TOML keys, command-line overrides, bounds of fits and randomisation all derive from it.
"""

import dataclasses
import difflib
import math
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import jax

from countersteer.errors import InputError
from countersteer.reading.values import as_float, short, shown
from countersteer.signals import Scalar

MOST_LISTED = 200  # characters

T = typing.TypeVar("T")

# Internal unit -> (suffix of the name at every edge, factor from the edge's unit to it).
EDGE = {
    "1": ("", 1.0),
    "1/N": ("_pn", 1.0),
    "m": ("_m", 1.0),
    "s": ("_s", 1.0),
    "kg": ("_kg", 1.0),
    "kg m2": ("_kgm2", 1.0),
    "rad": ("_deg", math.pi / 180),
    "rad/s": ("_degps", math.pi / 180),
    "rad/s2": ("_degps2", math.pi / 180),
    "m/s": ("_mps", 1.0),
    "s/m": ("_spm", 1.0),
    "m/s2": ("_mps2", 1.0),
    "N m": ("_nm", 1.0),
    "N m s": ("_nms", 1.0),
    "N m/A": ("_nmpa", 1.0),
    "ohm": ("_ohm", 1.0),
    "A": ("_a", 1.0),
    "C": ("_ah", 3600.0),
    "V": ("_v", 1.0),
    "Hz": ("_hz", 1.0),
}


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The declaration of a parameter. `low` and `high` are in its internal unit."""

    unit: str
    low: float
    high: float
    meaning: str
    source: str
    choices: tuple[str, ...] = ()
    whole: bool = False


def parameter(
    default: float, unit: str, low: float, high: float, meaning: str, source: str = "assumed"
) -> Any:
    """Declare a number. Default and range are in the unit of files (degrees, not radians)."""
    factor = EDGE[unit][1]
    declared = Declaration(unit, low * factor, high * factor, meaning, source)
    return dataclasses.field(default=default * factor, metadata={"declared": declared})


def count(default: int, low: int, high: int, meaning: str, source: str = "assumed") -> Any:
    """Declare a whole number, such as an array's size. It is static under `jit`."""
    declared = Declaration("1", low, high, meaning, source, whole=True)
    return dataclasses.field(default=default, metadata={"declared": declared, "static": True})


def choice(default: str, choices: tuple[str, ...], meaning: str, source: str = "assumed") -> Any:
    """Declare a setting with named values. It is static under `jit`."""
    declared = Declaration("1", 0.0, 0.0, meaning, source, choices)
    return dataclasses.field(default=default, metadata={"declared": declared, "static": True})


@typing.dataclass_transform(frozen_default=True, kw_only_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass and a pytree. Fields with `static` are not leaves."""
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    static = [f.name for f in dataclasses.fields(made) if f.metadata.get("static")]
    data = [f.name for f in dataclasses.fields(made) if f.name not in static]
    return jax.tree_util.register_dataclass(made, data_fields=data, meta_fields=static)


def declarations(part: type) -> dict[str, tuple[str, Declaration]]:
    """Key in files -> (field's name, declaration), in the order of declaration."""
    return {
        field.name + EDGE[field.metadata["declared"].unit][0]: (
            field.name,
            field.metadata["declared"],
        )
        for field in dataclasses.fields(part)
        if "declared" in field.metadata
    }


def read_value(where: str, key: str, declared: Declaration, value: Any) -> Any:
    """A value from a file or the command line, checked and in its internal unit.

    Raises `InputError` with the place, the key and the range.
    """
    if declared.choices:
        if not isinstance(value, str) or value not in declared.choices:
            raise InputError(f"{where}: {key} must be one of {', '.join(declared.choices)}")
        return value
    factor = EDGE[declared.unit][1]
    low, high = declared.low / factor, declared.high / factor
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(
            f"{where}: {key} must be a number in [{low:g}, {high:g}], not {shown(value)}"
        )
    given = shown(value) if isinstance(value, int) else f"{value:g}"
    value = as_float(value)
    slack = 1e-12 * max(abs(low), abs(high))  # a bound survives the round trip through degrees
    if not low - slack <= value <= high + slack:  # false for NaN too
        raise InputError(f"{where}: {key} = {given} is outside its range [{low:g}, {high:g}]")
    if declared.whole:
        if value != int(value):
            raise InputError(f"{where}: {key} must be a whole number, not {value:g}")
        return int(value)
    return float(value) * factor


def write_value(declared: Declaration, value: Any) -> Any:
    """The inverse of `read_value`, for files."""
    plain = declared.choices or declared.whole
    return value if plain else float(value) / EDGE[declared.unit][1]


def edge_unit(declared: Declaration) -> str:
    """The unit of the number that `write_value` gives."""
    return {"C": "A h"}.get(declared.unit, declared.unit.replace("rad", "deg"))


def changed(part: T, path: str, value: Scalar) -> T:
    """`part` with one parameter replaced, such as `tires.rear.friction` of a car.

    `path` holds field names. `value` is in the internal unit. It is unchecked and may be traced.
    """
    name, _, rest = path.partition(".")
    value = changed(getattr(part, name), rest, value) if rest else value
    replaced: T = dataclasses.replace(part, **{name: value})  # type: ignore[type-var]  # T is a pytree
    return replaced


def listed(names: Iterable[str]) -> str:
    """Names for a message, without those that make it too long."""
    whole = ", ".join(names)
    return whole if len(whole) <= MOST_LISTED else f"{whole[:MOST_LISTED].rpartition(',')[0]}, …"


def unknown_key(where: str, key: str, known: Mapping[str, Any]) -> InputError:
    """The error for an undeclared key. It names the nearest declared key, or else all."""
    near = difflib.get_close_matches(key[:100], known, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else f"; known: {listed(known)}"
    return InputError(f"{where}: unknown key {short(key)}{hint}")
