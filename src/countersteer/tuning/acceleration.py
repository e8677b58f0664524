"""The paper's own adjuster: steps of throttle from rest, until the simulated car keeps up.

Log and simulator run side by side on the same commands, and one parameter of acceleration is
changed until they agree. That parameter is `motor.resistance` R: the force at standstill is
d U k n e / (r (R + d² R_battery)) for every duty d, and the no-load speed d U / (k n) has no R in
it. So it scales how hard the car pulls at every throttle, and neither how fast it can get nor what
resists it.

Each level's log is compared over the first second of its throttle,

    speed(t_i) = mean over the reader's window about t_i of v(t - late; R) + e_i,

v by `planar.move`, straight, from rest, and e_i of the deviation that the reader states. A row
tells when the command came to within its period only, so that `late` of each level is fitted too,
within that period about 0, half of it as its deviation; it matters at 10 Hz, and not at 100.

The cost is Huber's of all e_i, in units of their spread. It is descended in log R by Gauss and
Newton's steps with the exact derivative of the simulator, halved until the cost falls. With one
parameter that is gradient descent whose step is the curvature's, so that there is no rate to choose
and a handful of simulations do. The derivative comes with the simulation, in the same program.
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
from countersteer.runs.files import Table
from countersteer.runs.run import Run
from countersteer.sensing import parts
from countersteer.signals import Array, Command, Scalar, Wheels
from countersteer.tuning.speed import TO_DEVIATION, read_speed
from countersteer.tuning.windows import asked
from countersteer.world import drivetrain, planar

PARAMETER = "motor.resistance"
DURATION = 1.0  # s of each step, the paper's
PRECISION = 1e-3  # part of the parameter; its standard deviation is several times that

DT = 0.005  # s; speeds are within 2e-4 m/s of those at 1 ms
AFTER = 0.2  # s simulated beyond the second, so that a car may be late or early
LANES = 16  # levels simulated at once, always as many: one program

# What is a step
SETTLES = 0.2  # s in which a hand has moved the throttle to its level
SAME = 0.02  # throttle that hands and filters differ by from one row to the next
LEAST = 0.4  # s that a level must be held
STRAIGHT = math.radians(5)
STILL = 0.1  # m/s before the onset
MOVED = 0.03  # m in a second: less is play, or an encoder's first count
FEWEST = 3  # readings; two tell speed and lateness but not that they do

HUBER = 1.345  # spreads beyond which an error counts by its size: 95 % efficient if all is normal
# Median error of a run that belongs to another car, or to a sensor that is stuck: in those of all
# readings, and over the run's mean speed. A car that is only modelled badly has the first alone.
FOREIGN, FOREIGN_PART = 3.0, 0.3
LONGEST_STEP = 0.7  # of log R: a factor of two
ROUNDS = 40  # of descent; it takes five

NEVER_MOVES = "the car does not move: under the dead zone, it tells nothing of acceleration"
SENSORS = {"encoder": "wheel_speed_mps", "sonar": "sonar_front_m", "lines": "line_crossings"}


class Series(NamedTuple):
    """One level: speed from its onset on, measured and simulated."""

    path: Path
    level: float  # throttle
    time: np.ndarray  # s since the throttle came
    measured: np.ndarray  # m/s
    deviation: np.ndarray  # m/s, the reader's
    before: np.ndarray  # m/s, simulated with the car as it was
    after: np.ndarray  # m/s, simulated with the fitted car
    late: float  # s by which the car answers later than its rows say
    rms_before: float  # m/s
    rms_after: float


class Unused(NamedTuple):
    """A run that took no part."""

    path: Path
    level: float  # throttle; NaN where there is none
    reason: str


class Acceleration(NamedTuple):
    """What came of a fit."""

    car: Car
    parameter: str  # path of what was fitted
    before: float
    after: float
    deviation: float  # one standard deviation of `after`
    rms_before: float  # m/s, over all readings
    rms_after: float
    source: str  # of the measured speed
    iterations: int
    converged: bool  # to the precision asked for
    at_bound: bool  # of the parameter's declared range
    series: tuple[Series, ...]  # by level
    unused: tuple[Unused, ...]
    masked: tuple[str, ...]  # a line for each stretch that was left out


class Step(NamedTuple):
    """A run's step of throttle as the simulator needs it, and what was measured in it."""

    path: Path
    level: float
    commands: Table  # throttle that the motor got
    onset: float  # s
    charge: float
    row: float  # s between two commands
    time: np.ndarray  # s since the onset; the middle of each reading
    over: np.ndarray  # s
    speed: np.ndarray  # m/s, positive the way the throttle pushes
    deviation: np.ndarray


