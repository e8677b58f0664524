"""Logs in, a car out: robust least squares over windows of logs, with what can be believed of it.

    minimise  sum over windows, quantities, samples of rho(w (predicted - measured) / scale)
              + sum over parameters of ((u - u_prior) / width)²

where u is the logarithm of a parameter, or itself for one that may be nothing or less, and rho the
soft L1 loss, so that a window in which the motion was caught at another instant counts no more than
any. The weight w of a log of n windows is (n / median of n)^-½, so that logs count alike: a long
one repeats a manoeuvre, and a brief one may be all there is of another. Derivatives are exact,
through the simulator (`shooting.predict`); the search keeps the declared ranges (`Problem.solve`).

The body and what drives it are shared by all logs; tyres and rolling drag are fitted for each
surface by itself. How full the battery was belongs to a log: where it does not tell, that is
fitted too, from a full one on.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import Declaration, changed, declarations
from countersteer.errors import InputError
from countersteer.runs.defects import LogDefect
from countersteer.runs.run import Run
from countersteer.signals import Array
from countersteer.tuning import shooting
from countersteer.tuning.shooting import Shots
from countersteer.tuning.windows import QUANTITIES

STEP = 0.002  # s; the step's own error is then a hundredth of a log's
HORIZON = 1.0  # s
SCALES = np.array([0.05, 0.03, 0.12, 0.08])  # of the quantities: what a good fit is off by
LOOSE = 0.5  # prior standard deviation of a logarithm, where there is none in `WIDTHS`
LANES = 64  # windows in a call of the compiled program, whatever their number
GROUP = 8  # derivatives that a lane takes at once
OUTLYING = 0.2  # normalised residual at which the loss turns linear
GROSS = 0.5  # square of a residual beyond which it tells no more of the noise
WILD = 1e3  # change of a residual per width of a parameter, from which nothing is linear
TOLERANCE = 1e-5
PASSES = 40  # steps of a search, at most
DAMPING, EASY, STUCK = 0.01, 1e-6, 1e4  # of a step: at first, at the least, and in vain
KNOWN = 0.9  # part of the prior's width under which a parameter counts as determined
STRAIGHT = math.radians(4)  # steering under which a window is straight
SLIDES = math.radians(10)  # sideslip from which it slides
SPINS = 0.5  # m/s of wheel speed over the ground's from which it slides too
HELD_OUT = 2.0  # s of each block that is fitted or held out by turns
BRIEF = 10.0  # s of windows under which a log is a manoeuvre

ROLLING = ("drivetrain.drag", "drivetrain.drag_viscous")
TIRES = (
    "tires.front.friction",
    "tires.rear.friction",
    "tires.front.cornering_stiffness",
    "tires.rear.cornering_stiffness",
    "tires.front.longitudinal_stiffness",
    "tires.rear.longitudinal_stiffness",
    "tires.front.sliding_ratio",
    "tires.rear.sliding_ratio",
    "tires.front.longitudinal_ratio",
    "tires.rear.longitudinal_ratio",
)
FLOOR = (*TIRES, *ROLLING)  # fitted for each surface by itself
SPEEDS = (
    "motor.resistance",
    "motor.torque_constant",
    "motor.dead_zone",
    "motor.full_throttle",
    "motor.conduction",
    "motor.neutral_brake",
    "motor.reverse",
    "motor.lag",
    "motor.delay",
    "motor.rotor_inertia",
    *ROLLING,
)
STEERING = (
    "servo.gain_left",
    "servo.gain_right",
    "servo.limit_left",
    "servo.limit_right",
    "servo.trim",
    "servo.lag",
    "servo.delay",
)
HANDLING = ("body.yaw_inertia", "body.front_roll_share")
PARAMETERS = (*SPEEDS, *STEERING, *HANDLING, *TIRES)
CHARGE = "battery.charge"  # no number of a car, but of a log
FULL = 1.0  # charge that is expected of a log that does not tell
TABLE = (*PARAMETERS, CHARGE)
WIDTHS = {"body.yaw_inertia": 0.3}  # known beforehand: standard deviation of a logarithm
ABSOLUTE = {  # the same, of a parameter that may as well be next to nothing, in its own unit
    CHARGE: 0.5,
    "body.front_roll_share": 0.25,
    "motor.conduction": 0.5,
    "motor.neutral_brake": 0.2,
    "motor.lag": 0.05,
    "motor.delay": 0.03,
    "motor.rotor_inertia": 1e-6,
    "drivetrain.drag_viscous": 1e-4,
    "servo.trim": math.radians(2),
    "servo.lag": 0.05,
    "servo.delay": 0.03,
    "tires.front.sliding_ratio": 0.1,
    "tires.rear.sliding_ratio": 0.1,
    "tires.front.longitudinal_ratio": 0.2,
    "tires.rear.longitudinal_ratio": 0.2,
}


class Stage(NamedTuple):
    """A fit of some parameters to some windows."""

    parameters: tuple[str, ...]
    chooses: Callable[[Shots], np.ndarray]  # windows that tell of them


def straight(shots: Shots) -> np.ndarray:
    """Windows in which nothing is steered."""
    return np.max(np.abs(shots.steering), axis=1) < STRAIGHT


def slides(shots: Shots) -> np.ndarray:
    """Windows in which the car slides past the limit, or spins its wheels."""
    vx, vy = (np.nan_to_num(shots.measured[:, i]) for i in (0, 1))
    sideslip = np.arctan2(np.abs(vy), np.maximum(np.abs(vx), 0.3))
    wheels = np.nan_to_num(shots.measured[:, 3] - np.hypot(vx, vy))
    captured = np.isfinite(shots.measured[:, 0, 0])
    return captured & ((sideslip > SLIDES) | (wheels > SPINS)).any(axis=1)


def steered(shots: Shots) -> np.ndarray:
    """Windows that are neither straight nor past the limit."""
    return ~straight(shots) & ~slides(shots)


def any_window(shots: Shots) -> np.ndarray:
    """All of them."""
    return np.full(len(shots.surface), True)


STAGES = {
    "longitudinal": Stage(SPEEDS, straight),
    "steering": Stage(STEERING, steered),
    "handling": Stage((*HANDLING, *TIRES[:4]), steered),
    "drift": Stage((*HANDLING, *TIRES), slides),
    "all": Stage(PARAMETERS, any_window),
}
ORDER = ("longitudinal", "steering", "handling", "drift", "all")


class Parameter(NamedTuple):
    """One number that is fitted: a path, for one surface or one log or (None) for all."""

    path: str
    surface: int | None = None
    run: int | None = None


class Fitted(NamedTuple):
    """What a fit makes of a parameter, in the units used inside."""

    path: str
    surface: str | None
    run: int | None
    before: float
    value: float
    deviation: float  # standard deviation: the larger of the two below
    by_curvature: float
    by_halves: float
    determined: bool  # else it was left at what it was
    at_bound: bool


class Result(NamedTuple):
    """A fit and what it is worth."""

    cars: dict[str, Car]  # by surface
    fitted: list[Fitted]
    cost: float
    evaluations: int


def declaration(path: str) -> Declaration:
    """The declaration of a car's parameter by its dotted path of names inside, or of `CHARGE`."""
    if path == CHARGE:
        return Declaration("1", 0.0, 1.0, "of the battery at a log's windows", "fitted")
    *rooms, name = path.split(".")
    part = reduce(getattr, rooms, Car())
    return dict(declarations(type(part)).values())[name]


