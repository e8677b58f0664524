"""Error models of encoder, gyroscope, accelerometer, voltmeter, position and line detector."""

import jax
import jax.numpy as jnp

from countersteer.car.car import (
    Accelerometer,
    Encoder,
    Gyroscope,
    LineDetector,
    Position,
    Voltmeter,
)
from countersteer.signals import Scalar, Wheels


def quantised(value: Scalar, step: Scalar) -> Scalar:
    """The value rounded to a multiple of `step`. A step of 0 does not round."""
    return jnp.where(step > 0, jnp.round(value / jnp.maximum(step, 1e-12)) * step, value)


def disc_speed(encoder: Encoder, wheels: Wheels, shaft: Scalar) -> Scalar:
    """Speed of the encoder's disc, on a wheel or the shaft (rad/s)."""
    if encoder.on == "shaft":
        return shaft
    return wheels[("front-left", "front-right", "rear-left", "rear-right").index(encoder.on)]


def regions_per_second(encoder: Encoder, speed: Scalar) -> Scalar:
    """Black and white regions that pass the eye per second, at a disc's speed (rad/s)."""
    return speed * encoder.regions / jnp.pi


def wheel_speed(encoder: Encoder, radius: Scalar, counts: Scalar, time: Scalar) -> Scalar:
    """Wheel speed (m/s), at least 0, from regions counted over a time. Step: pi R / (N time)."""
    return counts * jnp.pi / encoder.regions * radius / time


def gyroscope(part: Gyroscope, yaw_rate: Scalar, noise: Scalar) -> Scalar:
    """A reading (rad/s), given a standard normal `noise`: biased, noisy, saturated, quantised."""
    read = jnp.clip(yaw_rate + part.bias + part.noise * noise, -part.reach, part.reach)
    return quantised(read, part.resolution)


def accelerometer(
    part: Accelerometer, ax: Scalar, ay: Scalar, noise: jax.Array
) -> tuple[Scalar, Scalar]:
    """Readings forward and left (m/s²), given two standard normal numbers."""
    x = jnp.clip(ax + part.bias_x + part.noise * noise[0], -part.reach, part.reach)
    y = jnp.clip(ay + part.bias_y + part.noise * noise[1], -part.reach, part.reach)
    return quantised(x, part.resolution), quantised(y, part.resolution)


def voltmeter(part: Voltmeter, voltage: Scalar, noise: Scalar) -> Scalar:
    """A reading (V), given a standard normal number."""
    return quantised(voltage + part.noise * noise, part.resolution)


def position(part: Position, pose: jax.Array, noise: jax.Array) -> tuple[Scalar, Scalar, Scalar]:
    """Readings of x, y (m) and heading (rad, in ±pi), given three standard normal numbers."""
    heading = pose[2] + part.heading_noise * noise[2]
    turns = jnp.round(heading / (2 * jnp.pi))
    return (
        pose[0] + part.noise * noise[0],
        pose[1] + part.noise * noise[1],
        heading - 2 * jnp.pi * turns,
    )


def eye(part: LineDetector, x: Scalar, heading: Scalar) -> Scalar:
    """Position (m) of the eye along the world's x axis, for a car at x with this heading."""
    return x + part.x * jnp.cos(heading)


def lines_entered(part: LineDetector, before: Scalar, now: Scalar) -> Scalar:
    """Number of lines that the eye enters between two positions (m).

    It enters a line at the edge that it meets first. If it turns back on a line, it enters none.
    """
    edge = jnp.where(now > before, 0.5, -0.5) * part.width
    cells = [jnp.floor((place + edge) / part.spacing) for place in (before, now)]
    return jnp.abs(cells[1] - cells[0])
