"""Cars in TOML files: reading with `base`, overrides, and writing in full."""

import dataclasses
import importlib.resources
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tomli_w

from countersteer.car.car import Car, Mount, Sonar
from countersteer.car.parameter import declarations, read_value, unknown_key, write_value
from countersteer.errors import InputError

LIBRARY = importlib.resources.files("countersteer.car") / "library"


def library() -> list[str]:
    """Names of the cars that come with the package."""
    return sorted(p.name.removesuffix(".toml") for p in LIBRARY.iterdir() if p.suffix == ".toml")  # type: ignore[attr-defined]  # resources here are paths


def read_toml(name: str, shelf: Any, kind: str, files: str = ".toml") -> tuple[dict[str, Any], str]:
    """The tables of a library entry or of a file's path, and what to call them in messages.

    Raises `InputError` where there is none, or where it is no TOML; it says which `files` may be.
    """
    entry = shelf / f"{name}.toml"
    path = Path(name)
    try:
        if entry.is_file() and "/" not in name:
            return tomllib.loads(entry.read_text()), name
        if path.suffix == ".toml":
            return tomllib.loads(path.read_text()), str(path)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name}: not valid TOML: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{name}: cannot be read: {error}") from None
    known = ", ".join(sorted(p.name.removesuffix(".toml") for p in shelf.iterdir()))
    raise InputError(f"no {kind} {name}: give one of {known}, or the path of a {files} file")


def load_car(name: str, overrides: Iterable[str] = ()) -> Car:
    """A car from the library or a file, with `PATH=VALUE` overrides such as `battery.wear=0.5`.

    Leaves are 64-bit numbers. Raises `InputError` naming file, key and range.
    """
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
    """What must hold between parameters. Raises `InputError`."""
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


def _load(name: str, seen: tuple[str, ...]) -> Car:
    tables, where = read_toml(name, LIBRARY, "car")
    base = tables.pop("base", None)
    source = tables.pop("source", {})
    if not isinstance(source, dict):
        raise InputError(f"{where}: [source] must be a table of texts")
    if base is None:
        car = Car()
    elif not isinstance(base, str) or base in seen or base == name:
        raise InputError(f"{where}: base must name another car, not {base!r}")
    else:
        car = _load(base, (*seen, name))
    return _merge(car, tables, where, "")


def _merge(part: Any, table: Any, where: str, path: str) -> Any:
    """`part` with the values of a table in place of its own."""
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
    """Sonar mounts by name; a table of mounts adds to those that are there."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: {path.rstrip('.')} must be a table of mounts")
    mounts = dict(zip(sonar.mount_names, sonar.mounts, strict=True))
    for name, entry in table.items():
        mounts[name] = _merge(mounts.get(name, Mount()), entry, where, f"{path}{name}.")
    return {"mount_names": tuple(mounts), "mounts": tuple(mounts.values())}


def car_tables(part: Any) -> dict[str, Any]:
    """A car in full, as the tables of a file."""
    table: dict[str, Any] = {
        key: write_value(declared, getattr(part, name))
        for key, (name, declared) in declarations(type(part)).items()
    }
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if dataclasses.is_dataclass(value):
            table[field.name] = car_tables(value)
        elif field.name == "mounts":
            table["mounts"] = {
                name: car_tables(mount) for name, mount in zip(part.mount_names, value, strict=True)
            }
    return table


def car_from_tables(tables: dict[str, Any], where: str) -> Car:
    """The inverse of `car_tables`."""
    empty = dataclasses.replace(
        Car(), sensors=dataclasses.replace(Car().sensors, sonar=Sonar(mount_names=(), mounts=()))
    )
    return jax.tree.map(np.float64, _merge(empty, tables, where, ""))


def save_car(car: Car, path: Path, source: dict[str, str]) -> None:
    """Write a car in full. `source` says where each number is from."""
    path.write_text(tomli_w.dumps({"source": source, **car_tables(car)}))


def parameter_lines(part: Any = None, path: str = "") -> list[str]:
    """Every parameter: path, range with unit, default, meaning, source of the default."""
    part = Car() if part is None else part
    lines = []
    for key, (name, declared) in declarations(type(part)).items():
        value = write_value(declared, getattr(part, name))
        if declared.choices:
            span = " | ".join(declared.choices)
        else:
            span = "{:g} … {:g}".format(
                *(write_value(declared, bound) for bound in (declared.low, declared.high))
            )
            value = f"{value:g}"
        lines.append(
            f"{path}{key} = {value}  [{span}]  {declared.meaning} (default: {declared.source})"
        )
    for field in dataclasses.fields(part):
        inner = getattr(part, field.name)
        if dataclasses.is_dataclass(inner):
            lines += parameter_lines(inner, f"{path}{field.name}.")
        elif field.name == "mounts":
            lines += parameter_lines(Mount(), f"{path}mounts.NAME.")
    return lines
