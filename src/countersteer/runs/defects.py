"""What is false in a log: stretches that a fit must leave out, and logs that it must refuse.

`refuse` raises where a whole column cannot mean what its name says. `find_defects` lists stretches.
`repair` mends what can be mended without a guess. All three take any run: an imported log, one of
the simulator, a real car's. What a log does not hold is not judged.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from countersteer.car.car import GRAVITY
from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.runs.run import Run

# Clocks
MISSED = 5.0  # periods without a row that are a gap: one or two late rows are any log's
ROWS = 20  # fewer do not tell a period
SLOWEST_CLOCK = 0.5  # s; no sensor's rows are so far apart, but a clock in ms seems so

# Motion capture
SLACK, SLACK_YAW = 0.02, 0.1  # m, rad; noise that no speed is concluded from
ABRUPT, ABRUPT_YAW = 3.0, 20.0  # m/s, rad/s by which one step may exceed those around it
AROUND = 0.3  # s that tell how fast the car is about an instant
STANDS = 0.1  # m/s; below, a frame may repeat the one before
FALSE_YAW_RATE = 3.0  # rad/s off the heading's own rate: the largest honest one in the logs is 1.3

# Collisions. The best tyre on rubber reaches about 1 g; the hardest braking in the logs is 0.98 g,
# the mildest hit 1.7 g.
BEST_FRICTION, MARGIN = 1.0, 1.5
SPAN_OF_POSES = 0.05  # s over which poses are differenced: 1 mm of noise then is 1 m/s²
SPAN_OF_VELOCITIES = 0.01  # s, for velocities that are there already
BEFORE, AFTER = 0.05, 0.2  # s that a hit is taken to last beyond what shows
IMPACT_RATE = 50.0  # Hz; slower accelerometers show a single vibration as they show a hit
QUIET = 6.0  # standard deviations of an accelerometer that is read as noise

# Stuck sensors
HELD, HELD_ALONE = 0.5, 1.0  # s of one reading, with motion capture to judge it and without
READINGS = 5  # of one value in a row, at least
APART = 0.5  # m/s between wheels and car that slip in grip and a turn do not explain
TURNS = 0.7  # rad/s that a gyroscope cannot miss
DRIVEN, FULL = 0.1, 0.5  # throttle beyond any dead zone's doubt, with and without motion capture
STEERED = math.radians(5)  # a change that a moving car answers

# Units
FASTEST, FASTEST_YAW = 30.0, 60.0  # m/s, rad/s: no model car's
STEEPEST = math.radians(65)  # the largest lock that a car may declare
DEGREES = (45.0, 72.0)  # a ratio in here is that of degrees to radians
UNITS = {
    "cm/s": (80.0, 125.0),
    "km/h": (3.2, 4.0),
    "mm/s": (800.0, 1250.0),
}
TELLING = 20  # samples that a ratio is concluded from


class LogDefect(NamedTuple):
    """A stretch of a log that says what was not so."""

    start: float  # s
    end: float
    what: str  # for a person
    column: str = ""  # that is false; empty: nothing of the log holds there


class Track(NamedTuple):
    """Motion capture without its false frames; velocities NaN where they are not known."""

    time: np.ndarray
    east: np.ndarray  # velocity in the world's axes, m/s
    north: np.ndarray
    vx: np.ndarray  # in the body's
    vy: np.ndarray
    yaw_rate: np.ndarray
    span: float  # s that a velocity is the mean over

    def at(self, values: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Values at other times; NaN where they are not known."""
        return np.interp(time, self.time, values, left=math.nan, right=math.nan)


def find_defects(run: Run) -> list[LogDefect]:
    """Stretches of the run that a fit must leave out, by time.

    Raises `InputError`, naming file and time, where the log cannot be used at all.
    """
    refuse(run)
    run, _ = repair(run)
    found = [*gaps(run), *missing(run), *released(run)]
    track = None
    if run.truth is not None:
        found += [*repeated_frames(run.truth), *jumps(run.truth), *false_yaw_rates(run.truth)]
        track = follow(run.truth)
        found += collisions(run, track)
    else:
        found += impacts(run)
    found += [*stuck_encoder(run, track), *stuck_gyroscope(run, track)]
    return sorted(found)


