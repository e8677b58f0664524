"""Turns of a drive, and what became of it."""

import dataclasses
import math
from typing import Any

import numpy as np

from countersteer.course.course import Course, progress

STRAIGHT_RATE, STRAIGHT_SLIP = math.radians(30), math.radians(10)
STRAIGHT_FOR = 0.05  # s below both until a turn has ended
LONGEST = 2.0  # s after which a turn has ended whatever the car does
SLOW = 0.2  # m/s under which the direction of motion, and so sideslip, means nothing


@dataclasses.dataclass(frozen=True)
class TurnResult:
    """One turn; names and units are those of the JSON."""

    begin_s: float
    end_s: float
    entry_speed_mps: float
    peak_sideslip_deg: float
    peak_yaw_rate_degps: float
    heading_error_deg: float
    duration_s: float


def sideslip(vx: np.ndarray, vy: np.ndarray) -> np.ndarray:
    """Angle from the nose to the velocity (rad); 0 where the car all but stands."""
    return np.where(np.hypot(vx, vy) > SLOW, np.arctan2(vy, vx), 0.0)


def find_turns(
    course: Course,
    time: np.ndarray,
    heading: np.ndarray,
    vx: np.ndarray,
    vy: np.ndarray,
    yaw_rate: np.ndarray,
    turn: np.ndarray,
    laps: int,
) -> list[TurnResult]:
    """The turns that the driver handed over to.

    `turn` counts those begun. A turn ends when the yaw rate is under 30 °/s and the sideslip under
    10° for 50 ms, or after 2 s; the yaw rate must have been over that before. The heading error is
    that at the end, less the outgoing corridor's.
    """
    slip = sideslip(vx, vy)
    calm = going_straight(vx, vy, yaw_rate)
    results = []
    bearing = course.start[2]
    for number, corner in enumerate(course.turns_ahead(laps), start=1):
        begun = np.nonzero(turn >= number)[0]
        bearing += corner.angle
        if not len(begun):
            break
        begin = int(begun[0])
        late = np.nonzero(time >= time[begin] + LONGEST)[0]
        last = int(late[0]) if len(late) else len(time) - 1
        stirred = begin + int(np.argmax(~calm[begin : last + 1]))
        end, still = last, time[stirred]
        for i in range(stirred, last + 1):
            still = still if calm[i] else time[i]
            if calm[i] and time[i] - still >= STRAIGHT_FOR - 1e-9:
                end = i
                break
        during = slice(begin, end + 1)
        error = math.remainder(heading[end] - bearing, 2 * math.pi)
        results.append(
            TurnResult(
                begin_s=float(time[begin]),
                end_s=float(time[end]),
                entry_speed_mps=float(np.hypot(vx[begin], vy[begin])),
                peak_sideslip_deg=float(np.degrees(np.abs(slip[during]).max())),
                peak_yaw_rate_degps=float(np.degrees(np.abs(yaw_rate[during]).max())),
                heading_error_deg=math.degrees(error),
                duration_s=float(time[end] - time[begin]),
            )
        )
    return results


class Judge:
    """Follows a drive while it runs: how far it came, and whether it is over.

    A drive that has reached its goal runs on until the turn that it is in, if any, has ended.
    """

    STALLED = 5.0  # s without a step ahead

    def __init__(self, course: Course | None, laps: int) -> None:
        """For a course; without one nothing ends a drive but its time."""
        self.course = course
        self.goal = course.lap_end(laps) if course else None
        self.distance = course.start_distance if course else 0.0
        self.furthest, self.since = self.distance, 0.0
        self.goal_time: float | None = None
        self.stirred = 0.0  # last time at which the car was not going straight

    def follow(
        self, time: np.ndarray, x: np.ndarray, y: np.ndarray, calm: np.ndarray
    ) -> int | None:
        """Index of the sample at which the drive is over, if it is among these."""
        if self.course is None or self.goal is None:
            return None
        walked = progress(self.course, x, y, self.distance)
        self.distance = float(walked[-1])
        for i, (now, distance, straight) in enumerate(zip(time, walked, calm, strict=True)):
            if distance > self.furthest + 0.05:
                self.furthest, self.since = distance, float(now)
            if not straight:
                self.stirred = float(now)
            if self.goal_time is None and distance >= self.goal - 1e-9:
                self.goal_time = float(now)
            if self.goal_time is not None and (
                now - self.stirred >= STRAIGHT_FOR - 1e-9 or now - self.goal_time >= LONGEST
            ):
                return i
        return None

    def stalled(self, time: float) -> bool:
        """Whether the car has stopped getting ahead."""
        return self.goal is not None and self.goal_time is None and time - self.since > self.STALLED


def going_straight(vx: np.ndarray, vy: np.ndarray, yaw_rate: np.ndarray) -> np.ndarray:
    """Where yaw rate and sideslip are both under what ends a turn."""
    return (np.abs(yaw_rate) < STRAIGHT_RATE) & (np.abs(sideslip(vx, vy)) < STRAIGHT_SLIP)


def summary(
    judge: Judge, laps: int, status: str, table: dict[str, np.ndarray], contacts: int
) -> dict[str, Any]:
    """The JSON of a drive: `table` holds columns of `truth.csv` and `turn`."""
    turns = (
        find_turns(
            judge.course,
            table["time_s"],
            table["heading_rad"],
            table["vx_mps"],
            table["vy_mps"],
            table["yaw_rate_radps"],
            table["turn"],
            laps,
        )
        if judge.course is not None
        else []
    )
    completed = status in ("goal reached", "done")
    return {
        "completed": completed,
        "success": completed and contacts == 0,
        "status": status,
        "wall_contacts": contacts,
        "lap_time_s": judge.goal_time,
        "turns": [dataclasses.asdict(turn) for turn in turns],
    }
