"""Logs in, a car out: robust least squares over windows of logs, with what can be believed of it.

    minimise  sum over windows, quantities, samples of rho((predicted - measured) / scale)
              + sum over parameters of ((u - u_prior) / width)²

where u is the logarithm of a parameter, or itself for one that may be nothing or less, and rho the
soft L1 loss, so that a window in which the motion was caught at another instant counts no more than
any. Derivatives are exact, through the simulator (`shooting.predict`); the solver is
SciPy's trust-region reflective `least_squares`, which keeps the declared ranges.

The body and what drives it are shared by all logs; tyres and rolling drag are fitted for each
surface by itself.
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
from scipy.optimize import least_squares

from countersteer.car.car import Car
from countersteer.car.parameter import Array, Declaration, changed, declarations
from countersteer.errors import InputError
from countersteer.runs.faults import Fault
from countersteer.runs.run import Run
from countersteer.tuning import shooting
from countersteer.tuning.shooting import Shots
from countersteer.tuning.windows import QUANTITIES

STEP = 0.002  # s; the step's own error is then a hundredth of a log's
HORIZON = 1.0  # s
SCALES = np.array([0.05, 0.03, 0.12, 0.08])  # of the quantities: what a good fit is off by
LOOSE = 0.5  # prior standard deviation of a logarithm, where there is none in `WIDTHS`
LANES = 64  # windows in a call of the compiled program, whatever their number
GROUP = 8  # derivatives that a lane takes at once
OUTLYING = 0.5  # normalised residual at which the loss turns linear
TOLERANCE = 1e-5
PASSES = 40  # evaluations of a stage, at most
INSIDE = 0.1  # widths that a start keeps from a bound: the trust region is tiny near one
KNOWN = 0.7  # part of the prior's width under which a parameter counts as determined
STRAIGHT = math.radians(4)  # steering under which a window is straight
SLIDES = math.radians(10)  # sideslip from which it slides
SPINS = 0.5  # m/s of wheel speed over the ground's from which it slides too
HELD_OUT = 2.0  # s of each block that is fitted or held out by turns

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
HANDLING = ("body.yaw_inertia",)
PARAMETERS = (*SPEEDS, *STEERING, *HANDLING, *TIRES)
WIDTHS = {"body.yaw_inertia": 0.3}  # known beforehand: standard deviation of a logarithm
ABSOLUTE = {  # the same, of a parameter that may as well be next to nothing, in its own unit
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
    """One number that is fitted: a path, for one surface or (None) for all."""

    path: str
    surface: int | None


class Fitted(NamedTuple):
    """What a fit makes of a parameter, in the units used inside."""

    path: str
    surface: str | None
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
    """The declaration of a car's parameter by its dotted path of names inside."""
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
    faults: Sequence[list[Fault]],
    every: float = 0.25,
) -> tuple[Shots, np.ndarray, np.ndarray]:
    """All windows of all runs without those that a fault touches; with run and time of each."""
    names = list(cars)
    parts, of_run, starts = [], [], []
    for i, (run, surface) in enumerate(zip(runs, surfaces, strict=True)):
        found = shooting.take(run, cars[surface], names.index(surface), HORIZON, every, STEP)
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
        parts.append(taken(shots, clean))
        starts.append(start[clean])
        of_run.append(np.full(int(clean.sum()), i))
    if not parts or not sum(len(part.surface) for part in parts):
        raise InputError("no run holds a window of 1 s that can be fitted: driven, and measured")
    return shooting.joined(parts), np.concatenate(of_run), np.concatenate(starts)


COLUMNS = {"gyro_radps": 2, "yaw_rate_radps": 2, "wheel_speed_mps": 3, "encoder_counts": 3}


def without(shots: Shots, column: str, where: np.ndarray) -> Shots:
    """The windows with one quantity unknown in some of them."""
    index = COLUMNS.get(column)
    if index is None:
        return shots
    measured = shots.measured.copy()
    measured[where, index] = np.nan
    return shots._replace(measured=measured)


