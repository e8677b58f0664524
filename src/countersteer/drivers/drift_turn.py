"""Drifts round the corners of a corridor, on sonar, encoder, gyroscope and accelerometer."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import Scalar, pytree
from countersteer.course.course import Course
from countersteer.drivers import straighten
from countersteer.drivers.driver import Command, Observation
from countersteer.drivers.straighten import Straighten
from countersteer.errors import InputError

STRAIGHT, SPIN, CATCH = 0, 1, 2
SPEED = 2.02  # m/s, unless another is asked for


class Memory(NamedTuple):
    """What the driver is about."""

    phase: Scalar
    turn: Scalar  # turns begun
    since: Scalar  # when the phase began, s
    walked: Scalar  # distance along the straight since the last turn, m
    ahead: Scalar  # filtered distance of the front sonar, m
    heard: Scalar  # its reading before
    straight: straighten.Memory


@pytree
class DriftTurn:
    """Straightens; turns the wheels over at the wall; turns them back in time to end up straight.

    The turn begins when the wall ahead is near: wheels over, throttle high. When the heading turned
    plus what it will still turn reaches the target: wheels back, throttle off. What it will still
    turn is `coast` times the yaw rate: the paper's regression, with a slope set by hand. Targets
    are headings of corridors, so a turn's error is the next one's to mend. The lock shrinks as the
    speed squared grows, and holds the yaw rate, so that the car is not thrown round.
    """

    straight: Straighten
    angles: np.ndarray  # of the turns in their order, rad; 0 behind the last
    gaps: np.ndarray  # distance along the centre line to each turn from the one before, m
    front_x: Scalar  # mount of the front sonar, m
    width: Scalar
    ping: Scalar  # s between two readings of a sonar
    front: int = dataclasses.field(metadata={"static": True})
    trigger: Scalar = 1.46  # distance of the centre of mass to the wall ahead at handover, m
    trigger_speed: Scalar = 0.455  # more of it per speed over 2 m/s, s
    lock: Scalar = 0.37  # rad
    lock_speed: Scalar = 2.0  # m/s from which the lock shrinks
    rate: Scalar = 3.37  # yaw rate that the spin is held at by the lock, rad/s
    rate_gain: Scalar = 0.24  # s
    throttle: Scalar = 0.63
    coast: Scalar = 0.12  # s
    counter: Scalar = 0.468  # lock while catching, rad
    settled: Scalar = 1.2  # yaw rate (rad/s) at which the straightening takes over
    longest: Scalar = 1.2  # s that a phase of a turn may take

    def reset(self, key: jax.Array) -> Memory:
        """Straight ahead."""
        return Memory(STRAIGHT, 0, 0.0, 0.0, math.inf, math.inf, self.straight.reset(key))

    def act(self, memory: Memory, observation: Observation) -> tuple[Command, Memory]:
        """One control period."""
        seen, now = observation, observation.time
        dt = now - memory.straight.time
        straight = self.straight.follow(memory.straight, seen)
        estimate = seen.estimate
        angle = jnp.asarray(self.angles)[memory.turn]
        gap = jnp.asarray(self.gaps)[memory.turn]
        hand = jnp.sign(angle)

        # A spike is a reading shorter than the one before it allows; taking the longer of the two,
        # the earlier one less what was driven since, costs no delay.
        heard = seen.sonar[self.front]
        fresh = heard.age <= dt + 1e-9
        expected = memory.heard - estimate.vx * self.ping
        ahead = jnp.where(
            fresh, jnp.maximum(heard.value, expected), memory.ahead - dt * estimate.vx
        )
        before = jnp.where(fresh, heard.value, memory.heard)
        walked = memory.walked + dt * estimate.vx

        speed = jnp.maximum(estimate.vx, 0.5)
        handover = self.trigger + self.trigger_speed * (speed - 2.0) - self.front_x
        lined_up = jnp.abs(estimate.heading - straight.bearing) < 0.5
        near = (ahead < handover) & (walked > gap - 0.75 * self.width) & lined_up
        begins = (memory.phase == STRAIGHT) & near & (angle != 0)
        bearing = jnp.where(begins, straight.bearing + angle, straight.bearing)

        # While turning, `turn` is already the next one; its hand is that of the way to the bearing.
        left_over = bearing - estimate.heading
        turning = jnp.sign(left_over)
        still = self.coast * jnp.abs(estimate.yaw_rate)
        late = now - memory.since > self.longest
        stops = (memory.phase == SPIN) & ((jnp.abs(left_over) <= still) | late)
        ends = (memory.phase == CATCH) & ((jnp.abs(estimate.yaw_rate) < self.settled) | late)
        phase = jnp.where(
            begins, SPIN, jnp.where(stops, CATCH, jnp.where(ends, STRAIGHT, memory.phase))
        )
        changed = begins | stops | ends

        spin_hand = jnp.where(begins, hand, turning)
        lock = self.lock * jnp.minimum(1.0, (self.lock_speed / speed) ** 2)
        lock = lock + self.rate_gain * (self.rate - spin_hand * estimate.yaw_rate)
        lock = jnp.clip(lock, -self.straight.limit, self.straight.limit)
        over = Command(self.throttle + 0.0 * lock, spin_hand * lock)
        back = Command(0.0 * lock, -jnp.sign(estimate.yaw_rate) * self.counter)
        ahead_command = self.straight.command(straight, seen, self.straight.speed)
        command = Command(
            *(
                jnp.where(phase == SPIN, o, jnp.where(phase == CATCH, b, s))
                for o, b, s in zip(over, back, ahead_command, strict=True)
            )
        )
        straight = straight._replace(
            bearing=bearing,
            # A new corridor: nothing is known of the offset but what the sonars will tell.
            offset=jnp.where(phase == STRAIGHT, straight.offset, 0.0),
            integral=jnp.where(phase == STRAIGHT, straight.integral, 0.0),
        )
        return command, Memory(
            phase,
            memory.turn + begins,
            jnp.where(changed, now, memory.since),
            jnp.where(begins, 0.0, walked),
            ahead,
            before,
            straight,
        )


def drift_turn(course: Course, car: Car, speed: float | None = None, laps: int = 1) -> DriftTurn:
    """For a course and a nominal car; `speed` (m/s) is what it brings to a turn.

    Raises `InputError` where a closed course has no corners, as those of centre lines and maps.
    """
    turns = course.turns_ahead(laps)
    if course.closed and not turns:
        raise InputError(
            f"{course.name}: drift-turn needs straights with corners between them; "
            "examples/grip_limit.py laps a course without"
        )
    marks = [course.start_distance] + [t.distance for t in turns]
    sonar = car.sensors.sonar
    front = straighten.mount_number(car, "front")
    return DriftTurn(
        straight=straighten.straighten(course, car, SPEED if speed is None else speed),
        angles=np.array([t.angle for t in turns] + [0.0]),
        gaps=np.append(np.diff(marks), np.inf),
        front_x=sonar.mounts[front].x,
        width=course.width or 1.0,
        ping=(len(sonar.mounts) if sonar.firing == "in-turn" else 1) / sonar.rate,
        front=front,
    )