class UnusableError(Exception):
    """Why a run cannot be used; its level if it has one."""

    def __init__(self, reason: str, level: float = math.nan) -> None:
        super().__init__(reason)
        self.level = level


def fit_acceleration(
    runs: Sequence[Run], car: Car, source: str = "encoder", precision: float = PRECISION
) -> Acceleration:
    """The car with its `motor.resistance` so that it accelerates as it did in `runs`.

    `source` of the speed is `encoder`, `sonar` or `lines`. It ends where R changes by less than the
    part `precision`. Its standard deviation is the larger of that by the curvature and that by how
    much runs contradict each other. Runs that tell nothing or are false are named in `unused`,
    stretches that `faults` finds are left out and named in `masked`.

    Raises `InputError` where no run can be used.
    """
    steps, unused, masked = _take_all(runs, source)
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
# What was measured
# -------------------------------------------------------------------------------------------------


def _take_all(runs: Sequence[Run], source: str) -> tuple[list[Step], list[Unused], list[str]]:
    """The steps that can be used; the runs that cannot; and what of the steps was left out."""
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
        less = [abs(s.level) for s in steps if 0 < s.level / level < 1]  # none where it is NaN
        if reason == NEVER_MOVES and less:
            reason = f"{source} tells no motion, though the car moves at {min(less):g}: stuck?"
            unused[i] = Unused(path, level, reason)
    if not steps:
        reasons = "; ".join(f"{path.name}: {reason}" for path, _, reason in unused[:1])
        raise InputError(f"none of {len(runs)} runs tells an acceleration: {reasons}")
    return steps, unused, masked


def take(run: Run, source: str) -> tuple[Step, list[str]]:
    """The run's first step of throttle from rest, and a line for each stretch that is false in it.

    Raises `UnusableError` where it has none that can be used, `InputError` where it is false.
    """
    stretches = defects.find_defects(run)
    commands = _driven(run)
    onset, end, level = _held(run, commands, source)
    told = defects.readings(run, SENSORS[source])[1]
    # A detector reports when it meets a line: a sensor that is there, and nothing, is no motion.
    if SENSORS[source] in (run.telemetry or {}) and source != "sonar" and not np.any(told):
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
        value = value * np.sign(level)  # the others do not tell forward from backward
    if np.sum(value * over) / np.sum(over) * DURATION < MOVED:
        raise UnusableError(NEVER_MOVES, level)
    rows = np.diff(commands["time_s"])
    row = float(np.median(rows)) if len(rows) else DT
    charge = float(run.about.get("battery_charge", 1.0))
    return (
        Step(run.path, level, commands, onset, charge, row, time - onset, over, value, deviation),
        lines,
    )


def _driven(run: Run) -> Table:
    """The commands with the throttle that the motor got: none while the dead-man switch is open."""
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


def _held(run: Run, commands: Table, source: str) -> tuple[float, float, float]:
    """Begin and end (s) of the first throttle that is held from rest, and its level."""
    time, throttle = commands["time_s"], commands["throttle"]
    # The last row stands until the log ends.
    last = max(float(t["time_s"][-1]) for t in (commands, run.telemetry) if t is not None)
    reason, level = "there is no throttle in it", math.nan
    for i in np.flatnonzero((throttle != 0) & (np.append(0.0, throttle[:-1]) == 0)):
        onset = float(time[i])
        level = float(throttle[np.searchsorted(time, onset + SETTLES, side="right") - 1])
        left = (time > onset + SETTLES) & (np.abs(throttle - level) > SAME)
        end = min(onset + DURATION, float(time[left][0]) if np.any(left) else last)
        steered = np.abs(commands["steering"][(time >= onset) & (time < end)])
        if level == 0 or end - onset < LEAST:
            reason = f"no throttle is held for {LEAST:g} s"
        elif np.max(steered) > STRAIGHT:
            reason = f"it is not straight: steering goes to {math.degrees(np.max(steered)):.0f}°"
        elif _rolls(run, source, onset):
            reason = "the car rolls before the throttle comes"
        else:
            return onset, end, level
    raise UnusableError(reason, level)


