"""Random cars around a nominal one. A set of cars is a file, and a seed gives a trial."""

import dataclasses
import importlib.resources
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer import random_streams
from countersteer.car.car import Car
from countersteer.car.parameter import Declaration, changed, declarations, unknown_key
from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.random_streams import Stream
from countersteer.reading.content import reading
from countersteer.reading.values import number, short
from countersteer.signals import Array, Scalar
from countersteer.text import read_toml
from countersteer.world import floor
from countersteer.world.floor import LARGEST, Floor

LIBRARY = importlib.resources.files("countersteer.batch") / "library"
MOST_VARIED = 500
KINDS = ("within", "plus", "low", "high")
START = {"along_m": 1.0, "offset_m": 1.0, "heading_deg": math.pi / 180}  # factors to SI


class Varied(NamedTuple):
    """Parameters that one random u in [-1, 1] sets, in the units used inside.

    Their value is nominal · (1 + within u) + plus u, or goes from one of `ends` to the other.
    """

    paths: tuple[str, ...]  # by the names used inside
    declared: tuple[Declaration, ...]
    within: float
    plus: float
    ends: tuple[float, float] | None


@dataclasses.dataclass(frozen=True)
class Population:
    """The distribution of trials. SI units and radians."""

    name: str
    varied: tuple[Varied, ...]
    charge: tuple[float, float]
    start: tuple[float, float, float]  # largest offset along the line, to its left, and in heading
    floor: tuple[float, float]  # friction: relative standard deviation, and length scale (m)


class Drawn(NamedTuple):
    """A batch of trials; the leaves of `cars` have a leading axis of trials."""

    cars: Car
    charge: Array
    pose: Array  # (n, 3) x, y, heading
    speed: Array | None  # m/s, asked of the driver at a turn
    floor: Floor | None


def load_population(name: str) -> Population:
    """Load a set from the library or a file. Raises `InputError` with file and key."""
    with reading(short(name)):
        return _load(name)


def _load(name: str) -> Population:
    tables, where = read_toml(name, LIBRARY, "set of cars")
    for key in tables:
        if key not in ("description", "vary", "start", "floor"):
            raise unknown_key(where, key, {"vary": 0, "start": 0, "floor": 0})
    for table_name in ("vary", "start", "floor"):
        if not isinstance(tables.get(table_name, {}), dict):
            raise InputError(f"{where}: {table_name} must be a table")
    varied = tuple(_varied(where, key, entry) for key, entry in tables.get("vary", {}).items())
    if len(varied) > MOST_VARIED:
        raise InputError(f"{where}: vary has {len(varied)} keys, over {MOST_VARIED}")
    start, ground = tables.get("start", {}), tables.get("floor", {})
    for table, known in (
        (start, ("charge", *START)),
        (ground, ("deviation", "length_m")),
    ):
        for key in table:
            if key not in known:
                raise unknown_key(where, key, dict.fromkeys(known, 0))
    charge = start.get("charge", [1.0, 1.0])
    if not (isinstance(charge, list) and len(charge) == 2):
        raise InputError(f"{where}: start.charge must be [low, high] within [0, 1]")
    low, high = (number(value, f"{where}: start.charge", 0, 1) for value in charge)
    if low > high:
        raise InputError(f"{where}: start.charge must be [low, high] within [0, 1]")
    most = (
        factor * number(start.get(key, 0.0), f"{where}: start.{key}", 0, 360)
        for key, factor in START.items()
    )
    deviation = number(ground.get("deviation", 0.0), f"{where}: floor.deviation", 0, LARGEST)
    length = number(ground.get("length_m", 0.5), f"{where}: floor.length_m", 0.01, 100)
    along, offset, heading = most
    return Population(name, varied, (low, high), (along, offset, heading), (deviation, length))


