"""What a lidar's beams tell of the corridor: offset, angle, and the distance of the corner."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Lidar
from countersteer.estimation.kalman import Covariance, correct
from countersteer.sensing.lidar import bearings
from countersteer.signals import Array, Scalar

NEAR = 0.15  # m from where a wall is believed to be within which a beam is of it
AHEAD = math.radians(8)  # from the corridor's direction within which beams look at the wall ahead
ALIKE = 4.0  # beams whose errors hang together, as walls are not as straight as lines
FEWEST = 5  # beams that tell anything


class Seen(NamedTuple):
    """Where each beam ends in the corridor's axes: (beams,) m, from the car."""

    along: Array
    aside: Array
    valid: Array


def seen(part: Lidar, ranges: Array, angle: Scalar) -> Seen:
    """`angle` is the car's to the corridor."""
    valid = jnp.isfinite(ranges)
    away = jnp.where(valid, ranges, 0.0)
    bearing = bearings(part) + angle
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return Seen(
        part.x * cosine - part.y * sine + away * jnp.cos(bearing),
        part.x * sine + part.y * cosine + away * jnp.sin(bearing),
        valid,
    )


def line_up(
    part: Lidar,
    width: Scalar,
    mean: tuple[Scalar, ...],
    covariance: Covariance,
    ranges: Array,
    fresh: Scalar,
    gate: float,
) -> tuple[tuple[Scalar, ...], Covariance, Scalar]:
    """The wall filter's offset and angle (its first two states) with a scan; and whether taken.

    A beam that ends at (l, s) on the wall of a side is off by e = side w/2 - (offset + s), which
    the angle changes by l a radian. The mean of e, and the slope of e over l, are independent, and
    two measurements do for all beams.
    """
    ends = seen(part, ranges, mean[1])
    side = jnp.sign(ends.aside)
    off = side * width / 2 - (mean[0] + ends.aside)
    spread = jnp.sqrt(covariance[0][0] + covariance[1][0] * ends.along**2)
    on_wall = ends.valid & (jnp.abs(off) < NEAR + 2 * spread) & (jnp.abs(off) < 0.3 * width)
    weight = jnp.where(on_wall, 1.0, 0.0)
    count = jnp.sum(weight) + 1e-6
    middle = jnp.sum(weight * ends.along) / count
    residual = jnp.sum(weight * off) / count
    lever = ends.along - middle
    arm = jnp.sum(weight * lever**2) + 1e-6
    slope = jnp.sum(weight * lever * off) / arm
    accepted = fresh & (count > FEWEST)
    noise = ALIKE * (part.noise**2 + part.resolution**2 / 12 + 1e-8)
    before = mean[1]
    mean, covariance, first = correct(
        mean, covariance, {0: 1.0, 1: middle}, residual, noise / count, accepted, gate
    )
    mean, covariance, second = correct(
        mean, covariance, {1: 1.0}, slope - (mean[1] - before), noise / arm, accepted, gate
    )
    return mean, covariance, first & second


def corner_ahead(
    part: Lidar, width: Scalar, ranges: Array, error: Scalar, offset: Scalar, angle: Scalar
) -> tuple[Scalar, Scalar]:
    """Distance along the corridor to a corner by `angle`, and whether beams see the wall behind it.

    That wall passes the corner at w/2 from it: sin|a| (l - c) - cos a (s to the hand) = w/2.
    """
    ends = seen(part, ranges, error)
    hand, steep = jnp.sign(angle), jnp.maximum(jnp.sin(jnp.abs(angle)), 0.5)
    aside = hand * (offset + ends.aside)
    bearing = jnp.abs(jnp.arctan2(ends.aside, ends.along))
    looks = ends.valid & (bearing < AHEAD) & (jnp.abs(aside) < 0.35 * width)
    weight = jnp.where(looks, 1.0, 0.0)
    count = jnp.sum(weight)
    told = ends.along - (width / 2 + jnp.cos(angle) * aside) / steep
    return jnp.sum(weight * told) / jnp.maximum(count, 1.0), count > 1
