"""The laws of a turn: what is asked of the car over speed of entry and yaw rate."""

import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.drivers.stop_angle import interpolate
from countersteer.signals import Array, Command, Scalar

WEAKEST = 0.5  # part of a servo's gain that is made up for at most
MOST = 0.3  # rad of sideslip that is made up for at most


def weak(servo: Scalar) -> Scalar:
    """Part of the servo's gain that is missing; what it has too much ends at the lock's limit."""
    return jnp.clip(1 - servo, 0.0, WEAKEST)


@pytree
class Turning:
    """How a turn is driven: commands over yaw rate and heading.

    Tables hold a number for each of the `speeds` of entry; between them they are interpolated.
    """

    speeds: Array  # m/s
    lead: Array  # distance to the corner at which a turn by 90° is begun, m
    lock: Array  # rad
    rate: Array  # yaw rate that the spin is held at by the lock, rad/s
    throttle: Array
    counter: Array  # lock while stopping, rad
    rate_gain: Scalar  # lock per yaw rate that is missing, s
    stop_gain: Scalar  # lock given back per angle that would be missing, rad/rad
    settled: Scalar  # yaw rate (rad/s) under which the heading is held
    hold_p: Scalar  # lock per heading error while it settles, rad/rad
    hold_d: Scalar  # lock per yaw rate, s
    hold_slip: Scalar  # part of the front wheels' sideslip that they follow
    hold_throttle: Scalar  # throttle while it settles
    slip_aim: Scalar = 0.6  # sideslip that a turn is to reach, rad
    slip_gain: Scalar = 0.0  # angle turned beyond the target per sideslip that would be missing
    lead_grip: Scalar = 0.0  # part by which a turn is begun earlier per part of friction missing
    rate_grip: Scalar = 0.0  # part by which the yaw rate is held lower per part of it missing
    rate_servo: Scalar = 0.0  # the same per part of the servo's gain that is missing
    stop_servo: Scalar = 0.0  # part by which the car turns further once stopped, per part of that
    aim_servo: Scalar = 0.0  # part by which less sideslip is aimed at, per part of that

    def begins_at(self, speed: Scalar, grip: Scalar) -> Scalar:
        """Distance to a corner of 90° at which the turn begins (m).

        `grip` is the friction that is felt at the rear, over the nominal car's.
        """
        return interpolate(self.speeds, self.lead, speed) * (1 + self.lead_grip * (1 - grip))

    def spin(
        self,
        entry: Scalar,
        rate: Scalar,
        grip: Scalar = 1.0,
        battery: Scalar = 1.0,
        servo: Scalar = 1.0,
    ) -> Command:
        """Wheels over, throttle high: for a left turn. `rate` is the yaw rate.

        `battery` is the voltage and `servo` its gain as they are felt, over the nominal car's.
        """
        lock = interpolate(self.speeds, self.lock, entry)
        slower = self.rate_grip * (1 - grip) + self.rate_servo * weak(servo)
        held = interpolate(self.speeds, self.rate, entry) * (1 - slower)
        throttle = interpolate(self.speeds, self.throttle, entry)
        return Command(throttle / battery, lock + self.rate_gain * (held - rate))

    def still(self, angle: Scalar, servo: Scalar) -> Scalar:
        """How far the car turns once stopped, of what it does with the nominal servo (rad)."""
        return angle * (1 + self.stop_servo * weak(servo))

    def beyond(self, slip: Scalar, still: Scalar, servo: Scalar = 1.0) -> Scalar:
        """How far to turn beyond the target, so that the car slides as it is meant to (rad).

        While it is stopped the car hardly changes its way: the sideslip (`slip`, in the turn's
        hand) grows by about the angle that it still turns.
        """
        aim = self.slip_aim * (1 - self.aim_servo * weak(servo))
        return self.slip_gain * jnp.clip(aim - (slip + still), -MOST, MOST)

    def stop(self, entry: Scalar, missing: Scalar) -> Command:
        """Wheels back, throttle none: for a left turn of which so much angle would be missing."""
        counter = interpolate(self.speeds, self.counter, entry)
        return Command(0.0 * counter, self.stop_gain * missing - counter)