def _rolls(run: Run, source: str, onset: float) -> bool:
    """Whether the car moves in the half second before."""
    at, value = defects.readings(run, SENSORS[source])
    just = (at > onset - 0.5) & (at <= onset)
    if np.sum(just) < FEWEST:
        return False
    if source == "encoder":
        return bool(np.median(value[just]) > STILL)
    heard = value[just][np.isfinite(value[just])]
    moved = abs(heard[-1] - heard[0]) if len(heard) > 1 else 0.0
    return bool(moved > (1.5 if source == "lines" else 0.5 * STILL + MOVED))


# -------------------------------------------------------------------------------------------------
# What is simulated
# -------------------------------------------------------------------------------------------------


class Curve(NamedTuple):
    """How far a simulated car has come (m) at each tick, and how that changes with log R."""

    distance: np.ndarray
    slope: np.ndarray

    def mean(self, line: np.ndarray, time: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Mean rate of a line of the curve over windows about these times."""
        ticks = DT * np.arange(len(line))
        ends = (np.interp(time + side * over / 2, ticks, line) for side in (1, -1))
        return np.subtract(*ends) / over

    def rate(self, time: np.ndarray, over: np.ndarray) -> np.ndarray:
        """Mean acceleration over the windows."""
        ticks = DT * np.arange(len(self.distance) - 1)
        speed = np.diff(self.distance) / DT
        ends = (np.interp(time + side * over / 2 - DT / 2, ticks, speed) for side in (1, -1))
        return np.subtract(*ends) / over


def _roll(car: Car, place: Scalar, source: str, steps: Sequence[Step]) -> list[Curve]:
    """Simulate each step with log R at `place`."""
    ticks = round((DURATION + AFTER) / DT)
    curves = []
    for begin in range(0, len(steps), LANES):
        some = steps[begin : begin + LANES]
        throttle, charge = np.zeros((ticks, LANES)), np.ones(LANES)
        for lane, step in enumerate(some):
            at = (step.onset - float(car.motor.delay)) / DT + np.arange(ticks)
            throttle[:, lane] = asked(step.commands, at, DT)[0]
            charge[lane] = step.charge
        speeds, slopes = _speeds(car, np.float64(place), throttle, charge)
        which = int(source != "encoder")
        for lane, step in enumerate(some):
            lines = (_travelled(np.asarray(pair[which])[:, lane]) for pair in (speeds, slopes))
            # Measured speeds are positive the way in which the throttle pushes.
            curves.append(Curve(*(math.copysign(1.0, step.level) * line for line in lines)))
    return curves


def _travelled(speed: np.ndarray) -> np.ndarray:
    """Distance at the begin of each tick for the speed at its end, from rest."""
    at = np.concatenate([[0.0], speed])
    return np.concatenate([[0.0], np.cumsum(at[1:] + at[:-1]) * DT / 2])


@jax.jit
def _speeds(
    car: Car, place: Array, throttle: Array, charge: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Speed of the encoder's rim and of the car after each tick, (ticks, lanes), and d/d log R."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def drive(place: Scalar) -> tuple[Array, Array]:
        with_it = changed(car, PARAMETER, jnp.exp(place))
        at_rest = jax.tree.map(jnp.asarray, planar.initial_state(with_it, DT, slots=1))

        def begin(charge: Scalar) -> planar.State:
            return at_rest._replace(motion=at_rest.motion._replace(charge=charge))

        def tick(state: planar.State, throttle: Scalar) -> tuple[planar.State, tuple[Scalar, ...]]:
            command = Command(throttle, 0.0)
            work = planar.Tick(with_it, no_walls, command, command, 0, DT)
            state, _ = planar.move(state, work)
            return state, (_rim(with_it, state.motion.wheels), state.motion.vx)

        return jax.lax.scan(jax.vmap(tick), jax.vmap(begin)(charge), throttle)[1]

    return jax.jvp(drive, (place,), (jnp.ones_like(place),))


def _rim(car: Car, wheels: Wheels) -> Scalar:
    """Speed that the encoder reports (m/s)."""
    encoder = car.sensors.encoder
    radius = car.tires.rear.radius if "rear" in encoder.on else car.tires.front.radius
    return radius * parts.disc_speed(encoder, wheels, drivetrain.driven_speed(car, wheels))


# -------------------------------------------------------------------------------------------------
# The descent
# -------------------------------------------------------------------------------------------------


class Level(NamedTuple):
    """One level at one R."""

    value: np.ndarray  # m/s, simulated
    slope: np.ndarray  # of it over log R
    late: float  # s
    error: np.ndarray  # (measured - simulated) / deviation
    weight: np.ndarray  # Huber's over deviation² and spread²
    gradient: float  # of the cost, downhill
    curvature: float  # with `late` eliminated


class Point(NamedTuple):
    """All levels at one log R."""

    place: float
    spread: float  # of the errors in the readers' deviations, at least 1
    levels: tuple[Level, ...]
    priors: tuple[float, ...]  # the deviations of `late`

    def cost(self, spread: float) -> float:
        """Huber's, in units of that spread."""
        errors = np.abs(np.concatenate([level.error for level in self.levels])) / spread
        close = np.minimum(errors, HUBER)
        late = [level.late / prior for level, prior in zip(self.levels, self.priors, strict=True)]
        return float(np.sum(close * errors - close**2 / 2) + np.sum(np.square(late)) / 2)

    def curvature(self) -> float:
        """Of the cost over log R."""
        return sum(level.curvature for level in self.levels)

    def deviation(self) -> float:
        """Of log R: by the curvature, or by the scatter of the runs' own gradients if larger."""
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

    def at(self, place: float) -> Point:
        """Simulate at log R = `place`; lateness, spread and weights are those that fit it best."""
        curves = _roll(self.car, place, self.source, self.steps)
        priors = tuple(max(step.row / 2, DT / 2) for step in self.steps)
        lates, spread = [0.0] * len(curves), 1.0
        levels: list[Level] = []
        for _ in range(4):  # lateness needs the weights, and these the errors at it
            levels = [
                _level(step, curve, late, prior, spread)
                for step, curve, late, prior in zip(self.steps, curves, lates, priors, strict=True)
            ]
            errors = np.concatenate([level.error for level in levels])
            spread = max(1.0, TO_DEVIATION * float(np.median(np.abs(errors))))
            lates = [
                _later(step, curve, level, prior)
                for step, curve, level, prior in zip(
                    self.steps, curves, levels, priors, strict=True
                )
            ]
        return Point(place, spread, tuple(levels), priors)

    def foreign(self, point: Point) -> list[Unused]:
        """Runs that no R brings near what the others agree on."""
        usual = float(np.median(np.abs(np.concatenate([one.error for one in point.levels]))))
        found = []
        for step, level in zip(self.steps, point.levels, strict=True):
            off = float(np.median(np.abs(step.speed - level.value)))
            unusual = np.median(np.abs(level.error)) > FOREIGN * max(usual, 1 / TO_DEVIATION)
            if unusual and off > FOREIGN_PART * max(np.mean(step.speed), np.mean(level.value)):
                reason = f"it is {off:.2f} m/s off the car that the other runs agree on"
                found.append(Unused(step.path, step.level, reason))
        return found if 2 * len(found) < len(self.steps) else []


def _level(step: Step, curve: Curve, late: float, prior: float, spread: float) -> Level:
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


def _later(step: Step, curve: Curve, level: Level, prior: float) -> float:
    """The lateness that fits a level better: one step of Gauss and Newton, within its range."""
    rate = curve.rate(step.time - level.late, step.over)
    own = float(np.sum(level.weight * rate**2)) + prior**-2
    down = -float(np.sum(level.weight * rate * (step.speed - level.value))) - level.late / prior**2
    return float(np.clip(level.late + down / own, -2 * prior, min(2 * prior, AFTER / 2)))


def _descend(fit: _Fit, precision: float) -> tuple[Point, int, bool]:
    """The lowest point, the simulations that it took, and whether it is as precise as asked."""
    here, count = fit.at(fit.start), 1
    while count < ROUNDS:
        curvature = here.curvature()
        if curvature <= 0:
            return here, count, False
        step = sum(level.gradient for level in here.levels) / curvature
        step = float(np.clip(step, -LONGEST_STEP, LONGEST_STEP))
        while True:
            place = float(np.clip(here.place + step, math.log(fit.low), math.log(fit.high)))
            if abs(place - here.place) < precision:
                return here, count, True
            there = fit.at(place)
            count += 1
            if there.cost(here.spread) < here.cost(here.spread):
                break
            step /= 2
        here = there
    return here, count, False
