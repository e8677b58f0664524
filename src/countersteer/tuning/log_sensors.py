"""A log's own sensors: what its data tell of them, beside what is declared.

`[sensors]` of a log's `run.toml` declares its sensors (`runs/declared.py`, `windows.py`). What it
leaves out is estimated from the log, as far as the log tells. The rest is as the car declares it.

**Capture point and yaw offset**, from slow turns. The rear axle then moves along the car, but for a
slip angle in proportion to its load. With the captured velocity (u, w) and yaw rate r,

    w = -o u + (b + x) r - k u a

o is the captured heading less the car's, b the distance from the centre of mass to the rear axle, x
the point forward of where it is declared, k the rear tyres' compliance, and a the acceleration that
they hold: r u + dw/dt - I / (m f) dr/dt, with the distance f to the front axle.

**Encoder**, where the tyres grip. With the speed h of the hub of its wheel, by motion capture,

    reading(t) = s (h + c y r) + e u du/dt    at t - lag

s is the encoder's scale, y the point to the left of where it is declared, c the share of forward
speed in h, and e the slip under drive. Without the last term, slip would pass for less lag.

**Gyroscope**: reading(t) = g r(t - lag) + bias.

Each lag is that of the least squares. Deviations are the larger of that of the least squares, and
that of estimates which leave out one tenth of the log's time each (the jackknife).

**The encoder's step** is the largest number of which all readings are multiples, as far as the
file's decimals tell.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.runs.declared import sensor_tables
from countersteer.runs.defects import TO_DEVIATION, TURNS, pose_noise
from countersteer.runs.keys import ENCODER_ON
from countersteer.runs.run import Run
from countersteer.signals import Wheels
from countersteer.tuning import windows
from countersteer.tuning.charge import Charge, contradiction, from_voltmeter
from countersteer.tuning.windows import EARLY, Measured, Signal, measured_for
from countersteer.world.chassis import Vector, dot

DRIVES = 0.3  # m/s forward; a slower car tells little
GENTLE = 0.35  # part of the peak friction up to which tyres are taken as linear
JERKS = 4.0  # rad/s², yaw acceleration up to which a turn is slow
BLOCKS = 10  # of a log's time, of which the jackknife leaves out one
FEWEST = 60  # samples; motion capture has them in a second
CORRELATED = 0.15  # s over which errors of smoothed velocities are alike
LAGS = np.arange(-0.05, 0.3501, 0.0025)  # s, that are tried
OUTLYING = 4.0  # deviations beyond which a sample is left out
FINEST = 1e-6  # of a reading, below which differences are of its number format
CHANCE = 1e-3  # that readings fit a step which is none
MOST_STEPS = 500  # in the largest reading, to which a step is searched finely
ANGLES = np.linspace(-1.2, 1.2, 481)  # rad, of steering, between which wheels are interpolated
ALIGNED, AWAY = math.radians(2), 0.2  # rad, m; prior deviations of yaw offset and capture point
SLIP_KNOWN, SLIDES_BY = 0.3, 0.01  # part of a slip angle, m/s of lateral velocity without slip
TURNING, LONG_ENOUGH = 4.0, 1.0  # times `SLIDES_BY` at the rear axle, s: turns that tell it
SLIP_BY = 0.25  # relative prior deviation of the slip under drive
NOISY = 0.005  # m, noise of poses from which velocities are poor


class Kind(NamedTuple):
    """A number of a sensor that is estimated."""

    sensor: str
    key: str  # in `[sensors]` of run.toml
    what: str
    sure: float  # deviation up to which an estimate is used
    differs: float  # difference from what is declared that is worth a warning


KINDS = {
    (kind.sensor, kind.key): kind
    for kind in (
        Kind("capture", "x_m", "captured point, forward of the centre of mass", 0.01, 0.01),
        Kind("capture", "y_m", "captured point, left of the centre of mass", 0.01, 0.015),
        Kind("capture", "yaw_offset_deg", "captured heading less the car's", 0.5, 0.7),
        Kind("encoder", "lag_s", "lag of the encoder", 0.01, 0.015),
        Kind("encoder", "step_mps", "step of the encoder", math.inf, 0.0),
        Kind("gyroscope", "lag_s", "lag of the gyroscope", 0.01, 0.015),
    )
}
STEP_DIFFERS = 0.02  # part of a declared step
NUMBER_FORMAT = 0.005  # m/s; a smaller step is how a logger writes, and matters to nothing


class Estimate(NamedTuple):
    """A number of a log's sensor, declared and estimated, in the unit of its key."""

    kind: Kind
    declared: float
    source: str  # of the declared one: run.toml, the car, or truth.csv by what the file means
    value: float  # estimated
    deviation: float
    used: str  # declared, estimated

    @property
    def sure(self) -> bool:
        """True if the log tells the number well enough."""
        return bool(self.deviation <= self.kind.sure)

    @property
    def contradicts(self) -> bool:
        """True if the log tells another number than the declared one."""
        differs = self.kind.differs
        if self.kind.key == "step_mps":
            if self.value < NUMBER_FORMAT:
                return False
            differs = STEP_DIFFERS * self.declared
        return self.sure and abs(self.value - self.declared) > max(differs, 3 * self.deviation)

    def as_json(self) -> dict[str, Any]:
        """The estimate for JSON."""
        return {
            "sensor": self.kind.sensor,
            "key": self.kind.key,
            "declared": self.declared,
            "declared_by": self.source,
            "estimated": self.value,
            "deviation": self.deviation,
            "determined": self.sure,
            "used": self.used,
            "contradicts": self.contradicts,
        }


