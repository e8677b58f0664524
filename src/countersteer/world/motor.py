"""Motor and speed controller: torque at the wheels as a line over their speed."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Battery, Drivetrain, Motor
from countersteer.signals import Scalar
from countersteer.world import battery as pack

NEUTRAL = 0.05  # duty over which the controller goes from its neutral brake to driving
STANDSTILL = 10.0  # wheel speed (rad/s) over which braking hands over to reversing


class Drive(NamedTuple):
    """Torque at the wheels, all four together: torque - slope · driven speed."""

    torque: Scalar  # N m
    slope: Scalar  # N m s, >= 0
    battery_current: Scalar  # A
    battery_voltage: Scalar  # V, under that current


def duty(motor: Motor, throttle: Scalar) -> Scalar:
    """Duty for a throttle: none in the dead zone, full from `full_throttle` on, odd."""
    span = motor.full_throttle - motor.dead_zone
    return jnp.sign(throttle) * jnp.clip((jnp.abs(throttle) - motor.dead_zone) / span, 0.0, 1.0)


def drive(
    motor: Motor, drivetrain: Drivetrain, battery: Battery, d: Scalar, charge: Scalar, speed: Scalar
) -> Drive:
    """The motor's torque at duty d and driven speed (rad/s, at the wheels).

    The controller chops the battery. Where the current flows on through its pauses, that through
    the windings is (d U - k n w) / (R + d² R_battery), and d times that is the battery's. Where it
    dies at once, the back-EMF opposes it while switched on only: d (U - k n w) / (R + R_battery),
    all of it the battery's; a car at part throttle then runs nearly as fast as at full throttle if
    little resists. `conduction` goes from the second to the first. Outrunning the throttle,
    only the part `overrun` of the then negative current flows. At neutral, and in braking (d < 0
    while rolling forward), the windings are shorted by parts: torque proportional to speed.
    The torque is linear in the speed, so that it can be taken at the end of a step.
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
    # No current is driven where nothing is applied: at neutral the brake alone acts.
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