def value_of(car: Car, path: str) -> float:
    """A car's parameter by its dotted path."""
    value: Any = car
    for name in path.split("."):
        value = getattr(value, name)
    return float(value)


def take_shots(
    runs: Sequence[Run],
    cars: dict[str, Car],
    surfaces: Sequence[str],
    faults: Sequence[list[LogDefect]],
    every: float = 0.25,
) -> tuple[Shots, np.ndarray]:
    """All windows of all runs without those that a fault touches, and when they start."""
    names = list(cars)
    parts, starts = [], []
    for i, (run, surface) in enumerate(zip(runs, surfaces, strict=True)):
        found = shooting.take(run, cars[surface], i, names.index(surface), HORIZON, every, STEP)
        if found is None:
            continue
        shots, start = found
        clean = np.full(len(start), True)
        for fault in faults[i]:
            touched = (start < fault.end) & (start + HORIZON > fault.start)
            if fault.column:
                shots = without(shots, fault.column, touched)
            else:
                clean &= ~touched
        parts.append(select(shots, clean))
        starts.append(start[clean])
    if not parts or not sum(len(part.surface) for part in parts):
        raise InputError("no run holds a window of 1 s that can be fitted: driven, and measured")
    return shooting.joined(parts), np.concatenate(starts)


COLUMNS = {"gyro_radps": 2, "yaw_rate_radps": 2, "wheel_speed_mps": 3, "encoder_counts": 3}


