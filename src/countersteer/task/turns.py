"""The turns of a drive, found from motion and course alone, so that all drivers are judged alike.

Turn k begins when the heading is first 15° into corner k, counted from the corridor before it. The
car must be near that corner: within `NEAR` corridor widths of its arc, with no corner nearer. The
turn ends when yaw rate and sideslip have been under 30 °/s and 10° for 50 ms, after they have been
above. It ends at the latest after 2 s, or as another turn begins. A spin on a straight is no turn,
nor is a spin the wrong way near a corner.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.course.course import Course
from countersteer.signals import Array, Motion, Scalar

INTO = math.radians(15)  # heading into a corner at which its turn begins
STRAIGHT_RATE, STRAIGHT_SLIP = math.radians(30), math.radians(10)
STRAIGHT_FOR = 0.05  # s below both, after which a turn has ended
LONGEST = 2.0  # s after which a turn has ended whatever the car does
SLOW = 0.5  # m/s under which sideslip does not count
STANDS = 0.2  # m/s under which the direction of motion means nothing
ROUNDING = 1e-4  # s, of a time in 32 bits
NEAR = 1.5  # widths of the corridor
BEFORE = 0.5  # m of centre line before a turn's beginning; its entry speed is taken there
MARK = 0.05  # m between two places whose speeds are kept
MARKS = round(BEFORE / MARK) + 2


class Corners(NamedTuple):
    """The corners between start and goal: arrays of one number a corner."""

    before: Array  # bearing of the corridor before it, rad; whole turns do not matter
    angle: Array  # by which it turns, positive to the left
    near: Array  # distances along the line between which a car is near it, m
    far: Array


class Approach(NamedTuple):
    """Speeds at the last places along the line, `MARK` apart; place i is kept in slot i % MARKS."""

    speed: Array  # (MARKS,) m/s
    last: Scalar  # number of the last place


class Turns(NamedTuple):
    """The turns so far: arrays of one number a turn. Times (s) are inf until they come."""

    into: Array  # heading into the corner at the last sample, rad
    spun: Array  # whole turns (rad) to subtract from it; NaN while the car is not near
    begin: Array
    end: Array
    stirred: Array  # 1 once the car has not gone straight in it
    calm_since: Array
    entry_speed: Array
    peak_sideslip: Array
    peak_yaw_rate: Array
    overshoot: Array  # largest heading beyond that of the corridor after it, rad
    error: Array  # heading less that corridor's, at the end, rad


@dataclasses.dataclass(frozen=True)
class TurnResult:
    """One turn; names and units are those of the JSON."""

    begin_s: float
    end_s: float
    entry_speed_mps: float
    peak_sideslip_deg: float
    peak_yaw_rate_degps: float
    heading_error_deg: float
    heading_overshoot_deg: float
    duration_s: float
    handover_s: float | None  # beginning by the driver's own account; None: it gave none


def sideslip(vx: Array, vy: Array) -> Array:
    """Angle from the nose to the velocity (rad); 0 below the speed `SLOW`, and backwards."""
    own = jnp if isinstance(vx, jax.Array) else np  # NumPy's arrays keep their precision
    counts = (vx**2 + vy**2 > SLOW**2) & (vx > 0)
    return own.where(counts, own.arctan2(vy, own.where(counts, vx, 1.0)), 0.0)


def goes_straight(motion: Motion) -> Scalar:
    """Whether yaw rate and sideslip are both below the limits that end a turn.

    Here sideslip counts down to the speed `STANDS`, and backwards too. A car that is slow in the
    middle of a slide, or goes backwards out of a spin, does not go straight.
    """
    vx, vy = motion.vx, motion.vy
    ahead = (vx > 0) & (jnp.abs(vy) < math.tan(STRAIGHT_SLIP) * vx)
    stands = vx**2 + vy**2 < STANDS**2
    return (jnp.abs(motion.yaw_rate) < STRAIGHT_RATE) & (ahead | stands)


def corners_of(course: Course, laps: int, dtype: Any) -> Corners:
    """The corners of a course with a centre line, in the order driven."""
    turns = course.turns_ahead(laps)
    angles = np.array([turn.angle for turn in turns])
    places = np.array([turn.distance for turn in turns])
    reach = NEAR * (course.width or 1.0) + np.array([abs(t.angle) * t.radius / 2 for t in turns])
    middles = (places[1:] + places[:-1]) / 2
    ends = np.concatenate([[-np.inf], middles, [np.inf]]) if turns else np.zeros(1)
    # The bearing of the corridor before a corner is that of the first corridor plus all corners
    # between. The heading at the start is no base: the car may stand at an angle.
    own = np.array([turn.distance for turn in course.turns])
    bent = np.array([turn.angle for turn in course.turns])
    bearings = math.atan2(*(course.line[1] - course.line[0])[::-1]) + np.cumsum(bent) - bent
    # The corners ahead are consecutive among the corners of all rounds.
    off = (own - places[0]) / course.length if len(turns) else np.zeros(1)
    first = int(np.argmin(np.abs(off - np.round(off) if course.closed else off)))
    before = bearings[(first + np.arange(len(turns))) % max(len(own), 1)]
    nearest = np.maximum(ends[:-1], places - reach), np.minimum(ends[1:], places + reach)
    return Corners(*(np.asarray(column, dtype) for column in (before, angles, *nearest)))


def before_any(count: int, dtype: Any) -> tuple[Turns, Approach]:
    """`count` turns before their beginning, and no speeds."""
    never, zero = np.full(count, np.inf, dtype), np.zeros(count, dtype)
    none = np.full(count, np.nan, dtype)
    turns = Turns(none, none, never, never, *[zero] * 7)
    return turns, Approach(np.zeros(MARKS, dtype), np.int32(-(2**30)))


def approached(old: Approach, distance: Scalar, speed: Scalar) -> Approach:
    """The speeds after one more sample."""
    here = jnp.floor(distance / MARK).astype(jnp.int32)
    places = here - (here - jnp.arange(MARKS)) % MARKS  # that the slots hold now
    return Approach(jnp.where(places > old.last, speed, old.speed), here)


def speed_before(seen: Approach, distance: Scalar) -> Scalar:
    """The car's speed `BEFORE` metres of centre line earlier (m/s)."""
    at = (distance - BEFORE) / MARK
    place = jnp.floor(at)
    slot = place.astype(jnp.int32) + jnp.arange(2)
    first, second = seen.speed[slot[0] % MARKS], seen.speed[slot[1] % MARKS]
    return first + (at - place) * (second - first)


