"""Defects of a log: stretches that a fit must leave out, and logs that it must refuse.

`refuse` raises `InputError` if a column as a whole contradicts its name, for example in another
unit. `find_defects` lists stretches. `repair` makes the repairs that need no guess. All three take
any run: imported, simulated, or of a real car. Data that a log lacks are not judged.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter, percentile_filter

from countersteer.car.car import GRAVITY, Car
from countersteer.errors import InputError
from countersteer.runs.files import SLOWEST_CLOCK, Table, clock_mistake, drive_column
from countersteer.runs.run import Run, refuse_long

# Clocks
MISSED = 5.0  # periods between two rows that make a gap; every log has one or two late rows
ROWS = 20  # fewest rows that give a period
REPEATED = 0.2  # part of the rows; if so many repeat a time, the clock is too coarse

# Motion capture
SLACK, SLACK_YAW = 0.02, 0.1  # m, rad; noise of good poses, too small to give a speed
NOISY = 6.0  # standard deviations of the poses' own noise; a jump is larger
THIRD = math.sqrt(20)  # deviation of a third difference of white noise, over the noise's
AROUND_NOISE = 2.0  # s
TAIL, NORMAL_TAIL = 0.8, 1.2816  # quantile of a size, and the same of a normal variable's
ABRUPT, ABRUPT_YAW = 3.0, 20.0  # m/s, rad/s; largest excess of a rate over the median around it
AROUND = 0.3  # s, window of that median
STANDS = 0.1  # m/s; a slower car may repeat a frame
REVERSED = 1.0  # s; a spin takes less, and braking from reverse too
FALSE_YAW_RATE = 3.0  # rad/s off the heading's rate; correct ones in the logs reach 1.3

# Collisions. The best tyre on rubber reaches about 1 g. The hardest braking in the logs is 0.98 g,
# the mildest hit 1.7 g.
BEST_FRICTION, MARGIN = 1.0, 1.5
SPAN_OF_POSES = 0.05  # s between differenced poses; 1 mm of noise then gives 1 m/s²
SPAN_OF_VELOCITIES = 0.01  # s, the same for measured velocities
BEFORE, AFTER = 0.05, 0.2  # s added before and after the visible hit
IMPACT_RATE = 50.0  # Hz; at a lower rate, a single vibration looks like a hit
QUIET = 6.0  # standard deviations of an acceleration's noise that are added to the limit

# Stuck sensors
HELD, HELD_ALONE = 0.5, 1.0  # s of a constant reading, by how strong the evidence of motion is
READINGS = 5  # fewest readings: equal ones in a row, or ones beyond a limit
APART = 0.5  # m/s between wheels and car; slip within grip and turning explain less
TURNS = 0.7  # rad/s off the true yaw rate; a working gyroscope is closer
DRIVEN, FULL = 0.1, 0.5  # throttle that surely moves a car: confirmed by another sensor, or alone
STEERED = math.radians(5)  # rad; so much steering, or change of it, turns a moving car

# Units
FASTEST, FASTEST_YAW = 30.0, 60.0  # m/s, rad/s; no model car reaches them
STEEPEST = math.radians(65)  # rad, the largest steering limit that a car may declare
DEGREES = (45.0, 72.0)  # range of value / true value if the value is in degrees
TURN_WITHIN = 0.5  # rad, off a whole turn
ALIGNED, SIDEWAYS = 0.8, math.radians(75)  # concentration of an angle; no drift has such sideslip
MIRRORED = 1.5  # factor within which a heading turns as the course
COARSE = 2.5  # factor within which speed, steering and a guessed wheelbase tell a yaw rate
SERVO = 0.3  # s, by which the front wheels have followed the command
SLOW = 0.2  # m/s; a slower car does not tell its yaw rate
GENTLE = 1.0  # m/s² of lateral acceleration, within the grip of any floor
LEAST_LOCK = math.radians(1.2)  # rad; no car steers so little
DECLARE_DEGREES = 'convert it, or write unit = "deg/s" under [sensors.gyroscope] of run.toml'
UNITS = {  # the same of speeds in other units
    "cm/s": (80.0, 125.0),
    "km/h": (3.2, 4.0),
    "mm/s": (800.0, 1250.0),
}
TELLING = 20  # fewest samples for a ratio
TO_DEVIATION = 1.4826  # standard deviation of a normal variable over its median size


class LogDefect(NamedTuple):
    """A stretch of a log in which one column or all columns are false."""

    start: float  # s
    end: float
    what: str  # message for a person
    column: str = ""  # the false column; empty: all columns


class Track(NamedTuple):
    """Velocities from motion capture without its false frames; NaN where unknown."""

    time: np.ndarray  # s
    east: np.ndarray  # m/s, in the world's axes
    north: np.ndarray
    vx: np.ndarray  # m/s, in the body's axes
    vy: np.ndarray
    yaw_rate: np.ndarray  # rad/s
    span: float  # s, averaging time of a velocity
    noise: np.ndarray  # m/s, standard deviation of a velocity's noise

    def at(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Interpolate a column of the track to other times; NaN where unknown."""
        return np.interp(time, self.time, values, left=math.nan, right=math.nan)


