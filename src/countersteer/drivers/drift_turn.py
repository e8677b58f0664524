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
from countersteer.drivers import policy, straighten
from countersteer.drivers.driver import Observation, Status, paced
from countersteer.drivers.stop_angle import StopAngle
from countersteer.drivers.straighten import Straighten
from countersteer.drivers.turning import Turning
from countersteer.errors import InputError
from countersteer.estimation import lidar_walls
from countersteer.signals import Array, Command, Scalar

STRAIGHT, SPIN, STOP, SETTLE = 0, 1, 2, 3
SPEED = 2.0  # m/s, unless another is asked for
NEWS = 0.03  # m, standard deviation of what the front sonar says of the corner's distance
DOUBT = 0.2  # m, standard deviation of that distance as a corridor begins
SLIPPING = 0.12  # m/s, by which odometry may be off: what the doubt grows by in a second
GATE = 3.0  # standard deviations beyond which a reading is a spike
FOLLOWS, STEADY = 0.15, 2  # m from one reading to the next at most, and how often in a row
RESTS = (0.17, 1.0)  # sideslip and yaw rate (rad/s) under which a linked turn may follow
AGREE, INSIST = 0.08, 6  # m within which so many of them in a row agree, and are no spikes


class DriftTurnMemory(NamedTuple):
    """What the driver is about."""

    phase: Scalar
    turn: Scalar  # turns begun
    since: Scalar  # when the phase began, s
    entry: Scalar  # speed at which the turn was begun, m/s
    hand: Scalar  # of the turn: 1 left, -1 right
    calm: Scalar  # s for which the car has gone straight
    corner: Scalar  # distance along the corridor to the next corner, m
    doubt: Scalar  # its variance, m²
    heard: Scalar  # the front sonar's last reading, m
    odd: Scalar  # by how much the last that was not believed differed, m
    odds: Scalar  # how many in a row agreed on that
    follows: Scalar  # how many readings in a row followed the one before
    straight: straighten.StraightenMemory

    @property
    def time(self) -> Scalar:
        """Of the last thought (s)."""
        return self.straight.time

    @property
    def command(self) -> Command:
        """The last."""
        return self.straight.command


