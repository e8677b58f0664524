"""The interface of drivers: an `Observation` in, a `Command` out."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from countersteer.clock import shared
from countersteer.estimation.estimate import Estimate
from countersteer.signals import AnyCommand, Command, Scalar

ROUNDING = 2e-5  # s, rounding error of a time in 32 bits
THINKS = 0.005  # s between two decisions of a driver; gyroscope and estimate are as frequent


class Heard(NamedTuple):
    """The last reading of a sensor."""

    value: Scalar
    age: Scalar  # s since it was taken; inf before the first

    def came(self, within: Scalar) -> Scalar:
        """Whether it was taken less than `within` seconds ago; False at exactly `within`."""
        return self.age < within - ROUNDING


class Observation(NamedTuple):
    """All that a driver knows. SI units and radians."""

    time: Scalar  # s since the start
    sonar: tuple[Heard, ...]  # m, in the order of the car's mounts; inf: no echo
    encoder_counts: Heard  # regions passed, in either direction
    wheel_speed: Heard  # m/s, never negative
    gyroscope: Heard  # rad/s
    accel_x: Heard  # m/s²
    accel_y: Heard
    battery: Heard  # V
    line_crossings: Heard | None  # lines entered; None: the car has no line detector
    line_speed: Heard | None  # m/s, never negative
    lidar: Heard | None  # (beams,), m, from right to left; inf: no echo; None: the car has none
    position_x: Heard | None  # m, in the world's axes; None: the car has no such sensor
    position_y: Heard | None
    position_heading: Heard | None  # rad, in ±pi; None: the sensor reports none
    estimate: Estimate


class Status(NamedTuple):
    """What a driver reports about itself, for records and pages. The judge does not rely on it."""

    turn: Scalar = 0  # turns that it has begun
    phase: Scalar = 0  # of the turn: an index into the driver's `phases`; 0: none
    offset: Scalar = math.nan  # estimated, left of the corridor's middle, m
    angle: Scalar = math.nan  # estimated, to the corridor, rad
    offset_deviation: Scalar = math.inf  # standard deviation, m; inf: unknown
    angle_deviation: Scalar = math.inf  # rad
    doubts: Scalar = 0  # front sonar readings in a row that it takes for spikes


class Driver(Protocol):
    """A driver, made for a course and a nominal car.

    JAX traces, scans and batches a driver that is a pytree, such as one made with
    `countersteer.car.parameter.pytree`. Any other object is called from Python, once a control
    period. Its optional `period` (s, default 0.005) is the least time between two calls.
    Its optional method `status(memory)` returns a `Status`.
    """

    def reset(self, key: jax.Array) -> Any:
        """The memory at the start of a drive."""
        ...

    def act(self, memory: Any, observation: Observation) -> tuple[AnyCommand, Any]:
        """The command for the next control period, and the memory after it."""
        ...


def status_of(driver: Any, memory: Any) -> Status:
    """The driver's status; the default `Status` if it has no method `status`."""
    found: Status = driver.status(memory) if hasattr(driver, "status") else Status()
    return found


def paced(
    think: Callable[[Any, Observation], tuple[Command, Any]],
    memory: Any,
    seen: Observation,
    period: float = THINKS,
) -> tuple[Command, Any]:
    """Call `think` once a `period` (s), and repeat its last command in between.

    The memory has the fields `time`, of the last call, and `command`, its result.
    """

    def typed(memory: Any, seen: Observation) -> tuple[Command, Any]:
        return jax.tree.map(
            lambda new, old: jnp.asarray(new, jnp.result_type(old)),
            think(memory, seen),
            (memory.command, memory),
        )

    due = shared(seen.time - memory.time > period - ROUNDING)
    held: tuple[Command, Any] = jax.lax.cond(
        due, typed, lambda same, _: (same.command, same), memory, seen
    )
    return held