def without(shots: Shots, column: str, where: np.ndarray) -> Shots:
    """The windows with one quantity unknown in some of them."""
    index = COLUMNS.get(column)
    if index is None:
        return shots
    measured = shots.measured.copy()
    measured[where, index] = np.nan
    return shots._replace(measured=measured)


def blocks(time: np.ndarray, run: np.ndarray, fold: int = 2) -> np.ndarray:
    """Of windows of logs, by their start: 1 for those to fit, 2 for those held out, else 0.

    Blocks of `HELD_OUT` seconds take turns, two to fit and one (`fold` of 0 to 2) to hold out; a
    window that reaches from one kind into the other belongs to neither. Beside longer logs, one
    that is `brief` is fitted whole: it is a manoeuvre, and its parts are unlike.
    """
    held = [np.floor((time + lead) / HELD_OUT) % 3 == fold for lead in (0.0, HORIZON)]
    kind = np.where(held[0] & held[1], 2, np.where(held[0] | held[1], 0, 1))
    whole = brief(time, run)
    return kind if whole.all() else np.where(whole, 1, kind)


def brief(time: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Whether a window is of a log whose windows lie within `BRIEF` seconds."""
    return np.array([np.ptp(time[run == k]) < BRIEF for k in run])


class Solved(NamedTuple):
    """Where a search ended."""

    x: np.ndarray
    cost: float
    fun: np.ndarray  # residuals
    nfev: int


def loss(residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half the soft L1 loss of each residual; the factors of its gradient and of its curvature."""
    root = np.sqrt(1 + (residuals / OUTLYING) ** 2)
    return OUTLYING**2 * (root - 1), 1 / root, 1 / root**3


class Problem:
    """Residuals and their derivatives for some free parameters over some windows."""

    def __init__(
        self,
        cars: dict[str, Car],
        shots: Shots,
        free: Sequence[str],
        prior: dict[str, Car] | None = None,
        charge: np.ndarray | None = None,
    ) -> None:
        """`free` paths are fitted: those of the floor for each surface that has windows.

        `cars` say what the others are, and what is expected, unless `prior` says that; `charge`, by
        log, how full the battery is where a log does not tell. `CHARGE` is free for those logs.
        """
        self.cars = cars
        self.shots = shots
        self.surface = np.zeros(int(shots.run.max()) + 1, int)  # by log
        self.surface[shots.run] = shots.surface
        surfaces = [int(k) for k in np.unique(shots.surface)]
        untold = [int(k) for k in np.unique(shots.run[np.isnan(shots.charge)])]
        self.parameters = []
        for path in free:
            if path == CHARGE:
                self.parameters += [Parameter(path, run=k) for k in untold]
            elif path in FLOOR:
                self.parameters += [Parameter(path, surface=k) for k in surfaces]
            else:
                self.parameters.append(Parameter(path))
        self.known = np.isfinite(shots.measured)
        count = np.bincount(shots.run)
        usual = np.median(count[count > 0])
        self.divisor = np.sqrt(count[shots.run] / usual * shots.measured.shape[-1])[:, None, None]
        self.divisor = self.divisor * SCALES[:, None]
        self.table = self.tabled(cars, charge)
        self.index = np.array([TABLE.index(p.path) for p in self.parameters], int)
        self.rows = [np.flatnonzero(self.moves(p)) for p in self.parameters]
        declared = [declaration(p.path) for p in self.parameters]
        self.logarithmic = np.array([p.path not in ABSOLUTE for p in self.parameters])
        first = np.array([rows[0] for rows in self.rows], int)
        self.start, self.prior = (
            self.inside(table[first, self.index])
            for table in (self.table, self.tabled(prior or cars))
        )
        lowest = np.array([d.low for d in declared])
        self.high = np.array([d.high for d in declared])
        self.low = self.inside(
            np.where(self.logarithmic, np.maximum(lowest, 1e-9 * self.high), lowest)
        )
        self.high = self.inside(self.high)
        self.width = np.array(
            [ABSOLUTE.get(p.path, WIDTHS.get(p.path, LOOSE)) for p in self.parameters]
        )
        margin = 1e-6 * self.width
        self.prior = np.clip(self.prior, self.low + margin, self.high - margin)

    def tabled(self, cars: dict[str, Car], charge: np.ndarray | None = None) -> np.ndarray:
        """The values of `TABLE` in each log: (logs, `TABLE`)."""
        logs = len(self.surface)
        known = np.full(logs, FULL) if charge is None else charge[:logs].copy()
        tells = np.isfinite(self.shots.charge)
        known[self.shots.run[tells]] = self.shots.charge[tells]
        of_car = np.array([[value_of(car, path) for path in PARAMETERS] for car in cars.values()])
        return np.column_stack([of_car[self.surface], known])

    def moves(self, parameter: Parameter) -> np.ndarray:
        """The logs that a parameter is of."""
        if parameter.run is not None:
            return np.arange(len(self.surface)) == parameter.run
        return (self.surface == parameter.surface) | (parameter.surface is None)

    def inside(self, value: Array) -> Array:
        """From a parameter's value to the fit's variable."""
        return np.where(self.logarithmic, np.log(np.maximum(value, 1e-12)), value)

    def outside(self, u: Array) -> Array:
        """The inverse of `inside`."""
        return np.where(self.logarithmic, np.exp(u), u)

    def filled(self, u: Array) -> np.ndarray:
        """All values by log, as in `tabled`."""
        table = self.table.copy()
        for rows, index, value in zip(self.rows, self.index, self.outside(u), strict=True):
            table[rows, index] = value
        return table

    def predictions(self, u: Array = ()) -> np.ndarray:
        """What is simulated: (windows, quantities, samples)."""
        return in_lanes(predicted, self.base, self.filled(u)[self.shots.run], self.shots)

    def residuals(self, u: Array) -> np.ndarray:
        """All residuals, those of the prior last."""
        found = self.predictions(u)
        off = np.where(self.known, (found - self.shots.measured) / self.divisor, 0.0)
        return np.concatenate([np.nan_to_num(off, nan=1e2).ravel(), (u - self.prior) / self.width])

    def jacobian(self, u: Array) -> np.ndarray:
        """The derivatives of `residuals`."""
        table, rates = self.filled(u), np.where(self.logarithmic, self.outside(u), 1.0)
        # Each window with each group of the parameters that move it.
        lanes, columns = [], []
        for run in np.unique(self.shots.run):
            moves = [j for j, rows in enumerate(self.rows) if run in rows]
            moves += moves[-1:] * (-len(moves) % GROUP)
            for window in np.flatnonzero(self.shots.run == run):
                for first in range(0, len(moves), GROUP):
                    lanes.append(window)
                    columns.append(moves[first : first + GROUP])
        windows, group = np.array(lanes), np.array(columns)
        shots = jax.tree.map(lambda leaf: leaf[windows], self.shots)
        directions = np.zeros((*group.shape, len(TABLE)))
        rows, members = np.indices(group.shape)
        directions[rows, members, self.index[group]] = rates[group]
        slopes = in_lanes(differentiated, self.base, table[shots.run], shots, directions)
        whole = np.zeros((*self.shots.measured.shape, len(self.parameters)))
        whole[windows[:, None], :, :, group] = slopes
        whole = np.where(self.known[..., None], whole / self.divisor[..., None], 0.0)
        # A motion that is chaos by the window's end has derivatives beyond all bounds: no guide.
        wild = ~(np.abs(whole) * self.width < WILD)
        whole[wild.any(axis=(1, 2, 3))] = 0.0
        return np.concatenate([whole.reshape(-1, len(self.parameters)), np.diag(1 / self.width)])

    @property
    def base(self) -> Car:
        """What is not fitted; surfaces differ in `PARAMETERS` alone."""
        return next(iter(self.cars.values()))

    def solve(self, u: Array, passes: int) -> Solved:
        """Levenberg and Marquardt's method from u, held in the ranges by projection.

        A parameter at an end of its range that the gradient would push beyond takes no part in a
        step. SciPy's `least_squares` knows the same loss and ranges, but both its methods stop
        short here: where a parameter is next to an end, their trust region is next to nothing.
        """
        u = np.clip(u, self.low, self.high)
        fun, damping, evaluations = self.residuals(u), DAMPING, 1
        for _ in range(passes):
            jacobian, evaluations = self.jacobian(u) * self.width, evaluations + 1
            slope, bend = loss(fun)[1:]
            gradient = jacobian.T @ (slope * fun)
            hessian = jacobian.T @ (bend[:, None] * jacobian)
            free = ~(((u <= self.low) & (gradient > 0)) | ((u >= self.high) & (gradient < 0)))
            before = float(loss(fun)[0].sum())
            while damping < STUCK:
                block = hessian[np.ix_(free, free)]
                step = np.zeros(len(u))
                step[free] = -np.linalg.solve(
                    block + damping * np.diag(np.diag(block)), gradient[free]
                )
                there = np.clip(u + step * self.width, self.low, self.high)
                found, evaluations = self.residuals(there), evaluations + 1
                if loss(found)[0].sum() < before:
                    break
                damping *= 4
            else:
                break
            u, fun, damping = there, found, max(damping / 3, EASY)
            if before - loss(fun)[0].sum() < TOLERANCE * before:
                break
        return Solved(u, float(loss(fun)[0].sum()), fun, evaluations)

    def cars_at(self, u: Array) -> dict[str, Car]:
        """The cars by surface; each keeps what is not fitted of its own."""
        cars = dict(self.cars)
        for p, value in zip(self.parameters, self.outside(u), strict=True):
            for number, name in enumerate(cars):
                if p.path != CHARGE and p.surface in (None, number):
                    cars[name] = changed(cars[name], p.path, np.float64(value))
        return cars

    def charge_at(self, u: Array) -> np.ndarray:
        """How full the battery is, by log."""
        return self.filled(u)[:, -1]


def with_values(car: Car, values: Array) -> Car:
    """The car with all `PARAMETERS` replaced."""
    for path, value in zip(PARAMETERS, values, strict=True):
        car = changed(car, path, value)
    return car


def shoot(car: Car, values: Array, shot: Shots) -> Array:
    """`shooting.predict` for the values of `TABLE`."""
    return shooting.predict(with_values(car, values[:-1]), shot._replace(charge=values[-1]), STEP)


@jax.jit
def predicted(car: Car, values: Array, shots: Shots) -> Array:
    """`shoot` in lanes: values (lanes, `TABLE`)."""
    return jax.vmap(lambda v, shot: shoot(car, v, shot))(values, shots)


@jax.jit
def differentiated(car: Car, values: Array, shots: Shots, directions: Array) -> Array:
    """The derivatives of `predicted`, each lane along a group of directions of its own."""

    def slopes(v: Array, shot: Shots, along: Array) -> Array:
        return jax.vmap(lambda d: jax.jvp(lambda v: shoot(car, v, shot), (v,), (d,))[1])(along)

    return jax.vmap(slopes)(values, shots, directions)


def in_lanes(program: Callable[..., Array], car: Car, *arguments: Any) -> np.ndarray:
    """A program over any number of lanes, in blocks of `LANES` on all cores."""
    count = len(jax.tree.leaves(arguments)[0])

    def block(begin: int) -> np.ndarray:
        rows = np.minimum(np.arange(begin, begin + LANES), count - 1)
        with jax.enable_x64(True):
            part = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), arguments)
            return np.asarray(program(car, *part))[: min(LANES, count - begin)]

    begins = range(0, count, LANES)
    if len(begins) == 1:
        return block(0)
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # compiled code runs beside Python
        return np.concatenate(list(pool.map(block, begins)))


