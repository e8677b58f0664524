"""`Task`: a course to be driven to its goal, and the judge of the drive.

The judge takes one sample of one drive. A `scan` over samples judges a recorded drive, a `vmap` a
batch. It uses motion and course alone, so all drivers and recordings are judged alike.
"""

import dataclasses
import math
from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.position import Line, line_of
from countersteer.kept_programs import kept
from countersteer.signals import Array, Motion, Scalar
from countersteer.task import turns as turning
from countersteer.task.turns import (
    LONGEST,
    ROUNDING,
    STRAIGHT_FOR,
    Approach,
    Corners,
    Turns,
    goes_straight,
)

DRIFT = math.radians(25)  # sideslip; beyond it, a turn is a drift
PERIOD = 0.005  # s between two samples that are judged, as in truth.csv
STALLED = 5.0  # s without progress, after which a drive has stalled
STEP = 0.05  # m that count as progress


class Outcome(Enum):
    """State or end of a drive. The values are messages for people; arrays hold the `code`."""

    DRIVING = "driving"
    REACHED = "goal reached"
    TOUCHED = "touched a wall"
    ROLLED = "rolled over"
    STALLED = "stalled"
    LOST = "lost its state"
    LATE = "out of time"
    INTERRUPTED = "interrupted"
    DONE = "done"  # without a goal, and without a failure

    @property
    def code(self) -> int:
        """The number of the outcome."""
        return list(Outcome).index(self)

    @classmethod
    def of(cls, code: Scalar) -> "Outcome":
        """The outcome of a code."""
        return list(Outcome)[int(code)]


class Sample(NamedTuple):
    """A sample of a drive, as the judge needs it."""

    time: Scalar  # s
    motion: Motion
    wall_contacts: Scalar
    rolled_over: Scalar
    turn: Scalar = 0  # turns begun, by the driver's own account: only recorded


def samples(record: Any, rows: np.ndarray, dt: float) -> Sample:
    """The samples of some rows of a `simulator.Record` whose ticks last `dt` (s)."""
    happened = (record.motion, record.wall_contacts, record.rolled_over, record.status.turn)
    return Sample(record.tick[rows] * dt, *jax.tree.map(lambda leaf: leaf[rows], happened))


class Score(NamedTuple):
    """The result of a drive so far."""

    outcome: Scalar  # the code of an `Outcome`
    distance: Scalar  # along the centre line, m
    furthest: Scalar
    furthest_at: Scalar  # s
    goal_time: Scalar  # s; inf until it is reached
    stirred_at: Scalar  # last time at which the car was not going straight
    wall_contacts: Scalar
    time: Scalar  # of the last sample
    handover: Array  # when the driver began each turn, by its own account (s); inf: never
    turns: Turns
    approach: Approach


