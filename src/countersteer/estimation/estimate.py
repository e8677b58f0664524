"""The estimate of the car's motion, and its uncertainty."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.signals import Scalar
from countersteer.world.chassis import Symmetric


class Estimate(NamedTuple):
    """Estimated motion of the car. SI units, radians; the pose is of the centre of mass.

    A covariance of zeros means that none is known: of dead reckoning, and of ground truth.
    """

    x: Scalar
    y: Scalar
    heading: Scalar  # unwrapped
    vx: Scalar  # along the body's axes
    vy: Scalar
    yaw_rate: Scalar
    gyro_bias: Scalar = 0.0
    friction: Scalar = 1.0  # of the rear axle over the nominal car's
    friction_deviation: Scalar = 0.0
    battery: Scalar = 1.0  # open-circuit voltage over the nominal car's full pack's
    battery_resistance: Scalar = 0.0  # inside the pack, ohm
    servo: Scalar = 1.0  # its gain over the nominal car's
    servo_deviation: Scalar = 0.0
    velocity_covariance: Symmetric = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # vx, vy, yaw rate
    pose_covariance: Symmetric = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # x, y, heading

    @property
    def sideslip(self) -> Scalar:
        """Angle from the nose to the velocity (rad)."""
        return jnp.arctan2(self.vy, self.vx)
