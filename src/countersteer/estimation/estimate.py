"""What is believed of the car, and how far."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.signals import Scalar
from countersteer.world.chassis import Symmetric


class Estimate(NamedTuple):
    """The motion of the car as far as it is known. SI, radians; pose of the centre of mass.

    A covariance of zeros means that none is known: of dead reckoning, and of the truth itself.
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
    servo: Scalar = 1.0  # how far it turns, over the nominal car's
    servo_deviation: Scalar = 0.0
    velocity_covariance: Symmetric = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # vx, vy, yaw rate
    pose_covariance: Symmetric = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # x, y, heading

    @property
    def sideslip(self) -> Scalar:
        """Angle from the nose to the velocity (rad)."""
        return jnp.arctan2(self.vy, self.vx)
