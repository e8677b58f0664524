"""Fit the motor's resistance to steps of throttle from rest, as the paper's `SimulatorAdjuster`.

Log and simulator run on the same commands. `motor.resistance` R is changed until their speeds
agree. R alone is fitted, because it scales the acceleration at every throttle. With
`motor.conduction` 1,

    force at standstill = d U k n e / (r (R + d² R_battery))
    no-load speed of the wheels = d U / (k n)

d is the duty, U the battery's open-circuit voltage, k the torque constant, n the gear ratio, e the
efficiency and r the tyre radius. So R changes neither the no-load speed nor the drag.

Each log holds one level of throttle. The first second after its onset is compared:

    speed(t_i) = mean of v(t - late; R) over the reader's window about t_i  +  e_i

v is the speed of the simulated car (`planar.move`), straight and from rest. The reader of the speed
gives the standard deviation of e_i.

A row gives the time of its command only to within one row period. So `late` is fitted for each
level, within one period of 0. Its prior standard deviation is half a period. This matters at
10 Hz and does not matter at 100 Hz.

The cost is the Huber loss of all e_i, in units of their spread. It is minimised over log R by
Gauss-Newton steps with the exact derivative of the simulator. A step is halved until the cost
falls. With one parameter, this is gradient descent with a step size from the curvature. It needs no
learning rate and only a handful of simulations. One program computes speed and derivative.

Source: "Autonomous RC Car Drifting", the paper that the project started from.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import changed, declarations
from countersteer.errors import InputError
from countersteer.runs import defects
from countersteer.runs.files import Table, drive_column
from countersteer.runs.run import Run
from countersteer.sensing import error_models
from countersteer.signals import Array, Command, Scalar, Wheels
from countersteer.tuning.speed import TO_DEVIATION, read_speed
from countersteer.tuning.windows import asked
from countersteer.world import drivetrain, planar

PARAMETER = "motor.resistance"
DURATION = 1.0  # s of each step, as in the paper
PRECISION = 1e-3  # relative change of R that ends the fit; R's deviation is several times larger

DT = 0.005  # s; speeds are within 2e-4 m/s of those at 1 ms
AFTER = 0.2  # s simulated beyond `DURATION`, so that a car may be late or early
LANES = 16  # levels in every simulation; with a fixed number, one program is compiled

# Detection of a step
SETTLES = 0.2  # s after the onset; by then the operator has reached the level
SAME = 0.02  # throttle; a held level stays within this of its value
LEAST = 0.4  # s, shortest hold of a level
STRAIGHT = math.radians(5)  # steering; beyond it, a step is not straight
STILL = 0.1  # m/s before the onset; above it, the car rolls
MOVED = 0.03  # m in a second; less may be backlash, or an encoder's first count
FEWEST = 3  # readings; two would fix speed and lateness, with none left to check them

HUBER = 1.345  # spreads at which the loss turns linear: 95 % efficient for normal errors
# Limits of a run's median error, relative to that of all readings and to the run's mean speed.
# Beyond both, the run is of another car, or its sensor is stuck. A poor model exceeds the first
# alone.
FOREIGN, FOREIGN_PART = 3.0, 0.3
LONGEST_STEP = 0.7  # of log R: a factor of two
ROUNDS = 40  # simulations at most; the search takes five

NEVER_MOVES = "the car does not move: under the dead zone, it tells nothing of acceleration"
SENSORS = {"encoder": "wheel_speed_mps", "sonar": "sonar_front_m", "lines": "line_crossings"}


class Series(NamedTuple):
    """Measured and simulated speed at one level, from the onset of the throttle."""

    path: Path
    level: float  # throttle
    time: np.ndarray  # s after the onset
    measured: np.ndarray  # m/s
    deviation: np.ndarray  # m/s, standard deviation from the reader
    before: np.ndarray  # m/s, simulated with the original car
    after: np.ndarray  # m/s, simulated with the fitted car
    late: float  # s, lateness of the car after the row of the command
    rms_before: float  # m/s
    rms_after: float


class Unused(NamedTuple):
    """A run that the fit does not use."""

    path: Path
    level: float  # throttle; NaN where there is none
    reason: str


class Acceleration(NamedTuple):
    """The result of a fit."""

    car: Car
    parameter: str  # path of the fitted parameter
    before: float  # value of the parameter
    after: float
    deviation: float  # one standard deviation of `after`
    rms_before: float  # m/s, over all readings
    rms_after: float
    source: str  # reader of the measured speed
    iterations: int  # simulations
    converged: bool  # to the requested precision
    at_bound: bool  # the parameter is at a bound of its declared range
    series: tuple[Series, ...]  # by level
    unused: tuple[Unused, ...]
    masked: tuple[str, ...]  # a line for each excluded stretch


class Step(NamedTuple):
    """A run's step of throttle: the simulator's inputs and the measured speed."""

    path: Path
    level: float
    commands: Table  # with the throttle that reaches the motor
    onset: float  # s
    charge: float  # of the battery, 0 to 1
    row: float  # s between two commands
    time: np.ndarray  # s after the onset, at the middle of each reading
    over: np.ndarray  # s, averaging time of each reading
    speed: np.ndarray  # m/s, positive in the direction of the throttle
    deviation: np.ndarray  # m/s


class UnusableError(Exception):
    """The reason why a run is unusable, with its level (NaN: none)."""

    def __init__(self, reason: str, level: float = math.nan) -> None:
        super().__init__(reason)
        self.level = level


def fit_acceleration(
    runs: Sequence[Run], car: Car, source: str = "encoder", precision: float = PRECISION
) -> Acceleration:
    """Fit `motor.resistance` R so that the car accelerates as in `runs`.

    `source` is the reader of the speed: `encoder`, `sonar` or `lines`. The fit ends when R changes
    by less than the fraction `precision`. R's standard deviation is the larger of two: from the
    curvature of the cost, and from the disagreement between runs.

    `unused` lists runs that are false or have no usable step. Stretches of `find_defects` are left
    out and listed in `masked`.

    Raises `InputError` if `source` is unknown or no run is usable.
    """
    steps, unused, masked = _collect_steps(runs, source)
    with jax.enable_x64(True):
        first = _Fit(car, source, steps)
        best, iterations, converged = _descend(first, precision)
        foreign = first.foreign(best)
        if foreign:
            unused += foreign
            names = {one.path for one in foreign}
            first = _Fit(car, source, [step for step in steps if step.path not in names])
            best, more, converged = _descend(first, precision)
            iterations += more
        before = first.at(first.start)
    low, high = math.log(first.low), math.log(first.high)
    after = math.exp(best.place)
    series = tuple(
        Series(
            step.path,
            step.level,
            step.time,
            step.speed,
            step.deviation,
            old.value,
            new.value,
            new.late,
            _rms(step.speed - old.value),
            _rms(step.speed - new.value),
        )
        for step, old, new in zip(first.steps, before.levels, best.levels, strict=True)
    )
    return Acceleration(
        changed(car, PARAMETER, after),
        PARAMETER,
        math.exp(first.start),
        after,
        after * best.deviation(),
        _rms(np.concatenate([one.measured - one.before for one in series])),
        _rms(np.concatenate([one.measured - one.after for one in series])),
        source,
        iterations,
        converged,
        not low < best.place < high,
        tuple(sorted(series, key=lambda one: one.level)),
        tuple(unused),
        tuple(masked),
    )


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


# -------------------------------------------------------------------------------------------------
# Measurement
# -------------------------------------------------------------------------------------------------


def _collect_steps(runs: Sequence[Run], source: str) -> tuple[list[Step], list[Unused], list[str]]:
    """The usable steps, the unusable runs, and a line for each excluded stretch."""
    if source not in SENSORS:
        raise InputError(f"no reader of speed {source}: give one of {', '.join(SENSORS)}")
    steps: list[Step] = []
    unused: list[Unused] = []
    masked: list[str] = []
    for run in runs:
        try:
            step, lines = take(run, source)
        except InputError as error:
            unused.append(Unused(run.path, math.nan, str(error)))
        except UnusableError as error:
            unused.append(Unused(run.path, error.level, str(error)))
        else:
            steps.append(step)
            masked += lines
    for i, (path, level, reason) in enumerate(unused):
        lower = [abs(s.level) for s in steps if 0 < s.level / level < 1]  # none if NaN
        if reason == NEVER_MOVES and lower:
            reason = f"{source} tells no motion, though the car moves at {min(lower):g}: stuck?"
            unused[i] = Unused(path, level, reason)
    if not steps:
        reasons = "; ".join(f"{path.name}: {reason}" for path, _, reason in unused[:1])
        raise InputError(f"none of {len(runs)} runs tells an acceleration: {reasons}")
    return steps, unused, masked


def take(run: Run, source: str) -> tuple[Step, list[str]]:
    """The run's first step of throttle from rest, and a line for each false stretch in it.

    Raises `UnusableError` if the run has no usable step, and `InputError` if its data are false.
    """
    stretches = defects.find_defects(run)
    commands = _motor_commands(run)
    onset, end, level = _find_step(run, commands, source)
    reports = defects.readings(run, SENSORS[source])[1]
    # A line detector reports only at a line. A column without one, or of zeros, is no motion.
    if SENSORS[source] in (run.telemetry or {}) and source != "sonar" and not np.any(reports):
        raise UnusableError(NEVER_MOVES, level)
    speed = read_speed(run, source)
    inside = (speed.time + speed.over / 2 > onset) & (speed.time + speed.over / 2 <= end + 1e-6)
    false = [
        fault
        for fault in stretches
        if fault.column in ("", SENSORS[source]) and fault.start < end and fault.end > onset
    ]
    lines = [f"{run.path}, {f.start:.2f} to {f.end:.2f} s: {f.what}: left out" for f in false]
    for fault in false:
        begins, ends = speed.time - speed.over / 2, speed.time + speed.over / 2
        inside &= (ends < fault.start) | (begins > fault.end)
    time, value, deviation, over = (line[inside] for line in speed)
    if len(time) < FEWEST:
        reason = lines[0] if lines else f"only {len(time)} readings of its {source} in the step"
        raise UnusableError(reason, level)
    if source == "sonar":
        value = value * np.sign(level)  # the other readers give no sign
    if np.sum(value * over) / np.sum(over) * DURATION < MOVED:
        raise UnusableError(NEVER_MOVES, level)
    rows = np.diff(commands["time_s"])
    row = float(np.median(rows)) if len(rows) else DT
    charge = float(run.about.get("battery_charge", 1.0))
    return (
        Step(run.path, level, commands, onset, charge, row, time - onset, over, value, deviation),
        lines,
    )


def _motor_commands(run: Run) -> Table:
    """The commands with the throttle at the motor: 0 while the dead-man switch is open."""
    if drive_column(run.commands) == "speed":
        raise InputError(f"{run.path}: is commanded in m/s: steps of throttle are needed here")
    time = run.commands["time_s"]
    at, armed = defects.readings(run, "armed")
    throttle = defects.asked(run, "throttle", time)
    if len(at):
        time = np.union1d(time, at)
        closed = armed[np.maximum(np.searchsorted(at, time, side="right") - 1, 0)] >= 0.5
        throttle = np.where(closed, defects.asked(run, "throttle", time), 0.0)
    return Table(
        time_s=time,
        throttle=throttle,
        steering=defects.asked(run, "steering", time),
    )


def _find_step(run: Run, commands: Table, source: str) -> tuple[float, float, float]:
    """Onset (s), end (s) and level of the first throttle that is held straight from rest.

    Raises `UnusableError` if there is none.
    """
    time, throttle = commands["time_s"], commands["throttle"]
    # The last command holds until the log ends.
    last = max(float(t["time_s"][-1]) for t in (commands, run.telemetry) if t is not None)
    reason, level = "there is no throttle in it", math.nan
    for i in np.flatnonzero((throttle != 0) & (np.append(0.0, throttle[:-1]) == 0)):
        onset = float(time[i])
        level = float(throttle[np.searchsorted(time, onset + SETTLES, side="right") - 1])
        changes = (time > onset + SETTLES) & (np.abs(throttle - level) > SAME)
        end = min(onset + DURATION, float(time[changes][0]) if np.any(changes) else last)
        steered = np.abs(commands["steering"][(time >= onset) & (time < end)])
        if level == 0 or end - onset < LEAST:
            reason = f"no throttle is held for {LEAST:g} s"
        elif np.max(steered) > STRAIGHT:
            reason = f"it is not straight: steering goes to {math.degrees(np.max(steered)):.0f}°"
        elif _moves_before(run, source, onset):
            reason = "the car rolls before the throttle comes"
        else:
            return onset, end, level
    raise UnusableError(reason, level)


def _moves_before(run: Run, source: str, onset: float) -> bool:
    """True if the car moves in the half second before the onset."""
    at, value = defects.readings(run, SENSORS[source])
    recent = (at > onset - 0.5) & (at <= onset)
    if np.sum(recent) < FEWEST:
        return False
    if source == "encoder":
        return bool(np.median(value[recent]) > STILL)
    finite = value[recent][np.isfinite(value[recent])]
    moved = abs(finite[-1] - finite[0]) if len(finite) > 1 else 0.0
    return bool(moved > (1.5 if source == "lines" else 0.5 * STILL + MOVED))


# -------------------------------------------------------------------------------------------------
# Simulation
# -------------------------------------------------------------------------------------------------


class Curve(NamedTuple):
    """Distance of a simulated car (m) at each tick, and its derivative over log R."""

    distance: np.ndarray
    slope: np.ndarray

    def mean(self, line: np.ndarray, time: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Mean time derivative of `line` over windows, centred at `time` and `over` long (s)."""
        ticks = DT * np.arange(len(line))
        ends = (np.interp(time + side * over / 2, ticks, line) for side in (1, -1))
        return np.subtract(*ends) / over

    def rate(self, time: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Mean acceleration over the same windows (m/s²)."""
        ticks = DT * np.arange(len(self.distance) - 1)
        speed = np.diff(self.distance) / DT
        ends = (np.interp(time + side * over / 2 - DT / 2, ticks, speed) for side in (1, -1))
        return np.subtract(*ends) / over


def _simulate(car: Car, log_r: Scalar, source: str, steps: Sequence[Step]) -> list[Curve]:
    """Simulate each step with R = exp(log_r)."""
    ticks = round((DURATION + AFTER) / DT)
    curves = []
    for begin in range(0, len(steps), LANES):
        block = steps[begin : begin + LANES]
        throttle, charge = np.zeros((ticks, LANES)), np.ones(LANES)
        for lane, step in enumerate(block):
            at = (step.onset - float(car.motor.delay)) / DT + np.arange(ticks)
            throttle[:, lane] = asked(step.commands, at, DT)[0]
            charge[lane] = step.charge
        speeds, slopes = _speeds(car, np.float64(log_r), throttle, charge)
        which = int(source != "encoder")
        for lane, step in enumerate(block):
            lines = (_distance(np.asarray(pair[which])[:, lane]) for pair in (speeds, slopes))
            # Curves are positive in the direction of the throttle, as measured speeds are.
            curves.append(Curve(*(math.copysign(1.0, step.level) * line for line in lines)))
    return curves


def _distance(speed: np.ndarray) -> np.ndarray:
    """Distance by the trapezoidal rule, from rest; `speed` is at the end of each tick."""
    at = np.concatenate([[0.0], speed])
    return np.concatenate([[0.0], np.cumsum(at[1:] + at[:-1]) * DT / 2])


@jax.jit
def _speeds(
    car: Car, log_r: Array, throttle: Array, charge: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Speeds after each tick (ticks, lanes), and their derivatives over log R.

    Both are pairs: first the speed that the encoder measures, then the car's.
    """
    no_walls = jnp.full((1, 4), jnp.nan)

    def drive(log_r: Scalar) -> tuple[Array, Array]:
        adjusted = changed(car, PARAMETER, jnp.exp(log_r))
        at_rest = jax.tree.map(jnp.asarray, planar.initial_state(adjusted, DT, slots=1))

        def begin(charge: Scalar) -> planar.State:
            return at_rest._replace(motion=at_rest.motion._replace(charge=charge))

        def tick(state: planar.State, throttle: Scalar) -> tuple[planar.State, tuple[Scalar, ...]]:
            command = Command(throttle, 0.0)
            work = planar.Tick(adjusted, no_walls, command, command, 0, DT)
            state, _ = planar.move(state, work)
            return state, (_rim(adjusted, state.motion.wheels), state.motion.vx)

        return jax.lax.scan(jax.vmap(tick), jax.vmap(begin)(charge), throttle)[1]

    return jax.jvp(drive, (log_r,), (jnp.ones_like(log_r),))


def _rim(car: Car, wheels: Wheels) -> Scalar:
    """Speed that the encoder reports (m/s)."""
    encoder = car.sensors.encoder
    radius = car.tires.rear.radius if "rear" in encoder.on else car.tires.front.radius
    return radius * error_models.disc_speed(encoder, wheels, drivetrain.driven_speed(car, wheels))


# -------------------------------------------------------------------------------------------------
# Descent
# -------------------------------------------------------------------------------------------------


class Level(NamedTuple):
    """One level simulated at one R, with its part of the cost's derivatives."""

    value: np.ndarray  # m/s, simulated
    slope: np.ndarray  # d value / d log R
    late: float  # s
    error: np.ndarray  # (measured - simulated) / deviation
    weight: np.ndarray  # Huber weight / (deviation² spread²)
    gradient: float  # minus the derivative of the cost over log R
    curvature: float  # of the cost over log R, with `late` eliminated


class Point(NamedTuple):
    """All levels at one log R."""

    place: float
    spread: float  # robust standard deviation of all `error`, at least 1
    levels: tuple[Level, ...]
    priors: tuple[float, ...]  # s, prior standard deviation of `late` at each level

    def cost(self, spread: float) -> float:
        """Sum of the Huber loss of error / `spread` and of (late / prior)² / 2."""
        errors = np.abs(np.concatenate([level.error for level in self.levels])) / spread
        close = np.minimum(errors, HUBER)
        late = [level.late / prior for level, prior in zip(self.levels, self.priors, strict=True)]
        return float(np.sum(close * errors - close**2 / 2) + np.sum(np.square(late)) / 2)

    def curvature(self) -> float:
        """Second derivative of the cost over log R."""
        return sum(level.curvature for level in self.levels)

    def deviation(self) -> float:
        """Standard deviation of log R: the larger of two.

        They are curvature^-½ and sqrt(sum of gradient² · m / (m - 1)) / curvature over m levels.
        """
        curvature, count = self.curvature(), len(self.levels)
        variance = 1 / curvature if curvature > 0 else math.inf
        if count > 1 and curvature > 0:
            scatter = sum(level.gradient**2 for level in self.levels) * count / (count - 1)
            variance = max(variance, scatter / curvature**2)
        return math.sqrt(variance)


class _Fit:
    """The cost over log R for given steps."""

    def __init__(self, car: Car, source: str, steps: list[Step]) -> None:
        declared = declarations(type(car.motor))["resistance_ohm"][1]
        self.car, self.source, self.steps = car, source, steps
        self.low, self.high = declared.low, declared.high
        self.start = math.log(float(car.motor.resistance))

    def at(self, log_r: float) -> Point:
        """Simulate at `log_r`, with the lateness, spread and weights that fit best there."""
        curves = _simulate(self.car, log_r, self.source, self.steps)
        priors = tuple(max(step.row / 2, DT / 2) for step in self.steps)
        lates, spread = [0.0] * len(curves), 1.0
        levels: list[Level] = []
        for _ in range(4):  # lateness depends on the weights, and they on lateness
            levels = [
                _level(step, curve, late, prior, spread)
                for step, curve, late, prior in zip(self.steps, curves, lates, priors, strict=True)
            ]
            errors = np.concatenate([level.error for level in levels])
            spread = max(1.0, TO_DEVIATION * float(np.median(np.abs(errors))))
            lates = [
                _improve_lateness(step, curve, level, prior)
                for step, curve, level, prior in zip(
                    self.steps, curves, levels, priors, strict=True
                )
            ]
        return Point(log_r, spread, tuple(levels), priors)

    def foreign(self, point: Point) -> list[Unused]:
        """Runs with errors beyond `FOREIGN` and `FOREIGN_PART` at this point.

        Empty unless they are the minority.
        """
        typical = float(np.median(np.abs(np.concatenate([one.error for one in point.levels]))))
        found = []
        for step, level in zip(self.steps, point.levels, strict=True):
            off = float(np.median(np.abs(step.speed - level.value)))
            outlying = np.median(np.abs(level.error)) > FOREIGN * max(typical, 1 / TO_DEVIATION)
            if outlying and off > FOREIGN_PART * max(np.mean(step.speed), np.mean(level.value)):
                reason = f"it is {off:.2f} m/s off the car that the other runs agree on"
                found.append(Unused(step.path, step.level, reason))
        return found if 2 * len(found) < len(self.steps) else []


def _level(step: Step, curve: Curve, late: float, prior: float, spread: float) -> Level:
    """The errors of a step at this lateness, with the derivatives of the cost."""
    time = step.time - late
    value = curve.mean(curve.distance, time, step.over)
    slope = curve.mean(curve.slope, time, step.over)
    rate = curve.rate(time, step.over)
    error = (step.speed - value) / step.deviation
    huber = np.minimum(1.0, HUBER * spread / np.maximum(np.abs(error), 1e-12))
    weight = huber / (step.deviation * spread) ** 2
    # The simulated speed changes by slope d(log R) - rate d(late).
    mixed = float(np.sum(weight * slope * rate))
    own = float(np.sum(weight * rate**2)) + prior**-2
    gradient = float(np.sum(weight * slope * (step.speed - value)))
    curvature = float(np.sum(weight * slope**2)) - mixed**2 / own
    return Level(value, slope, late, error, weight, gradient, curvature)


def _improve_lateness(step: Step, curve: Curve, level: Level, prior: float) -> float:
    """A better lateness by one Gauss-Newton step, limited to two prior deviations."""
    rate = curve.rate(step.time - level.late, step.over)
    own = float(np.sum(level.weight * rate**2)) + prior**-2
    down = -float(np.sum(level.weight * rate * (step.speed - level.value))) - level.late / prior**2
    return float(np.clip(level.late + down / own, -2 * prior, min(2 * prior, AFTER / 2)))


def _descend(fit: _Fit, precision: float) -> tuple[Point, int, bool]:
    """Minimise the cost: the best point, the number of simulations, and whether it converged."""
    point, simulations = fit.at(fit.start), 1
    while simulations < ROUNDS:
        curvature = point.curvature()
        if curvature <= 0:
            return point, simulations, False
        step = sum(level.gradient for level in point.levels) / curvature
        step = float(np.clip(step, -LONGEST_STEP, LONGEST_STEP))
        while True:
            log_r = float(np.clip(point.place + step, math.log(fit.low), math.log(fit.high)))
            if abs(log_r - point.place) < precision:
                return point, simulations, True
            candidate = fit.at(log_r)
            simulations += 1
            if candidate.cost(point.spread) < point.cost(point.spread):
                break
            step /= 2
        point = candidate
    return point, simulations, False