def repair(run: Run) -> tuple[Run, list[str]]:
    """The run with its heading unwrapped, and a line for each repair; the same run if none."""
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
    """The usual time between two rows (s); NaN where rows are too few or come at no rate."""
    steps = np.diff(time)
    if len(time) < ROWS:
        return math.nan
    usual = float(np.median(steps))
    return usual if np.mean(np.abs(steps - usual) <= 0.5 * usual) > 0.8 else math.nan


def asked(run: Run, name: str, time: np.ndarray) -> np.ndarray:
    """Throttle or steering at these times; 0 before the first command."""
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
# What is not there
# -------------------------------------------------------------------------------------------------


def gaps(run: Run) -> Iterator[LogDefect]:
    """Rows, or reports of one sensor, that come too late or twice at once."""
    tables = {"commands": run.commands, "telemetry": run.telemetry, "truth": run.truth}
    for name, table in tables.items():
        if table is None:
            continue
        yield from _late(table["time_s"], f"{name}.csv has no rows", "")
        for i in np.flatnonzero(np.diff(table["time_s"]) <= 0).tolist():
            at = float(table["time_s"][i])
            yield LogDefect(at, at, f"{name}.csv has two rows at one time")
    for name in run.telemetry or ():
        if name != "time_s":
            yield from _late(readings(run, name)[0], f"{name} reports nothing", name)


def _late(time: np.ndarray, what: str, column: str) -> Iterator[LogDefect]:
    every = period(time)
    for i in np.flatnonzero(np.diff(time) > MISSED * every).tolist():
        start, end = float(time[i]), float(time[i + 1])
        yield LogDefect(start, end, f"{what} for {end - start:.2f} s", column)


def missing(run: Run) -> Iterator[LogDefect]:
    """Columns that hold nothing, cells of motion capture that do not, and infinite values."""
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
    """While the dead-man switch is open, what was asked is not what the motor got."""
    time, armed = readings(run, "armed")
    for first, last in stretches(armed < 0.5):
        end = time[min(last + 1, len(time) - 1)]
        yield LogDefect(float(time[first]), float(end), "the dead-man switch is released")


# -------------------------------------------------------------------------------------------------
# Motion capture
# -------------------------------------------------------------------------------------------------


def frames(truth: Table) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses, (3, frames), of the frames that hold one; times rise."""
    pose = np.stack([truth["x_m"], truth["y_m"], truth["heading_rad"]])
    good = np.all(np.isfinite(pose), axis=0)
    good[1:] &= np.diff(truth["time_s"]) > 0
    return truth["time_s"][good], pose[:, good]


def usual(time: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Median of a step's rate over the steps around it."""
    width = 2 * max(3, round(AROUND / 2 / max(float(np.median(np.diff(time))), 1e-4))) + 1
    return median_filter(rates, width, mode="nearest")


def repeated_frames(truth: Table) -> Iterator[LogDefect]:
    """Frames that are the one before, though the car moves."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    speed = np.hypot(*np.diff(pose[:2], axis=1)) / np.diff(time)
    same = np.all(np.diff(pose, axis=1) == 0, axis=0) & (usual(time, speed) > STANDS)
    for first, last in stretches(same):
        span = float(time[first]), float(time[last + 1])
        yield LogDefect(*span, "motion capture repeats a frame while the car moves")


def false_frames(time: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Frames off the median of the five around them by more than any acceleration explains."""
    reach = 2 * float(np.median(np.diff(time)))
    limit = SLACK + MARGIN * BEST_FRICTION * GRAVITY * reach**2 / 2
    limit_yaw = SLACK_YAW + ABRUPT_YAW * reach / 2
    middle = median_filter(pose, (1, 5), mode="nearest")
    off = np.abs(pose - middle)
    return np.any(off > np.array([[limit], [limit], [limit_yaw]]), axis=0)


