"""A neural network that PPO taught: the estimate and the way ahead in, a command out.

It is a multilayer perceptron with tanh units, learned by `learn ppo`. It decides every
`PERIOD`. Its inputs are `features`. Its file is one of `drivers.stored`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.way import Way, start_of, way_of
from countersteer.drivers import stored
from countersteer.drivers.driver import Observation, paced
from countersteer.errors import InputError
from countersteer.reading.values import short, shown
from countersteer.signals import Array, Command, Scalar

KIND = "ppo"
FORMAT = 1
PERIOD = 0.02  # s between two decisions
BACK = (1, 2, 3, 4, 6, 8, 11, 16)  # decisions before, of which it is told command and motion:
PAST = max(BACK)  # from these it can guess grip and servo. So many decisions are kept.
AHEAD = (0.3, 0.7, 1.2, 1.8, 2.6)  # m along the way, at which it is told the way's points
SPEED, RATE = 3.0, 6.0  # m/s and rad/s that count as 1
FAR = 10.0  # no input is beyond
FEATURES = 6 + 2 * len(AHEAD) + 5 * len(BACK)
MOST_UNITS = 4096


class Layer(NamedTuple):
    """y = x · weight + bias."""

    weight: Array  # (inputs, outputs)
    bias: Array  # (outputs,)


class Sight(NamedTuple):
    """What the network is told of the car's motion: SI units and radians."""

    x: Scalar
    y: Scalar
    heading: Scalar
    vx: Scalar
    vy: Scalar
    yaw_rate: Scalar


class Past(NamedTuple):
    """What was at the decisions before: arrays (PAST,), the newest last."""

    throttle: Array  # in ±1
    steering: Array  # in ±1
    vx: Array
    vy: Array
    yaw_rate: Array

    @classmethod
    def none(cls, dtype: Any) -> "Past":
        """Before the first decision."""
        return cls(*[np.zeros(PAST, dtype)] * len(cls._fields))

    def then(self, given: Command, seen: Sight) -> "Past":
        """The past after a decision, given what was seen at it. Commands are in ±1."""
        now = (given.throttle, given.steering, seen.vx, seen.vy, seen.yaw_rate)
        return Past(*(jnp.append(line[1:], new) for line, new in zip(self, now, strict=True)))


def features(way: Way, place: Scalar, seen: Sight, past: Past) -> Array:
    """The network's inputs (FEATURES,), each about 1 in size.

    Speeds, yaw rate; offset left of the way (m); sine and cosine of the heading off it; points of
    the way ahead in the car's axes, over their distance; the past, a quantity after the other.
    """
    row = way.row(place)
    along_x, along_y = way.along_x[row], way.along_y[row]
    cosine, sine = jnp.cos(seen.heading), jnp.sin(seen.heading)
    offset = along_x * (seen.y - way.y[row]) - along_y * (seen.x - way.x[row])
    parts = [
        seen.vx / SPEED,
        seen.vy / SPEED,
        seen.yaw_rate / RATE,
        offset,
        along_x * sine - along_y * cosine,
        along_x * cosine + along_y * sine,
    ]
    for distance in AHEAD:
        x, y = way.point(place + distance)
        x, y = x - seen.x, y - seen.y
        parts += [(cosine * x + sine * y) / distance, (cosine * y - sine * x) / distance]
    sizes = (1.0, 1.0, SPEED, SPEED, RATE)
    for line, size in zip(past, sizes, strict=True):
        parts += [line[-back] / size for back in BACK]
    return jnp.clip(jnp.stack(parts), -FAR, FAR)


def network(layers: tuple[Layer, ...], inputs: Array) -> Array:
    """The outputs of a perceptron with tanh units and a linear last layer."""
    *hidden, last = layers
    for layer in hidden:
        inputs = jnp.tanh(inputs @ layer.weight + layer.bias)
    return inputs @ last.weight + last.bias


