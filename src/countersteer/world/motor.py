"""Motor and speed controller: torque at the wheels, linear in their speed."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Battery, Drivetrain, Motor
from countersteer.signals import Scalar
from countersteer.world import battery as pack

NEUTRAL = 0.05  # duty at which the neutral brake has fully given way to driving
STANDSTILL = 10.0  # wheel speed (rad/s) below which braking fades into reversing


class Drive(NamedTuple):
    """Total torque at the four wheels: torque - slope · driven speed."""

    torque: Scalar  # N m
    slope: Scalar  # N m s, >= 0
    battery_current: Scalar  # A
    battery_voltage: Scalar  # V, under that current


def duty(motor: Motor, throttle: Scalar) -> Scalar:
    """Duty of a throttle: 0 in the dead zone, 1 from `full_throttle` on. An odd function."""
    span = motor.full_throttle - motor.dead_zone
    return jnp.sign(throttle) * jnp.clip((jnp.abs(throttle) - motor.dead_zone) / span, 0.0, 1.0)


def drive(
    motor: Motor, drivetrain: Drivetrain, battery: Battery, d: Scalar, charge: Scalar, speed: Scalar
) -> Drive:
    """The motor's torque at duty d and driven speed w (rad/s, at the wheels).

    The controller switches the battery voltage U on and off. `conduction` goes from case 0 to 1:

    1: Current flows on through the pauses. The windings' current is
       (d U - k n w) / (R + d² R_battery). The battery's current is d times that.
    0: Current stops in the pauses. Back-EMF opposes it only while switched on. Both currents are
       d (U - k n w) / (R + R_battery). So with little resistance to motion, a car at part
       throttle runs nearly as fast as at full throttle.

    k is the torque constant, n the gear ratio. If the car outruns its throttle, the current is
    negative, and only the part `overrun` of it flows. At neutral, and in braking (d < 0 while
    rolling forward), the windings are partly shorted: torque is proportional to speed. The torque
    is linear in the speed, so that an implicit step can evaluate it at its end.
    """
    back_emf = motor.torque_constant * drivetrain.gear_ratio  # V per rad/s of the wheels
    shorted = back_emf**2 / motor.resistance
    brakes = jnp.where(d < 0, jnp.clip(speed / STANDSTILL, 0.0, 1.0), 0.0)
    applied = jnp.where(d < 0, motor.reverse * (1 - brakes), 1.0) * d
    voltage = pack.open_circuit(battery, charge)
    inner = pack.resistance(battery)
    pause = 1 - motor.conduction
    path = motor.resistance + (motor.conduction * applied**2 + pause) * inner
    opposed = motor.conduction + pause * jnp.abs(applied)
    current = (applied * voltage - opposed * back_emf * speed) / path
    drives = current * applied >= 0
    # Without applied voltage no current is driven: at neutral only the brake acts.
    share = jnp.where(drives, 1.0, motor.overrun) * jnp.clip(jnp.abs(applied) / NEUTRAL, 0.0, 1.0)
    share = share * jnp.minimum(1.0, motor.current_limit / (jnp.abs(current) + 1e-9))
    strength = share * drivetrain.efficiency * back_emf / path
    neutral = motor.neutral_brake * jnp.clip(1 - jnp.abs(d) / NEUTRAL, 0.0, 1.0)
    battery_current = share * current * (motor.conduction * applied + pause * jnp.sign(applied))
    return Drive(
        strength * applied * voltage,
        strength * opposed * back_emf + shorted * (neutral + motor.brake * brakes * jnp.abs(d)),
        battery_current,
        voltage - inner * battery_current,
    )