def jumps(truth: Table) -> Iterator[LogDefect]:
    """Frames that the car cannot have been at, or cannot have come to."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    false = false_frames(time, pose)
    for first, last in stretches(false):
        span = float(time[max(first - 1, 0)]), float(time[min(last + 1, len(time) - 1)])
        yield LogDefect(*span, "motion capture has a false frame")
    time, pose = time[~false], pose[:, ~false]
    span = np.diff(time)
    moved, turned = np.hypot(*np.diff(pose[:2], axis=1)), np.abs(np.diff(pose[2]))
    speed, rate = usual(time, moved / span), usual(time, turned / span)
    far = moved > SLACK + (speed + ABRUPT) * span
    round_ = turned > SLACK_YAW + (rate + ABRUPT_YAW) * span
    for i in np.flatnonzero(far | round_).tolist():
        by = f"{moved[i]:.2f} m" if far[i] else f"{math.degrees(turned[i]):.0f}°"
        yield LogDefect(float(time[i]), float(time[i + 1]), f"motion capture jumps by {by}")


def false_yaw_rates(truth: Table) -> Iterator[LogDefect]:
    """Yaw rates that are not how the heading changes, before nor after."""
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
    """Velocities from motion capture; None where it is too short."""
    time, pose = frames(truth)
    if len(time) < ROWS:
        return None
    heading = pose[2]
    if {"vx_mps", "vy_mps", "yaw_rate_radps"} <= truth.keys():
        inside = np.isin(truth["time_s"], time)
        inside[1:] &= np.diff(truth["time_s"]) > 0
        vx, vy, rate = (truth[n][inside] for n in ("vx_mps", "vy_mps", "yaw_rate_radps"))
        cosine, sine = np.cos(heading), np.sin(heading)
        east, north = cosine * vx - sine * vy, sine * vx + cosine * vy
        return Track(time, east, north, vx, vy, rate, SPAN_OF_VELOCITIES)
    good = ~false_frames(time, pose)
    good[1:] &= np.any(np.diff(pose, axis=1) != 0, axis=0)
    kept, pose = time[good], pose[:, good]
    if len(kept) < ROWS:
        return None
    half = max(1, math.ceil(SPAN_OF_POSES / 2 / float(np.median(np.diff(kept))) - 0.01))
    rates = (pose[:, 2 * half :] - pose[:, : -2 * half]) / (kept[2 * half :] - kept[: -2 * half])
    time, heading = kept[half:-half], pose[2, half:-half]
    cosine, sine = np.cos(heading), np.sin(heading)
    east, north, rate = rates
    vx, vy = cosine * east + sine * north, cosine * north - sine * east
    return Track(time, east, north, vx, vy, rate, SPAN_OF_POSES)


# -------------------------------------------------------------------------------------------------
# Collisions
# -------------------------------------------------------------------------------------------------


def hardest(run: Run) -> float:
    """Acceleration that is beyond the car's tyres (m/s²)."""
    friction = BEST_FRICTION
    if run.car is not None:
        tires = run.car.tires
        friction = max(friction, float(tires.front.peak_friction), float(tires.rear.peak_friction))
    return MARGIN * GRAVITY * friction


