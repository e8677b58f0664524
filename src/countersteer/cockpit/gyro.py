"""The steering gyroscope and the ramps of keys: from what hands do to a command.

Real drift cars steer so: the stick is a target for the yaw rate, and a gyroscope counter-steers.
A key is a stick that is in the middle or at its end. With the axis s in ±1 (left positive), the
yaw rate r, the speed v and the largest angle L of the front wheels:

    target    moves to s · `RATE`, within `RATE_ON` while it grows and `RATE_OFF` while it falls
    limit(v)  = L / (1 + (v / `HALVES`)²)
    steering  = target / `RATE` · limit(v) + strength · `GAIN` · (target − r)

`steering` is limited to ±limit(v) into the turn, and to ±L while it counter-steers, which is while
it points against r. Without the gyroscope, the axis ramps the angle itself to s · limit(v), and to
s · L while it counter-steers. The throttle is ramped likewise to throttle − brake; beyond `SOFT`
it rises slowly, so that a key that is pressed again and again is a throttle in between.

All is in plain scalars. It runs on Python's floats, and JAX can trace it.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.signals import Command, Scalar

RATE = math.radians(195)  # rad/s, target of a full axis
RATE_ON, RATE_OFF = RATE / 0.25, RATE / 0.08  # rad/s²
GAIN = 0.33  # s: rad of steering per rad/s of error
HALVES = 5.5  # m/s, speed at which half of the lock is left
ANGLE_ON, ANGLE_OFF = 1 / 0.30, 1 / 0.15  # of the full angle a second, without the gyroscope
SOFT = 0.57  # throttle that a key gives at once; from there it rises slowly
THROTTLE_ON, THROTTLE_SLOW, THROTTLE_OFF = 1 / 0.20, 1 / 1.3, 1 / 0.10  # 1/s


class Hands(NamedTuple):
    """What the hands do."""

    steer: Scalar = 0.0  # -1 to 1, positive to the left
    throttle: Scalar = 0.0  # 0 to 1
    brake: Scalar = 0.0  # 0 to 1; it brakes, and reverses once the car stands


class Assist(NamedTuple):
    """How the car helps."""

    gyro: Scalar = 1.0  # 1 on, 0 off
    strength: Scalar = 1.0  # of the gyroscope, over `GAIN`
    lock: Scalar = math.radians(26)  # rad, largest angle of the front wheels


class Ramps(NamedTuple):
    """What is ramped, between two commands."""

    target: Scalar = 0.0  # rad/s
    angle: Scalar = 0.0  # part of the largest angle, -1 to 1; without the gyroscope
    throttle: Scalar = 0.0  # -1 to 1


def steer(
    assist: Assist, ramps: Ramps, hands: Hands, yaw_rate: Scalar, speed: Scalar, dt: Scalar
) -> tuple[Command, Ramps]:
    """The command after `dt` seconds, and the ramps after it. Rates in rad/s, speed in m/s."""
    own = jnp if any(isinstance(x, jax.Array) for x in (*hands, yaw_rate, speed)) else np
    target = ramp(ramps.target, hands.steer * RATE, RATE_ON * dt, RATE_OFF * dt)
    angle = ramp(ramps.angle, hands.steer, ANGLE_ON * dt, ANGLE_OFF * dt)
    rises = own.where(abs(ramps.throttle) < SOFT, THROTTLE_ON, THROTTLE_SLOW) * dt
    throttle = ramp(ramps.throttle, hands.throttle - hands.brake, rises, THROTTLE_OFF * dt)
    limit = assist.lock / (1 + (speed / HALVES) ** 2)
    held = target / RATE * limit + assist.strength * GAIN * (target - yaw_rate)
    steering = own.where(assist.gyro > 0.5, held, angle * assist.lock)
    most = own.where(steering * yaw_rate < 0, assist.lock, limit)
    return Command(throttle, own.clip(steering, -most, most)), Ramps(target, angle, throttle)


def ramp(value: Scalar, goal: Scalar, on: Scalar, off: Scalar) -> Scalar:
    """`value` moved to `goal`, by at most `on` away from 0 and `off` towards it.

    It stops at 0 on its way to the other side.
    """
    own = jnp if isinstance(value, jax.Array) or isinstance(goal, jax.Array) else np
    falls = (value * goal < 0) | (abs(goal) < abs(value))
    near = own.where(value * goal < 0, 0.0, goal)  # the far side comes after 0
    most = own.where(falls, off, on)
    return value + own.clip(near - value, -most, most)