def follow(
    old: Turns, corners: Corners, seen: Approach, distance: Scalar, motion: Motion, time: Scalar
) -> Turns:
    """The turns after one more sample, at a distance along the line."""
    rate, slip = jnp.abs(motion.yaw_rate), jnp.abs(sideslip(motion.vx, motion.vy))
    calm, hand = goes_straight(motion), jnp.sign(corners.angle)
    off, whole = motion.heading - corners.before, 2 * math.pi
    near = (distance >= corners.near) & (distance < corners.far)
    spun = jnp.where(jnp.isnan(old.spun), whole * jnp.round(off / whole), old.spun)
    # A whole turn the wrong way round does not count.
    back = jnp.isinf(old.begin) & (hand * (off - spun) < INTO - whole)
    spun = jnp.where(back, spun - hand * whole, spun)
    into = hand * (off - spun)
    # An overshoot in one turn, and its return, do not begin the next turn of the same hand.
    in_turn = (old.begin <= time) & jnp.isinf(old.end)
    same = jnp.any(in_turn & (hand == hand[:, None]), axis=1)
    passes = (old.into < INTO) & (into - old.into < math.pi)
    goes_on = hand * motion.yaw_rate > STRAIGHT_RATE
    begins = jnp.isinf(old.begin) & near & (into >= INTO) & (passes | ~same | goes_on)
    begin = jnp.where(begins, time, old.begin)
    under_way = (begin <= time) & jnp.isinf(old.end)
    stirred = jnp.where(under_way & ~calm, 1.0, old.stirred)
    calm_since = jnp.where(calm & ~begins, old.calm_since, time)
    late = time - begin >= LONGEST - ROUNDING
    settled = (stirred > 0) & calm & (time - calm_since >= STRAIGHT_FOR - ROUNDING)
    ends = under_way & (late | settled | (jnp.any(begins) & ~begins))
    beyond = into - jnp.abs(corners.angle)
    error = hand * beyond
    error = error - 2 * math.pi * jnp.round(error / (2 * math.pi))

    def peak(now: Scalar, before: Array) -> Array:
        return jnp.where(under_way, jnp.maximum(before, now), before)

    return Turns(
        into,
        jnp.where(near | jnp.isfinite(begin), spun, jnp.nan),
        begin,
        jnp.where(ends, time, old.end),
        stirred,
        calm_since,
        jnp.where(begins, speed_before(seen, distance), old.entry_speed),
        peak(slip, old.peak_sideslip),
        peak(rate, old.peak_yaw_rate),
        peak(beyond, old.overshoot),
        jnp.where(under_way, error, old.error),
    )


def results(turns: Turns, handover: Array, time: float) -> list[TurnResult]:
    """The turns that have begun. One under way ends at `time`, the end of the drive.

    `handover` has the times at which the driver began its turns, or inf.
    """
    found = []
    for i in np.nonzero(np.isfinite(turns.begin))[0].tolist():
        begin, end = float(turns.begin[i]), min(float(turns.end[i]), time)
        found.append(
            TurnResult(
                begin_s=begin,
                end_s=end,
                entry_speed_mps=float(turns.entry_speed[i]),
                peak_sideslip_deg=math.degrees(turns.peak_sideslip[i]),
                peak_yaw_rate_degps=math.degrees(turns.peak_yaw_rate[i]),
                heading_error_deg=math.degrees(turns.error[i]),
                heading_overshoot_deg=math.degrees(turns.overshoot[i]),
                duration_s=end - begin,
                handover_s=float(handover[i]) if math.isfinite(handover[i]) else None,
            )
        )
    return found
