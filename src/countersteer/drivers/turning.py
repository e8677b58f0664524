"""The laws of a turn: commands over entry speed and yaw rate."""

import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.drivers.stop_angle import interpolate
from countersteer.signals import Array, Command, Scalar

WEAKEST = 0.5  # largest missing part of a servo's gain that is compensated
SHARPEST = 2.1  # rad, angle beyond which a corner's turn begins no earlier
MOST = 0.3  # rad, largest sideslip error that is compensated


def weak(servo: Scalar) -> Scalar:
    """Missing part of the servo's gain. Excess gain counts as 0, as the lock has a limit."""
    return jnp.clip(1 - servo, 0.0, WEAKEST)


@pytree
class Turning:
    """The commands of a turn over yaw rate and heading.

    Arrays hold a number for each entry speed in `speeds`; between speeds they are interpolated.
    """

    speeds: Array  # m/s
    lead: Array  # distance to a corner of 90° at which its turn begins, m
    lock: Array  # rad
    rate: Array  # yaw rate that the lock holds during the spin, rad/s
    throttle: Array
    counter: Array  # counter-steering lock during the stop, rad
    rate_gain: Scalar  # lock per missing yaw rate, s
    stop_gain: Scalar  # decrease of the counter lock per missing angle, rad/rad
    settled: Scalar  # yaw rate (rad/s) below which the stop ends and the heading is held
    hold_p: Scalar  # lock per heading error while it settles, rad/rad
    hold_d: Scalar  # lock per yaw rate, s
    hold_slip: Scalar  # part of the front axle's sideslip that the front wheels follow
    hold_throttle: Scalar  # throttle while it settles
    slip_aim: Array = 0.6  # target sideslip of a turn, rad
    slip_gain: Scalar = 0.0  # angle turned beyond the target per missing sideslip, rad/rad
    lead_grip: Scalar = 0.0  # relative increase of `lead` per missing part of friction
    rate_grip: Scalar = 0.0  # relative decrease of `rate` per missing part of friction
    rate_servo: Scalar = 0.0  # the same per missing part of the servo's gain
    stop_servo: Scalar = 0.0  # relative increase of the stop angle per that part
    aim_servo: Scalar = 0.0  # relative decrease of `slip_aim` per that part
    lead_arc: Scalar = 1.0  # part of `lead` that grows with the corner's angle as an arc's
    power: Array = 0.0  # throttle of the stop

    def begins_at(self, speed: Scalar, grip: Scalar, angle: Scalar) -> Scalar:
        """Distance to a corner at which its turn begins (m). `angle` is that of the corner (rad).

        An arc of radius R begins R tan(angle / 2) before the corner. The part `lead_arc` of the
        lead grows so; the rest, the way until the car turns, is the same for every corner. `grip`
        is the estimated friction of the rear axle over the nominal car's.
        """
        lead = interpolate(self.speeds, self.lead, speed) * (1 + self.lead_grip * (1 - grip))
        bend = jnp.tan(jnp.minimum(jnp.abs(angle), SHARPEST) / 2)
        return lead * (1 + self.lead_arc * (bend - 1))

    def spin(
        self,
        entry: Scalar,
        rate: Scalar,
        grip: Scalar = 1.0,
        battery: Scalar = 1.0,
        servo: Scalar = 1.0,
    ) -> Command:
        """The command of the spin in a left turn: wheels over, throttle high.

        `rate` is the yaw rate. `grip` (friction), `battery` (voltage) and `servo` (gain) are the
        estimates over the nominal car's.
        """
        lock = interpolate(self.speeds, self.lock, entry)
        slower = self.rate_grip * (1 - grip) + self.rate_servo * weak(servo)
        held = interpolate(self.speeds, self.rate, entry) * (1 - slower)
        throttle = interpolate(self.speeds, self.throttle, entry)
        return Command(throttle / battery, lock + self.rate_gain * (held - rate))

    def still(self, angle: Scalar, servo: Scalar) -> Scalar:
        """The stop angle with this servo (rad). `angle` is that with the nominal servo."""
        return angle * (1 + self.stop_servo * weak(servo))

    def beyond(self, entry: Scalar, slip: Scalar, still: Scalar, servo: Scalar = 1.0) -> Scalar:
        """How far to turn beyond the target, to reach the target sideslip (rad).

        During the stop the car hardly changes its direction of motion. So the sideslip (`slip`,
        positive in a drift) grows by about the angle that the car still turns (`still`).
        """
        aim = self._at(self.slip_aim, entry) * (1 - self.aim_servo * weak(servo))
        return self.slip_gain * jnp.clip(aim - (slip + still), -MOST, MOST)

    def stop(self, entry: Scalar, missing: Scalar, battery: Scalar = 1.0) -> Command:
        """The command of the stop in a left turn: wheels back, `power`. `missing` is in rad."""
        counter = interpolate(self.speeds, self.counter, entry)
        power = self._at(self.power, entry)
        return Command(power / battery, self.stop_gain * missing - counter)

    def _at(self, table: Array, speed: Scalar) -> Scalar:
        """The value at a speed; a single number holds at all speeds."""
        return interpolate(self.speeds, jnp.broadcast_to(table, jnp.shape(self.speeds)), speed)
