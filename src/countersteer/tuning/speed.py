"""A car's speed over time from what it reports, with the standard deviation of each value.

Three readers: the wheel encoder, the front sonar before a wall, lines on the floor. Each value is
placed at the middle of what it is the mean over, so that a steady acceleration does not bias it.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.defects import readings
from countersteer.runs.run import Run

# A count over a window begins and ends somewhere between two edges: it is off by the difference of
# two uniform numbers of one count each. So is a time between two events that are seen in rows.
ROUNDED_TWICE = 1 / math.sqrt(6)

FINEST = 1e-3  # m/s; readings that are closer differ by their clock, not by a count
WINDOW = 0.2  # s of echoes that a line is laid through: 8 at 40 Hz
FEWEST = 5  # echoes on a line: two lay it, three more say that it is one
SPIKE = 3.0  # standard deviations off its line, beyond which an echo is of something else
ROUNDS = 5  # of telling spikes by the spread and the spread by what is no spike
RESOLVED = 1e-3  # m; no sonar tells less
ASTRAY = 1.4  # by which slopes err more than their line's echoes say: those of a wall's edges that
# lie within `SPIKE` of it pass for the wall's own (measured: 20 steps of throttle of `rx7`)
LIKE_MEAN = 0.6  # a line's slope weighs the speed by a parabola, of 3/5 of a flat mean's variance
TO_DEVIATION = 1.4826  # a normal variable's standard deviation over its median magnitude


class Speed(NamedTuple):
    """Speed as a sensor tells it."""

    time: np.ndarray  # s, rising
    value: np.ndarray  # m/s; forward and backward alike for the encoder and for lines
    deviation: np.ndarray  # m/s; one standard deviation. Where two values meet, at a count or a
    # line, one's error is in part the other's with its sign turned; else errors are independent.
    over: np.ndarray  # s; the time about `time` that the value is the mean over


def read_speed(run: Run, source: str) -> Speed:
    """Speed from `encoder`, `sonar` or `lines`.

    Raises `InputError` where the run has no such sensor.
    """
    if source not in READERS:
        raise InputError(f"no reader of speed {source}: give one of {', '.join(READERS)}")
    return READERS[source](run)


def from_encoder(run: Run) -> Speed:
    """Rim speed of the wheel with the encoder, or the wheels' mean where it is on the shaft.

    A reading is the mean since the one before, in whole counts: the deviation is a count's speed
    over the root of 6. Its size is told by `encoder_counts`, else by the readings' least step.
    """
    time, speed = _reported(run, "wheel_speed_mps")
    window = np.diff(time)
    quantum = _quantum(run, speed)
    deviation = np.full(len(window), quantum * ROUNDED_TWICE)
    return Speed(time[1:] - window / 2, speed[1:], deviation, window)


def from_sonar(run: Run) -> Speed:
    """Speed towards a wall straight ahead, from `sonar_front_m`.

    Through the echoes of each 0.2 s the line is laid that half of them are nearest to (least median
    of squares); echoes off it are spikes, and by least squares of the rest the slope is found, with
    deviation `ASTRAY` s / sqrt(sum (t - mean t)²). The spread s is that of all windows' echoes
    about their lines. A window in which most pings are spikes or unanswered gives no value.
    """
    windows = list(_windows(*_reported(run, "sonar_front_m")))
    lines = [_least_median(t, d) for t, d, _ in windows]
    # The spread is not known beforehand: what lies on a line tells it, and it tells what does.
    spread, kept = math.inf, []
    for _ in range(ROUNDS):
        off = [
            np.abs(d - np.polyval(line, t)) for (t, d, _), line in zip(windows, lines, strict=True)
        ]
        if math.isinf(spread) and windows:
            spread = max(float(np.median([_spread(values) for values in off])), RESOLVED)
        kept = [values <= SPIKE * spread for values in off]
        squares, free = 0.0, 0
        for i, (t, d, least) in enumerate(windows):
            if np.sum(kept[i]) >= least:
                lines[i] = np.polyfit(t[kept[i]], d[kept[i]], 1)
                squares += float(np.sum((d - np.polyval(lines[i], t))[kept[i]] ** 2))
                free += int(np.sum(kept[i])) - 2
        if not free:
            raise InputError(f"{run.path}/telemetry.csv: sonar_front_m never follows a wall ahead")
        spread = max(math.sqrt(squares / free), RESOLVED)
    found = [
        (
            np.mean(t[k]),
            -line[0],
            ASTRAY * spread / (np.std(t[k]) * math.sqrt(np.sum(k))),
            math.sqrt(LIKE_MEAN) * np.ptp(t[k]),
        )
        for (t, _, least), line, k in zip(windows, lines, kept, strict=True)
        if np.sum(k) >= least
    ]
    return Speed(*np.array(found).T)


def from_lines(run: Run) -> Speed:
    """Speed over lines that are `line_spacing_m` of `run.toml` apart, from `line_crossings`.

    Lines passed times their spacing, over the time between two rows in which the count rises. A
    line was passed anywhere between its row and the row before, so that a time T is off by the
    difference of two uniform numbers, and the speed v by v/T times that.
    """
    spacing = run.about.get("line_spacing_m")
    if not isinstance(spacing, float | int) or not 0 < spacing < math.inf:
        raise InputError(f"{run.path}/run.toml: line_spacing_m must say how far apart lines are")
    time, counts = _reported(run, "line_crossings")
    passed = np.diff(counts)
    if np.any(passed < 0):
        at = time[1:][np.argmax(passed < 0)]
        raise InputError(f"{run.path}/telemetry.csv, {at:.2f} s: line_crossings falls")
    rising = np.concatenate([[True], passed > 0])
    time, counts = time[rising], counts[rising]
    if counts[0] == 0:
        time, counts = time[1:], counts[1:]  # nothing was passed yet
    if len(time) < 2:
        raise InputError(f"{run.path}/telemetry.csv: line_crossings holds no two lines")
    assert run.telemetry is not None
    rows = run.telemetry["time_s"]
    gap = time - rows[np.maximum(np.searchsorted(rows, time) - 1, 0)]
    first, last = gap[:-1], gap[1:]
    took = np.diff(time) + (first - last) / 2
    speed = spacing * np.diff(counts) / took
    middle = (time[1:] + time[:-1] - (first + last) / 2) / 2
    return Speed(middle, speed, speed / took * np.sqrt((first**2 + last**2) / 12), took)


READERS: dict[str, Callable[[Run], Speed]] = {
    "encoder": from_encoder,
    "sonar": from_sonar,
    "lines": from_lines,
}


def _reported(run: Run, name: str) -> tuple[np.ndarray, np.ndarray]:
    time, values = readings(run, name)
    if len(time) < 2:
        raise InputError(f"{run.path}/telemetry.csv: {name} is not there, or holds no two readings")
    return time, values


def _quantum(run: Run, speed: np.ndarray) -> float:
    """Speed of one count in a window (m/s)."""
    counts = readings(run, "encoder_counts")[1]
    passed = np.diff(counts) if len(counts) == len(speed) else np.zeros(len(speed) - 1)
    told = (passed > 0) & (speed[1:] > 0)  # one of the two may be stuck
    if np.any(told):
        return float(np.median(speed[1:][told] / passed[told]))
    steps = np.diff(np.unique(np.append(speed, 0.0)))
    steps = steps[steps > FINEST]
    if not len(steps):
        raise InputError(f"{run.path}/telemetry.csv: wheel_speed_mps never changes")
    return float(np.min(steps))


def _windows(
    time: np.ndarray, distance: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Times and distances of the echoes of each window, and how many must lie on a line."""
    for start in np.arange(time[0], time[-1], WINDOW):
        inside = (time >= start - 1e-9) & (time < start + WINDOW - 1e-9)
        least = max(FEWEST, np.sum(inside) / 2)
        inside &= np.isfinite(distance)
        if np.sum(inside) >= least:
            yield time[inside], distance[inside], float(least)


def _least_median(time: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Slope and level of the line through two of the points that half of all are nearest to."""
    first, second = np.array(list(itertools.combinations(range(len(time)), 2))).T
    slope = (distance[second] - distance[first]) / (time[second] - time[first])
    level = distance[first] - slope * time[first]
    off = np.median(np.abs(distance - level[:, None] - slope[:, None] * time), axis=1)
    best = np.argmin(off)
    return np.array([slope[best], level[best]])


def _spread(off: np.ndarray) -> float:
    """Standard deviation of points about their least-median line, spikes among them.

    With Rousseeuw's factor for few points, as the line is the one that flatters them.
    """
    return float(TO_DEVIATION * (1 + 5 / (len(off) - 2)) * np.median(off))