def blocks(time: np.ndarray) -> np.ndarray:
    """Of windows that start at these times: 1 for those to fit, 2 for those held out, else 0.

    Blocks of `HELD_OUT` seconds take turns, two to fit and one to hold out; a window that reaches
    from one kind into the other belongs to neither.
    """
    held = [np.floor((time + lead) / HELD_OUT) % 3 == 2 for lead in (0.0, HORIZON)]
    return np.where(held[0] & held[1], 2, np.where(held[0] | held[1], 0, 1))


class Problem:
    """Residuals and their derivatives for some free parameters over some windows."""

    def __init__(
        self,
        cars: dict[str, Car],
        shots: Shots,
        free: Sequence[str],
        prior: dict[str, Car] | None = None,
    ) -> None:
        """`free` paths are fitted, those of the floor for each surface that has windows.

        `cars` say what the others are, and what is expected, unless `prior` says that.
        """
        self.cars = cars
        surfaces = [int(k) for k in np.unique(shots.surface)]
        self.parameters = [
            Parameter(path, surface)
            for path in free
            for surface in (surfaces if path in FLOOR else [None])
        ]
        self.shots = shots
        self.known = np.isfinite(shots.measured)
        self.divisor = SCALES[:, None] * math.sqrt(shots.measured.shape[-1])
        self.table = np.array(
            [[value_of(car, path) for path in PARAMETERS] for car in cars.values()]
        )
        declared = [declaration(p.path) for p in self.parameters]
        self.logarithmic = np.array([p.path not in ABSOLUTE for p in self.parameters])
        self.prior = self.inside(values(self, prior or cars))
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

    def inside(self, value: Array) -> Array:
        """From a parameter's value to the fit's variable."""
        return np.where(self.logarithmic, np.log(np.maximum(value, 1e-12)), value)

    def outside(self, u: Array) -> Array:
        """The inverse of `inside`."""
        return np.where(self.logarithmic, np.exp(u), u)

    def filled(self, u: Array) -> np.ndarray:
        """All parameters by surface, (surfaces, `PARAMETERS`)."""
        table = self.table.copy()
        for p, value in zip(self.parameters, self.outside(u), strict=True):
            rows = slice(None) if p.surface is None else p.surface
            table[rows, PARAMETERS.index(p.path)] = value
        return table

    def residuals(self, u: Array) -> np.ndarray:
        """All residuals, those of the prior last."""
        values = self.filled(u)[self.shots.surface]
        found = in_lanes(predicted, self.base, values, self.shots)
        off = np.where(self.known, (found - self.shots.measured) / self.divisor, 0.0)
        return np.concatenate([np.nan_to_num(off, nan=1e2).ravel(), (u - self.prior) / self.width])

    def jacobian(self, u: Array) -> np.ndarray:
        """The derivatives of `residuals`."""
        table, rates = self.filled(u), np.where(self.logarithmic, self.outside(u), 1.0)
        # Each window with each group of the parameters that move it.
        lanes, columns = [], []
        for surface in np.unique(self.shots.surface):
            moves = [j for j, p in enumerate(self.parameters) if p.surface in (None, surface)]
            moves += [moves[-1]] * (-len(moves) % GROUP)
            for window in np.flatnonzero(self.shots.surface == surface):
                for first in range(0, len(moves), GROUP):
                    lanes.append(window)
                    columns.append(moves[first : first + GROUP])
        windows, group = np.array(lanes), np.array(columns)
        shots = jax.tree.map(lambda leaf: leaf[windows], self.shots)
        places = np.array([PARAMETERS.index(p.path) for p in self.parameters])
        directions = np.zeros((*group.shape, len(PARAMETERS)))
        rows, members = np.indices(group.shape)
        directions[rows, members, places[group]] = rates[group]
        slopes = in_lanes(differentiated, self.base, table[shots.surface], shots, directions)
        whole = np.zeros((*self.shots.measured.shape, len(self.parameters)))
        whole[windows[:, None], :, :, group] = slopes
        whole = np.where(self.known[..., None], whole / self.divisor[..., None], 0.0)
        flat = np.nan_to_num(whole).reshape(-1, len(self.parameters))
        return np.concatenate([flat, np.diag(1 / self.width)])

    @property
    def base(self) -> Car:
        """What is not fitted; surfaces differ in `PARAMETERS` alone."""
        return next(iter(self.cars.values()))

    def solve(self, u: Array, passes: int) -> Any:
        """SciPy's result, from u."""
        inside = np.minimum(INSIDE * self.width, (self.high - self.low) / 4)
        return least_squares(
            self.residuals,
            np.clip(u, self.low + inside, self.high - inside),
            jac=self.jacobian,
            bounds=(self.low, self.high),
            x_scale=self.width,
            loss="soft_l1",
            f_scale=OUTLYING,
            max_nfev=passes,
            xtol=TOLERANCE,
            ftol=TOLERANCE,
        )

    def cars_at(self, u: Array) -> dict[str, Car]:
        """The cars by surface; each keeps what is not fitted of its own."""
        cars = {}
        for (name, car), row in zip(self.cars.items(), self.filled(u), strict=True):
            for path in {p.path for p in self.parameters}:
                car = changed(car, path, np.float64(row[PARAMETERS.index(path)]))
            cars[name] = car
        return cars