def fit(
    cars: dict[str, Car],
    shots: Shots,
    what: str,
    report: Callable[[str], None] = lambda _: None,
) -> Result:
    """Fit `what` of `STAGES`; `all` takes the stages in their order, and then everything at once.

    `cars` are by surface, in the order of the shots' `surface`. Parameters that the logs do not
    determine are named and put back. The charge of logs that do not tell it is fitted in each
    stage; that of one log alone cannot be told from the motor.
    """
    alone = len(np.unique(shots.run)) == 1
    total = 0
    current, charge = cars, np.full(int(shots.run.max()) + 1, FULL)
    for name in ORDER if what == "all" else (what,):
        stage = STAGES[name]
        free = stage.parameters
        if not (alone and set(free) & set(SPEEDS)):
            free = (*free, CHARGE)
        chosen = stage.chooses(shots)
        if not chosen.any() and name == what:
            raise InputError(f"--fit {what}: no window of these runs tells of it")
        if not chosen.any():
            report(f"{name}: no window tells of it")
            continue
        part = select(shots, chosen)
        if name == what:
            report(f"{what}: {int(chosen.sum())} windows")
            break
        problem = Problem(current, part, free, cars, charge)
        solved = problem.solve(problem.start, PASSES)
        total += solved.nfev
        current = problem.cars_at(solved.x)
        found = problem.charge_at(solved.x)
        charge[: len(found)] = found
        report(f"{name}: {int(chosen.sum())} windows, cost {solved.cost:.4g}")
    return believed(cars, current, part, free, report, charge, total)


