"""Drifts round the corners of a corridor, on sonar, encoder, gyroscope and accelerometer."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Lidar
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.position import FAR, as_table, beyond_corner
from countersteer.drivers import policy, straighten
from countersteer.drivers.driver import Observation, Status, paced
from countersteer.drivers.stop_angle import StopAngle
from countersteer.drivers.straighten import Straighten
from countersteer.drivers.turning import Turning
from countersteer.errors import InputError
from countersteer.estimation import lidar_walls
from countersteer.signals import Array, Command, Scalar

STRAIGHT, SPIN, STOP, SETTLE = 0, 1, 2, 3
SPEED = 2.0  # m/s, default
NEWS = 0.03  # m, standard deviation of the corner's distance by the front sonar
DOUBT = 0.2  # m, standard deviation of the estimated distance as a corridor begins
SLIPPING = 0.12  # m per root second: growth of that deviation, by odometry
GATE = 3.0  # standard deviations beyond which a reading is a spike
FOLLOWS, STEADY = 0.15, 2  # steady readings: largest change (m), and number of changes in a row
RESTS = (0.17, 1.0)  # |vy / vx| and yaw rate (rad/s), below which a linked turn may begin
AGREE, INSIST = 0.08, 6  # m within which odd readings agree; so many in a row are no spikes


class DriftTurnMemory(NamedTuple):
    """The driver between two decisions."""

    phase: Scalar
    turn: Scalar  # turns begun
    since: Scalar  # when the phase began, s
    entry: Scalar  # speed at the turn's beginning, m/s
    hand: Scalar  # of the turn: 1 left, -1 right
    calm: Scalar  # s for which the car has gone straight
    corner: Scalar  # distance along the corridor to the next corner, m
    doubt: Scalar  # variance of `corner`, m²
    heard: Scalar  # last reading of the front sonar, m
    odd: Scalar  # `corner` by the last usable reading, less the corrected `corner`, m
    odds: Scalar  # unexpected readings in a row that agree
    follows: Scalar  # readings in a row that differ little from the one before
    straight: straighten.StraightenMemory

    @property
    def time(self) -> Scalar:
        """Time of the last decision (s)."""
        return self.straight.time

    @property
    def command(self) -> Command:
        """The last command."""
        return self.straight.command


@pytree
class DriftTurn:
    """Straightens; turns the wheels over before the corner; turns them back in time.

    The distance to the corner decides when the wheels turn over. With `by` "wall", front sonar and
    encoder give it. `by` "pose" is for corners so round that no wall stands ahead. The pose
    estimate then gives the distance. It also gives offset and angle to the corridor, as side sonars
    mislead in a curve. Corridors are then the straights from corner point to corner point.

    At each tick of the spin the driver predicts how far the car still turns if stopped now
    (`stop_angle`). It stops the turn when this is the angle that is left to the target.

    Targets are headings of corridors, so the next turn corrects a turn's error. With `carry` 0, a
    target counts from the heading at the turn's beginning. `carry` has no effect by "pose".
    """

    straight: Straighten
    turning: Turning
    stop_angle: StopAngle
    angles: Array  # of the turns in their order, rad; 0 after the last
    gaps: np.ndarray  # distance along the centre line to each turn from the one before, m
    front_x: Scalar  # mount of the front sonar, m
    front_axle: Scalar
    width: Scalar
    cone: Scalar  # half-angle of the front sonar's cone, rad
    front: int = dataclasses.field(metadata={"static": True})
    by: str = dataclasses.field(default="wall", metadata={"static": True})
    lidar: Lidar | None = None  # if the car has one, it replaces the front sonar
    carry: Scalar = 1.0  # part of a turn's error that the next turn corrects
    linked: Scalar = 0.0  # 1: a turn begins when the last slide ends, wherever the walls are
    longest: Scalar = 1.2  # s, longest phase of a turn
    phases = ("straight", "spin", "stop", "settle")

    def reset(self, key: jax.Array) -> DriftTurnMemory:
        """Straight ahead, `gaps[0]` before the first corner."""
        gap = jnp.asarray(self.gaps)[0]
        first = (STRAIGHT, 0, 0.0, 0.0, 1.0, 0.0, gap, DOUBT**2, math.inf, 0.0, 0, 0)
        return DriftTurnMemory(*first, self.straight.reset(key))

    def act(
        self, memory: DriftTurnMemory, observation: Observation
    ) -> tuple[Command, DriftTurnMemory]:
        """One control period."""
        return paced(self.think, memory, observation)

    def status(self, memory: DriftTurnMemory) -> Status:
        """The turn, its phase, and the estimated place in the corridor."""
        told = self.straight.status(memory.straight)
        return told._replace(turn=memory.turn, phase=memory.phase, doubts=memory.odds)

    def think(self, memory: DriftTurnMemory, seen: Observation) -> tuple[Command, DriftTurnMemory]:
        """The command from now on, and the memory after this decision."""
        now, own = seen.time, self.turning
        dt = now - memory.time
        straight = self.straight.follow(memory.straight, seen)
        estimate = seen.estimate
        angle = jnp.asarray(self.angles)[memory.turn]
        gap = jnp.asarray(self.gaps)[memory.turn + 1]
        corner, doubt, spikes = self._approach(memory, seen, straight.error, angle, dt)
        if self.by == "pose":
            place = self.straight.legs.seen(memory.turn, estimate.x, estimate.y, estimate.heading)
            straight = straight._replace(offset=place.offset, error=place.bearing)
            corner = place.distance

        speed = jnp.maximum(estimate.vx, 0.5)
        lead = own.begins_at(speed, estimate.friction, angle)
        lined_up = jnp.abs(straight.error) < 0.5
        near = (memory.phase == STRAIGHT) & (corner < lead) & lined_up
        fast = (memory.turn > 0) | (estimate.vx > 0.9 * self.straight.speed)
        rests = (jnp.abs(estimate.vy) < RESTS[0] * speed) & (jnp.abs(estimate.yaw_rate) < RESTS[1])
        free = (memory.phase == STRAIGHT) | ((memory.phase == SETTLE) & rests)
        begins = jnp.where(self.linked > 0, free & fast, near) & (angle != 0)
        ahead, aside = corner * jnp.cos(angle), None
        if self.lidar is not None:
            # Only from nearly the right place can it be told which wall a beam ends on.
            ahead, aside = beyond_corner(corner, straight.offset, angle)
        turn = angle + (1 - self.carry) * straight.error
        straight = self.straight.turned(straight, turn, begins, aside)
        hand = jnp.where(begins, jnp.sign(angle), memory.hand)
        entry = jnp.where(begins, speed, memory.entry)

        left_over = -hand * straight.error
        rate = hand * estimate.yaw_rate
        still = self.stop_angle.angle(speed, jnp.maximum(rate, 0.0))
        still = own.still(still, estimate.servo)
        slip = -hand * jnp.arctan2(estimate.vy, speed)
        missing = left_over - still + own.beyond(entry, slip, still, estimate.servo)
        late = now - memory.since > self.longest
        stops = (memory.phase == SPIN) & ((missing <= 0) | late)
        settles = (memory.phase == STOP) & ((rate < own.settled) | late)
        straight_on = (jnp.abs(estimate.yaw_rate) < 0.5) & (jnp.abs(estimate.vy) < 0.17 * speed)
        calm = jnp.where(straight_on, memory.calm + dt, 0.0)
        ends = (memory.phase == SETTLE) & ((calm > 0.06) | late)
        phase = memory.phase
        for happens, into in ((begins, SPIN), (stops, STOP), (settles, SETTLE), (ends, STRAIGHT)):
            phase = jnp.where(happens, into, phase)
        changed = begins | stops | settles | ends

        front_slip = jnp.arctan2(estimate.vy + self.front_axle * estimate.yaw_rate, speed)
        hold = (
            -own.hold_p * straight.error
            - own.hold_d * estimate.yaw_rate
            + own.hold_slip * front_slip
        )
        battery = jnp.clip(estimate.battery, 0.5, 1.2)
        spin = own.spin(entry, rate, estimate.friction, battery, estimate.servo)
        stop = own.stop(entry, missing, battery)
        on = self.straight.command(straight, seen, self.straight.speed)
        steering, throttle = on.steering, on.throttle
        for which, lock, power in (
            (SPIN, hand * spin.steering, spin.throttle),
            (STOP, hand * stop.steering, stop.throttle),
            (SETTLE, hold, own.hold_throttle),
        ):
            steering = jnp.where(phase == which, lock, steering)
            throttle = jnp.where(phase == which, power, throttle)
        limit = self.straight.limit
        command = Command(jnp.clip(throttle, -1.0, 1.0), jnp.clip(steering, -limit, limit))
        integral = jnp.where(phase == STRAIGHT, straight.integral, 0.0)
        return command, DriftTurnMemory(
            phase,
            memory.turn + begins,
            jnp.where(changed, now, memory.since),
            entry,
            hand,
            calm,
            jnp.where(begins, gap + ahead, corner),
            jnp.where(begins, DOUBT**2, doubt),
            *spikes,
            straight._replace(integral=integral, command=command),
        )

    def _approach(
        self, memory: DriftTurnMemory, seen: Observation, error: Scalar, angle: Scalar, dt: Scalar
    ) -> tuple[Scalar, Scalar, tuple[Scalar, Scalar, Scalar, Scalar]]:
        """Distance to the next corner and its variance, by odometry and the wall ahead.

        The third value holds the new `heard`, `odd`, `odds` and `follows`. With `straight.by`
        "pose", the pose gives the distance.

        The wall behind a corner by an angle a is w/2 beyond it. Its normal is 90° - a off the
        heading. So it is c sin a + w/2 away from a sonar that is c before the corner. If the cone
        is short of the normal by an angle b, the echo comes from 1 / cos b times as far.

        A reading that odometry does not expect is a spike, until `INSIST` in a row agree. A reading
        that repeats while the car moves is ignored. So is one that leaps: of many spikes, some
        match by chance. A steady and expected reading is believed at once.
        """
        along = seen.estimate.vx * jnp.cos(error) - seen.estimate.vy * jnp.sin(error)
        corner = memory.corner - dt * along
        doubt = memory.doubt + dt * SLIPPING**2
        if self.straight.by == "pose":
            pose = seen.estimate
            place = self.straight.legs.seen(memory.turn, pose.x, pose.y, pose.heading)
            corner = place.distance
            return corner, doubt, (memory.heard, memory.odd, memory.odds, memory.follows)
        heard = seen.sonar[self.front]
        came = heard.came(dt)
        near = jnp.abs(heard.value - memory.heard) < FOLLOWS
        follows = jnp.where(came, jnp.where(near, memory.follows + 1, 0), memory.follows)
        stuck = (heard.value == memory.heard) & (along > 0.5)
        looks = (jnp.abs(error) < 0.3) & (memory.phase == STRAIGHT) & jnp.isfinite(heard.value)
        fresh = came & looks & ~stuck & (follows >= STEADY)
        sine = jnp.maximum(jnp.sin(jnp.abs(angle)), 0.5)
        short = jnp.maximum(jnp.abs(math.pi / 2 - jnp.abs(angle)) - self.cone, 0.0)
        told = (heard.value * jnp.cos(short) - self.width / 2) / sine + self.front_x
        if self.lidar is not None and seen.lidar is not None:
            offset = memory.straight.offset
            told, sees = lidar_walls.corner_ahead(
                self.lidar, self.width, seen.lidar.value, error, offset, angle
            )
            fresh = seen.lidar.came(dt) & (memory.phase == STRAIGHT) & sees
        news = jnp.where(fresh, told - corner, 0.0)
        likely = news**2 < GATE**2 * (doubt + NEWS**2)
        agrees = jnp.where(jnp.abs(news - memory.odd) < AGREE, memory.odds + 1, 1)
        odds = jnp.where(fresh, jnp.where(likely, 0, agrees), memory.odds)
        doubt = jnp.where(odds >= INSIST, DOUBT**2, doubt)
        gain = jnp.where(fresh & (likely | (odds >= INSIST)), doubt / (doubt + NEWS**2), 0.0)
        spikes = (
            jnp.where(came, heard.value, memory.heard),
            jnp.where(fresh, (1 - gain) * news, memory.odd),
            odds,
            follows,
        )
        return corner + gain * news, (1 - gain) * doubt, spikes


def drift_turn(
    course: Course,
    car: Car,
    speed: float | None = None,
    laps: int = 1,
    turning: Turning | None = None,
    stop_angle: StopAngle | None = None,
    by: str | None = None,
    straight_by: str = "filter",
) -> DriftTurn:
    """For a course and a nominal car; `speed` (m/s) is what it brings to a turn.

    Laws that are not given are those of the library's policy. `straight_by` is the `by` of
    `Straighten`. `by` is that of `DriftTurn`. Its default is "pose" if the centre line's radius R
    in any corner is over half the width w, else "wall". In such a corner the wall ahead is oblique
    by more than asin(R / (R + w/2)) = 30°, and not where a mitred corner would have it.

    Raises `InputError` for a course without corners to count, such as a centre line or a map.
    """
    turns = course.turns_ahead(laps)
    if course.sides is not None and not turns:
        raise InputError(
            f"{course.name}: drift-turn needs straights with corners between them; "
            "examples/grip_limit.py laps a course without"
        )
    marks = [course.start_distance] + [t.distance for t in turns]
    sonar = car.sensors.sonar
    front = straighten.mount_number(car, "front")
    width = course.width or 1.0
    if by is None:
        by = "pose" if any(t.radius > width / 2 for t in turns) else "wall"
    return DriftTurn(
        straight=straighten.straighten(
            course, car, SPEED if speed is None else speed, straight_by, laps
        ),
        turning=turning or policy.library().turning,
        stop_angle=stop_angle or policy.library().stop_angle,
        angles=as_table(np.array([t.angle for t in turns] + [0.0]), 0.0),
        gaps=as_table(np.append(np.diff(marks), [FAR, FAR]), FAR),
        front_x=sonar.mounts[front].x,
        front_axle=car.body.front_axle,
        width=width,
        cone=sonar.half_angle,
        front=front,
        by=by,
        lidar=car.sensors.lidar if car.sensors.lidar.beams else None,
    )
