"""A car's speed over time from its sensors, with the standard deviation of each value.

Three readers: the wheel encoder, the front sonar before a wall, lines on the floor. Each value
stands at the middle of its averaging time, so that a steady acceleration does not bias it.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.defects import readings
from countersteer.runs.run import Run

# A count over a window begins and ends between two edges. Its error is the difference of two
# uniform numbers of one count each. The same holds for the time between two events seen in rows.
ROUNDED_TWICE = 1 / math.sqrt(6)

FINEST = 1e-3  # m/s; a smaller difference of readings is due to their clock, not to a count
WINDOW = 0.2  # s of echoes for each line: 8 at 40 Hz
FEWEST = 5  # echoes on a line: two define it, three more confirm it
SPIKE = 3.0  # standard deviations off the line; beyond, an echo is a spike
ROUNDS = 5  # iterations between the spikes and the spread without them
RESOLVED = 1e-3  # m, finest resolution of a sonar
ASTRAY = 1.4  # true error of a slope over the error by its line's echoes. Echoes of a wall's edges
# within `SPIKE` of the line pass for the wall's own (measured: 20 throttle steps of `rx7`)
LIKE_MEAN = 0.6  # a line's slope weighs the speed by a parabola: 3/5 of a flat mean's variance
TO_DEVIATION = 1.4826  # standard deviation of a normal variable over its median magnitude


class Speed(NamedTuple):
    """Speed from a sensor."""

    time: np.ndarray  # s, rising
    value: np.ndarray  # m/s; encoder and lines do not give the sign
    deviation: np.ndarray  # m/s, standard deviation. Neighbours that share a count or a line share
    # part of their error with opposite sign. All other errors are independent.
    over: np.ndarray  # s, averaging time around `time`


def read_speed(run: Run, source: str) -> Speed:
    """Speed by the reader `source`: `encoder`, `sonar` or `lines`.

    Raises `InputError` if there is no such reader, or if the run has no such sensor.
    """
    if source not in READERS:
        raise InputError(f"no reader of speed {source}: give one of {', '.join(READERS)}")
    return READERS[source](run)


def from_encoder(run: Run) -> Speed:
    """Rim speed of the wheel with the encoder, or the wheels' mean if the encoder is on the shaft.

    A reading is the mean since the one before, in whole counts. Its deviation is the speed of one
    count over the root of 6. That speed is from `encoder_counts`, else from the readings' least
    step.
    """
    time, speed = _reported(run, "wheel_speed_mps")
    window = np.diff(time)
    quantum = _quantum(run, speed)
    deviation = np.full(len(window), quantum * ROUNDED_TWICE)
    return Speed(time[1:] - window / 2, speed[1:], deviation, window)


def from_sonar(run: Run) -> Speed:
    """Speed towards a wall straight ahead, from `sonar_front_m`.

    In each 0.2 s, a line is fitted to the echoes by the least median of squares. Echoes far off it
    are spikes. Least squares of the rest give the slope, with the deviation
    `ASTRAY` s / sqrt(sum (t - mean t)²). s is the spread of all windows' echoes about their lines.
    A window in which most pings are spikes or unanswered gives no value.
    """
    windows = list(_windows(*_reported(run, "sonar_front_m")))
    lines = [_least_median(t, d) for t, d, _ in windows]
    # The spread depends on which echoes lie on a line, and these depend on the spread: iterate.
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

    speed = lines passed · spacing / time between two rows in which the count rises. A line was
    passed anywhere between its row and the row before. So the error of a time T is the difference
    of two uniform numbers, and the error of the speed v is v/T times that.
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
        time, counts = time[1:], counts[1:]  # no line was passed yet
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
    time, values = _readings(run, name)
    if len(time) < 2:
        raise InputError(f"{run.path}/telemetry.csv: {name} is not there, or holds no two readings")
    return time, values


def _readings(run: Run, name: str) -> tuple[np.ndarray, np.ndarray]:
    """`readings` at rising times: of equal times, the first counts. Infinite ones are echoes."""
    time, values = readings(run, name)
    if not name.startswith("sonar"):
        time, values = time[np.isfinite(values)], values[np.isfinite(values)]
    time, rows = np.unique(time, return_index=True)
    return time, values[rows]


def _quantum(run: Run, speed: np.ndarray) -> float:
    """Speed of one count in a window (m/s)."""
    counts = _readings(run, "encoder_counts")[1]
    passed = np.diff(counts) if len(counts) == len(speed) else np.zeros(len(speed) - 1)
    told = (passed > 0) & (speed[1:] > 0)  # one of the two columns may be stuck
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
    """Times and distances of the echoes of each window, and the fewest that must lie on a line."""
    for start in np.arange(time[0], time[-1], WINDOW):
        inside = (time >= start - 1e-9) & (time < start + WINDOW - 1e-9)
        least = max(FEWEST, np.sum(inside) / 2)
        inside &= np.isfinite(distance)
        if np.sum(inside) >= least and np.ptp(time[inside]) > WINDOW / 4:
            yield time[inside], distance[inside], float(least)


def _least_median(time: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Slope and level of the line through two points with the least median distance of all."""
    first, second = np.array(list(itertools.combinations(range(len(time)), 2))).T
    slope = (distance[second] - distance[first]) / (time[second] - time[first])
    level = distance[first] - slope * time[first]
    off = np.median(np.abs(distance - level[:, None] - slope[:, None] * time), axis=1)
    best = np.argmin(off)
    return np.array([slope[best], level[best]])


def _spread(off: np.ndarray) -> float:
    """Standard deviation of points about their least-median line; spikes have little effect.

    Rousseeuw's factor corrects for few points, because the line is chosen for a small median.
    """
    return float(TO_DEVIATION * (1 + 5 / (len(off) - 2)) * np.median(off))
