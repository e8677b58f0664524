"""The car's speed controller: the duty that brings the wheels to a commanded speed."""

import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.signals import AnyCommand, Command, Scalar, Wheels
from countersteer.world import drivetrain, motor, servo


def goals(car: Car, asked: AnyCommand, wheels: Wheels) -> Command:
    """What motor and servo approach under a command: duty, and angle of the front wheels (rad)."""
    return Command(goal_duty(car, asked, wheels), servo.target(car.servo, asked.steering))


def goal_duty(car: Car, command: AnyCommand, wheels: Wheels) -> Scalar:
    """The duty that the motor approaches under a command, while the wheels spin so.

    A throttle passes its dead zone (`motor.duty`). For a commanded speed v it is, with the limits
    mirrored for a reverse v,

        clip(feed_forward v + gain (v - measured), -brake_limit, throttle_limit)

    where `measured` is the motor's speed, taken at the rims of the driven wheels (m/s). The
    controller has no memory. So its standing error is what `feed_forward` leaves, over the gain.
    """
    if isinstance(command, Command):
        return motor.duty(car.motor, command.throttle)
    part, speed = car.speed_controller, command.speed
    share = car.drivetrain.front_share
    radius = share * car.tires.front.radius + (1 - share) * car.tires.rear.radius
    measured = radius * drivetrain.driven_speed(car, wheels)
    asked = part.feed_forward * speed + part.gain * (speed - measured)
    hand = jnp.where(speed < 0, -1.0, 1.0)
    return hand * jnp.clip(hand * asked, -part.brake_limit, part.throttle_limit)
