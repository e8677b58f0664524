"""The nominal car as a single track: its motion while no sensor reports."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import GRAVITY, Car
from countersteer.signals import AnyCommand, Scalar, Wheels
from countersteer.world import drivetrain, motor, servo, speed_controller, tyre
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Symmetric, Vector, combine, dot, solve
from countersteer.world.planar import rotated


class Actuators(NamedTuple):
    """State of motor and servo after the commands so far."""

    duty: Scalar
    steering: Scalar  # rad


def follow(car: Car, before: Actuators, command: AnyCommand, speed: Scalar, h: Scalar) -> Actuators:
    """The state after h seconds of a command. A pure delay counts as additional lag.

    A speed controller measures `speed` (m/s).
    """
    front, rear = speed / car.tires.front.radius, speed / car.tires.rear.radius
    goal = speed_controller.goal_duty(car, command, Wheels(front, front, rear, rear))
    slow = dataclasses.replace(car.servo, lag=car.servo.lag + car.servo.delay)
    return Actuators(
        before.duty - (goal - before.duty) * jnp.expm1(-h / (car.motor.lag + car.motor.delay)),
        servo.turn(slow, before.steering, servo.target(slow, command.steering), h),
    )


def step(
    car: Car, velocity: Vector, before: Actuators, drive: motor.Drive, friction: Scalar, h: Scalar
) -> Vector:
    """The velocity h seconds later, in the car's axes then, by one implicit Euler step.

    Both wheels bear their static loads and follow their tyres' law. The rear wheel rolls. The front
    wheel rolls too; as far as the centre is locked, it turns as fast as the rear one. The tyres'
    grip limits the pull of the motor. `friction` scales the tyres' friction.
    """
    body, line = car.body, car.drivetrain
    matrix = Symmetric(body.mass, body.mass, body.yaw_inertia, 0.0, 0.0, 0.0)
    momentum = Vector(
        body.mass * velocity.x, body.mass * velocity.y, body.yaw_inertia * velocity.yaw
    )
    behind = body.wheelbase - body.front_axle
    dragged: Scalar = 0.0  # force of the locked centre on the front wheel; the rear one loses it
    for tire, arm, other, share, (cosine, sine) in (
        (car.tires.front, body.front_axle, behind, line.front_share, cosine_sine(before.steering)),
        (car.tires.rear, -behind, body.front_axle, 1 - line.front_share, (1.0, 0.0)),
    ):
        roll = Vector(cosine, sine, arm * sine)
        slide = Vector(-sine, cosine, arm * cosine)
        load = body.mass * GRAVITY * other / body.wheelbase
        along = dot(roll, velocity)
        rim = along + line.center_lock * (velocity.x - along)
        scaled = dataclasses.replace(tire, friction=friction * tire.friction)
        contact = tyre.contact(scaled, load, along - rim, dot(slide, velocity), rim)
        pull = share * drive.torque / tire.radius - dragged
        dragged = contact.k_x * (rim - along)
        drag = 2 * drivetrain.drag(car, tire, contact.force_y / 2, rim / tire.radius)
        slope = (share * drive.slope + drag) / tire.radius**2
        # Beyond the tyre's grip the wheel spins or locks.
        most = friction * tyre.limit(tire, load)
        over = jnp.minimum(1.0, most / (jnp.abs(pull - slope * along) + 1e-6))
        matrix = matrix.plus(h * contact.k_y, slide).plus(h * over * slope, roll)
        momentum = combine(1.0, momentum, h * (over * pull + dragged), roll)
    return rotated(solve(matrix, momentum), h * velocity.yaw)