def with_values(car: Car, values: Array) -> Car:
    """The car with all `PARAMETERS` replaced."""
    for path, value in zip(PARAMETERS, values, strict=True):
        car = changed(car, path, value)
    return car


@jax.jit
def predicted(car: Car, values: Array, shots: Shots) -> Array:
    """`shooting.predict` in lanes: values (lanes, parameters)."""
    return jax.vmap(lambda v, shot: shooting.predict(with_values(car, v), shot, STEP))(
        values, shots
    )


@jax.jit
def differentiated(car: Car, values: Array, shots: Shots, directions: Array) -> Array:
    """The derivatives of `predicted`, each lane along a group of directions of its own."""

    def slopes(v: Array, shot: Shots, along: Array) -> Array:
        def predict(v: Array) -> Array:
            return shooting.predict(with_values(car, v), shot, STEP)

        return jax.vmap(lambda d: jax.jvp(predict, (v,), (d,))[1])(along)

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
    run_of: np.ndarray,
    report: Callable[[str], None] = lambda _: None,
) -> Result:
    """Fit `what` of `STAGES`; `all` takes the stages in their order, and then everything at once.

    `cars` are by surface, in the order of the shots' `surface`; `run_of` tells the halves of the
    data apart. Parameters that the logs do not determine are named and put back.
    """
    total = 0
    current = cars
    for name in ORDER[:-1] if what == "all" else ():
        stage = STAGES[name]
        chosen = stage.chooses(shots)
        if not chosen.any():
            report(f"{name}: no window tells of it")
            continue
        problem = Problem(current, taken(shots, chosen), stage.parameters, cars)
        solved = problem.solve(problem.inside(values(problem, current)), PASSES)
        total += solved.nfev
        current = problem.cars_at(solved.x)
        report(f"{name}: {int(chosen.sum())} windows, cost {solved.cost:.4g}")
    stage = STAGES[what]
    chosen = stage.chooses(shots)
    if not chosen.any():
        raise InputError(f"--fit {what}: no window of these runs tells of it")
    report(f"{what}: {int(chosen.sum())} windows")
    part = taken(shots, chosen)
    return believed(cars, current, part, stage.parameters, run_of[chosen], total, report)


def taken(shots: Shots, chosen: np.ndarray) -> Shots:
    """Some of the windows."""
    return jax.tree.map(lambda leaf: leaf[chosen], shots)


