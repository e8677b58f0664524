"""Cars in TOML files: reading with `base`, overrides, and writing in full."""

import dataclasses
import importlib.resources
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from countersteer.car.car import Car, MagicFormula, Mount, Sensors, Sonar
from countersteer.car.parameter import (
    declarations,
    edge_unit,
    read_value,
    unknown_key,
    write_value,
)
from countersteer.errors import InputError
from countersteer.reading.content import reading
from countersteer.reading.values import path as checked_path
from countersteer.reading.values import short, shown
from countersteer.text import read_toml, toml_of
from countersteer.writing import write_whole

LIBRARY = importlib.resources.files("countersteer.car") / "library"
MOST_BASES, MOST_MOUNTS = 16, 64


def library() -> list[str]:
    """Names of the cars that come with the package."""
    return sorted(p.name.removesuffix(".toml") for p in LIBRARY.iterdir() if p.suffix == ".toml")  # type: ignore[attr-defined]  # resources here are paths


def load_car(name: str, overrides: Iterable[str] = ()) -> Car:
    """A car from the library or a file, with `PATH=VALUE` overrides such as `battery.wear=0.5`.

    Leaves are 64-bit numbers. Raises `InputError` naming file, key and range.
    """
    with reading(short(name)):
        car = _load(name, ())
    for override in overrides:
        path, sign, text = override.partition("=")
        if not sign or not path:
            raise InputError(f"--set {override}: write PATH=VALUE, such as battery.wear=0.5")
        try:
            value: Any = float(text)
        except ValueError:
            value = text
        table: Any = value
        for key in reversed(path.split(".")):
            table = {key: table}
        car = _merge(car, table, "--set", "")
    check(car, name)
    return jax.tree.map(np.float64, car)


def check(car: Car, where: str) -> None:
    """Check the constraints between parameters. Raises `InputError`."""
    body = car.body
    if not body.front_axle < body.wheelbase:
        raise InputError(f"{where}: body.front_axle_m must be less than body.wheelbase_m")
    servo = car.servo
    steepest = max(float(servo.limit_left), float(servo.limit_right)) + abs(float(servo.trim))
    spread = abs(float(servo.ackermann)) * float(body.track) / (2 * float(body.wheelbase))
    if steepest >= math.pi / 2 or spread * math.tan(steepest) >= 1:
        raise InputError(f"{where}: [servo] limits, trim and ackermann turn a wheel beyond 90°")
    if not car.motor.dead_zone < car.motor.full_throttle:
        raise InputError(f"{where}: motor.dead_zone must be less than motor.full_throttle")


def require_speed_controller(car: Car, where: str) -> None:
    """Raise `InputError`, naming the commands in m/s, if a car cannot follow them."""
    if not car.speed_controller.gain:
        raise InputError(
            f"{where}: is commanded in m/s (speed_mps), and the car has no speed controller: give "
            "a car whose speed_controller.gain_spm is above 0"
        )


def _load(name: str, seen: tuple[Path, ...]) -> Car:
    """A car with its bases. `seen` holds the files on the way to it, to reject a cycle."""
    tables, where = read_toml(name, LIBRARY, "car")
    base, source = tables.pop("base", None), tables.pop("source", {})
    if not isinstance(source, dict):
        raise InputError(f"{where}: [source] must be a table of texts")
    if not isinstance(tables.pop("description", ""), str):
        raise InputError(f"{where}: description must be a text")
    if base is None:
        if not tables:
            raise InputError(f"{where}: holds no parameter: give a base, or tables such as [body]")
        return _merge(Car(), tables, where, "")
    seen = (*seen, Path(name).resolve())
    if len(seen) > MOST_BASES:
        raise InputError(f"{where}: base: over {MOST_BASES} cars, each the base of another")
    base = checked_path(base, f"{where}: base")
    other = str(Path(name).parent / base) if base.endswith(".toml") else base
    if Path(other).resolve() in seen:
        raise InputError(f"{where}: base must name another car, not {shown(base)}")
    return _merge(_load(other, seen), tables, where, "")