def _varied(where: str, key: str, entry: Any) -> Varied:
    """One line of `[vary]`."""
    at = f"{where}: {short(key)}"
    paths, declared, factors = [], [], []
    for path in key.split(","):
        inside, found, factor = locate(where, path.strip())
        paths.append(inside)
        declared.append(found)
        factors.append(factor)
    if not isinstance(entry, dict) or not entry or set(entry) - set(KINDS):
        raise InputError(f"{at} must be a table of {', '.join(KINDS)}")
    if len({"low", "high"} & set(entry)) == 1 or ("low" in entry and len(entry) > 2):
        raise InputError(f"{at} needs low and high together, and nothing beside them")
    factor = factors[0]
    ends = None
    if "low" in entry:
        bounds = (declared[0].low / factor, declared[0].high / factor)
        low, high = (number(entry[end], f"{at}.{end}", *bounds) for end in ("low", "high"))
        ends = (factor * low, factor * high)
    within = number(entry.get("within", 0.0), f"{at}.within", 0, 1)
    plus = factor * number(entry.get("plus", 0.0), f"{at}.plus", 0, 1e6)
    return Varied(tuple(paths), tuple(declared), within, plus, ends)


def locate(where: str, path: str) -> tuple[str, Declaration, float]:
    """The path inside, declaration and unit factor of a parameter, by its name in files."""
    from countersteer.car.parameter import EDGE

    part: Any = Car()
    *rooms, key = path.split(".")
    for room in rooms:
        part = getattr(part, room, None)
        if not dataclasses.is_dataclass(part):
            raise InputError(
                f"{where}: unknown parameter {short(path)} ('list parameters' has them all)"
            )
    known = declarations(type(part))
    if key not in known or known[key][1].choices:
        raise InputError(
            f"{where}: unknown parameter {short(path)} ('list parameters' has them all)"
        )
    name, declared = known[key]
    return ".".join([*rooms, name]), declared, EDGE[declared.unit][1]


def draw(
    population: Population,
    car: Car,
    course: Course | None,
    seeds: Sequence[int],
    dtype: Any,
    speeds: tuple[float, float] | None = None,
) -> Drawn:
    """Draw a car, charge, start, speed and floor for each seed, around a nominal car."""
    count = len(population.varied) + 5
    even = np.array([np.random.default_rng(seed).uniform(-1, 1, count) for seed in seeds])
    for i, entry in enumerate(population.varied):
        for path, declared in zip(entry.paths, entry.declared, strict=True):
            u = even[:, i]
            if entry.ends is not None:
                value = _between(entry.ends, u)
            else:
                nominal = _value(car, path)
                value = nominal * (1 + entry.within * u) + entry.plus * u
            car = changed(car, path, np.clip(value, declared.low, declared.high))
    n = len(seeds)
    cars = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf, dtype), (n,)), car)
    charge = _between(population.charge, even[:, -4])
    speed = None if speeds is None else _between(speeds, even[:, -5])
    pose = np.zeros((n, 3))
    if course is not None:
        along, offset, turned = (
            m * even[:, i] for m, i in zip(population.start, (-3, -2, -1), strict=True)
        )
        x, y, heading = course.start
        pose[:, 0] = x + along * math.cos(heading) - offset * math.sin(heading)
        pose[:, 1] = y + along * math.sin(heading) + offset * math.cos(heading)
        pose[:, 2] = heading + turned
    return Drawn(
        cars, charge.astype(dtype), pose.astype(dtype), speed, _floors(population, seeds, dtype)
    )


def _floors(population: Population, seeds: Sequence[int], dtype: Any) -> Floor | None:
    """A floor for each seed; None if friction is the same everywhere."""
    deviation, length = population.floor
    if deviation == 0:
        return None
    with jax.enable_x64(False):  # 64 bits would draw other numbers

        @jax.jit
        @jax.vmap
        def laid(seed: Scalar) -> Floor:
            key = random_streams.key(random_streams.root(seed), Stream.FLOOR)
            return floor.draw(key, deviation, length)

        drawn = laid(np.asarray(seeds, np.int32))
    cast: Floor = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), drawn)
    return cast


def _between(ends: tuple[float, float], even: Array) -> Array:
    """Map `even` linearly from [-1, 1] to the two ends."""
    return ends[0] + (ends[1] - ends[0]) * (even + 1) / 2


def _value(car: Car, path: str) -> float:
    value: Any = car
    for name in path.split("."):
        value = getattr(value, name)
    return float(value)