def values(problem: Problem, cars: dict[str, Car]) -> np.ndarray:
    """The free parameters' values of some cars."""
    by_surface = list(cars.values())
    return np.array([value_of(by_surface[p.surface or 0], p.path) for p in problem.parameters])


def believed(
    cars: dict[str, Car],
    current: dict[str, Car],
    shots: Shots,
    free: Sequence[str],
    run_of: np.ndarray,
    evaluations: int,
    report: Callable[[str], None],
) -> Result:
    """The last fit and its deviations; what is not determined is put back, the rest refitted."""
    problem = Problem(cars, shots, free)
    u = problem.inside(values(problem, current))
    solved = problem.solve(u, PASSES)
    curvature, determined = deviations(problem, solved)
    if not determined.all():
        loose = [p for p, known in zip(problem.parameters, determined, strict=True) if not known]
        report("not determined: " + ", ".join(sorted({p.path for p in loose})))
        held = Held(problem, determined)
        solved = held.solve(solved.x[determined], PASSES)
        whole = problem.prior.copy()
        whole[determined] = solved.x
        solved.x = whole
    evaluations += solved.nfev
    halves = by_halves(cars, shots, free, run_of, determined, solved.x)
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
    return Result(problem.cars_at(solved.x), fitted, float(solved.cost), evaluations)


class Held(Problem):
    """A problem with some of its parameters held at their prior."""

    def __init__(self, whole: Problem, free: np.ndarray) -> None:
        """`free` tells which stay."""
        self.__dict__ |= vars(whole)
        self.parameters = [p for p, stays in zip(whole.parameters, free, strict=True) if stays]
        for name in ("logarithmic", "prior", "low", "high", "width"):
            setattr(self, name, getattr(whole, name)[free])


def deviations(problem: Problem, solved: Any) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations by the curvature of the cost, and which parameters are determined.

    A window counts as one observation of each quantity (the residuals are divided so), and the
    noise is taken from the windows' mean square residuals, never less than one. The parameter that
    adds least to its prior is taken as known, and so on, until the data say something of each that
    is left: of two that only their sum is known of, one is determined given the other.
    """
    hessian = solved.jac.T @ solved.jac
    data = solved.fun[: -len(problem.parameters)]
    observations = max(1, int(problem.known[:, :, -1].sum()))
    noise = max(1.0, float(np.sum(np.minimum(data**2, OUTLYING)) / observations))
    deviation = np.sqrt(noise * np.maximum(np.diag(np.linalg.pinv(hessian)), 0.0))
    left = list(range(len(problem.parameters)))
    while left:
        some = np.sqrt(noise * np.diag(np.linalg.pinv(hessian[np.ix_(left, left)])))
        worst = int(np.argmax(some / problem.width[left]))
        deviation[left] = some
        if some[worst] < KNOWN * problem.width[left[worst]]:
            break
        del left[worst]
    determined = np.isin(np.arange(len(problem.parameters)), left)
    return deviation, determined


def by_halves(
    cars: dict[str, Car],
    shots: Shots,
    free: Sequence[str],
    run_of: np.ndarray,
    determined: np.ndarray,
    u: np.ndarray,
) -> np.ndarray:
    """Half the difference between fits to two halves of the data: its eighths, by turns."""
    rank = np.argsort(np.argsort(run_of, kind="stable"))
    eighth = rank * 8 // len(rank)
    ends = []
    for half in (0, 1):
        problem = Problem(cars, taken(shots, eighth % 2 == half), free)
        if len(problem.parameters) != len(u):
            return np.zeros(len(u))
        held = Held(problem, determined)
        found = problem.prior.copy()
        found[determined] = held.solve(u[determined], 12).x
        ends.append(found)
    return np.abs(ends[1] - ends[0]) / 2


def errors(cars: dict[str, Car], shots: Shots) -> dict[str, Any]:
    """Median absolute errors at the windows' ends and RMS over them, beside persistence."""
    problem = Problem(cars, shots, ())
    found = in_lanes(predicted, problem.base, problem.table[shots.surface], shots)
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
