"""What the velocity filter holds between two steps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.estimation import kalman, steering
from countersteer.estimation.battery import Pack
from countersteer.estimation.kalman import Covariance, Row
from countersteer.estimation.single_track import Actuators
from countersteer.estimation.velocity.soundness import Senses
from countersteer.signals import Scalar
from countersteer.world.chassis import Vector

# The states. The last two are there only if the car has a position sensor.
VX, VY, RATE, HEADING, GYRO, AX, AY, ROLLED, X, Y = range(10)


class Belief(NamedTuple):
    """Mean and covariance of the states.

    vx, vy (m/s), yaw rate (rad/s), heading (rad), the biases of gyroscope (rad/s) and
    accelerometer (m/s²), the way rolled since the last encoder count (m), and x, y (m).
    """

    mean: tuple[Scalar, ...]
    covariance: Covariance

    def correct(
        self, row: Row, residual: Scalar, noise: Scalar, valid: Scalar, gate: float
    ) -> tuple["Belief", Scalar]:
        """After one scalar measurement, and whether it was accepted; see `kalman.correct`."""
        mean, covariance, accepted = kalman.correct(
            self.mean, self.covariance, row, residual, noise, valid, gate
        )
        return Belief(mean, covariance), accepted

    def replace(self, values: dict[int, Scalar]) -> "Belief":
        """The same with other means of some states."""
        return self._replace(mean=tuple(values.get(i, old) for i, old in enumerate(self.mean)))


class VelocityMemory(NamedTuple):
    """The filter between two steps.

    Yaw rate and heading are those of `tick`. Velocity, accelerometer biases and `ROLLED` are those
    of `settled`; `ahead` carries the velocity on from there to `tick`.
    """

    belief: Belief
    tick: Scalar
    settled: Scalar  # tick of the last accelerometer reading
    settled_heading: Scalar
    ahead: Vector  # velocity at `tick`
    x: Scalar
    y: Scalar
    accel_x: Scalar  # smoothed, m/s²
    accel_y: Scalar
    yaw_acceleration: Scalar  # smoothed, rad/s²
    friction: Scalar  # of the rear axle, over the nominal
    friction_variance: Scalar
    pack: Pack
    servo: steering.Servo
    actuators: Actuators
    senses: Senses
    lost: Scalar  # encoder reports in a row that were rejected


def seconds(ticks: Scalar, dt: float, memory: VelocityMemory) -> Scalar:
    """So many ticks as a time, in the memory's precision."""
    time: jax.Array = (ticks * dt).astype(jnp.result_type(memory.x))
    return time
