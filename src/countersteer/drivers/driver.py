"""What every driver is given and gives back."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from countersteer.estimation.estimate import Estimate
from countersteer.signals import Command, Scalar

ROUNDING = 2e-5  # s, of a time in 32 bits
THINKS = 0.005  # s between two thoughts of a driver: as often as gyroscope and estimate have news


class Heard(NamedTuple):
    """The last reading of a sensor."""

    value: Scalar
    age: Scalar  # s since it was taken; inf before the first

    def came(self, within: Scalar) -> Scalar:
        """Whether it was taken in the last so many seconds, the beginning not counted."""
        return self.age < within - ROUNDING


class Observation(NamedTuple):
    """All that a driver knows. SI units and radians."""

    time: Scalar  # s since the start
    sonar: tuple[Heard, ...]  # m, in the order of the car's mounts; inf: no echo
    encoder_counts: Heard  # regions passed, blind to direction
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
    position_heading: Heard | None  # rad, in ±pi; None: the sensor tells none
    estimate: Estimate


class Status(NamedTuple):
    """What a driver says it is about, for records and pages. Nothing is judged by it."""

    turn: Scalar = 0  # turns that it has handed over to
    phase: Scalar = 0  # of the turn, as the driver's `phases` name them; 0: none
    offset: Scalar = math.nan  # left of its corridor's middle, as it believes, m
    angle: Scalar = math.nan  # to the corridor, rad
    offset_deviation: Scalar = math.inf  # of the two, as far as it says
    angle_deviation: Scalar = math.inf
    doubts: Scalar = 0  # readings in a row of the front sonar that it holds for spikes


class Driver(Protocol):
    """Made for a course and a nominal car.

    A driver that is a pytree (such as one made with `countersteer.car.parameter.pytree`) is traced
    by JAX: scanned, and batched. Any other object is called from Python, once a control period;
    it may have a `period` (s), or else decides 200 times a second at most.
    It may have `status(memory)`, which gives a `Status`: what it is about.
    """

    def reset(self, key: jax.Array) -> Any:
        """The memory at the start of a drive."""
        ...

    def act(self, memory: Any, observation: Observation) -> tuple[Command, Any]:
        """The command for the next control period, and the memory after it."""
        ...


def status_of(driver: Any, memory: Any) -> Status:
    """What the driver says it is about; nothing where it says none."""
    found: Status = driver.status(memory) if hasattr(driver, "status") else Status()
    return found


def paced(
    think: Callable[[Any, Observation], tuple[Command, Any]],
    memory: Any,
    seen: Observation,
    period: float = THINKS,
) -> tuple[Command, Any]:
    """Thinks when it is time to, and asks for the same as before in between.

    The memory has a `time`, that of the last thought, and the `command` that came of it.
    """

    def typed(memory: Any, seen: Observation) -> tuple[Command, Any]:
        return jax.tree.map(
            lambda new, old: jnp.asarray(new, jnp.result_type(old)),
            think(memory, seen),
            (memory.command, memory),
        )

    due = seen.time - memory.time > period - ROUNDING
    held: tuple[Command, Any] = jax.lax.cond(
        due, typed, lambda same, _: (same.command, same), memory, seen
    )
    return held