def _merge(part: Any, table: Any, where: str, path: str) -> Any:
    """`part` with its values replaced by those of a table. Raises `InputError`."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: {path.rstrip('.')} must be a table of parameters")
    known = declarations(type(part))
    parts = {
        field.name: getattr(part, field.name)
        for field in dataclasses.fields(part)
        if dataclasses.is_dataclass(getattr(part, field.name))
    }
    changes: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(part, Sonar) and key == "mounts":
            changes |= _mounts(part, value, where, f"{path}mounts.")
        elif key in parts:
            changes[key] = _merge(parts[key], value, where, f"{path}{key}.")
        elif key in known:
            name, declared = known[key]
            changes[name] = read_value(where, f"{path}{key}", declared, value)
        else:
            raise unknown_key(where, f"{path}{key}", {f"{path}{k}": 0 for k in known | parts})
    return dataclasses.replace(part, **changes)


def _mounts(sonar: Sonar, table: Any, where: str, path: str) -> dict[str, Any]:
    """The sonar's mounts, with the mounts of a table added or changed by name."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: {path.rstrip('.')} must be a table of mounts")
    mounts = dict(zip(sonar.mount_names, sonar.mounts, strict=True))
    for name, entry in table.items():
        if not re.fullmatch(r"[\w-]{1,40}", name):  # it names a column of a log
            raise InputError(
                f"{where}: {path}{short(name)}: a mount's name has up to 40 letters, digits, _ or -"
            )
        mounts[name] = _merge(mounts.get(name, Mount()), entry, where, f"{path}{name}.")
    if len(mounts) > MOST_MOUNTS:
        raise InputError(f"{where}: {path.rstrip('.')}: {len(mounts)} mounts, over {MOST_MOUNTS}")
    return {"mount_names": tuple(mounts), "mounts": tuple(mounts.values())}


def car_tables(part: Any) -> dict[str, Any]:
    """All of a car as the tables of a file. Brush tyres have no `magic_formula`."""
    table: dict[str, Any] = {
        key: write_value(declared, getattr(part, name))
        for key, (name, declared) in declarations(type(part)).items()
    }
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, MagicFormula) and part.law == "brush":
            continue
        if dataclasses.is_dataclass(value):
            table[field.name] = car_tables(value)
        elif field.name == "mounts":
            table["mounts"] = {
                name: car_tables(mount) for name, mount in zip(part.mount_names, value, strict=True)
            }
    return table


def car_from_tables(tables: dict[str, Any], where: str) -> Car:
    """The inverse of `car_tables`. Raises `InputError` naming `where`."""
    empty = dataclasses.replace(
        Car(), sensors=dataclasses.replace(Car().sensors, sonar=Sonar(mount_names=(), mounts=()))
    )
    car = _merge(empty, tables, where, "")
    check(car, where)
    return jax.tree.map(np.float64, car)


def save_car(car: Car, path: Path, source: dict[str, str]) -> None:
    """Write all of a car. `source` says where each number is from."""
    write_whole(path, car_text(car, source))


def car_text(car: Car, source: dict[str, str]) -> str:
    """The text of `save_car`'s file."""
    return toml_of({"source": source, **car_tables(car)})


def parameters(car: Car | None = None) -> list[dict[str, Any]]:
    """Every parameter of a car in the units of files, in the order of declaration.

    `path` is as in `--set`, `value` is the car's, `low` and `high` are its range (None if it has
    `choices`), `source` is that of the default, and `unit` that of all its numbers. Without a
    car, values are the defaults, and the one sonar mount is called NAME.
    """
    plain = Sonar(mount_names=("NAME",), mounts=(Mount(),))
    return _parameters(car or Car(sensors=Sensors(sonar=plain)), "")


def _parameters(part: Any, path: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for key, (name, declared) in declarations(type(part)).items():
        default = getattr(type(part)(), name)
        value, default, low, high = (
            # The conversion to radians and back changes the last digits.
            v if declared.choices else float(f"{write_value(declared, v):.12g}")
            for v in (getattr(part, name), default, declared.low, declared.high)
        )
        found.append(
            {
                "path": f"{path}{key}",
                "unit": edge_unit(declared),
                "value": value,
                "low": None if declared.choices else low,
                "high": None if declared.choices else high,
                "choices": list(declared.choices),
                "default": default,
                "meaning": declared.meaning,
                "source": declared.source,
            }
        )
    for field in dataclasses.fields(part):
        inner = getattr(part, field.name)
        if dataclasses.is_dataclass(inner):
            found += _parameters(inner, f"{path}{field.name}.")
        elif field.name == "mounts":
            for name, mount in zip(part.mount_names, inner, strict=True):
                found += _parameters(mount, f"{path}mounts.{name}.")
    return found