def estimated_charge(cars: dict[str, Car], shots: Shots) -> np.ndarray:
    """How full the battery was in each log: as it tells, or else as fits its windows best."""
    problem = Problem(cars, shots, (CHARGE,))
    if not problem.parameters:
        return problem.table[:, -1]
    return problem.charge_at(problem.solve(problem.start, PASSES).x)


def with_charge(shots: Shots, charge: np.ndarray) -> Shots:
    """The windows of logs of which it is known how full the battery was; others' was full."""
    filled = np.full(max(len(charge), int(shots.run.max()) + 1), FULL)
    filled[: len(charge)] = charge
    return shots._replace(charge=filled[shots.run])


def select(shots: Shots, chosen: np.ndarray) -> Shots:
    """Some of the windows."""
    return jax.tree.map(lambda leaf: leaf[chosen], shots)


def believed(
    cars: dict[str, Car],
    current: dict[str, Car],
    shots: Shots,
    free: Sequence[str],
    report: Callable[[str], None] = lambda _: None,
    charge: np.ndarray | None = None,
    evaluations: int = 0,
) -> Result:
    """The last fit and its deviations; what is not determined is put back, the rest refitted.

    `cars` are what is expected; the solver starts at `current` and, by log, `charge`.
    """
    problem = Problem(cars, shots, free)
    solved = problem.solve(Problem(current, shots, free, None, charge).start, PASSES)
    curvature, determined = deviations(problem, solved)
    if not determined.all():
        loose = [p for p, known in zip(problem.parameters, determined, strict=True) if not known]
        report("not determined: " + ", ".join(sorted({p.path for p in loose})))
        held = Held(problem, determined)
        solved = held.solve(solved.x[determined], PASSES)
        whole = problem.prior.copy()
        whole[determined] = solved.x
        solved = solved._replace(x=whole)
    evaluations += solved.nfev
    halves = by_halves(problem, determined, solved.x)
    deviation = np.maximum(curvature, halves)
    near = 1e-3 * problem.width
    low, high = solved.x - problem.low < near, problem.high - solved.x < near
    rates = np.where(problem.logarithmic, problem.outside(solved.x), 1.0)
    start, end = problem.outside(problem.prior), problem.outside(solved.x)
    surfaces = list(cars)
    fitted = [
        Fitted(
            p.path,
            None if p.surface is None else surfaces[p.surface],
            p.run,
            float(start[i]),
            float(end[i]),
            float(rates[i] * deviation[i]),
            float(rates[i] * curvature[i]),
            float(rates[i] * halves[i]),
            bool(determined[i]),
            bool(determined[i] and (low[i] or high[i])),
        )
        for i, p in enumerate(problem.parameters)
    ]
    return Result(problem.cars_at(solved.x), fitted, solved.cost, evaluations)