class LogSensors(NamedTuple):
    """A log's sensors: the run with `[sensors]` filled in, the estimates, and lines of doubt."""

    run: Run
    estimates: list[Estimate]
    charge: Charge | None  # of the battery, by the log's voltmeter
    warnings: list[str]

    @property
    def charge_from(self) -> str:
        """What tells the battery's charge: run.toml, voltmeter, or nothing."""
        if "battery_charge" not in self.run.about:
            return ""
        return "voltmeter" if "battery_charge_end" in self.run.about else "run.toml"

    def as_json(self) -> list[dict[str, Any]]:
        """The estimates for JSON."""
        return [one.as_json() for one in self.estimates]


def resolve(run: Run, car: Car, dt: float) -> LogSensors:
    """What a log tells of its sensors.

    The returned run declares all that is used: what it declared itself, else what the log tells,
    else what the car declares. A run with a car of its own declares by that car. `dt` is the step
    of the steering's simulation (s).
    """
    measured = measured_for(run, car)
    found = encoder_step(run, measured)
    course = None if measured.vx is None else course_of(run, car, measured, dt)
    if course is not None and len(course.time) >= FEWEST:
        found += from_motion_capture(run, car, measured, course)
    estimates = [one for one in found if math.isfinite(one.value)]
    filled = {name: dict(table) for name, table in run.about.get("sensors", {}).items()}
    for one in estimates:
        if one.used == "estimated":
            filled.setdefault(one.kind.sensor, {})[one.kind.key] = one.value
    warnings = [line for one in estimates if (line := warning(one))]
    warnings += noise_warning(run)
    if course is not None and len(course.time) >= FEWEST and measured.encoder is not None:
        warnings += wheel_warning(run, car, measured, course)
    about = run.about | {"sensors": filled}
    charge, doubt = from_voltmeter(run, car, measured, dt)
    if doubt:
        warnings.append(doubt)
    if charge is not None and "battery_charge" in about:
        warnings += filter(None, [contradiction(float(about["battery_charge"]), charge)])
    elif charge is not None:
        about |= {"battery_charge": charge.begin, "battery_charge_end": charge.end}
    return LogSensors(dataclasses.replace(run, about=about), estimates, charge, warnings)


def warning(one: Estimate) -> str:
    """A line for an estimate that contradicts what is declared; empty for others."""
    if not one.contradicts:
        return ""
    kind = one.kind
    plus = "" if one.deviation == 0 else f" ± {one.deviation:.2g}"
    line = (
        f"{kind.what}: the log tells {one.value:.4g}{plus}, but {one.source} {one.declared:.4g} "
        f"({kind.key} under [sensors.{kind.sensor}] of run.toml)"
    )
    return f"{line}; the log's is used" if one.used == "estimated" else line


def estimated(
    run: Run, sensor: str, key: str, default: tuple[float, str], value: float, deviation: float
) -> Estimate:
    """An estimate beside what is declared. It is used where run.toml does not declare the key."""
    kind = KINDS[sensor, key]
    own = sensor_tables(run.about, sensor)
    declared, source = (float(own[key]), "run.toml") if key in own else default
    free = key not in own and sensor != "capture" and run.car is None
    used = "estimated" if free and deviation <= kind.sure else "declared"
    return Estimate(kind, declared, source, value, deviation, used)


