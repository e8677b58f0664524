"""The rigid body: loads of its wheels, and the linear algebra of its three velocities."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import GRAVITY, Body
from countersteer.signals import Scalar, Wheels


class Vector(NamedTuple):
    """A vector over the body's three degrees of freedom: forward, left, yaw."""

    x: Scalar
    y: Scalar
    yaw: Scalar


NONE = Vector(0.0, 0.0, 0.0)


def times(*factors: Scalar) -> Scalar:
    """The product. It is 0.0 without computation if a factor is Python's 0.0.

    Wheel directions hold such zeros. The compiler cannot drop 0 · x, since x may be NaN.
    """
    if any(isinstance(factor, float) and factor == 0 for factor in factors):
        return 0.0
    return math.prod(factors)


class Symmetric(NamedTuple):
    """A symmetric 3 x 3 matrix over the body's degrees of freedom x, y and w (yaw)."""

    xx: Scalar
    yy: Scalar
    ww: Scalar
    xy: Scalar
    xw: Scalar
    yw: Scalar

    def plus(self, weight: Scalar, a: Vector) -> "Symmetric":
        """The matrix plus weight · a aᵀ."""
        return Symmetric(
            self.xx + times(weight, a.x, a.x),
            self.yy + times(weight, a.y, a.y),
            self.ww + times(weight, a.yaw, a.yaw),
            self.xy + times(weight, a.x, a.y),
            self.xw + times(weight, a.x, a.yaw),
            self.yw + times(weight, a.y, a.yaw),
        )

    def plus_mixed(self, weight: Scalar, a: Vector, b: Vector) -> "Symmetric":
        """The matrix plus weight · (a bᵀ + b aᵀ)."""
        return Symmetric(
            self.xx + times(2, weight, a.x, b.x),
            self.yy + times(2, weight, a.y, b.y),
            self.ww + times(2, weight, a.yaw, b.yaw),
            self.xy + times(weight, times(a.x, b.y) + times(a.y, b.x)),
            self.xw + times(weight, times(a.x, b.yaw) + times(a.yaw, b.x)),
            self.yw + times(weight, times(a.y, b.yaw) + times(a.yaw, b.y)),
        )


def dot(a: Vector, b: Vector) -> Scalar:
    """Scalar product."""
    return times(a.x, b.x) + times(a.y, b.y) + times(a.yaw, b.yaw)


def combine(weight_a: Scalar, a: Vector, weight_b: Scalar, b: Vector) -> Vector:
    """weight_a · a + weight_b · b."""
    return Vector(
        times(weight_a, a.x) + times(weight_b, b.x),
        times(weight_a, a.y) + times(weight_b, b.y),
        times(weight_a, a.yaw) + times(weight_b, b.yaw),
    )


def solve(m: Symmetric, b: Vector, least: Vector = NONE) -> Vector:
    """The solution of m v = b for a positive definite m, by its LDLᵀ factors.

    If m is a diagonal plus squares, no factor is below that diagonal, `least`. Without it, rounding
    could bring one to 0: contacts can be a million times as stiff as the body is heavy.
    """
    by_x = 1 / m.xx
    l_yx, l_wx = m.xy * by_x, m.xw * by_x
    by_y = 1 / _at_least(least.y, m.yy - l_yx * m.xy)
    yw = m.yw - l_yx * m.xw
    l_wy = yw * by_y
    d_w = _at_least(least.yaw, m.ww - l_wx * m.xw - l_wy * yw)
    z_y = b.y - l_yx * b.x
    yaw = (b.yaw - l_wx * b.x - l_wy * z_y) / d_w
    y = z_y * by_y - l_wy * yaw
    return Vector(b.x * by_x - l_yx * y - l_wx * yaw, y, yaw)


def _at_least(least: Scalar, value: Scalar) -> Scalar:
    # Not `maximum`: where the two are equal, it halves the derivative.
    return jnp.where(value < least, least, value)


def wheel_loads(body: Body, ax: Scalar, ay: Scalar) -> Wheels:
    """Load on each wheel (N) at an acceleration of ax forward and ay left (m/s²).

    With the centre of mass at height h, m h ax / wheelbase moves from front to rear, and
    m h ay / track from left to right. The front axle takes the part `front_roll_share` of the
    latter. If a wheel has no load left, the other axle takes over. So the loads are never
    negative, and their sum is always the weight.
    """
    weight = body.mass * GRAVITY
    behind = body.wheelbase - body.front_axle
    front = (weight * behind - body.mass * body.cm_height * ax) / body.wheelbase
    front = jnp.clip(front, 0.0, weight)
    rear = weight - front
    # A track of zero is a single-track car: no load moves between left and right.
    track = jnp.where(body.track > 0, body.track, 1.0)
    aside = jnp.where(body.track > 0, body.mass * body.cm_height * ay / track, 0.0)
    to_front = jnp.clip(body.front_roll_share * aside, -front / 2, front / 2)
    to_rear = jnp.clip(aside - to_front, -rear / 2, rear / 2)
    to_front = jnp.clip(aside - to_rear, -front / 2, front / 2)
    return Wheels(
        front / 2 - to_front, front / 2 + to_front, rear / 2 - to_rear, rear / 2 + to_rear
    )


def pair_in_air(loads: Wheels) -> Scalar:
    """1 if both wheels of a side or of an axle have no load, else 0."""
    fl, fr, rl, rr = (load <= 0 for load in loads)
    return jnp.where((fl & rl) | (fr & rr) | (fl & fr) | (rl & rr), 1.0, 0.0)