class Held(Problem):
    """A problem with some of its parameters held at their prior."""

    def __init__(self, whole: Problem, free: np.ndarray) -> None:
        """`free` tells which stay."""
        self.__dict__ |= vars(whole)
        for name in ("parameters", "rows"):
            kept = zip(getattr(whole, name), free, strict=True)
            setattr(self, name, [one for one, stays in kept if stays])
        for name in ("index", "logarithmic", "start", "prior", "low", "high", "width"):
            setattr(self, name, getattr(whole, name)[free])


def deviations(problem: Problem, solved: Solved) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations by the curvature of the cost, and which parameters are determined.

    A window counts as one observation of each quantity (the residuals are divided so), and the
    noise is taken from the windows' mean square residuals, never less than one. The parameter that
    adds least to its prior is taken as known, and so on, until the data say something of each that
    is left: of two that only their sum is known of, one is determined given the other.
    """
    count = len(problem.parameters)
    observations = max(1, int(problem.known[:, :, -1].sum()))
    curved = np.sqrt(loss(solved.fun)[2])[:, None] * problem.jacobian(solved.x)
    data, expected = curved[:-count], curved[-count:]
    noise = max(1.0, float(np.sum(np.minimum(solved.fun[:-count] ** 2, GROSS)) / observations))
    information = data.T @ data / noise + expected.T @ expected
    left = list(range(count))
    deviation = problem.width.copy()
    while left:
        some = np.sqrt(np.diag(np.linalg.pinv(information[np.ix_(left, left)])))
        deviation[left] = some
        worst = int(np.argmax(some / problem.width[left]))
        if some[worst] < KNOWN * problem.width[left[worst]]:
            break
        del left[worst]
    determined = np.isin(np.arange(count), left)
    return deviation, determined


def by_halves(whole: Problem, determined: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Half the difference between fits to two halves of the data: its eighths, by turns.

    0 for what only one half tells of.
    """
    rank = np.argsort(np.argsort(whole.shots.run, kind="stable"))
    eighth = rank * 8 // len(rank)
    ends, known = np.tile(u, (2, 1)), np.full(len(u), True)
    for half, end in enumerate(ends):
        problem = Problem(
            whole.cars,
            select(whole.shots, eighth % 2 == half),
            list(dict.fromkeys(p.path for p in whole.parameters)),
            charge=whole.charge_at(u),
        )
        place = np.array([whole.parameters.index(p) for p in problem.parameters], int)
        free = determined[place]
        end[place[free]] = Held(problem, free).solve(u[place[free]], 12).x
        known &= np.isin(np.arange(len(u)), place)
    return np.where(known, np.abs(ends[1] - ends[0]) / 2, 0.0)


def errors(cars: dict[str, Car], shots: Shots) -> dict[str, Any]:
    """Median absolute errors at the windows' ends and RMS over them, beside persistence."""
    found = Problem(cars, shots, ()).predictions()
    start = np.stack(
        [shots.velocity.x, shots.velocity.y, shots.velocity.yaw, shots.wheel_speed], axis=1
    )[:, :, None]
    result: dict[str, Any] = {"windows": len(shots.surface)}
    for name, prediction in (("simulated", found), ("persistence", start)):
        off = prediction - shots.measured
        result[name] = {
            quantity: {
                "median_abs_error": float(np.nanmedian(np.abs(off[:, i, -1]))),
                "rmse": float(np.sqrt(np.nanmean(off[:, i] ** 2))),
            }
            for i, quantity in enumerate(QUANTITIES)
            if np.isfinite(shots.measured[:, i, -1]).any()
        }
    return result
