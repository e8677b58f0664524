"""The steering: a Kalman filter of the servo's gain and trim.

A servo that turns too little leaves less lock to catch a slide. This matters most for whether a
turn can be ended. The gain shows while the front tyres hold. The accelerometer gives their side
force over their load, f. The inverse of the brush model then gives the slip angle

    s = 3 mu / C (1 - (1 - |f| / mu)^(1/3)) sign f

between the wheels and the axle's direction of motion, atan2(vy + a r, vx). The sum of the two is
the angle of the wheels.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.estimation.kalman import Covariance, correct, diagonal, predict
from countersteer.signals import Scalar

SERVOS = 0.12  # standard deviation at the start: of the gain over the nominal servo's,
TRIMS = math.radians(0.6)  # and of the trim
DRIFTS = 0.005  # random walk of the gain, per root second
EXACT = math.radians(1.0)  # standard deviation of the measured angle: a constant,
SLIPS = 0.25  # a part of the tyres' own slip angle,
LAGS = 0.015  # and the error of the servo's timing, s
MEMORY = 0.1  # s, time for which such an error stays the same
USED = 0.8  # part of their friction up to which the tyres hold
SLOWEST = 0.8  # m/s, below which angles mean little
GATE = 4.0  # standard deviations beyond which a measurement is rejected


class Servo(NamedTuple):
    """Estimate of the servo: gain over the nominal one's, and trim (rad)."""

    mean: tuple[Scalar, ...]
    covariance: Covariance


def initial() -> Servo:
    """The nominal servo."""
    return Servo((1.0, 0.0), diagonal([SERVOS, TRIMS]))


def gives(share: Scalar) -> Scalar:
    """Slip of a brush tyre over that of a linear tyre, at a share of its friction."""
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
    """The estimate after h seconds.

    `nominal` is the angle of the nominal servo (rad), `turning` its rate.
    `way` is the angle from the nose to the front axle's motion (rad), `push` its side force over
    its load. A servo at its `limit` (rad) is no measurement: it shows only that it turns so far.
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