# -------------------------------------------------------------------------------------------------
# The encoder's step
# -------------------------------------------------------------------------------------------------


def encoder_step(run: Run, measured: Measured) -> list[Estimate]:
    """The estimate of the encoder's step, if its readings have one."""
    if measured.encoder is None:
        return []
    step, deviation = common_step(measured.encoder.value)
    declared = (measured.encoder_timing.step, "the car")
    return [estimated(run, "encoder", "step_mps", declared, step, deviation)]


def common_step(values: np.ndarray) -> tuple[float, float]:
    """The largest step of which all values are multiples, and its deviation; NaN for none.

    A value may be off by half of its last decimal. A step counts if values would fit it by chance
    with a probability below `CHANCE`.
    """
    values = np.unique(np.abs(values[np.isfinite(values)]))
    values = values[values > 0]
    if len(values) < 2:
        return math.nan, math.nan
    largest = float(values[-1])
    decimals = next(
        (d for d in range(9) if np.all(np.abs(values - np.round(values, d)) < FINEST * largest)), 9
    )
    slack = max(0.51 * 10.0**-decimals, FINEST * largest)
    values = values[np.diff(values, prepend=-math.inf) > FINEST * largest]
    gaps = np.diff(np.append(0.0, values))
    least = float(np.min(gaps[gaps > 2 * slack], initial=math.inf))
    if not math.isfinite(least):
        return 10.0**-decimals, 0.0
    highest = largest / least + 1
    for part in (1, 2, 3, 4):
        near = np.arange(-2 * slack, 2 * slack, slack / min(highest, MOST_STEPS) / 20)
        candidates = (least + near) / part
        candidates = candidates[candidates > 2.5 * slack]
        if len(candidates) == 0:
            break
        off = np.abs(values - candidates[:, None] * np.rint(values / candidates[:, None]))
        worst = np.max(off, axis=1)
        best = candidates[np.argmin(worst)]
        chance = len(candidates) * (2 * slack / best) ** (len(values) - 1)
        if np.min(worst) <= slack and chance < CHANCE:
            count = np.rint(values / best)
            step = float(count @ values / (count @ count))
            return step, float(slack / math.sqrt(3) / math.sqrt(count @ count))
    return (10.0**-decimals, 0.0) if decimals < 6 else (math.nan, math.nan)


# -------------------------------------------------------------------------------------------------
# Least squares
# -------------------------------------------------------------------------------------------------


class Prior(NamedTuple):
    """What is expected of coefficients: means, and deviations (infinite: nothing)."""

    mean: Sequence[float]
    deviation: Sequence[float]


class Solved(NamedTuple):
    """Coefficients of a regression at the best lag, and that lag (s), with their deviations."""

    value: np.ndarray  # (coefficients + 1,), the lag last
    deviation: np.ndarray
    spread: float  # robust standard deviation of the residuals
    misfit: float = 0.0  # root mean square of all residuals, of outliers too


def regression(
    design: Callable[[float], np.ndarray],
    target: np.ndarray,
    time: np.ndarray,
    lags: np.ndarray,
    prior: Prior,
) -> Solved | None:
    """Least squares of target (n,) on `design(lag)` (n, k), at the lag of the least residual.

    Samples are outliers if they are off by `OUTLYING` deviations at the best lag. None with fewer
    than `FEWEST` samples.
    """
    designs = [design(lag) for lag in lags.tolist()]
    usable = np.isfinite(target) & np.all([np.isfinite(d).all(axis=1) for d in designs], axis=0)
    known = usable.copy()
    for _ in range(3):
        if np.sum(usable) < FEWEST:
            return None
        stack = np.stack([d[usable] for d in designs])
        found = _solved(stack, target[usable], time[usable], lags, prior)
        best = int(np.argmin(np.abs(lags - found.value[-1])))
        off = np.abs(target - designs[best] @ found.value[:-1])
        usable &= ~(off > OUTLYING * max(found.spread, FINEST))
    return found._replace(misfit=float(np.sqrt(np.mean(off[known] ** 2))))


