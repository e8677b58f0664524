"""Follows the centre line of any course by pure pursuit, without drifting, on a pose estimate."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.position import Line, line_of
from countersteer.drivers.driver import Observation, paced
from countersteer.drivers.straighten import holding_throttle
from countersteer.errors import InputError
from countersteer.estimation.estimate import Estimate
from countersteer.signals import Array, Command, Scalar

AHEAD = (0.2, 0.15)  # look-ahead: m, and s at the car's speed
FASTEST = 2.0  # m/s, unless a speed is given
GRIP = 0.5  # part of the tyres' friction that a bend may take
BRAKING = 1.0  # m/s², before a bend
STEP = 0.25  # m between the rows of the table of speeds


class PursuitMemory(NamedTuple):
    """Place on the centre line, and the last command."""

    along: Scalar  # m
    time: Scalar  # s
    command: Command


@pytree
class Pursuit:
    """Pure pursuit, at the speed that the bends ahead allow."""

    line: Line
    speeds: Array  # (n,) m/s, one every `STEP` of the centre line
    hold: Scalar  # throttle per speed that holds it, s/m
    dead_zone: Scalar
    limit: Scalar  # of steering, rad
    wheelbase: Scalar
    rear_axle: Scalar  # behind the centre of mass, m
    throttle_p: Scalar = 0.4  # s/m

    def reset(self, key: jax.Array) -> PursuitMemory:
        """At the start."""
        del key
        return PursuitMemory(self.line.start, 0.0, Command(0.0, 0.0))

    def act(self, memory: PursuitMemory, observation: Observation) -> tuple[Command, PursuitMemory]:
        """One control period."""
        return paced(self._think, memory, observation)

    def _think(self, memory: PursuitMemory, seen: Observation) -> tuple[Command, PursuitMemory]:
        estimate = seen.estimate
        here = self.line.follow(estimate.x, estimate.y, memory.along)
        row = jnp.floor(here.distance / STEP).astype(jnp.int32) % len(self.speeds)
        speed = jnp.asarray(self.speeds)[row]
        lock = pursued(self.line, here.distance, estimate, self.wheelbase, self.rear_axle)
        asked = self.hold * speed + self.throttle_p * (speed - estimate.vx)
        asked = jnp.maximum(asked, jnp.where(estimate.vx > 0.5, -0.5, 0.0))  # no reverse
        throttle = asked + self.dead_zone * jnp.sign(asked)
        lock = jnp.clip(lock, -self.limit, self.limit)
        command = Command(jnp.clip(throttle, -1.0, 1.0), lock)
        return command, PursuitMemory(here.distance, seen.time, command)


def pursued(
    line: Line, distance: Scalar, estimate: Estimate, wheelbase: Scalar, rear_axle: Scalar
) -> Scalar:
    """Lock (rad) towards the point of the line that lies `AHEAD`: pure pursuit (Coulter 1992).

    lock = atan(2 wheelbase sin(a) / l). l and a are the distance and the bearing of the point from
    the rear axle. `distance` (m) is the car's place on the line.
    """
    ahead = AHEAD[0] + AHEAD[1] * jnp.maximum(estimate.vx, 0.0)
    x, y = line.at(distance + ahead)
    cosine, sine = jnp.cos(estimate.heading), jnp.sin(estimate.heading)
    dx = x - estimate.x + rear_axle * cosine
    dy = y - estimate.y + rear_axle * sine
    left = cosine * dy - sine * dx
    return jnp.arctan(2 * wheelbase * left / (dx**2 + dy**2 + 1e-4))


def pursuit(course: Course, car: Car, speed: float | None = None) -> Pursuit:
    """For a course with a centre line and a nominal car; `speed` (m/s) is the highest.

    Raises `InputError` for free walls.
    """
    if not len(course.line):
        raise InputError(
            f"{course.name}: free walls have no centre line for pursuit to follow: give a course "
            "with segments, or a map with a goal"
        )
    top = FASTEST if speed is None else speed
    return Pursuit(
        line=line_of(course),
        speeds=_speeds(course, car, top),
        hold=holding_throttle(car, top) / max(top, 0.1),
        dead_zone=car.motor.dead_zone,
        limit=min(float(car.servo.limit_left), float(car.servo.limit_right)),
        wheelbase=car.body.wheelbase,
        rear_axle=car.body.wheelbase - car.body.front_axle,
    )


def _speeds(course: Course, car: Car, top: float) -> np.ndarray:
    """The highest speed (m/s) at each `STEP` of the line.

    In a bend v² <= `GRIP` mu g R. Before it the car brakes by `BRAKING`. A mitred corner counts as
    an arc of half the corridor's width.
    """
    count = max(1, math.ceil(course.length / STEP))
    at = STEP * np.arange(count)
    grip = min(float(t.peak_friction) for t in (car.tires.front, car.tires.rear))
    speeds = np.full(count, top)
    for turn in course.turns:
        radius = turn.radius or (course.width or 1.0) / 2
        off = np.abs(at - turn.distance)
        off = np.minimum(off, course.length - off) if course.closed else off
        bend = math.sqrt(GRIP * grip * GRAVITY * radius)
        inside = off <= abs(turn.angle) * radius / 2 + STEP
        speeds[inside] = np.minimum(speeds[inside], bend)
    rounds = 2 if course.closed else 1
    for i in range(rounds * count - 2, -1, -1):
        here, after = i % count, (i + 1) % count
        speeds[here] = min(speeds[here], math.sqrt(speeds[after] ** 2 + 2 * BRAKING * STEP))
    return speeds