class NetworkMemory(NamedTuple):
    """Place on the way, the past, and the last command."""

    time: Scalar  # s
    command: Command
    place: Scalar  # m along the way
    past: Past


@pytree
class NetworkDriver:
    """Drives by a network, on any estimate with a pose."""

    way: Way
    place: Scalar  # of the start along the way, m
    layers: tuple[Layer, ...]  # from `FEATURES` to throttle and steering in ±1
    lock: Scalar  # rad, full steering

    def reset(self, key: jax.Array) -> NetworkMemory:
        """At the start, without a command."""
        del key
        none = Past.none(np.result_type(self.layers[0].weight))
        return NetworkMemory(-1.0, Command(0.0, 0.0), self.place, none)

    def act(self, memory: NetworkMemory, observation: Observation) -> tuple[Command, NetworkMemory]:
        """One control period."""
        return paced(self._think, memory, observation, PERIOD)

    def _think(self, memory: NetworkMemory, seen: Observation) -> tuple[Command, NetworkMemory]:
        known = seen.estimate
        place = self.way.follow(known.x, known.y, memory.place)
        sight = Sight(known.x, known.y, known.heading, known.vx, known.vy, known.yaw_rate)
        out = jnp.clip(network(self.layers, features(self.way, place, sight, memory.past)), -1, 1)
        given = Command(out[0], out[1])
        command = Command(given.throttle, self.lock * given.steering)
        return command, NetworkMemory(seen.time, command, place, memory.past.then(given, sight))


def full_lock(car: Car) -> float:
    """The steering angle (rad) that counts as full."""
    return min(float(car.servo.limit_left), float(car.servo.limit_right))


def network_driver(course: Course, car: Car, layers: tuple[Layer, ...]) -> NetworkDriver:
    """The driver for a course with a centre line and the nominal car. Raises `InputError`."""
    way = way_of(course)
    return NetworkDriver(way=way, place=start_of(course, way), layers=layers, lock=full_lock(car))


def network_file(layers: tuple[Layer, ...], about: Mapping[str, Any]) -> bytes:
    """The content of a network's file: `about` tells course, car and where it is from."""
    told = {"kind": KIND, "format": FORMAT, "features": FEATURES, **about}
    found: dict[str, Any] = {}
    for i, layer in enumerate(layers):
        found |= {f"weight_{i}": np.asarray(layer.weight), f"bias_{i}": np.asarray(layer.bias)}
    return stored.packed(found, told)


def read_network(path: Path) -> tuple[tuple[Layer, ...], dict[str, Any]]:
    """The layers in a file, and what it says about itself. Raises `InputError` in one line."""
    where = short(str(path))
    held, about = stored.read(path, KIND)
    if about.get("format") != FORMAT or about.get("features") != FEATURES:
        raise InputError(
            f"{where}: is of another version (format {shown(about.get('format'))}, "
            f"{shown(about.get('features'))} features): learn it again with 'learn ppo'"
        )
    layers: list[Layer] = []
    width = FEATURES
    while len(layers) < len(held) // 2:
        try:
            layer = Layer(held[f"weight_{len(layers)}"], held[f"bias_{len(layers)}"])
        except KeyError as error:
            raise InputError(f"{where}: {error.args[0]} is missing") from None
        shape = layer.weight.shape
        fits = len(shape) == 2 and shape[0] == width and layer.bias.shape == (shape[1],)
        real = layer.weight.dtype.kind == layer.bias.dtype.kind == "f"
        if not fits or not 0 < shape[1] <= MOST_UNITS or not real:
            raise InputError(f"{where}: layer {len(layers)} does not fit the one before it")
        if not all(bool(np.all(np.isfinite(part))) for part in layer):
            raise InputError(f"{where}: layer {len(layers)} holds numbers that are not finite")
        layers.append(Layer(layer.weight.astype(np.float32), layer.bias.astype(np.float32)))
        width = shape[1]
    if not layers or width != 2:
        raise InputError(f"{where}: its last layer has {width} outputs, not throttle and steering")
    return tuple(layers), about
