"""What every driver is given and gives back."""

from typing import Any, NamedTuple, Protocol

import jax

from countersteer.car.parameter import Scalar
from countersteer.estimation.estimate import Estimate
from countersteer.world.planar import Command

__all__ = ["Command", "Driver", "Heard", "Observation"]


class Heard(NamedTuple):
    """The last reading of a sensor."""

    value: Scalar
    age: Scalar  # s since it was taken; inf before the first


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


class Driver(Protocol):
    """Made for a course and a nominal car.

    A driver that is a pytree (such as one made with `countersteer.car.parameter.pytree`) is traced
    by JAX: scanned, and batched. Any other object is called from Python, once a control period.
    A memory may have a field `turn`: how many turns were begun; the record marks turns by it.
    """

    def reset(self, key: jax.Array) -> Any:
        """The memory at the start of a drive."""
        ...

    def act(self, memory: Any, observation: Observation) -> tuple[Command, Any]:
        """The command for the next control period, and the memory after it."""
        ...
