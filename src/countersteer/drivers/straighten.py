"""Keeps to the middle of a corridor: PID on what sonar and gyroscope tell."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.car.parameter import Scalar, pytree
from countersteer.course.course import Course
from countersteer.drivers.driver import Command, Observation
from countersteer.errors import InputError

SPEED = 1.5  # m/s, unless another is asked for


class Memory(NamedTuple):
    """Where the car is in its corridor."""

    offset: Scalar  # left of the middle, m
    integral: Scalar  # of the offset, m s
    bearing: Scalar  # heading of the corridor, rad
    time: Scalar


@pytree
class Straighten:
    """PID between walls, and a speed held by the throttle.

    steering = -(p offset + i integral + d heading error), the heading error standing for the
    offset's rate. The offset comes from the side sonars, each by itself while it sees a wall of
    the corridor, and runs on by heading and speed in between.
    """

    speed: Scalar  # m/s
    width: Scalar  # of the corridor, m
    bearing: Scalar  # at the start, rad
    left_x: Scalar  # mounts of the side sonars, m
    left_y: Scalar
    right_x: Scalar
    right_y: Scalar
    hold: Scalar  # throttle per speed that holds it, s/m
    dead_zone: Scalar
    limit: Scalar  # of steering, rad
    left: int = dataclasses.field(metadata={"static": True})  # their numbers among the mounts
    right: int = dataclasses.field(metadata={"static": True})
    p: Scalar = 1.2  # rad/m
    i: Scalar = 0.3  # rad/(m s)
    d: Scalar = 0.9  # rad/rad
    throttle_p: Scalar = 0.25  # s/m
    blend: Scalar = 0.3  # part of a sonar's news that is believed at once

    def reset(self, key: jax.Array) -> Memory:
        """In the middle of the corridor."""
        del key
        return Memory(0.0, 0.0, self.bearing, 0.0)

    def act(self, memory: Memory, observation: Observation) -> tuple[Command, Memory]:
        """Steers to the middle at the speed that was asked for."""
        memory = self.follow(memory, observation)
        return self.command(memory, observation, self.speed), memory

    def follow(self, memory: Memory, seen: Observation) -> Memory:
        """The memory with what is new: also while something else steers."""
        dt = seen.time - memory.time
        error = seen.estimate.heading - memory.bearing
        sideways = seen.estimate.vx * jnp.sin(error) + seen.estimate.vy * jnp.cos(error)
        offset = memory.offset + dt * sideways
        for index, side, x, y in (
            (self.left, 1.0, self.left_x, self.left_y),
            (self.right, -1.0, self.right_x, self.right_y),
        ):
            heard = seen.sonar[index]
            at = side * (self.width / 2 - heard.value) - x * jnp.sin(error) - y * jnp.cos(error)
            # Not a wall of this corridor, or one seen at a slant: a gap, or a turn under way.
            sees = (jnp.abs(at) < self.width / 2) & (jnp.abs(error) < math.radians(30))
            news = (heard.age <= dt + 1e-9) & sees
            offset = offset + jnp.where(news, self.blend * (at - offset), 0.0)
        return memory._replace(
            offset=offset,
            integral=jnp.clip(memory.integral + dt * offset, -0.1, 0.1),
            time=seen.time,
        )

    def command(self, memory: Memory, seen: Observation, speed: Scalar) -> Command:
        """PID, and the throttle that holds a speed."""
        error = seen.estimate.heading - memory.bearing
        steering = -(self.p * memory.offset + self.i * memory.integral + self.d * error)
        asked = self.hold * speed + self.throttle_p * (speed - seen.estimate.vx)
        # Braking would reverse a car that stands; let it roll instead.
        throttle = jnp.clip(asked, 0.0, 1.0) + self.dead_zone * jnp.where(asked > 0, 1.0, 0.0)
        return Command(jnp.clip(throttle, 0.0, 1.0), jnp.clip(steering, -self.limit, self.limit))


def straighten(course: Course, car: Car, speed: float | None = None) -> Straighten:
    """For a course and a nominal car; `speed` in m/s."""
    speed = SPEED if speed is None else speed
    left, right = mount_number(car, "left"), mount_number(car, "right")
    mounts = car.sensors.sonar.mounts
    return Straighten(
        speed=speed,
        width=course.width or 1.0,
        bearing=course.start[2],
        left_x=mounts[left].x,
        left_y=mounts[left].y,
        right_x=mounts[right].x,
        right_y=mounts[right].y,
        hold=holding_throttle(car, speed) / max(speed, 0.1),
        dead_zone=car.motor.dead_zone,
        limit=min(float(car.servo.limit_left), float(car.servo.limit_right)),
        left=left,
        right=right,
    )


def mount_number(car: Car, name: str) -> int:
    """Where a sonar of this name is among the car's mounts. Raises `InputError`."""
    names = car.sensors.sonar.mount_names
    if name not in names:
        raise InputError(f"the driver needs a sonar mount {name}; the car has {', '.join(names)}")
    return names.index(name)


def holding_throttle(car: Car, speed: float) -> float:
    """Throttle beyond the dead zone that holds a speed on the straight (full battery)."""
    wheel = speed / float(car.tires.rear.radius)
    drag = float(car.drivetrain.drag) + float(car.drivetrain.drag_viscous) * wheel
    back_emf = float(car.motor.torque_constant * car.drivetrain.gear_ratio)
    current = drag / (back_emf * float(car.drivetrain.efficiency))
    duty = (current * float(car.motor.resistance) + back_emf * wheel) / float(car.battery.full)
    return min(duty, 1.0) * float(car.motor.full_throttle - car.motor.dead_zone)
