"""Steering: from the commanded angle to the direction of each front wheel."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Body, Servo
from countersteer.signals import Scalar
from countersteer.world.angle import cosine_sine


def target(servo: Servo, asked: Scalar) -> Scalar:
    """Steady-state steering angle (rad) of a command: gain and limit of its side, then the trim.

    `softness` blends clip(gain a, limit) into limit · tanh(gain a / limit).
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
    """Steering angle (rad) after h seconds towards `goal`: first-order lag, limited rate."""
    step = (goal - steering) * -jnp.expm1(-h / servo.lag)
    return steering + jnp.clip(step, -servo.rate * h, servo.rate * h)


def directions(
    body: Body, servo: Servo, steering: Scalar
) -> tuple[tuple[Scalar, Scalar], tuple[Scalar, Scalar]]:
    """(cosine, sine) of the angle of the left and of the right front wheel.

    Ackermann's condition is cot(right) - cot(left) = track / wheelbase. A share of it is
    tan(side) = t / (1 -+ share t track / (2 wheelbase)), with t = tan(steering) and - for left.
    """
    cosine, sine = cosine_sine(steering)
    spread = servo.ackermann * sine * body.track / (2 * body.wheelbase)

    def direction(ahead: Scalar) -> tuple[Scalar, Scalar]:
        length = jax.lax.rsqrt(ahead**2 + sine**2)
        return ahead * length, sine * length

    return direction(cosine - spread), direction(cosine + spread)