def find_defects(run: Run, car: Car | None = None) -> list[LogDefect]:
    """Stretches of the run that a fit must leave out, sorted by start.

    `car` is as in `refuse`. Raises `InputError` with file and time if the whole log is unusable.
    """
    refuse(run, car)
    run, _ = repair(run)
    found = [*gaps(run), *missing(run), *released(run)]
    track = None
    if run.truth is not None:
        found += [*repeated_frames(run.truth), *jumps(run.truth), *false_yaw_rates(run.truth)]
        track = follow(run.truth)
        found += [*backwards(run, track), *collisions(run, track)]
    else:
        found += impacts(run)
    found += [*stuck_encoder(run, track), *stuck_gyroscope(run, track)]
    return sorted(found)


def repair(run: Run) -> tuple[Run, list[str]]:
    """The run with its heading unwrapped, and a line for each repair.

    A run that needs no repair is returned as it is.
    """
    truth = run.truth
    if truth is None or not len(truth):
        return run, []
    heading = truth["heading_rad"]
    there = np.isfinite(heading)
    wraps = np.abs(np.diff(heading[there])) > math.pi
    if not np.any(wraps):
        return run, []
    whole = heading.copy()
    whole[there] = np.unwrap(heading[there])
    first = float(truth["time_s"][there][1:][wraps][0])
    line = f"{run.path}/truth.csv: heading_rad wraps {np.sum(wraps)} times, first at {first:.2f} s"
    table = Table(truth | {"heading_rad": whole})
    return dataclasses.replace(run, truth=table), [f"{line}: unwrapped"]


def stretches(where: np.ndarray) -> Iterator[tuple[int, int]]:
    """First and last index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    yield from zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)


def period(time: np.ndarray) -> float:
    """The median time between two rows (s); NaN if rows are too few or irregular.

    Rows are irregular if a fifth of the steps or more are off the median by over half of it.
    """
    steps = np.diff(time)
    if len(time) < ROWS:
        return math.nan
    usual = float(np.median(steps))
    return usual if np.mean(np.abs(steps - usual) <= 0.5 * usual) > 0.8 else math.nan


def asked(run: Run, name: str, time: np.ndarray) -> np.ndarray:
    """A column of the commands at these times; 0 before the first command."""
    last = np.searchsorted(run.commands["time_s"], time + 1e-6, side="right") - 1
    return np.where(last >= 0, run.commands[name][np.maximum(last, 0)], 0.0)


def readings(run: Run, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of a sensor's reports; empty where the run has none."""
    table = run.telemetry
    if table is None or name not in table:
        return np.zeros(0), np.zeros(0)
    there = ~np.isnan(table[name])
    return table["time_s"][there], table[name][there]


# -------------------------------------------------------------------------------------------------
# Missing data
# -------------------------------------------------------------------------------------------------


def gaps(run: Run) -> Iterator[LogDefect]:
    """Gaps between rows or between reports of a sensor, and rows with the same time."""
    tables = {"commands": run.commands, "telemetry": run.telemetry, "truth": run.truth}
    for name, table in tables.items():
        if table is None:
            continue
        yield from _pauses(table["time_s"], f"{name}.csv has no rows", "")
        for i in np.flatnonzero(np.diff(table["time_s"]) <= 0).tolist():
            at = float(table["time_s"][i])
            yield LogDefect(at, at, f"{name}.csv has two rows at one time")
    for name in run.telemetry or ():
        if name != "time_s":
            yield from _pauses(readings(run, name)[0], f"{name} reports nothing", name)


def _pauses(time: np.ndarray, what: str, column: str) -> Iterator[LogDefect]:
    """A defect for each step of time above `MISSED` periods."""
    every = period(time)
    for i in np.flatnonzero(np.diff(time) > MISSED * every).tolist():
        start, end = float(time[i]), float(time[i + 1])
        yield LogDefect(start, end, f"{what} for {end - start:.2f} s", column)