def collisions(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """Where the velocity changes faster than tyres can change it."""
    if track is None:
        return
    time = track.time
    step = max(1, math.ceil(track.span / float(np.median(np.diff(time))) - 0.01))
    span = time[step:] - time[:-step]
    change = np.hypot(
        *(values[step:] - values[:-step] for values in (track.east, track.north))
    ) / np.maximum(span, track.span)
    # Beside a gap nothing can be said, and nothing beside a jump of the poses.
    hit = (change > hardest(run)) & (span < 1.5 * max(track.span, float(np.median(span))))
    if run.truth is not None:
        for fault in jumps(run.truth):
            reach = track.span
            hit &= (time[step:] < fault.start - reach) | (time[:-step] > fault.end + reach)
    yield from _hits(time[:-step], time[step:], change, hit, "the car is slowed or thrown by")


def impacts(run: Run) -> Iterator[LogDefect]:
    """The same from a fast accelerometer, where there is no motion capture."""
    time, ax = readings(run, "accel_x_mps2")
    other, ay = readings(run, "accel_y_mps2")
    if not np.array_equal(time, other) or not period(time) <= 1 / IMPACT_RATE:
        return
    ax, ay = ax - np.median(ax), ay - np.median(ay)
    noise = 1.4826 * np.median(np.abs(np.diff([ax, ay]))) / math.sqrt(2)
    size = np.hypot(ax, ay)
    hit = size > hardest(run) + QUIET * noise
    yield from _hits(time, time, size, hit, "the accelerometer reads")


def _hits(
    begin: np.ndarray, end: np.ndarray, size: np.ndarray, hit: np.ndarray, what: str
) -> Iterator[LogDefect]:
    """Hits that are closer than their own length are one."""
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
    """First and last reading of each stretch of one value that lasts so long (s)."""
    for first, last in stretches(np.diff(values) == 0):
        if time[last + 1] - time[first] >= least and last + 2 - first >= READINGS:
            yield first, last + 1


def longest(time: np.ndarray, where: np.ndarray) -> float:
    """Duration of the longest stretch that is so throughout (s)."""
    return max((float(time[b] - time[a]) for a, b in stretches(where)), default=0.0)


def stuck_encoder(run: Run, track: Track | None) -> Iterator[LogDefect]:
    """A wheel speed that stays the same though drive and motion say that it cannot."""
    time, speed = readings(run, "wheel_speed_mps")
    if len(time) < ROWS:
        return
    steps = np.diff(np.unique(speed))
    slack = APART + 2.5 * (float(np.min(steps)) if len(steps) else 0.0)
    gyro_time, gyro = readings(run, "gyro_radps")
    for first, last in held(time, speed, HELD):
        at, value = time[first : last + 1], float(speed[first])
        throttle = asked(run, "throttle", at)
        idle = throttle == 0
        early, late = (np.mean(half) for half in np.array_split(throttle, 2))
        other = abs(late - early) > 0.2 and min(early, late) < FULL
        why = ""
        if value > 0 and longest(at, idle) >= HELD_ALONE:
            why = "without throttle"
        elif value > 0 and other and at[-1] - at[0] >= HELD_ALONE:
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
    """A yaw rate that stays the same though the car turns otherwise. At its reach it may."""
    time, rate = readings(run, "gyro_radps")
    if len(time) < ROWS:
        return
    most = float(np.max(np.abs(rate)))
    wheel_time, wheel = readings(run, "wheel_speed_mps")
    for first, last in held(time, rate, HELD):
        at, value = time[first : last + 1], float(rate[first])
        full = abs(value) >= 0.99 * most and most > 2
        if track is not None:
            true = track.at(track.yaw_rate, at)
            false = np.abs(true - value) > TURNS
            if full:
                false &= np.abs(true) < abs(value)
            stuck = longest(at, false) >= HELD
        else:
            steering = asked(run, "steering", at)
            moving = np.interp(at, wheel_time, wheel) > APART if len(wheel) else np.zeros(len(at))
            answers = np.ptp(steering) > STEERED or (
                np.min(np.abs(steering)) > STEERED and abs(value) < SLACK_YAW
            )
            long = at[-1] - at[0] >= HELD_ALONE
            stuck = bool(long and np.all(moving) and answers and not full)
        if stuck:
            what = f"the gyroscope stays at {value:.2f} rad/s while the car turns otherwise: stuck"
            yield LogDefect(float(at[0]), float(at[-1]), what, "gyro_radps")


# -------------------------------------------------------------------------------------------------
# What cannot be used
# -------------------------------------------------------------------------------------------------


def refuse(run: Run) -> None:
    """Raise `InputError`, naming file and time, for what no masking can save."""
    for name, table in (("telemetry", run.telemetry), ("truth", run.truth)):
        if table is not None:
            _refuse_table(f"{run.path}/{name}.csv", table)
    commands = f"{run.path}/commands.csv"
    _none(commands, run.commands, ~np.isfinite(run.commands["throttle"]), "throttle is no number")
    _none(
        commands,
        run.commands,
        np.abs(run.commands["throttle"]) > 1,
        "throttle is beyond 1: is it in percent?",
    )
    _none(
        commands,
        run.commands,
        np.abs(run.commands["steering"]) > STEEPEST,
        "steering_deg is beyond any lock",
    )
    if run.truth is not None:
        _refuse_truth(run, run.truth)
    _refuse_sensors(run)


def _none(file: str, table: Table, wrong: np.ndarray, message: str) -> None:
    if np.any(wrong):
        raise InputError(f"{file}, {table['time_s'][np.argmax(wrong)]:.2f} s: {message}")


def _refuse_table(file: str, table: Table) -> None:
    if not len(table):
        raise InputError(f"{file}: holds no rows")
    time = table["time_s"]
    _none(file, table, ~np.isfinite(time), "time_s is no number")
    _none(file, table, np.diff(time, prepend=time[0]) < 0, "time_s goes backwards")
    if len(time) >= ROWS and np.median(np.diff(time)) >= SLOWEST_CLOCK:
        step = float(np.median(np.diff(time)))
        raise InputError(
            f"{file}, {time[0]:.2f} s: rows are {step:g} s apart: is time_s in milliseconds?"
        )


def _refuse_truth(run: Run, truth: Table) -> None:
    """Units of motion capture: of poses by how fast they go, of the rest by the poses."""
    file = f"{run.path}/truth.csv"
    for name in ("x_m", "y_m", "heading_rad"):
        if not np.any(np.isfinite(truth[name])):
            raise InputError(f"{file}, {truth['time_s'][0]:.2f} s: {name} is empty from here on")
    time, pose = frames(truth)
    if len(time) < ROWS:
        return
    span = np.diff(time)
    # The same over a tenth of a second tells a course, where frames are noise.
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
    told = moving[stride:] & moving[:-stride] & (np.abs(bend) > 0.05)
    _no_degrees(file, "heading_rad", begins[stride:], turned[stride:], bend, told)
    rate = np.abs(turned) / over
    if np.quantile(rate, 0.9) > FASTEST_YAW:  # of a car that spins, where the course tells little
        at = float(begins[np.argmax(rate > FASTEST_YAW)])
        message = f"heading_rad turns at over {FASTEST_YAW:g} rad/s: in degrees?"
        raise InputError(f"{file}, {at:.2f} s: {message}")
    middle = begins + over / 2
    if "yaw_rate_radps" in truth:
        rate = np.interp(middle, truth["time_s"], truth["yaw_rate_radps"])
        slope = np.angle(np.exp(1j * turned)) / over
        _no_degrees(file, "yaw_rate_radps", begins, rate, slope, np.abs(slope) > 0.3)
    if {"vx_mps", "vy_mps"} <= truth.keys():
        size = np.hypot(truth["vx_mps"], truth["vy_mps"])
        size = np.interp(middle, truth["time_s"], size)
        _no_other_speed(file, "vx_mps, vy_mps", begins, size, speed, speed > 2 * STANDS)


def _refuse_sensors(run: Run) -> None:
    """Units of encoder and gyroscope: by motion capture, or by what no model car does."""
    file = f"{run.path}/telemetry.csv"
    track = follow(repair(run)[0].truth) if run.truth is not None and len(run.truth) else None  # type: ignore[arg-type]  # it has one as this run has
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
            _no_degrees(file, name, time, values, rate, np.abs(rate) > 0.3)
        else:
            vx, vy = track.at(track.vx, time), track.at(track.vy, time)
            grips = (vx > 0.3) & (np.abs(vy) < 0.1 * vx)
            _no_other_speed(file, name, time, values, vx, grips)


def _ratio(values: np.ndarray, true: np.ndarray, told: np.ndarray) -> tuple[float, float] | None:
    """Quartiles of how much larger a value is than it should be; None where that is not told."""
    told = told & np.isfinite(values) & np.isfinite(true) & (true != 0)
    if np.sum(told) < TELLING:
        return None
    low, high = np.quantile(values[told] / true[told], [0.25, 0.75])
    return float(low), float(high)


def _no_degrees(
    file: str, name: str, time: np.ndarray, values: np.ndarray, true: np.ndarray, told: np.ndarray
) -> None:
    found = _ratio(values, true, told)
    if found and DEGREES[0] < found[0] and found[1] < DEGREES[1]:
        at = float(time[np.argmax(told)])
        raise InputError(f"{file}, {at:.2f} s: {name} is some 57 times what is so: in degrees?")


def _no_other_speed(
    file: str, name: str, time: np.ndarray, values: np.ndarray, true: np.ndarray, told: np.ndarray
) -> None:
    found = _ratio(values, true, told)
    for unit, (low, high) in UNITS.items():
        if found and low < found[0] and found[1] < high:
            at = float(time[np.argmax(told)])
            raise InputError(f"{file}, {at:.2f} s: {name} is in {unit}, by the positions")