@pytree
class DriftTurn:
    """Straightens; turns the wheels over before the corner; turns them back in time.

    When the wheels turn over is told by the distance to the corner, which the front sonar and the
    encoder tell; or (`by` "pose"), where the corners are so round that no wall stands ahead, the
    pose estimate. Then it tells offset and angle to the corridor too, as side sonars mislead in a
    curve; corridors are for it the straights from corner point to corner point. At each tick of the
    turn the driver asks how far the car would still turn if it were stopped now (`stop_angle`), and
    stops when that is what is left of the target. Targets are headings of corridors, so a turn's
    error is the next one's to mend (`carry`, by the wall); without that they are counted from the
    heading at which the turn was begun.
    """

    straight: Straighten
    turning: Turning
    stop_angle: StopAngle
    angles: Array  # of the turns in their order, rad; 0 behind the last
    gaps: np.ndarray  # distance along the centre line to each turn from the one before, m
    front_x: Scalar  # mount of the front sonar, m
    front_axle: Scalar
    width: Scalar
    cone: Scalar  # half-angle of the front sonar's cone, rad
    front: int = dataclasses.field(metadata={"static": True})
    by: str = dataclasses.field(default="wall", metadata={"static": True})
    lidar: Lidar | None = None  # where the car has one, it looks for the corner instead
    carry: Scalar = 1.0  # part of a turn's error that is carried into the next one's target
    linked: Scalar = 0.0  # 1: a turn begins as soon as the slide of the last ends, walls or not
    longest: Scalar = 1.2  # s that a phase of a turn may take
    phases = ("straight", "spin", "stop", "settle")

    def reset(self, key: jax.Array) -> DriftTurnMemory:
        """Straight ahead, a corridor's length away from the first corner."""
        gap = jnp.asarray(self.gaps)[0]
        first = (STRAIGHT, 0, 0.0, 0.0, 1.0, 0.0, gap, DOUBT**2, math.inf, 0.0, 0, 0)
        return DriftTurnMemory(*first, self.straight.reset(key))

    def act(
        self, memory: DriftTurnMemory, observation: Observation
    ) -> tuple[Command, DriftTurnMemory]:
        """One control period."""
        return paced(self.think, memory, observation)

    def status(self, memory: DriftTurnMemory) -> Status:
        """The turn and its phase, and where it believes to be in its corridor."""
        told = self.straight.status(memory.straight)
        return told._replace(turn=memory.turn, phase=memory.phase, doubts=memory.odds)

    def think(self, memory: DriftTurnMemory, seen: Observation) -> tuple[Command, DriftTurnMemory]:
        """The command from now on, and the memory with what is new."""
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
        bend = jnp.tan(jnp.minimum(jnp.abs(angle), 2.1) / 2)
        lead = own.begins_at(speed, estimate.friction) * bend
        lined_up = jnp.abs(straight.error) < 0.5
        near = (memory.phase == STRAIGHT) & (corner < lead) & lined_up
        fast = (memory.turn > 0) | (estimate.vx > 0.9 * self.straight.speed)
        rests = (jnp.abs(estimate.vy) < RESTS[0] * speed) & (jnp.abs(estimate.yaw_rate) < RESTS[1])
        free = (memory.phase == STRAIGHT) | ((memory.phase == SETTLE) & rests)
        begins = jnp.where(self.linked > 0, free & fast, near) & (angle != 0)
        straight = self.straight.turned(straight, angle + (1 - self.carry) * straight.error, begins)
        hand = jnp.where(begins, jnp.sign(angle), memory.hand)
        entry = jnp.where(begins, speed, memory.entry)

        left_over = -hand * straight.error
        rate = hand * estimate.yaw_rate
        still = self.stop_angle.angle(speed, jnp.maximum(rate, 0.0))
        still = own.still(still, estimate.servo)
        slip = -hand * jnp.arctan2(estimate.vy, speed)
        missing = left_over - still + own.beyond(slip, still, estimate.servo)
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
        stop = own.stop(entry, missing)
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
            jnp.where(begins, gap + corner * jnp.cos(angle), corner),
            jnp.where(begins, DOUBT**2, doubt),
            *spikes,
            straight._replace(integral=integral, command=command),
        )

    def _approach(
        self, memory: DriftTurnMemory, seen: Observation, error: Scalar, angle: Scalar, dt: Scalar
    ) -> tuple[Scalar, Scalar, tuple[Scalar, Scalar, Scalar, Scalar]]:
        """Distance to the next corner and its variance: odometry, and the wall ahead.

        The wall behind a corner by an angle a stands w/2 beyond it, its normal turned by 90° - a
        from the heading: from a distance c before the corner it is c sin a + w/2 away, and an
        echo comes from within the cone, so from as much farther as the cone is short of the normal.
        A reading that odometry does not expect is a spike, until several in a row agree; one that
        stands still while the car moves tells nothing, nor does one that leaps: of many spikes some
        would be expected. One that follows those before and is expected is believed at once.
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

    Laws that are not given are those of the library's policy. `straight_by` is what it straightens
    by, as in `Straighten`. `by`, what tells where a corner is, is "wall" or "pose"; by default what
    the roundest corner asks for. Where the centre line's radius R is over half the width w,
    the wall ahead stands oblique by more than asin(R / (R + w/2)) = 30°, and is no longer where
    that of a mitred corner would be.

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
    width = course.width or 1.0
    if by is None:
        by = "pose" if any(t.radius > width / 2 for t in turns) else "wall"
    return DriftTurn(
        straight=straighten.straighten(
            course, car, SPEED if speed is None else speed, straight_by, laps
        ),
        turning=turning or policy.library().turning,
        stop_angle=stop_angle or policy.library().stop_angle,
        angles=np.array([t.angle for t in turns] + [0.0]),
        gaps=np.append(np.diff(marks), [1e3, 1e3]),
        front_x=sonar.mounts[front].x,
        front_axle=car.body.front_axle,
        width=width,
        cone=sonar.half_angle,
        front=front,
        by=by,
        lidar=car.sensors.lidar if car.sensors.lidar.beams else None,
    )