def missing(run: Run) -> Iterator[LogDefect]:
    """Empty columns, empty cells of motion capture, and infinite values.

    Infinite sonar readings are no defect.
    """
    for name, table in (("telemetry", run.telemetry), ("truth", run.truth)):
        if table is None or not len(table):
            continue
        time = table["time_s"]
        for column, values in table.items():
            infinite = np.isinf(values) & (not column.startswith("sonar_"))
            for first, last in stretches(infinite):
                span = float(time[first]), float(time[last])
                yield LogDefect(*span, f"{column} is infinite in {name}.csv", column)
            nothing = np.isnan(values)
            if np.all(nothing) and len(values) >= ROWS:
                yield LogDefect(
                    float(time[0]), float(time[-1]), f"{column} of {name}.csv is empty", column
                )
            elif name == "truth":
                for first, last in stretches(nothing):
                    yield LogDefect(
                        float(time[first]), float(time[last]), f"{column} is empty", column
                    )


def released(run: Run) -> Iterator[LogDefect]:
    """Stretches with the dead-man switch open: the motor does not follow the throttle command."""
    time, armed = readings(run, "armed")
    for first, last in stretches(armed < 0.5):
        end = time[min(last + 1, len(time) - 1)]
        yield LogDefect(float(time[first]), float(end), "the dead-man switch is released")


# -------------------------------------------------------------------------------------------------
# Motion capture
# -------------------------------------------------------------------------------------------------


def frames(truth: Table) -> tuple[np.ndarray, np.ndarray]:
    """Rising times (frames,) and poses (3, frames) of the frames with a complete pose."""
    pose = np.stack([truth["x_m"], truth["y_m"], truth["heading_rad"]])
    good = np.all(np.isfinite(pose), axis=0)
    good[1:] &= np.diff(truth["time_s"]) > 0
    return truth["time_s"][good], pose[:, good]


