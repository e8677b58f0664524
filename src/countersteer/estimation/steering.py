"""The steering as it is felt: a Kalman filter of how far the servo turns, and of its trim.

A servo that turns less than it should leaves less lock to catch a slide with: what decides most of
all whether a turn can be ended. It is felt where the front tyres hold. Their side force (over their
load, f) is known by the accelerometer, so the brush model's law turned round tells the angle

    s = 3 mu / C (1 - (1 - |f| / mu)^(1/3)) sign f

between the wheels and the way that the axle takes, atan2(vy + a r, vx); the sum of the two is where
the wheels stand.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.estimation.kalman import Covariance, correct, diagonal, predict
from countersteer.signals import Scalar

SERVOS = 0.12  # deviation of the gain at the start, over the nominal servo's
TRIMS = math.radians(0.6)  # of the trim
DRIFTS = 0.005  # of the gain, per root second
EXACT = math.radians(1.0)  # standard deviation of an angle that is told,
SLIPS = 0.25  # part of the tyres' own slip angle,
LAGS = 0.015  # and s by which the servo is early or late
MEMORY = 0.1  # s for which such an error stays the same
USED = 0.8  # part of their friction up to which tyres hold
SLOWEST = 0.8  # m/s, under which angles mean little
GATE = 4.0


class Servo(NamedTuple):
    """What is believed of the servo: gain over the nominal one's, and trim (rad)."""

    mean: tuple[Scalar, ...]
    covariance: Covariance


def initial() -> Servo:
    """The nominal one."""
    return Servo((1.0, 0.0), diagonal([SERVOS, TRIMS]))


def gives(share: Scalar) -> Scalar:
    """By how much more than in proportion a brush tyre slips at a share of its friction."""
    share = jnp.clip(share, 0.01, 0.9)
    return 3 * (1 - jnp.cbrt(1 - share)) / share


def update(
    believed: Servo,
    nominal: Scalar,
    turning: Scalar,
    way: Scalar,
    push: Scalar,
    friction: Scalar,
    stiffness: Scalar,
    limit: Scalar,
    speed: Scalar,
    valid: Scalar,
    h: Scalar,
) -> Servo:
    """After h seconds: `nominal` is where the nominal servo stands (rad) and `turning` its rate.

    `way` is the front axle's angle to the nose (rad), `push` its side force over its load. At its
    `limit` (rad) a servo tells no more than that it turns so far.
    """
    mean, covariance = believed
    share = jnp.abs(push) / friction
    slip = gives(share) * push / stiffness
    noise = EXACT**2 + (SLIPS * slip) ** 2 + (LAGS * turning) ** 2
    stands = way + slip
    expected = jnp.clip(mean[0] * nominal, -limit, limit) + mean[1]
    stops = (jnp.abs(mean[0] * nominal) > limit) & (jnp.abs(stands) > 0.95 * limit)
    mean, covariance, _ = correct(
        mean,
        predict(covariance, {}, {0: DRIFTS**2 * h}),
        {0: nominal, 1: 1.0},
        stands - expected,
        noise * 2 * MEMORY / jnp.maximum(h, 1e-6),
        valid & ~stops & (share < USED) & (speed > SLOWEST) & (h > 0),
        GATE,
    )
    return Servo((jnp.clip(mean[0], 0.4, 2.0), mean[1]), covariance)
