"""A lidar in a corridor: offset, angle, and the distance of the corner from its beams."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Lidar
from countersteer.estimation.kalman import Covariance, correct
from countersteer.sensing.lidar import bearings
from countersteer.signals import Array, Scalar

NEAR = 0.15  # m from a wall's expected place, within which a beam is of that wall
AHEAD = math.radians(8)  # from the corridor's direction, within which beams look at the wall ahead
ALIKE = 4.0  # beams that share one error, as walls are not exactly straight
FEWEST = 5  # beams of a measurement, at least


class Seen(NamedTuple):
    """The end of each beam in the corridor's axes: (beams,) m, from the car."""

    along: Array
    aside: Array
    valid: Array


def seen(part: Lidar, ranges: Array, angle: Scalar) -> Seen:
    """The ends of the beams of a scan. `angle` is that of the car to the corridor (rad)."""
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
    """The wall filter's mean and covariance after a scan, and whether it was accepted.

    The scan corrects offset and angle, the first two states. A beam that ends at (l, s) on a side's
    wall differs by e = side w/2 - (offset + s). The angle changes e by l per radian. The mean of e
    and the slope of e over l are independent, so two measurements stand for all beams.
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

    That wall is w/2 from the corner, which is at a distance c. So sin|a| (l - c) - cos a s = w/2
    for a beam that ends on it. l is along the corridor from the car, s from the corridor's middle
    to the turn's hand. `error` and `offset` are the car's angle and offset in the corridor.
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
