"""Keeps to the middle of a corridor: PID on sonar and gyroscope."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.position import Legs, legs_of
from countersteer.drivers.driver import Observation, Status, paced
from countersteer.errors import InputError
from countersteer.estimation.wall_angle import WallAngle, wall_angle
from countersteer.signals import Command, Scalar

SPEED = 1.5  # m/s, default
DOUBT = math.radians(0.5)  # standard deviation of the angle between two corridors


class StraightenMemory(NamedTuple):
    """Where the car is in its corridor."""

    offset: Scalar  # left of the middle, m
    error: Scalar  # angle to the corridor, positive to the left, rad
    integral: Scalar  # of the offset, m s
    heading: Scalar  # the estimate's, rad
    time: Scalar
    walls: Any  # memory of the wall filter; () without one
    command: Command  # the last
    turned: Scalar = 0  # corners passed


@pytree
class Straighten:
    """PID between walls, and a throttle that holds the speed.

    steering = -(p offset + i integral + d angle). The angle to the corridor stands for the offset's
    rate. `by` selects the source of both:
    "filter": the wall filter.
    "sonar", as in the paper: the offset is from each side sonar that sees a wall of the corridor,
    the angle from the gyroscope alone.
    "pose": the estimate's pose in `legs`, for a car whose pose on the course is known.
    """

    speed: Scalar  # m/s
    walls: WallAngle
    bearing: Scalar  # heading at the start, rad
    hold: Scalar  # throttle per speed, to hold it, s/m
    dead_zone: Scalar
    limit: Scalar  # of steering, rad
    legs: Legs
    by: str = dataclasses.field(default="filter", metadata={"static": True})
    p: Scalar = 1.2  # rad/m
    i: Scalar = 0.3  # rad/(m s)
    d: Scalar = 0.9  # rad/rad
    steepest: Scalar = 0.15  # largest steering for offset and integral, rad
    throttle_p: Scalar = 0.25  # s/m
    blend: Scalar = 0.3  # part of the offset's error that a reading corrects, by "sonar"

    def reset(self, key: jax.Array) -> StraightenMemory:
        """In the middle of the corridor."""
        del key
        walls: Any = ()
        if self.by == "filter":
            walls = self.walls.initial_memory(heading=self.bearing, dtype=float)
        return StraightenMemory(0.0, 0.0, 0.0, self.bearing, 0.0, walls, Command(0.0, 0.0))

    def act(
        self, memory: StraightenMemory, observation: Observation
    ) -> tuple[Command, StraightenMemory]:
        """Steer to the middle, at `speed`."""

        def think(memory: StraightenMemory, seen: Observation) -> tuple[Command, StraightenMemory]:
            memory = self.follow(memory, seen)
            command = self.command(memory, seen, self.speed)
            return command, memory._replace(command=command)

        return paced(think, memory, observation)

    def status(self, memory: StraightenMemory) -> Status:
        """The estimated place in the corridor."""
        told = Status(memory.turned, 0, memory.offset, memory.error)
        if self.by == "filter":
            walls = memory.walls
            told = told._replace(
                offset_deviation=walls.offset_deviation, angle_deviation=walls.angle_deviation
            )
        return told

    def follow(self, memory: StraightenMemory, seen: Observation) -> StraightenMemory:
        """The memory after an observation. Call it also while something else steers."""
        dt = seen.time - memory.time
        walls: Any = ()
        if self.by == "filter":
            ages = tuple(heard.age for heard in seen.sonar)
            scan = () if seen.lidar is None else (seen.lidar, seen.lidar.age)
            walls = self.walls.update(
                memory.walls, seen.sonar, ages, seen.estimate, seen.time, *scan
            )
            offset, error = walls.offset, walls.angle
        elif self.by == "pose":
            pose = seen.estimate
            _, offset, error = self.legs.seen(memory.turned, pose.x, pose.y, pose.heading)
        else:
            error = memory.error + seen.estimate.heading - memory.heading
            offset = self._heard(memory.offset, error, seen, dt)
        return StraightenMemory(
            offset,
            error,
            jnp.clip(memory.integral + dt * offset, -0.1, 0.1),
            seen.estimate.heading,
            seen.time,
            walls,
            memory.command,
            memory.turned,
        )

    def _heard(self, offset: Scalar, error: Scalar, seen: Observation, dt: Scalar) -> Scalar:
        """The offset by sonar, without a filter."""
        sine, cosine = jnp.sin(error), jnp.cos(error)
        offset = offset + dt * (seen.estimate.vx * sine + seen.estimate.vy * cosine)
        own = self.walls
        for mount, side, x, y in zip(own.mounts, own.sides, own.xs, own.ys, strict=True):
            heard = seen.sonar[mount]
            at = side * (own.width / 2 - heard.value) - x * sine - y * cosine
            # Otherwise the wall is not of this corridor, or seen at a slant: a gap, or a turn.
            sees = (jnp.abs(at) < own.width / 2) & (jnp.abs(error) < math.radians(30))
            news = heard.came(dt) & sees
            offset = offset + jnp.where(news, self.blend * (at - offset), 0.0)
        return offset

    def turned(
        self, memory: StraightenMemory, angle: Scalar, now: Scalar, offset: Scalar | None = None
    ) -> StraightenMemory:
        """If `now`: the memory in the corridor after a corner by `angle`; its `offset` if known."""
        walls = memory.walls
        if self.by == "filter":
            walls = self.walls.turned(walls, angle, DOUBT, offset)
        beyond = memory._replace(
            offset=0.0 * memory.offset if offset is None else offset,
            error=memory.error - angle,
            integral=0.0,
            walls=walls,
            turned=memory.turned + 1,
        )
        return jax.tree.map(lambda new, old: jnp.where(now, new, old), beyond, memory)

    def command(self, memory: StraightenMemory, seen: Observation, speed: Scalar) -> Command:
        """The steering of the PID, and the throttle that holds a speed."""
        aside = self.p * memory.offset + self.i * memory.integral
        steering = -(jnp.clip(aside, -self.steepest, self.steepest) + self.d * memory.error)
        asked = self.hold * speed + self.throttle_p * (speed - seen.estimate.vx)
        # Braking would reverse a car that stands; let it roll instead.
        throttle = jnp.clip(asked, 0.0, 1.0) + self.dead_zone * jnp.where(asked > 0, 1.0, 0.0)
        return Command(jnp.clip(throttle, 0.0, 1.0), jnp.clip(steering, -self.limit, self.limit))


def straighten(
    course: Course, car: Car, speed: float | None = None, by: str = "filter", laps: int = 1
) -> Straighten:
    """For a course and a nominal car; `speed` in m/s.

    Raises `InputError` without side sonars, and for free walls.
    """
    if not len(course.line):
        raise InputError(
            f"{course.name}: free walls have no centre line for the driver to follow: give a "
            "commands.csv, or a course with segments"
        )
    speed = SPEED if speed is None else speed
    mount_number(car, "left"), mount_number(car, "right")
    return Straighten(
        speed=speed,
        walls=wall_angle(car, course.width or 1.0),
        bearing=course.start[2],
        hold=holding_throttle(car, speed) / max(speed, 0.1),
        dead_zone=car.motor.dead_zone,
        limit=min(float(car.servo.limit_left), float(car.servo.limit_right)),
        legs=legs_of(course, laps),
        by=by,
    )


def mount_number(car: Car, name: str) -> int:
    """Index of the sonar `name` among the car's mounts. Raises `InputError` if there is none."""
    names = car.sensors.sonar.mount_names
    if name not in names:
        raise InputError(f"the driver needs a sonar mount {name}; the car has {', '.join(names)}")
    return names.index(name)


def holding_throttle(car: Car, speed: float) -> float:
    """Throttle beyond the dead zone that holds a speed on a straight, with a full battery."""
    wheel = speed / float(car.tires.rear.radius)
    drag = float(car.drivetrain.drag) + float(car.drivetrain.drag_viscous) * wheel
    back_emf = float(car.motor.torque_constant * car.drivetrain.gear_ratio)
    current = drag / (back_emf * float(car.drivetrain.efficiency))
    duty = (current * float(car.motor.resistance) + back_emf * wheel) / float(car.battery.full)
    return min(duty, 1.0) * float(car.motor.full_throttle - car.motor.dead_zone)
