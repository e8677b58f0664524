"""Steering: from the angle asked for to where each front wheel points."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Body, Servo
from countersteer.signals import Scalar
from countersteer.world.angle import cosine_sine


def target(servo: Servo, asked: Scalar) -> Scalar:
    """The angle that the linkage settles at: gain and limit by side, then the trim (rad).

    softness blends clip(gain a, limit) into limit · tanh(gain a / limit).
    """
    left = asked >= 0
    gained = jnp.where(left, servo.gain_left, servo.gain_right) * asked
    limit = jnp.where(left, servo.limit_left, servo.limit_right)
    hard = jnp.clip(gained, -limit, limit)
    return (
        (1 - servo.softness) * hard
        + servo.softness * limit * jnp.tanh(gained / limit)
        + (servo.trim)
    )


def turn(servo: Servo, steering: Scalar, goal: Scalar, h: Scalar) -> Scalar:
    """The angle after h seconds on the way to `goal`: first-order lag, limited rate (rad)."""
    step = (goal - steering) * -jnp.expm1(-h / servo.lag)
    return steering + jnp.clip(step, -servo.rate * h, servo.rate * h)


def directions(
    body: Body, servo: Servo, steering: Scalar
) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
    """(cosine, sine) of the angle of the left and of the right front wheel.

    Ackermann's condition is cot(right) - cot(left) = track / wheelbase; a share of it is
    tan(side) = t / (1 -+ share t track / (2 wheelbase)) with t = tan(steering).
    """
    cosine, sine = cosine_sine(steering)
    tangent = sine / cosine
    spread = servo.ackermann * tangent * body.track / (2 * body.wheelbase)

    def direction(t: Scalar) -> tuple[Scalar, Scalar]:
        cosine = jax.lax.rsqrt(1 + t**2)
        return cosine, t * cosine

    return direction(tangent / (1 - spread)), direction(tangent / (1 + spread))