@pytree
class Task:
    """To drive a course from start to goal, or for a number of laps if it is closed.

    After the goal, a drive goes on until a turn under way has ended. With `walls_end` it ends at
    the first touch of a wall. Without a goal it ends only by a failure. With `of_log` it may rest
    without limit, and its place is found again after a gap.
    """

    line: Line | None  # the centre line; None: there is no goal
    start: Scalar  # distance along it, m
    goal: Scalar  # m
    corners: Corners
    walls_end: bool = dataclasses.field(default=False, metadata={"static": True})
    of_log: bool = dataclasses.field(default=False, metadata={"static": True})

    @classmethod
    def of(
        cls, course: Course | None, laps: int = 1, walls_end: bool = False, dtype: Any = np.float64
    ) -> "Task":
        """For a course, in a precision. Without a goal, `walls_end` has no effect."""
        number = np.dtype(dtype).type
        if course is None or course.goal_distance is None:
            none = Corners(*[np.zeros(0, dtype)] * 4)
            return cls(line=None, start=number(0), goal=number(np.inf), corners=none)
        return cls(
            line=line_of(course, dtype),
            start=number(course.start_distance),
            goal=number(course.lap_end(laps)),
            corners=turning.corners_of(course, laps, dtype),
            walls_end=walls_end,
        )

    def init(self) -> Score:
        """Before the first sample."""
        count, dtype = len(self.corners.angle), self.corners.angle.dtype
        zero, inf = dtype.type(0), dtype.type(np.inf)
        never = np.full(count, np.inf, dtype)
        outcome = np.int32(Outcome.DRIVING.code)
        at = (self.start, self.start, zero, inf, zero, zero, zero)
        return Score(outcome, *at, never, *turning.before_any(count, dtype))

    def update(self, score: Score, sample: Sample) -> Score:
        """The score after one more sample. The score of a drive that has ended stays."""
        time, motion = sample.time, sample.motion
        distance, finite = score.distance, jnp.isfinite(motion.x + motion.vx + motion.yaw_rate)
        if self.line is not None:
            follow = self.line.find if self.of_log else self.line.follow
            distance = follow(motion.x, motion.y, distance).distance
        ahead = distance > score.furthest + STEP
        reached = jnp.isinf(score.goal_time) & (distance >= self.goal - 1e-9)
        goal_time = jnp.where(reached, time, score.goal_time)
        stirred_at = jnp.where(goes_straight(motion), score.stirred_at, time)
        furthest_at = jnp.where(ahead, time, score.furthest_at)
        speed = jnp.sqrt(motion.vx**2 + motion.vy**2)
        seen = turning.approached(score.approach, distance, speed)
        turns = turning.follow(score.turns, self.corners, seen, distance, motion, time)
        turns = jax.tree.map(lambda a, b: jnp.where(finite, a, b), turns, score.turns)
        handed = jnp.arange(len(score.handover)) < sample.turn
        handover = jnp.where(handed & jnp.isinf(score.handover), time, score.handover)
        over = ~jnp.isinf(goal_time) & (
            (time - stirred_at >= STRAIGHT_FOR - ROUNDING) | (time - goal_time >= LONGEST)
        )
        stalled = jnp.isinf(goal_time) & (time - furthest_at > STALLED)
        outcome = jnp.int32(Outcome.DRIVING.code)
        for found, name in (
            (stalled & (self.line is not None and not self.of_log), Outcome.STALLED.code),
            (over, Outcome.REACHED.code),
            (sample.rolled_over > 0, Outcome.ROLLED.code),
            (self.walls_end & (sample.wall_contacts > 0), Outcome.TOUCHED.code),
            (~finite, Outcome.LOST.code),
        ):
            outcome = jnp.where(found, jnp.int32(name), outcome)
        new = Score(
            outcome,
            distance,
            jnp.where(ahead, distance, score.furthest),
            furthest_at,
            goal_time,
            stirred_at,
            sample.wall_contacts,
            time,
            handover,
            turns,
            seen,
        )
        ended = score.outcome != Outcome.DRIVING.code
        return jax.tree.map(
            lambda old, new: jnp.where(ended, old, jnp.asarray(new, jnp.result_type(old))),
            score,
            new,
        )

    def follow(self, score: Score, samples: Sample) -> tuple[Score, np.ndarray]:
        """The score after a piece of a drive, and the outcome at each of its samples.

        Leaves of `samples` have a leading axis of samples. They are converted to 64 bits.
        """
        # On another device, if there is one, this need not wait for a loop under computation.
        with jax.enable_x64(True), jax.default_device(jax.devices()[-1]):
            wide = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), samples)
            score, outcomes = _follow(self, score, wide)
            return jax.tree.map(np.asarray, score), np.asarray(outcomes)


@kept()
def _follow(task: Task, score: Score, samples: Sample) -> tuple[Score, Array]:
    def step(score: Score, sample: Sample) -> tuple[Score, Scalar]:
        score = task.update(score, sample)
        return score, score.outcome

    return jax.lax.scan(step, score, samples)


def summary(score: Score, outcome: Outcome) -> dict[str, Any]:
    """The JSON of a drive with this outcome. A goal reached with a wall touched is `TOUCHED`."""
    completed = outcome in (Outcome.REACHED, Outcome.DONE)
    contacts = int(score.wall_contacts)
    turns = turning.results(score.turns, score.handover, float(score.time))
    if completed and contacts:
        outcome = Outcome.TOUCHED
    slips = [turn.peak_sideslip_deg for turn in turns]
    return {
        "completed": completed,
        "success": completed and contacts == 0,
        "outcome": outcome.value,
        "verdict": outcome.value + (_of_drifts(slips) if completed else ""),
        "wall_contacts": contacts,
        "lap_time_s": float(score.goal_time) if np.isfinite(score.goal_time) else None,
        "drifts": sum(slip > math.degrees(DRIFT) for slip in slips),
        "turns": [dataclasses.asdict(turn) for turn in turns],
    }


def _of_drifts(slips: Sequence[float]) -> str:
    """What a verdict adds where not every turn was a drift."""
    drifts = sum(slip > math.degrees(DRIFT) for slip in slips)
    if drifts == len(slips):
        return ""
    if drifts:
        return f", but drifted in {drifts} of {len(slips)} turns"
    return f", but did not drift: {max(slips):.0f}° of sideslip at most"