def _solved(
    stack: np.ndarray, target: np.ndarray, time: np.ndarray, lags: np.ndarray, prior: Prior
) -> Solved:
    """The solution for designs (lags, n, k), with the jackknife over `BLOCKS` parts of the time."""
    block = np.minimum(np.arange(len(target)) * BLOCKS // len(target), BLOCKS - 1)
    parts = [block == i for i in range(BLOCKS)]
    gram = np.stack([np.einsum("lni,lnj->lij", stack[:, p], stack[:, p]) for p in parts])
    moment = np.stack([np.einsum("lni,n->li", stack[:, p], target[p]) for p in parts])
    square = np.array([target[p] @ target[p] for p in parts])
    precision = np.diag(1 / np.asarray(prior.deviation, float) ** 2)
    mean = np.asarray(prior.mean, float)
    # Errors alike within `CORRELATED` are as good as one.
    steps = np.diff(time)
    period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else CORRELATED
    alike = max(1.0, CORRELATED / period)

    def at(chosen: np.ndarray, variance: float) -> tuple[np.ndarray, np.ndarray]:
        """The coefficients and the lag for some blocks, and their covariance."""
        scale = 1 / (alike * variance)
        whole = scale * gram[chosen].sum(0) + precision
        right = scale * moment[chosen].sum(0) + precision @ mean
        value = np.linalg.solve(whole, right[..., None])[..., 0]
        cost = (
            scale * square[chosen].sum()
            - 2 * np.einsum("li,li->l", value, scale * moment[chosen].sum(0))
            + np.einsum("li,lij,lj->l", value, scale * gram[chosen].sum(0), value)
            + np.einsum("li,ij,lj->l", value - mean, precision, value - mean)
        )
        best = int(np.argmin(cost))
        inverse = np.linalg.inv(whole[best])
        deviations = np.sqrt(np.diag(inverse))
        lag, sharp = lags[best], math.nan
        if 0 < best < len(lags) - 1:
            left, middle, right_ = cost[best - 1 : best + 2]
            bend = left - 2 * middle + right_
            step = lags[1] - lags[0]
            lag = lag + 0.5 * step * (left - right_) / max(bend, 1e-300)
            sharp = step * math.sqrt(2 / max(bend, 1e-300))
        elif len(lags) == 1:
            sharp = 0.0
        return np.append(value[best], lag), np.append(deviations, sharp)

    everything = np.arange(BLOCKS)
    value, _ = at(everything, float(np.var(target)) + FINEST**2)
    best = int(np.argmin(np.abs(lags - value[-1])))
    residual = target - stack[best] @ value[:-1]
    spread = float(TO_DEVIATION * np.median(np.abs(residual)))
    variance = max(float(np.mean(np.minimum(residual**2, (3 * spread) ** 2))), FINEST**2)
    value, deviation = at(everything, variance)
    without = np.stack([at(everything[everything != i], variance)[0] for i in range(BLOCKS)])
    jackknife = np.sqrt((BLOCKS - 1) * np.mean((without - without.mean(0)) ** 2, axis=0))
    return Solved(value, np.maximum(deviation, jackknife), spread)


# -------------------------------------------------------------------------------------------------
# Against motion capture
# -------------------------------------------------------------------------------------------------


class Course(NamedTuple):
    """The captured motion on an even grid, in the car's axes; NaN where unknown."""

    time: np.ndarray
    vx: np.ndarray
    vy: np.ndarray
    yaw_rate: np.ndarray
    steering: np.ndarray  # of the front wheels, by the car's servo (rad)

    def slope(self, values: np.ndarray) -> np.ndarray:
        """The derivative of a column over time."""
        return np.gradient(values, self.time)


def course_of(run: Run, car: Car, measured: Measured, dt: float) -> Course:
    """The motion of a log with motion capture."""
    assert measured.vx is not None
    assert measured.vy is not None
    assert measured.yaw_rate is not None
    time, rows = np.unique(measured.vx.time, return_index=True)
    vx, vy, rate = (s.value[rows] for s in (measured.vx, measured.vy, measured.yaw_rate))
    last = max(1, int(max(time[-1], run.commands["time_s"][-1]) / dt) + 1)
    commands = windows.asked(run.commands, np.arange(last), dt)
    angle = windows.actuators(car, measured, commands, dt)[0]
    steering = np.interp(time, dt * np.arange(len(angle)), angle)
    return Course(time, vx, vy, rate, steering)


def from_motion_capture(run: Run, car: Car, measured: Measured, course: Course) -> list[Estimate]:
    """The capture point, the yaw offset, and the lags of encoder and gyroscope."""
    moves = capture_point(run, car, course)
    found = list(moves)
    if measured.encoder is not None:
        before = sensor_tables(run.about, "capture").get("x_m", 0.0)
        points = [one.value - before for one in moves if one.kind.key == "x_m" and one.sure]
        point = points[0] if points else 0.0
        moved = course._replace(vy=course.vy - course.yaw_rate * point)
        found += encoder_lag(run, car, measured, moved)
    if measured.gyro is not None:
        found += gyro_lag(run, measured.gyro, course)
    return found


def capture_point(run: Run, car: Car, course: Course) -> list[Estimate]:
    """The yaw offset, and the captured point forward of the centre of mass if the log turns."""
    body, rear = car.body, car.tires.rear
    back = float(body.wheelbase - body.front_axle)
    vx, vy, rate = course.vx, course.vy, course.yaw_rate
    turns = course.slope(rate)
    swing = float(body.yaw_inertia / (body.mass * body.front_axle))
    held = rate * vx + course.slope(vy) - swing * turns
    grip = min(float(car.tires.front.peak_friction), float(rear.peak_friction))
    stiff = 1 / (GRAVITY * float(rear.cornering_stiffness))
    slow = (vx > DRIVES) & (np.abs(held) < GENTLE * grip * GRAVITY) & (np.abs(turns) < JERKS)
    slow &= np.abs(course.slope(vx)) < GENTLE * grip * GRAVITY
    # The slip angle is known to a part only. So the slowest turns count most.
    weight = 1 / np.hypot(1.0, SLIP_KNOWN * stiff * vx * held / SLIDES_BY)
    turning = slow & (weight * np.abs(rate) * back > TURNING * SLIDES_BY)
    told = np.sum(turning) * float(np.median(np.diff(course.time))) >= LONG_ENOUGH
    design = weight[:, None] * np.stack([-vx, rate, -vx * held], axis=1)
    prior = Prior((0.0, back, stiff), (ALIGNED, AWAY, stiff))
    target = np.where(slow, weight * vy, math.nan)
    found = regression(lambda _: design, target, course.time, np.zeros(1), prior)
    if found is None:
        return []
    convention = (0.0, "truth.csv")
    own = sensor_tables(run.about, "capture")
    yaw, forward = (float(v) for v in found.value[:2])
    # The table was moved by what is declared. The estimate is what is left.
    x, offset = (
        forward - back + own.get("x_m", 0.0),
        yaw + math.radians(own.get("yaw_offset_deg", 0.0)),
    )
    deviations = found.deviation[:2].tolist()
    whole = [
        estimated(
            run,
            "capture",
            "yaw_offset_deg",
            convention,
            math.degrees(offset),
            math.degrees(deviations[0]),
        )
    ]
    if told:
        whole.append(estimated(run, "capture", "x_m", convention, x, deviations[1]))
    return whole


def encoder_fit(
    car: Car, measured: Measured, course: Course, sees: Wheels, aside: float
) -> Solved | None:
    """The encoder's scale, its point aside times the scale, its slip and lag.

    `aside` is the prior deviation of the captured point to the left (m).
    """
    assert measured.encoder is not None
    roll = Vector(
        *(
            np.interp(course.steering, ANGLES, np.broadcast_to(part, ANGLES.shape))
            for part in windows.seen_by(sees, windows.rolls(car, ANGLES))
        )
    )
    hub = dot(roll, Vector(course.vx, course.vy, course.yaw_rate))
    ahead = roll.x
    push = course.slope(course.vx)
    grip = min(float(car.tires.front.peak_friction), float(car.tires.rear.peak_friction))
    limit = GENTLE * grip * GRAVITY
    rough = (course.vx < DRIVES) | (np.abs(push) > limit)
    rough |= (np.abs(course.yaw_rate * course.vx) > limit) | ~np.isfinite(hub)
    beside = ahead * course.yaw_rate
    columns = np.where(rough, math.nan, np.stack([hub, beside, course.vx * push]))
    time, read = measured.encoder
    over = measured.encoder_timing.over

    def design(lag: float) -> np.ndarray:
        return np.stack([_mean(course.time, c, time - lag, over) for c in columns], axis=1)

    tires = car.tires
    stiff = float(tires.front.longitudinal_stiffness + tires.rear.longitudinal_stiffness) / 2
    slip = 1 / (GRAVITY * stiff)  # of wheels that are all driven
    prior = Prior((1.0, 0.0, slip), (0.3, aside, SLIP_BY * slip))
    return regression(design, np.where(read > 0, read, math.nan), time, LAGS, prior)


def _mean(time: np.ndarray, values: np.ndarray, at: np.ndarray, over: float) -> np.ndarray:
    """The mean of a series over windows around `at`; NaN where a sample in one is unknown."""
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    if over <= 0:
        near = np.interp(at, time, (~known).astype(float), left=1.0, right=1.0)
        return np.where(near > 0, math.nan, np.interp(at, time, filled))
    area, holes = (
        np.append(0.0, np.cumsum(np.diff(time) * (line[1:] + line[:-1]) / 2))
        for line in (filled, (~known).astype(float))
    )
    ends = at - over / 2, at + over / 2
    inside = (ends[0] >= time[0]) & (ends[1] <= time[-1])
    gap = np.interp(ends[1], time, holes) - np.interp(ends[0], time, holes)
    value = (np.interp(ends[1], time, area) - np.interp(ends[0], time, area)) / over
    return np.where(inside & (gap < EARLY), value, math.nan)


def encoder_lag(run: Run, car: Car, measured: Measured, course: Course) -> list[Estimate]:
    """The encoder's lag, and the captured point to the left by its speed in turns."""
    found = encoder_fit(car, measured, course, measured.encoder_sees, 0.1)
    if found is None:
        return []
    scale, aside, _, lag = (float(v) for v in found.value)
    if not 0.5 < scale < 2:
        return []
    declared = (measured.encoder_timing.lag, "the car")
    y = aside / scale + sensor_tables(run.about, "capture").get("y_m", 0.0)
    convention = (0.0, "truth.csv")
    return [
        estimated(run, "encoder", "lag_s", declared, lag, float(found.deviation[3])),
        estimated(run, "capture", "y_m", convention, y, float(found.deviation[1]) / scale),
    ]


def gyro_lag(run: Run, gyro: Signal, course: Course) -> list[Estimate]:
    """The gyroscope's lag behind motion capture."""
    known = np.isfinite(course.yaw_rate)
    if np.sum(known) < FEWEST:
        return []

    def design(lag: float) -> np.ndarray:
        return np.stack(
            [_mean(course.time, course.yaw_rate, gyro.time - lag, 0.0), np.ones(len(gyro.time))], 1
        )

    found = regression(design, gyro.value, gyro.time, LAGS, Prior((1.0, 0.0), (0.5, 1.0)))
    if found is None or found.spread >= TURNS:
        return []
    lag, deviation = float(found.value[-1]), float(found.deviation[-1])
    return [estimated(run, "gyroscope", "lag_s", (0.0, "the car"), lag, deviation)]


# -------------------------------------------------------------------------------------------------
# Warnings
# -------------------------------------------------------------------------------------------------

OTHER_WHEEL = 0.7  # residual of the best wheel over that of the declared one, for a warning
AS_GOOD = 1.1  # residual over the least, of wheels that cannot be told apart
BESIDE = 0.002  # m, prior deviation of the captured point to the left where wheels are compared


def noise_warning(run: Run) -> list[str]:
    """A line if the poses are noisy."""
    if run.truth is None or not len(run.truth) or "vx_mps" in run.truth:
        return []
    noise, _ = pose_noise(run.truth)
    if noise <= NOISY:
        return []
    return [
        f"truth.csv: positions have a noise of {noise:.3f} m, so velocities from them are poor and "
        "collisions hardly show"
    ]


def wheel_warning(run: Run, car: Car, measured: Measured, course: Course) -> list[str]:
    """A line if the encoder seems to sit on another wheel than declared."""
    declared = windows.encoder_on(run, car)
    misfit = {}
    for on in ENCODER_ON:
        fit = encoder_fit(car, measured, course, windows.shares(on, car), BESIDE)
        if fit is not None:
            misfit[on] = fit.misfit
    if declared not in misfit:
        return []
    least = min(misfit.values())
    if least > OTHER_WHEEL * misfit[declared]:
        return []
    likely = [on for on, off in misfit.items() if off < AS_GOOD * least]
    return [
        f"the encoder reads as one on the {' or '.join(likely)} would (off by {least:.3f} m/s), "
        f"not as one on the {declared} ({misfit[declared]:.3f} m/s): change on under "
        "[sensors.encoder] of run.toml, unless the captured point is beside the middle"
    ]