def local_noise(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Standard deviation of a series' white noise around each sample, from third differences.

    A motion is smooth over four samples. The noise of a particle filter grows in curves and has
    long tails. So it is taken over `AROUND_NOISE` seconds, from the `TAIL` quantile of its size.
    """
    if len(time) < ROWS:
        return np.zeros(len(time))
    third = np.abs(np.diff(values, 3))
    width = min(round(AROUND_NOISE / max(float(np.median(np.diff(time))), 1e-4)), len(third))
    size = percentile_filter(third, 100 * TAIL, max(width, ROWS), mode="nearest")
    return np.pad(size / NORMAL_TAIL / THIRD, (1, 2), mode="edge")


def pose_noise(truth: Table) -> tuple[float, float]:
    """Typical standard deviations of a position's (m) and of a heading's (rad) noise."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return 0.0, 0.0
    x, y, heading = (float(np.median(local_noise(time, line))) for line in pose)
    return max(x, y), heading


def usual(time: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Rolling median of rates over `AROUND` seconds, or 7 rates if those are more."""
    width = 2 * max(3, round(AROUND / 2 / max(float(np.median(np.diff(time))), 1e-4))) + 1
    return median_filter(rates, width, mode="nearest")


def repeated_frames(truth: Table) -> Iterator[LogDefect]:
    """Frames that repeat the previous frame while the car moves."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    speed = np.hypot(*np.diff(pose[:2], axis=1)) / np.diff(time)
    same = np.all(np.diff(pose, axis=1) == 0, axis=0) & (usual(time, speed) > STANDS)
    for first, last in stretches(same):
        span = float(time[first]), float(time[last + 1])
        yield LogDefect(*span, "motion capture repeats a frame while the car moves")


def slack(truth: Table) -> tuple[float, float]:
    """How far a pose may be off by noise (m, rad)."""
    noise, noise_yaw = pose_noise(truth)
    return max(SLACK, NOISY * noise), max(SLACK_YAW, NOISY * noise_yaw)


def false_frames(time: np.ndarray, pose: np.ndarray, off_by: tuple[float, float]) -> np.ndarray:
    """True for frames too far off the median of the five frames around them: (frames,).

    The limit in position is the slack + `MARGIN` `BEST_FRICTION` g h² / 2, with h two periods. The
    limit in heading is the slack + `ABRUPT_YAW` h / 2. `off_by` is the `slack`.
    """
    reach = 2 * float(np.median(np.diff(time)))
    limit = off_by[0] + MARGIN * BEST_FRICTION * GRAVITY * reach**2 / 2
    limit_yaw = off_by[1] + ABRUPT_YAW * reach / 2
    middle = median_filter(pose, (1, 5), mode="nearest")
    off = np.abs(pose - middle)
    return np.any(off > np.array([[limit], [limit], [limit_yaw]]), axis=0)


def backwards(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """Stretches of `REVERSED` seconds in which a car that is driven forwards goes backwards."""
    if track is None:
        return
    driven = (asked(run, drive_column(run.commands), track.time) > DRIVEN) & (track.vx < -APART)
    for first, last in stretches(driven):
        span = float(track.time[first]), float(track.time[last])
        if span[1] - span[0] >= REVERSED:
            yield LogDefect(*span, "heading_rad points backwards while the car is driven forwards")


def jumps(truth: Table) -> Iterator[LogDefect]:
    """False frames, and steps from one frame to the next that are too large for a car."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    off_by = slack(truth)
    false = false_frames(time, pose, off_by)
    for first, last in stretches(false):
        span = float(time[max(first - 1, 0)]), float(time[min(last + 1, len(time) - 1)])
        yield LogDefect(*span, "motion capture has a false frame")
    time, pose = time[~false], pose[:, ~false]
    span = np.diff(time)
    moved, turned = np.hypot(*np.diff(pose[:2], axis=1)), np.abs(np.diff(pose[2]))
    speed, rate = usual(time, moved / span), usual(time, turned / span)
    far = moved > off_by[0] + (speed + ABRUPT) * span
    spun = turned > off_by[1] + (rate + ABRUPT_YAW) * span
    for i in np.flatnonzero(far | spun).tolist():
        by = f"{moved[i]:.2f} m" if far[i] else f"{math.degrees(turned[i]):.0f}°"
        yield LogDefect(float(time[i]), float(time[i + 1]), f"motion capture jumps by {by}")


def false_yaw_rates(truth: Table) -> Iterator[LogDefect]:
    """Yaw rates off the heading's rate by `FALSE_YAW_RATE`, both before and after the row."""
    if "yaw_rate_radps" not in truth or len(truth) < ROWS:
        return
    time, rate = truth["time_s"], truth["yaw_rate_radps"]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.diff(truth["heading_rad"]) / np.diff(time)
    before, after = np.append(slope[0], slope), np.append(slope, slope[-1])
    low, high = np.minimum(before, after), np.maximum(before, after)
    false = (rate < low - FALSE_YAW_RATE) | (rate > high + FALSE_YAW_RATE)
    for first, last in stretches(false):
        worst = rate[first : last + 1][np.argmax(np.abs(rate[first : last + 1]))]
        what = f"a yaw rate of {worst:.1f} rad/s is not the heading's"
        yield LogDefect(float(time[first]), float(time[last]), what, "yaw_rate_radps")


def follow(truth: Table) -> Track | None:
    """Velocities from motion capture, as recorded or else differenced from poses.

    None if fewer than `ROWS` frames are usable.
    """
    time, pose = frames(truth)
    if len(time) < ROWS:
        return None
    heading = pose[2]
    if {"vx_mps", "vy_mps", "yaw_rate_radps"} <= truth.keys():
        inside = np.isin(truth["time_s"], time)
        inside[1:] &= np.diff(truth["time_s"]) > 0
        told = (truth[n][inside] for n in ("vx_mps", "vy_mps", "yaw_rate_radps"))
        vx, vy, rate = (np.where(np.isfinite(v), v, math.nan) for v in told)
        cosine, sine = np.cos(heading), np.sin(heading)
        east, north = cosine * vx - sine * vy, sine * vx + cosine * vy
        noise = np.maximum(*(local_noise(time, np.nan_to_num(line)) for line in (east, north)))
        return Track(time, east, north, vx, vy, rate, SPAN_OF_VELOCITIES, noise)
    good = ~false_frames(time, pose, slack(truth))
    good[1:] &= np.any(np.diff(pose, axis=1) != 0, axis=0)
    kept, pose = time[good], pose[:, good]
    if len(kept) < ROWS:
        return None
    step = float(np.median(np.diff(kept)))
    half = max(1, math.ceil(SPAN_OF_POSES / 2 / step - 0.01))
    noise = np.maximum(*(local_noise(kept, line)[half:-half] for line in pose[:2]))
    noise *= math.sqrt(2) / (2 * half * step)
    rates = (pose[:, 2 * half :] - pose[:, : -2 * half]) / (kept[2 * half :] - kept[: -2 * half])
    time, heading = kept[half:-half], pose[2, half:-half]
    cosine, sine = np.cos(heading), np.sin(heading)
    east, north, rate = rates
    vx, vy = cosine * east + sine * north, cosine * north - sine * east
    return Track(time, east, north, vx, vy, rate, SPAN_OF_POSES, noise)


# -------------------------------------------------------------------------------------------------
# Collisions
# -------------------------------------------------------------------------------------------------


def hardest(run: Run) -> float:
    """Largest acceleration by the tyres (m/s²): `MARGIN` · friction · `GRAVITY`.

    The friction is that of the run's car if known, and at least `BEST_FRICTION`.
    """
    friction = BEST_FRICTION
    if run.car is not None:
        tires = run.car.tires
        friction = max(friction, float(tires.front.peak_friction), float(tires.rear.peak_friction))
    return MARGIN * GRAVITY * friction


def collisions(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """Stretches whose mean acceleration over the track's span is beyond `hardest`.

    `QUIET` deviations of that acceleration's noise are added to the limit.
    """
    if track is None:
        return
    time = track.time
    step = max(1, math.ceil(track.span / float(np.median(np.diff(time))) - 0.01))
    span = time[step:] - time[:-step]
    change = np.hypot(
        *(values[step:] - values[:-step] for values in (track.east, track.north))
    ) / np.maximum(span, track.span)
    # Next to a gap or a jump of the poses, a change of velocity is no evidence.
    noise = track.noise[step:] * math.sqrt(2) / np.maximum(span, track.span)
    hit = (change > hardest(run) + QUIET * noise) & (
        span < 1.5 * max(track.span, float(np.median(span)))
    )
    if run.truth is not None:
        for fault in jumps(run.truth):
            reach = track.span
            hit &= (time[step:] < fault.start - reach) | (time[:-step] > fault.end + reach)
    yield from _merged_hits(
        time[:-step], time[step:], change, hit, "the car is slowed or thrown by"
    )


def impacts(run: Run) -> Iterator[LogDefect]:
    """Collisions by an accelerometer of `IMPACT_RATE` or more, for runs without motion capture."""
    time, ax = readings(run, "accel_x_mps2")
    other, ay = readings(run, "accel_y_mps2")
    if not np.array_equal(time, other) or not period(time) <= 1 / IMPACT_RATE:
        return
    ax, ay = ax - np.median(ax), ay - np.median(ay)
    noise = TO_DEVIATION * np.median(np.abs(np.diff([ax, ay]))) / math.sqrt(2)
    size = np.hypot(ax, ay)
    hit = size > hardest(run) + QUIET * noise
    yield from _merged_hits(time, time, size, hit, "the accelerometer reads")


def _merged_hits(
    begin: np.ndarray, end: np.ndarray, size: np.ndarray, hit: np.ndarray, what: str
) -> Iterator[LogDefect]:
    """A defect for each hit, extended by `BEFORE` and `AFTER`. Overlapping hits are merged."""
    found: list[tuple[float, float, float]] = []
    for first, last in stretches(hit):
        start, stop = float(begin[first]) - BEFORE, float(end[last]) + AFTER
        worst = float(np.max(size[first : last + 1]))
        if found and start <= found[-1][1]:
            start, worst = found[-1][0], max(worst, found.pop()[2])
        found.append((start, stop, worst))
    for start, stop, worst in found:
        yield LogDefect(
            max(start, 0.0), stop, f"{what} {worst:.0f} m/s², beyond any tyre: a collision"
        )


# -------------------------------------------------------------------------------------------------
# Stuck sensors
# -------------------------------------------------------------------------------------------------


def held(time: np.ndarray, values: np.ndarray, least: float) -> Iterator[tuple[int, int]]:
    """First and last index of each stretch of equal readings of at least `least` seconds."""
    for first, last in stretches(values[1:] == values[:-1]):
        if time[last + 1] - time[first] >= least and last + 2 - first >= READINGS:
            yield first, last + 1


def longest(time: np.ndarray, where: np.ndarray) -> float:
    """Duration of the longest stretch of True (s)."""
    return max((float(time[b] - time[a]) for a, b in stretches(where)), default=0.0)


def stuck_encoder(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """Stretches of constant wheel speed that contradict the throttle or the motion."""
    time, speed = readings(run, "wheel_speed_mps")
    if len(time) < ROWS:
        return
    steps = np.diff(np.unique(speed))
    slack = APART + 2.5 * (float(np.min(steps)) if len(steps) else 0.0)
    gyro_time, gyro = readings(run, "gyro_radps")
    for first, last in held(time, speed, HELD):
        at, value = time[first : last + 1], float(speed[first])
        # A speed says where a throttle drives, and where none does.
        throttle = np.clip(asked(run, drive_column(run.commands), at), -1, 1)
        idle = throttle == 0
        early, late = (np.mean(half) for half in np.array_split(throttle, 2))
        throttle_changes = abs(late - early) > 0.2 and min(early, late) < FULL
        why = ""
        if value > 0 and longest(at, idle) >= HELD_ALONE:
            why = "without throttle"
        elif value > 0 and throttle_changes and at[-1] - at[0] >= HELD_ALONE:
            why = "whatever the throttle"
        elif track is not None:
            vx = track.at(track.vx, at)
            pushed = throttle * np.sign(vx) > DRIVEN
            if value > 0 and longest(at, idle & (value - np.abs(vx) > slack)) >= HELD:
                why = "without throttle, faster than the car"
            elif longest(at, pushed & (np.abs(vx) - value > slack)) >= HELD:
                why = "under drive, slower than the car"
        elif value == 0 and longest(at, np.abs(throttle) >= FULL) >= HELD_ALONE:
            why = "under drive"
        elif value == 0 and len(gyro):
            turning = np.abs(np.interp(at, gyro_time, gyro)) > 1
            if longest(at, turning & (np.abs(throttle) > DRIVEN)) >= HELD:
                why = "in a turn under drive"
        if why:
            what = f"the encoder stays at {value:.2f} m/s {why}: stuck"
            yield LogDefect(float(at[0]), float(at[-1]), what, "wheel_speed_mps")


def stuck_gyroscope(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """Stretches of constant yaw rate that contradict the car's turning.

    A saturated gyroscope is no defect: its reading stays constant while the car turns faster.
    """
    time, rate = readings(run, "gyro_radps")
    if len(time) < ROWS:
        return
    largest = float(np.max(np.abs(rate)))
    wheel_time, wheel = readings(run, "wheel_speed_mps")
    for first, last in held(time, rate, HELD):
        at, value = time[first : last + 1], float(rate[first])
        saturated = abs(value) >= 0.99 * largest and largest > 2
        if track is not None:
            true = track.at(track.yaw_rate, at)
            false = np.abs(true - value) > TURNS
            if saturated:
                false &= np.abs(true) < abs(value)
            stuck = longest(at, false) >= HELD
        else:
            steering = asked(run, "steering", at)
            moving = np.interp(at, wheel_time, wheel) > APART if len(wheel) else np.zeros(len(at))
            should_turn = np.ptp(steering) > STEERED or (
                np.min(np.abs(steering)) > STEERED and abs(value) < SLACK_YAW
            )
            lasting = at[-1] - at[0] >= HELD_ALONE
            stuck = bool(lasting and np.all(moving) and should_turn and not saturated)
        if stuck:
            what = f"the gyroscope stays at {value:.2f} rad/s while the car turns otherwise: stuck"
            yield LogDefect(float(at[0]), float(at[-1]), what, "gyro_radps")


# -------------------------------------------------------------------------------------------------
# Refusals
# -------------------------------------------------------------------------------------------------


def refuse(run: Run, car: Car | None = None) -> None:
    """Raise `InputError` with file and time for errors that masking a stretch cannot remove.

    `car` is the car of the log, if known. Its wheelbase tells how fast it turns.
    """
    refuse_long(run)
    for name, table in (("telemetry", run.telemetry), ("truth", run.truth)):
        if table is not None:
            _refuse_table(f"{run.path}/{name}.csv", table)
    commands, drive = f"{run.path}/commands.csv", drive_column(run.commands)
    _require_none(
        commands, run.commands, ~np.isfinite(run.commands[drive]), f"{drive} is no number"
    )
    if drive == "throttle":
        _require_none(
            commands,
            run.commands,
            np.abs(run.commands["throttle"]) > 1,
            "throttle is beyond 1: is it in percent?",
        )
    _require_none(
        commands,
        run.commands,
        np.abs(run.commands["steering"]) > STEEPEST,
        "steering_deg is beyond any lock",
    )
    _refuse_two_clocks(run)
    if run.truth is not None:
        _refuse_truth(run, run.truth)
    _refuse_sensors(run)
    _refuse_turning(run, run.car or car or Car())


def _require_none(file: str, table: Table, wrong: np.ndarray, message: str) -> None:
    """Raise `InputError` for the first row of the mask `wrong`, if any."""
    if np.any(wrong):
        raise InputError(f"{file}, {table['time_s'][np.argmax(wrong)]:.2f} s: {message}")


def _refuse_table(file: str, table: Table) -> None:
    """Refuse a table without rows, or with a false clock."""
    if not len(table):
        raise InputError(f"{file}: holds no rows")
    time = table["time_s"]
    _require_none(file, table, ~np.isfinite(time), "time_s is no number")
    _require_none(file, table, np.diff(time, prepend=time[0]) < 0, "time_s goes backwards")
    steps = np.diff(time)
    if len(time) >= ROWS and np.median(steps) >= SLOWEST_CLOCK:
        step = float(np.median(steps))
        raise InputError(
            f"{file}, {time[0]:.2f} s: rows are {step:g} s apart: {clock_mistake(time)}"
        )
    if len(time) >= ROWS and np.mean(steps == 0) > REPEATED:
        raise InputError(
            f"{file}, {time[np.argmax(steps == 0)]:.2f} s: time_s stands still in "
            f"{np.sum(steps == 0)} of {len(time)} rows with other values: give it more decimals"
        )


def _refuse_two_clocks(run: Run) -> None:
    """Refuse tables whose times do not overlap with those of the commands."""
    first, last = run.commands["time_s"][[0, -1]]
    for name, table in (("telemetry", run.telemetry), ("truth", run.truth)):
        if table is None or len(table) < ROWS:
            continue
        begin, end = table["time_s"][[0, -1]]
        if begin > last + 1 or end < first:
            raise InputError(
                f"{run.path}/{name}.csv: goes from {begin:.2f} to {end:.2f} s, but commands.csv "
                f"from {first:.2f} to {last:.2f} s: give both one clock"
            )


def _refuse_truth(run: Run, truth: Table) -> None:
    """Refuse motion capture without poses or in other units than its columns name.

    Poses are judged by their speed, the other columns by the poses.
    """
    file = f"{run.path}/truth.csv"
    for name in ("x_m", "y_m", "heading_rad"):
        if not np.any(np.isfinite(truth[name])):
            raise InputError(f"{file}, {truth['time_s'][0]:.2f} s: {name} is empty from here on")
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    pose[2] = without_turns(pose[2])
    span = np.diff(time)
    # Over a tenth of a second, poses give a course. From frame to frame, they give noise.
    stride = max(1, round(0.1 / float(np.median(span))))
    east, north, turned = (line[stride:] - line[:-stride] for line in pose)
    over = time[stride:] - time[:-stride]
    speed = np.hypot(east, north) / over
    moving = speed > STANDS
    if np.sum(moving) < TELLING:
        return
    if np.median(speed[moving]) > FASTEST:
        at = float(time[:-stride][moving][0])
        raise InputError(f"{file}, {at:.2f} s: x_m, y_m move at over {FASTEST:g} m/s: not metres")
    begins = time[:-stride]
    course = np.arctan2(north, east)
    bend = np.angle(np.exp(1j * (course[stride:] - course[:-stride])))
    curved = moving[stride:] & moving[:-stride] & (np.abs(bend) > 0.05)
    _refuse_axes(run, file, begins + over / 2, pose[2, : len(course)] + turned / 2, course, moving)
    found = _ratio(turned[stride:], bend, curved)
    if found and found[0] > -MIRRORED and found[1] < -1 / MIRRORED:
        at = float(begins[stride:][np.argmax(curved)])
        raise InputError(
            f"{file}, {at:.2f} s: heading_rad turns against the course of x_m, y_m: y is to the "
            "left of x, and headings are positive to the left"
        )
    _refuse_degrees(file, "heading_rad", begins[stride:], turned[stride:], bend, curved)
    rate = np.abs(turned) / over
    if np.quantile(rate, 0.9) > FASTEST_YAW:  # for a spinning car: it has no reliable course
        at = float(begins[np.argmax(rate > FASTEST_YAW)])
        message = f"heading_rad turns at over {FASTEST_YAW:g} rad/s: in degrees?"
        raise InputError(f"{file}, {at:.2f} s: {message}")
    middle = begins + over / 2
    if "yaw_rate_radps" in truth:
        rate = np.interp(middle, truth["time_s"], truth["yaw_rate_radps"])
        slope = np.angle(np.exp(1j * turned)) / over
        _refuse_degrees(file, "yaw_rate_radps", begins, rate, slope, np.abs(slope) > 0.3)
    if {"vx_mps", "vy_mps"} <= truth.keys():
        size = np.hypot(truth["vx_mps"], truth["vy_mps"])
        size = np.interp(middle, truth["time_s"], size)
        _refuse_other_units(file, "vx_mps, vy_mps", begins, size, speed, speed > 2 * STANDS)


def without_turns(heading: np.ndarray) -> np.ndarray:
    """The heading without jumps of whole turns, as a quaternion's sign makes them."""
    jump = np.diff(heading)
    whole = 2 * math.pi * np.rint(jump / (2 * math.pi))
    jump = np.where(np.abs(jump - whole) < TURN_WITHIN, whole, 0.0)
    return heading - np.append(0.0, np.cumsum(jump))


def _refuse_axes(
    run: Run,
    file: str,
    time: np.ndarray,
    heading: np.ndarray,
    course: np.ndarray,
    moving: np.ndarray,
) -> None:
    """Refuse a heading that is not that of the course while the car is driven forwards."""
    driven = moving & (asked(run, drive_column(run.commands), time) > DRIVEN)
    if np.sum(driven) < TELLING:
        return
    mean = np.mean(np.exp(1j * (course - heading)[driven]))
    off = float(np.angle(mean))
    if abs(mean) > ALIGNED and abs(off) > SIDEWAYS:
        raise InputError(
            f"{file}, {time[np.argmax(driven)]:.2f} s: heading_rad is off the course of x_m, y_m "
            f"by {math.degrees(off):.0f}°, though the car is driven forwards: it is 0 along x, and "
            "positive to the left"
        )


def _refuse_sensors(run: Run) -> None:
    """Refuse an encoder or gyroscope in another unit, by motion capture or the limits of cars."""
    file = f"{run.path}/telemetry.csv"
    track = follow(repair(run)[0].truth) if run.truth is not None and len(run.truth) else None  # type: ignore[arg-type]  # `repair` keeps `truth`
    for name, limit in (("wheel_speed_mps", FASTEST), ("gyro_radps", FASTEST_YAW)):
        time, values = readings(run, name)
        beyond = np.abs(values) > limit
        if np.sum(beyond & np.isfinite(values)) >= READINGS:
            at = float(time[np.argmax(beyond)])
            raise InputError(f"{file}, {at:.2f} s: {name} is beyond {limit:g}: another unit?")
        if track is None or not len(time):
            continue
        if name == "gyro_radps":
            rate = track.at(track.yaw_rate, time)
            _refuse_degrees(file, name, time, values, rate, np.abs(rate) > 0.3)
        else:
            vx, vy = track.at(track.vx, time), track.at(track.vy, time)
            grips = (vx > 0.3) & (np.abs(vy) < 0.1 * vx)
            _refuse_other_units(file, name, time, values, vx, grips)


def _refuse_turning(run: Run, car: Car) -> None:
    """Refuse a yaw rate w that contradicts speed v, steering d and wheelbase L.

    Within grip, w = v tan(d) / L. That holds within a factor of `COARSE` for any servo and for a
    wheelbase that is only guessed. Rows count in which the car drives with its steering held.
    """
    time, rate = readings(run, "gyro_radps")
    wheel_time, wheel = readings(run, "wheel_speed_mps")
    if len(wheel) < TELLING:
        return
    speed = np.interp(time, wheel_time, wheel)
    steering = asked(run, "steering", time - SERVO)
    expected = speed * np.tan(np.clip(steering, -1.2, 1.2)) / float(car.body.wheelbase)
    steady = np.abs(steering - asked(run, "steering", time)) < 0.5 * np.abs(steering)
    usable = (speed > SLOW) & steady & (np.abs(rate) > 0)
    file = f"{run.path}/telemetry.csv"
    largest = float(np.max(np.abs(run.commands["steering"])))
    turns = usable & (np.abs(steering) > STEERED)
    found = _ratio(rate, expected, turns)
    if found and DEGREES[0] / COARSE < found[0] and found[1] < DEGREES[1] * COARSE:
        at = float(time[np.argmax(turns)])
        raise InputError(
            f"{file}, {at:.2f} s: gyro_radps is some {np.mean(found):.0f} times what speed, "
            f"steering and wheelbase allow: in degrees? {DECLARE_DEGREES}"
        )
    # In a drift the front wheels point the other way. A car that hardly turns does not drift.
    # The encoder has no sign, so in reverse all turns would look turned round.
    forward = asked(run, drive_column(run.commands), time) > 0
    gentle = turns & forward & (speed * np.abs(rate) < GENTLE)
    found = _ratio(rate, expected, gentle)
    if found and found[0] > -COARSE and found[1] < -1 / COARSE:
        at = float(time[np.argmax(gentle)])
        raise InputError(
            f"{file}, {at:.2f} s: gyro_radps and steering_deg have opposite signs: both are "
            "positive to the left"
        )
    found = _ratio(rate, expected, usable & (steering != 0))
    if largest < LEAST_LOCK and found and found[0] > DEGREES[0] / COARSE:
        raise InputError(
            f"{run.path}/commands.csv: steering_deg stays within {math.degrees(largest):.2f}, but "
            f"the car turns {np.mean(found):.0f} times as fast: is it in radians?"
        )


def _ratio(values: np.ndarray, true: np.ndarray, usable: np.ndarray) -> tuple[float, float] | None:
    """Quartiles of value / true value; None with fewer than `TELLING` usable samples."""
    usable = usable & np.isfinite(values) & np.isfinite(true) & (true != 0)
    if np.sum(usable) < TELLING:
        return None
    low, high = np.quantile(values[usable] / true[usable], [0.25, 0.75])
    return float(low), float(high)


def _refuse_degrees(
    file: str, name: str, time: np.ndarray, values: np.ndarray, true: np.ndarray, usable: np.ndarray
) -> None:
    """Refuse values that are in degrees, by their ratio to the true radians."""
    found = _ratio(values, true, usable)
    if found and DEGREES[0] < found[0] and found[1] < DEGREES[1]:
        at = float(time[np.argmax(usable)])
        raise InputError(f"{file}, {at:.2f} s: {name} is some 57 times what is so: in degrees?")


def _refuse_other_units(
    file: str, name: str, time: np.ndarray, values: np.ndarray, true: np.ndarray, usable: np.ndarray
) -> None:
    """Refuse speeds in one of `UNITS`, by their ratio to the true m/s."""
    found = _ratio(values, true, usable)
    for unit, (low, high) in UNITS.items():
        if found and low < found[0] and found[1] < high:
            at = float(time[np.argmax(usable)])
            raise InputError(f"{file}, {at:.2f} s: {name} is in {unit}, by the positions")
