"""The laws of a turn: what is asked of the car over speed of entry and yaw rate."""

from countersteer.car.parameter import Array, Scalar, pytree
from countersteer.drivers.driver import Command
from countersteer.drivers.stop_angle import interpolate


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

    def spin(self, entry: Scalar, rate: Scalar) -> Command:
        """Wheels over, throttle high: for a left turn. `rate` is the yaw rate."""
        lock = interpolate(self.speeds, self.lock, entry)
        held = interpolate(self.speeds, self.rate, entry)
        throttle = interpolate(self.speeds, self.throttle, entry)
        return Command(throttle, lock + self.rate_gain * (held - rate))

    def stop(self, entry: Scalar, missing: Scalar) -> Command:
        """Wheels back, throttle none: for a left turn of which so much angle would be missing."""
        counter = interpolate(self.speeds, self.counter, entry)
        return Command(0.0 * counter, self.stop_gain * missing - counter)
