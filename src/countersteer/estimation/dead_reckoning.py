"""Dead reckoning: gyroscope, accelerometer and wheel encoder, integrated from a known start."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.estimation.estimate import Estimate
from countersteer.signals import Command, Readings, Scalar

ROLLING = 1.0  # yaw rate (rad/s) below which the wheels count as rolling, and give the speed
TRUST = 0.25  # part of the difference to the wheel speed that a report corrects
FADE = 0.3  # s, time constant of the sideways speed's decay while the wheels roll


class ReckoningMemory(NamedTuple):
    """The estimate, and the ticks of the reports that are already in it."""

    estimate: Estimate
    gyroscope: Scalar
    accelerometer: Scalar
    encoder: Scalar


def initial_memory(pose: tuple[float, float, float], dtype: np.dtype) -> ReckoningMemory:
    """At rest at a known pose."""
    x, y, heading, zero = (jnp.asarray(value, dtype) for value in (*pose, 0.0))
    estimate = Estimate(x, y, heading, zero, zero, zero)
    none = np.int32(0)
    return ReckoningMemory(estimate, none, none, none)


def update(memory: ReckoningMemory, readings: Readings, dt: float) -> ReckoningMemory:
    """The memory after the new readings.

    dvx/dt = ax + r vy and dvy/dt = ay - r vx are integrated between reports of the accelerometer,
    the yaw rate r between reports of the gyroscope. While the car hardly turns, the wheel speed
    corrects vx, and vy decays.
    """
    old = memory.estimate
    turned = jnp.maximum(readings.gyroscope.tick - memory.gyroscope, 0) * dt
    rate = jnp.where(readings.gyroscope.tick > 0, readings.gyroscope.value, 0.0)
    moved = jnp.maximum(readings.accel_x.tick - memory.accelerometer, 0) * dt
    rolls = jnp.abs(rate) < ROLLING
    vx = old.vx + moved * (readings.accel_x.value + rate * old.vy)
    vy = old.vy + moved * (readings.accel_y.value - rate * old.vx)
    vy = jnp.where(rolls, vy * jnp.exp(-moved / FADE), vy)
    counted = rolls & (readings.wheel_speed.tick > memory.encoder)
    wheel = readings.wheel_speed.value * jnp.where(vx < -0.2, -1.0, 1.0)
    vx = vx + jnp.where(counted, TRUST * (wheel - vx), 0.0)
    heading = old.heading + turned * rate
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    estimate = Estimate(
        old.x + moved * (cosine * vx - sine * vy),
        old.y + moved * (sine * vx + cosine * vy),
        heading,
        vx,
        vy,
        rate,
    )
    return ReckoningMemory(
        estimate,
        jnp.maximum(readings.gyroscope.tick, memory.gyroscope),
        jnp.maximum(readings.accel_x.tick, memory.accelerometer),
        jnp.maximum(readings.wheel_speed.tick, memory.encoder),
    )


@pytree
class DeadReckoning:
    """Dead reckoning as an `Estimator`, from a known start."""

    start: tuple[Scalar, Scalar, Scalar]  # x, y, heading
    dt: float = dataclasses.field(metadata={"static": True})
    name = "reckoning"
    takes_truth = False
    period = 0.0

    def init(self, key: jax.Array) -> ReckoningMemory:
        """At rest at the start."""
        del key
        return initial_memory(self.start, jnp.result_type(self.start[0]))

    def update(
        self, memory: ReckoningMemory, readings: Readings, command: Command, tick: Scalar
    ) -> ReckoningMemory:
        """The memory after the new readings."""
        del command, tick
        return update(memory, readings, self.dt)

    def estimate(self, memory: ReckoningMemory) -> Estimate:
        """The estimate after the last update."""
        return memory.estimate
