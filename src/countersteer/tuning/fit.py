"""Fit a car's parameters to windows of logs by robust least squares, with their uncertainty.

    minimise  sum over windows, quantities, samples of rho(w (predicted - measured) / scale)
              + sum over parameters of ((u - u_prior) / width)² / 2
              + sum over what floors share of ((d_floor - mean of floors) / width)² / 2

u is the logarithm of a parameter. The parameters of `ABSOLUTE` may be zero or negative, so u is
their value itself. rho is the soft L1 loss (`loss`). It limits the cost of outliers, such as a
window whose motion was captured at another instant.

A log of n windows with s samples each has the weight w = (s n / median of n)^-½. So all logs have
equal weight. A long log repeats a manoeuvre; a short one may be the only log of another.

Derivatives are exact, through the simulator (`shooting.predict`). The search keeps the declared
ranges (`Problem.solve`).

All logs share body, motor and servo. Tyres and rolling drag are fitted for each surface, but a
floor may not change them at will (`SHARED`, `BALANCE`). It may make all tyres grip less. It hardly
changes their stiffness, or how the grip of front and rear compare: the same rubber is on both. One
log seldom tells all of that. d is what a fit has moved a parameter by (u - u_prior).

Battery charge is fitted for each log that does not state it. Its prior is a full battery.
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
from countersteer.car.parameter import Declaration, changed, declarations
from countersteer.errors import InputError
from countersteer.runs.defects import LogDefect
from countersteer.runs.run import Run
from countersteer.signals import Array, SpeedCommand
from countersteer.tuning import shooting
from countersteer.tuning.shooting import Shots
from countersteer.tuning.windows import QUANTITIES, measured_for, why_no_window
from countersteer.world import servo

STEP = 0.002  # s, of the simulation; its error is then 1 % of the measurement's
HORIZON = 1.0  # s, length of a window
SCALES = np.array([0.05, 0.03, 0.12, 0.08])  # of `QUANTITIES`, SI units: errors of a good fit
GAIN = 0.3  # prior standard deviation of the steering's gains in `told`
LOOSE = 0.5  # prior standard deviation of a logarithm that is not in `WIDTHS`
LANES = 64  # windows in every call of the compiled program; shorter blocks are padded
GROUP = 8  # derivatives that one lane computes
OUTLYING = 0.2  # normalised residual at which the loss turns linear
GROSS = 0.5  # upper limit of a squared residual in the estimate of the noise
WILD = 1e3  # change of a residual per prior width; beyond it, a window is chaotic
TOLERANCE = 1e-5  # relative decrease of the cost at which a search ends
PASSES = 40  # largest number of steps in a search
DAMPING, EASY, STUCK = 0.01, 1e-6, 1e4  # of a step: first, least, and where a search gives up
KNOWN = 0.9  # ratio of posterior to prior deviation; below it, a parameter is determined
STRAIGHT = math.radians(4)  # steering; below it, a window is straight
SLOW = 1.5  # m/s² of lateral acceleration; below it, a tyre hardly slips
CREEPS = 0.3  # m/s; below it, an angle of yaw rate over speed is noise
STEADY = math.radians(1)  # largest change of a command that counts as steady
ENOUGH = 5  # slow windows to a side; fewer do not tell the steering
ANGLE = math.radians(0.3)  # error of what the slow driving of one log tells
SLIDES = math.radians(10)  # sideslip; beyond it, a window slides
SPINS = 0.5  # m/s of wheel speed above ground speed; beyond it, a window slides too
HELD_OUT = 2.0  # s, length of a block; whole blocks are fitted or held out
BRIEF = 10.0  # s; a log whose starts of windows span less is one manoeuvre

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
FLOOR = (*TIRES, *ROLLING)  # fitted for each surface
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
HANDLING = (
    "body.yaw_inertia",
    "body.front_roll_share",
    "tires.front.cornering_drag",
    "tires.rear.cornering_drag",
)
PARAMETERS = (*SPEEDS, *STEERING, *HANDLING, *TIRES)
CONTROLLER = ("speed_controller.gain", "speed_controller.feed_forward")
OF_CAR = (*PARAMETERS, *CONTROLLER)  # `CONTROLLER` is fitted to logs commanded in m/s only
CHARGE = "battery.charge"  # belongs to a log, not to a car
FULL = 1.0  # prior charge of a log that does not state it
EMPTY = 0.1  # least charge that a fit may find: below it, a car's protection ends the drive
TABLE = (*OF_CAR, CHARGE)
WIDTHS = {  # prior standard deviations of logarithms
    "body.yaw_inertia": 0.3,
    "servo.limit_left": 0.2,
    "servo.limit_right": 0.2,
}
ABSOLUTE = {  # prior standard deviations in SI units, of parameters that may be near zero
    CHARGE: 0.5,
    "body.front_roll_share": 0.25,
    "tires.front.cornering_drag": 0.1,
    "tires.rear.cornering_drag": 0.1,
    "motor.conduction": 0.5,
    "motor.neutral_brake": 0.2,
    "motor.lag": 0.05,
    "motor.delay": 0.03,
    "motor.rotor_inertia": 1e-6,
    "drivetrain.drag_viscous": 1e-4,
    "speed_controller.gain": 0.5,
    "speed_controller.feed_forward": 0.05,
    "servo.trim": math.radians(2),
    "servo.lag": 0.05,
    "servo.delay": 0.03,
    "tires.front.sliding_ratio": 0.1,
    "tires.rear.sliding_ratio": 0.1,
    "tires.front.longitudinal_ratio": 0.2,
    "tires.rear.longitudinal_ratio": 0.2,
}


# What floors share: the standard deviation of a floor's own departure from the mean of all floors
SHARED = {
    "tires.front.cornering_stiffness": 0.15,
    "tires.rear.cornering_stiffness": 0.15,
    "tires.front.longitudinal_stiffness": 0.2,
    "tires.rear.longitudinal_stiffness": 0.2,
    "tires.front.sliding_ratio": 0.03,
    "tires.rear.sliding_ratio": 0.03,
    "tires.front.longitudinal_ratio": 0.1,
    "tires.rear.longitudinal_ratio": 0.1,
}
# Two parameters of a floor, and the standard deviation of how far they depart from each other
BALANCE = (("tires.front.friction", "tires.rear.friction", 0.07),)


class Stage(NamedTuple):
    """The parameters of one fit, and the windows that it uses."""

    parameters: tuple[str, ...]
    chooses: Callable[[Shots], np.ndarray]  # mask of the windows that excite them
    needs: str  # what such a window is


def straight(shots: Shots) -> np.ndarray:
    """True for windows whose steering stays below `STRAIGHT`: (windows,)."""
    return np.max(np.abs(shots.commands.steering), axis=1) < STRAIGHT


def slides(shots: Shots) -> np.ndarray:
    """True for windows with sideslip beyond `SLIDES` or wheelspin beyond `SPINS`: (windows,).

    False for windows without motion capture.
    """
    vx, vy = (np.nan_to_num(shots.measured[:, i]) for i in (0, 1))
    sideslip = np.arctan2(np.abs(vy), np.maximum(np.abs(vx), 0.3))
    wheels = np.nan_to_num(shots.measured[:, 3] - np.hypot(vx, vy))
    captured = np.isfinite(shots.measured[:, 0, 0])
    return captured & ((sideslip > SLIDES) | (wheels > SPINS)).any(axis=1)


def steered(shots: Shots) -> np.ndarray:
    """True for windows that are neither straight nor sliding: (windows,)."""
    return ~straight(shots) & ~slides(shots)


def slow(shots: Shots) -> np.ndarray:
    """True for windows of steady steering and little lateral acceleration: (windows,)."""
    speed, yaw_rate = motion_of(shots)
    aside = np.nan_to_num(np.abs(speed * yaw_rate), nan=math.inf)
    steady = np.ptp(shots.commands.steering, axis=1) < STEADY
    return steady & (aside < SLOW).all(axis=1) & (speed > CREEPS).all(axis=1)


def motion_of(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Forward speed, or else the wheels', and yaw rate: (windows, samples)."""
    forward, wheels = shots.measured[:, 0], shots.measured[:, 3]
    return np.where(np.isfinite(forward), forward, wheels), shots.measured[:, 2]


def any_window(shots: Shots) -> np.ndarray:
    """True for every window: (windows,)."""
    return np.full(len(shots.surface), True)


_STRAIGHT, _SLIDES = (f"{math.degrees(angle):.0f}°" for angle in (STRAIGHT, SLIDES))
STEERED = f"steered by {_STRAIGHT} or more, without sliding"
STAGES = {
    "longitudinal": Stage(SPEEDS, straight, f"steered by less than {_STRAIGHT}"),
    "steering": Stage(STEERING, steered, STEERED),
    "handling": Stage((*HANDLING, *TIRES[:4]), steered, STEERED),
    "drift": Stage((*HANDLING, *TIRES), slides, f"sideslip above {_SLIDES}, or wheelspin"),
    "all": Stage(PARAMETERS, any_window, ""),
}
ORDER = ("longitudinal", "steering", "handling", "drift", "all")


class Parameter(NamedTuple):
    """A fitted number: the path of a parameter, and its surface or log (None: all)."""

    path: str
    surface: int | None = None
    run: int | None = None


class Fitted(NamedTuple):
    """The result for one parameter, in SI units and radians."""

    path: str
    surface: str | None
    run: int | None
    before: float  # prior value
    value: float
    deviation: float  # standard deviation: the larger of `by_curvature` and `by_halves`
    by_curvature: float  # from the curvature of the cost (`deviations`)
    by_halves: float  # from fits to two halves of the data
    determined: bool  # False: the data hardly move its prior
    at_bound: bool  # of its declared range


class Result(NamedTuple):
    """The fitted cars, their parameters and the cost."""

    cars: dict[str, Car]  # by surface
    fitted: list[Fitted]
    cost: float
    evaluations: int


def declaration(path: str) -> Declaration:
    """The declaration of a car's parameter, by its dotted path of fields, or of `CHARGE`."""
    if path == CHARGE:
        return Declaration("1", EMPTY, 1.0, "of the battery at a log's windows", "fitted")
    *rooms, name = path.split(".")
    part = reduce(getattr, rooms, Car())
    return dict(declarations(type(part)).values())[name]


def value_of(car: Car, path: str) -> float:
    """The value of a car's parameter, by its dotted path of fields."""
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
    """The windows of all runs without false data, and their start times (s): (windows,).

    `surfaces` and `faults` are by run. `every` (s) is the time between two starts. A defect of all
    columns removes the windows that it overlaps. A defect of one column makes its quantity
    unknown (NaN) in them. Raises `InputError` if no window is left.
    """
    names = list(cars)
    parts, starts, reasons = [], [], []
    for i, (run, surface) in enumerate(zip(runs, surfaces, strict=True)):
        found = shooting.take(run, cars[surface], i, names.index(surface), HORIZON, every, STEP)
        if found is None:
            measured = measured_for(run, cars[surface])
            reasons.append(why_no_window(run, measured, HORIZON))
            continue
        shots, start = found
        clean = np.full(len(start), True)
        for fault in faults[i]:
            touched = (start < fault.end) & (start + HORIZON > fault.start)
            if fault.column:
                shots = without(shots, fault.column, touched)
            else:
                clean &= ~touched
        if not clean.any():
            whole = [fault.what for fault in faults[i] if not fault.column]
            reasons.append(f"{run.path}: all windows are left out: {whole[0]}")
        parts.append(select(shots, clean))
        starts.append(start[clean])
    if not sum(len(part.surface) for part in parts):
        more = f" (and {len(reasons) - 1} runs more)" if len(reasons) > 1 else ""
        raise InputError(f"{reasons[0]}{more}")
    return shooting.joined(parts), np.concatenate(starts)


# Index in `QUANTITIES` of the quantity that a column measures
COLUMNS = {"gyro_radps": 2, "yaw_rate_radps": 2, "wheel_speed_mps": 3, "encoder_counts": 3}


def without(shots: Shots, column: str, where: np.ndarray) -> Shots:
    """The windows, with the quantity of a column unknown (NaN) in those of the mask `where`."""
    index = COLUMNS.get(column)
    if index is None:
        return shots
    measured = shots.measured.copy()
    measured[where, index] = np.nan
    return shots._replace(measured=measured)


def blocks(time: np.ndarray, run: np.ndarray, fold: int = 2) -> np.ndarray:
    """Split windows by their start times: 1 is fitted, 2 is held out, 0 is neither.

    Time is cut into blocks of `HELD_OUT` seconds. Of every three blocks, the one of number `fold`
    (0 to 2) is held out and two are fitted. A window that overlaps both kinds is neither. A `brief`
    log is fitted whole if there are longer ones: it is one manoeuvre, whose parts cannot test each
    other.
    """
    held = [np.floor((time + lead) / HELD_OUT) % 3 == fold for lead in (0.0, HORIZON)]
    kind = np.where(held[0] & held[1], 2, np.where(held[0] | held[1], 0, 1))
    whole = brief(time, run)
    return kind if whole.all() else np.where(whole, 1, kind)


def brief(time: np.ndarray, run: np.ndarray) -> np.ndarray:
    """True for windows of logs whose windows all start within `BRIEF` seconds: (windows,)."""
    return np.array([np.ptp(time[run == k]) < BRIEF for k in run])


class Solved(NamedTuple):
    """The end of a search."""

    x: np.ndarray  # u of each free parameter
    cost: float
    fun: np.ndarray  # residuals
    nfev: int  # evaluations of residuals or Jacobian


def loss(residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half the soft L1 loss of each residual r, and the factors of its gradient and curvature.

    With c = `OUTLYING` and q = sqrt(1 + (r/c)²), they are c² (q - 1), 1/q and 1/q³.
    """
    root = np.sqrt(1 + (residuals / OUTLYING) ** 2)
    return OUTLYING**2 * (root - 1), 1 / root, 1 / root**3


class Problem:
    """Residuals of windows and their derivatives over the free parameters."""

    def __init__(
        self,
        cars: dict[str, Car],
        shots: Shots,
        free: Sequence[str],
        prior: dict[str, Car] | None = None,
        charge: np.ndarray | None = None,
    ) -> None:
        """`free` are the paths to fit. Those of `FLOOR` are fitted for each surface with windows.

        `cars` give all other values and the start of the search. They are the prior too, unless
        `prior` is given. `charge` (logs,) gives the charge of logs that do not state it, by
        default `FULL`. If `CHARGE` is in `free`, it is fitted for those logs.
        """
        self.cars = cars
        self.shots = shots
        self.surface = np.zeros(int(shots.run.max()) + 1, int)  # surface of each log
        self.surface[shots.run] = shots.surface
        surfaces = [int(k) for k in np.unique(shots.surface)]
        without_charge = [int(k) for k in np.unique(shots.run[np.isnan(shots.charge)])]
        self.parameters = []
        for path in free:
            if path == CHARGE:
                self.parameters += [Parameter(path, run=k) for k in without_charge]
            elif path in FLOOR:
                self.parameters += [Parameter(path, surface=k) for k in surfaces]
            else:
                self.parameters.append(Parameter(path))
        self.known = np.isfinite(shots.measured)
        count = np.bincount(shots.run)
        median = np.median(count[count > 0])
        self.divisor = np.sqrt(count[shots.run] / median * shots.measured.shape[-1])[:, None, None]
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
        self.expected = np.concatenate([np.diag(1 / self.width), self.shared()])
        self.offset = np.zeros(len(self.expected))  # of these rows, by what is fixed

    def shared(self) -> np.ndarray:
        """The rows of what floors share: their product with u - u_prior is (rows,)."""
        rows = []
        for path, width in SHARED.items():
            floors = [j for j, p in enumerate(self.parameters) if p.path == path]
            for j in floors if len(floors) > 1 else ():
                row = np.zeros(len(self.parameters))
                row[floors] = -1 / len(floors)
                row[j] += 1
                rows.append(row / width)
        for one, other, width in BALANCE:
            for j, p in enumerate(self.parameters):
                pair = Parameter(other, p.surface)
                if p.path == one and pair in self.parameters:
                    row = np.zeros(len(self.parameters))
                    row[[j, self.parameters.index(pair)]] = 1, -1
                    rows.append(row / width)
        return np.array(rows).reshape(len(rows), len(self.parameters))

    def tabled(self, cars: dict[str, Car], charge: np.ndarray | None = None) -> np.ndarray:
        """The values of `TABLE` for each log, `charge` where it states none: (logs, `TABLE`)."""
        logs = len(self.surface)
        charges = np.full(logs, FULL) if charge is None else charge[:logs].copy()
        stated = np.isfinite(self.shots.charge)
        charges[self.shots.run[stated]] = self.shots.charge[stated]
        of_car = np.array([[value_of(car, path) for path in OF_CAR] for car in cars.values()])
        return np.column_stack([of_car[self.surface], charges])

    def moves(self, parameter: Parameter) -> np.ndarray:
        """True for the logs that a parameter affects: (logs,)."""
        if parameter.run is not None:
            return np.arange(len(self.surface)) == parameter.run
        return (self.surface == parameter.surface) | (parameter.surface is None)

    def inside(self, value: Array) -> Array:
        """The search variables u: the logarithm of each free parameter, or its value."""
        return np.where(self.logarithmic, np.log(np.maximum(value, 1e-12)), value)

    def outside(self, u: Array) -> Array:
        """The values of the free parameters at u: the inverse of `inside`."""
        return np.where(self.logarithmic, np.exp(u), u)

    def filled(self, u: Array) -> np.ndarray:
        """The values of `TABLE` for each log, with the free ones at u: (logs, `TABLE`)."""
        table = self.table.copy()
        for rows, index, value in zip(self.rows, self.index, self.outside(u), strict=True):
            table[rows, index] = value
        return table

    def predictions(self, u: Array = ()) -> np.ndarray:
        """The simulated quantities: (windows, quantities, samples)."""
        return in_lanes(predicted, self.base, self.filled(u)[self.shots.run], self.shots)

    def residuals(self, u: Array) -> np.ndarray:
        """The residuals of all samples, then those of the prior, in one row.

        A residual is 0 if the sample is unknown, and 100 if the prediction is NaN.
        """
        found = self.predictions(u)
        data = np.where(self.known, (found - self.shots.measured) / self.divisor, 0.0)
        prior = self.expected @ (u - self.prior) + self.offset
        return np.concatenate([np.nan_to_num(data, nan=1e2).ravel(), prior])

    def jacobian(self, u: Array) -> np.ndarray:
        """The derivatives of `residuals` over u: (residuals, parameters).

        They are 0 for a window whose motion is chaotic.
        """
        table, rates = self.filled(u), np.where(self.logarithmic, self.outside(u), 1.0)
        # A lane is a window with one group of the parameters that affect it.
        lanes, columns = [], []
        for run in np.unique(self.shots.run):
            affecting = [j for j, rows in enumerate(self.rows) if run in rows]
            affecting += affecting[-1:] * (-len(affecting) % GROUP)  # repeated to full groups
            for window in np.flatnonzero(self.shots.run == run):
                for first in range(0, len(affecting), GROUP):
                    lanes.append(window)
                    columns.append(affecting[first : first + GROUP])
        windows, group = np.array(lanes), np.array(columns)
        shots = jax.tree.map(lambda leaf: leaf[windows], self.shots)
        directions = np.zeros((*group.shape, len(TABLE)))
        rows, members = np.indices(group.shape)
        directions[rows, members, self.index[group]] = rates[group]
        slopes = in_lanes(differentiated, self.base, table[shots.run], shots, directions)
        whole = np.zeros((*self.shots.measured.shape, len(self.parameters)))
        whole[windows[:, None], :, :, group] = slopes
        whole = np.where(self.known[..., None], whole / self.divisor[..., None], 0.0)
        # A motion that turns chaotic within its window has unbounded derivatives. Drop them.
        chaotic = ~(np.abs(whole) * self.width < WILD)
        whole[chaotic.any(axis=(1, 2, 3))] = 0.0
        return np.concatenate([whole.reshape(-1, len(self.parameters)), self.expected])

    @property
    def base(self) -> Car:
        """A car with the values that are not fitted. Surfaces differ in `OF_CAR` alone."""
        return next(iter(self.cars.values()))

    def solve(self, u: Array, passes: int) -> Solved:
        """Minimise from u by the Levenberg-Marquardt method, projected onto the declared ranges.

        If descent would push a parameter beyond its bound, a step leaves that parameter out.
        SciPy's `least_squares` has the same loss and bounds, but both of its methods stop early
        here. Their trust region nearly vanishes when a parameter is close to a bound.
        """
        u = np.clip(u, self.low, self.high)
        fun, damping, evaluations = self.residuals(u), DAMPING, 1
        for _ in range(passes):
            jacobian, evaluations = self.jacobian(u) * self.width, evaluations + 1
            _, slope, bend = self.loss(fun)
            gradient = jacobian.T @ (slope * fun)
            hessian = jacobian.T @ (bend[:, None] * jacobian)
            free = ~(((u <= self.low) & (gradient > 0)) | ((u >= self.high) & (gradient < 0)))
            before = float(self.loss(fun)[0].sum())
            while damping < STUCK:
                block = hessian[np.ix_(free, free)]
                step = np.zeros(len(u))
                step[free] = -np.linalg.solve(
                    block + damping * np.diag(np.diag(block)), gradient[free]
                )
                candidate = np.clip(u + step * self.width, self.low, self.high)
                candidate_fun, evaluations = self.residuals(candidate), evaluations + 1
                if self.loss(candidate_fun)[0].sum() < before:
                    break
                damping *= 4
            else:
                break
            u, fun, damping = candidate, candidate_fun, max(damping / 3, EASY)
            if before - self.loss(fun)[0].sum() < TOLERANCE * before:
                break
        return Solved(u, float(self.loss(fun)[0].sum()), fun, evaluations)

    def loss(self, fun: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`loss` of the samples, and half the squares of the prior. Windows err; a prior does not.

        A robust prior would let a number that the logs hardly tell run off for next to nothing.
        """
        found = loss(fun)
        prior = fun[self.known.size :]
        squares = prior**2 / 2, np.ones(len(prior)), np.ones(len(prior))
        for part, plain in zip(found, squares, strict=True):
            part[self.known.size :] = plain
        return found

    def cars_at(self, u: Array) -> dict[str, Car]:
        """The cars by surface with the fitted values at u. Each keeps its other values."""
        cars = dict(self.cars)
        for p, value in zip(self.parameters, self.outside(u), strict=True):
            for number, name in enumerate(cars):
                if p.path != CHARGE and p.surface in (None, number):
                    cars[name] = changed(cars[name], p.path, np.float64(value))
        return cars

    def charge_at(self, u: Array) -> np.ndarray:
        """The battery charge of each log at u: (logs,)."""
        return self.filled(u)[:, -1]


def with_values(car: Car, values: Array) -> Car:
    """The car with all of `OF_CAR` replaced, in their order."""
    for path, value in zip(OF_CAR, values, strict=True):
        car = changed(car, path, value)
    return car


def shoot(car: Car, values: Array, shot: Shots) -> Array:
    """`shooting.predict` with the values of `TABLE`: (quantities, samples)."""
    return shooting.predict(with_values(car, values[:-1]), shot._replace(charge=values[-1]), STEP)


@jax.jit
def predicted(car: Car, values: Array, shots: Shots) -> Array:
    """`shoot` for each lane of values (lanes, `TABLE`): (lanes, quantities, samples)."""
    return jax.vmap(lambda v, shot: shoot(car, v, shot))(values, shots)


@jax.jit
def differentiated(car: Car, values: Array, shots: Shots, directions: Array) -> Array:
    """The derivatives of `predicted` along directions (lanes, group, `TABLE`).

    Their shape is (lanes, group, quantities, samples).
    """

    def slopes(v: Array, shot: Shots, along: Array) -> Array:
        return jax.vmap(lambda d: jax.jvp(lambda v: shoot(car, v, shot), (v,), (d,))[1])(along)

    return jax.vmap(slopes)(values, shots, directions)


def in_lanes(program: Callable[..., Array], car: Car, *arguments: Any) -> np.ndarray:
    """Call a compiled program for any number of lanes, in blocks of `LANES`, on all cores."""
    count = len(jax.tree.leaves(arguments)[0])

    def block(begin: int) -> np.ndarray:
        rows = np.minimum(np.arange(begin, begin + LANES), count - 1)
        with jax.enable_x64(True):
            part = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), arguments)
            return np.asarray(program(car, *part))[: min(LANES, count - begin)]

    begins = range(0, count, LANES)
    if len(begins) == 1:
        return block(0)
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # compiled code runs in parallel
        return np.concatenate(list(pool.map(block, begins)))


def fit(
    cars: dict[str, Car],
    shots: Shots,
    what: str,
    report: Callable[[str], None] = lambda _: None,
) -> Result:
    """Fit the stage `what`. `all` fits the other stages in `ORDER`, then all parameters at once.

    `cars` are by surface, in the order of the shots' `surface`. They are the prior.

    Gains and trim of the steering are taken from slow driving, where there is enough (`told`). At
    speed a wrong steering and wrong tyres make up for each other, on these logs and no others.

    Each stage also fits the charge of logs that do not state it. The exception is a single log in
    a stage with parameters of `SPEEDS`: one log cannot separate charge and motor.

    Raises `InputError` if no window suits the stage `what`.
    """
    single_log = len(np.unique(shots.run)) == 1
    total, of_slow = 0, []
    if what in ("all", "steering"):
        of_slow = told(shots, next(iter(cars.values())))
    known = {one.path for one in of_slow}
    for one in of_slow:
        cars = {k: changed(car, one.path, np.float64(one.value)) for k, car in cars.items()}
        report(f"{one.path}: {one.value:.4g} from slow driving")
    current, charge = cars, np.full(int(shots.run.max()) + 1, FULL)
    for name in ORDER if what == "all" else (what,):
        stage = STAGES[name]
        free = tuple(path for path in stage.parameters if path not in known)
        if isinstance(shots.commands, SpeedCommand) and set(free) & set(SPEEDS):
            free = (*free, *CONTROLLER)
        if not (single_log and set(free) & set(SPEEDS)):
            free = (*free, CHARGE)
        chosen = stage.chooses(shots)
        if not chosen.any() and name == what:
            raise InputError(f"--fit {what}: no window of these runs tells of it ({stage.needs})")
        if not chosen.any():
            report(f"{name}: no window tells of it")
            continue
        part = select(shots, chosen)
        if name == what:
            only = f" of {len(chosen)}: {stage.needs}" if stage.needs else ""
            report(f"{what}: {int(chosen.sum())} windows{only}")
            break
        problem = Problem(current, part, free, cars, charge)
        solved = problem.solve(problem.start, PASSES)
        total += solved.nfev
        current = problem.cars_at(solved.x)
        charges = problem.charge_at(solved.x)
        charge[: len(charges)] = charges
        report(f"{name}: {int(chosen.sum())} windows, cost {solved.cost:.4g}")
    result = believed(cars, current, part, free, report, charge, total)
    return result._replace(fitted=of_slow + result.fitted)


def told(shots: Shots, car: Car) -> list[Fitted]:
    """What slow driving tells of the steering: gains and trim; none if it tells too little.

        atan(wheelbase · yaw rate / speed) = servo.target(command)

    It needs no tyres, since they hardly slip. Logs count alike. The limits are the car's. A side
    with less than `ENOUGH` windows is not told of.
    """
    chosen = slow(shots)
    command = np.median(shots.commands.steering, axis=1)
    sides = [chosen & (command > STRAIGHT), chosen & (command < -STRAIGHT)]
    paths = [path for path, side in zip(STEERING[:2], sides, strict=True) if side.sum() >= ENOUGH]
    if not paths:
        return []
    paths.append("servo.trim")
    part = select(shots, chosen)
    command, run = command[chosen], shots.run[chosen]
    speed, yaw_rate = motion_of(part)
    angle = np.arctan(float(car.body.wheelbase) * np.median(yaw_rate / speed, axis=1))
    weight = 1 / np.sqrt(np.bincount(run)[run])
    prior = np.array([value_of(car, path) for path in paths])
    width = np.array([GAIN] * (len(paths) - 1) + [ABSOLUTE["servo.trim"]])

    def residuals(values: np.ndarray) -> np.ndarray:
        tried = car
        for path, value in zip(paths, values, strict=True):
            tried = changed(tried, path, np.float64(value))
        off = np.asarray(servo.target(tried.servo, command)) - angle
        return np.concatenate([weight * off / ANGLE, (values - prior) / width])

    with jax.enable_x64(True):
        found = least_squares(residuals, prior, loss="soft_l1", x_scale=width)
    jacobian = np.asarray(found.jac)
    deviation = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))).tolist()
    return [
        Fitted(path, None, None, float(before), float(value), error, error, 0.0, True, False)
        for path, before, value, error in zip(paths, prior, found.x, deviation, strict=True)
    ]


def estimated_charge(cars: dict[str, Car], shots: Shots) -> np.ndarray:
    """The battery charge of each log, as stated or else fitted to its windows: (logs,)."""
    problem = Problem(cars, shots, (CHARGE,))
    if not problem.parameters:
        return problem.table[:, -1]
    return problem.charge_at(problem.solve(problem.start, PASSES).x)


def with_charge(shots: Shots, charge: np.ndarray) -> Shots:
    """The windows with `charge` (logs,) as that of their logs. Logs beyond it have `FULL`."""
    filled = np.full(max(len(charge), int(shots.run.max()) + 1), FULL)
    filled[: len(charge)] = charge
    return shots._replace(charge=filled[shots.run])


def select(shots: Shots, chosen: np.ndarray) -> Shots:
    """The windows that a mask or indices choose."""
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
    """The last fit, with deviations.

    `cars` are the prior. The search starts at `current` and, for each log, at `charge`.
    `evaluations` of earlier stages are added to its own.

    Parameters that the logs do not determine stay where the search ends. Put back at their prior,
    they would take along what the logs tell only of several together.
    """
    problem = Problem(cars, shots, free)
    solved = problem.solve(Problem(current, shots, free, None, charge).start, PASSES)
    evaluations += solved.nfev
    curvature, determined = deviations(problem, solved)
    if not determined.all():
        loose = zip(problem.parameters, determined, strict=True)
        report("not determined: " + ", ".join(sorted({p.path for p, known in loose if not known})))
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
    """A problem with some parameters fixed at the values of its cars."""

    def __init__(self, whole: Problem, free: np.ndarray) -> None:
        """`free` is True for the parameters that stay free: (parameters,)."""
        self.__dict__ |= vars(whole)
        for name in ("parameters", "rows"):
            kept = zip(getattr(whole, name), free, strict=True)
            setattr(self, name, [one for one, stays in kept if stays])
        for name in ("index", "logarithmic", "start", "prior", "low", "high", "width"):
            setattr(self, name, getattr(whole, name)[free])
        fixed = whole.start[~free] - whole.prior[~free]
        self.expected = whole.expected[:, free]
        self.offset = whole.offset + whole.expected[:, ~free] @ fixed


def deviations(problem: Problem, solved: Solved) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations from the curvature of the cost, and the mask of determined parameters.

    deviation = sqrt(diag(inverse(D'D / noise + P'P))), where D and P are the Jacobian's rows of
    data and prior. They are weighted by the curvature of the loss. A window counts as one
    observation of each quantity, since w contains 1/sqrt(samples). noise is the sum of
    the squared residuals, each at most `GROSS`, over the observations. It is at least 1.

    The parameter whose deviation is largest beside its prior one is fixed. This repeats until
    all remaining ratios are below `KNOWN`. If the data give only the sum of two parameters, one
    of them is fixed and the other is determined.
    """
    count = len(problem.parameters)
    observations = max(1, int(problem.known[:, :, -1].sum()))
    weighted = np.sqrt(problem.loss(solved.fun)[2])[:, None] * problem.jacobian(solved.x)
    samples = problem.known.size
    data, prior = weighted[:samples], weighted[samples:]
    noise = max(1.0, float(np.sum(np.minimum(solved.fun[:samples] ** 2, GROSS)) / observations))
    information = data.T @ data / noise + prior.T @ prior
    left = list(range(count))
    deviation = problem.width.copy()
    while left:
        block = np.ix_(left, left)
        posterior, before = (
            np.sqrt(np.diag(np.linalg.pinv(matrix[block])))
            for matrix in (information, prior.T @ prior)
        )
        deviation[left] = posterior
        worst = int(np.argmax(posterior / before))
        if posterior[worst] < KNOWN * before[worst]:
            break
        del left[worst]
    determined = np.isin(np.arange(count), left)
    return deviation, determined


def halves(run: np.ndarray) -> np.ndarray:
    """The half of each window, 0 or 1: (windows,). `run` is the index of its log.

    Windows in the order of their logs are cut into eighths. The even eighths are one half, the odd
    ones the other. Fewer than eight windows go to the halves by turns.
    """
    rank = np.argsort(np.argsort(run, kind="stable"))
    pieces = min(8, len(rank))
    return np.asarray(rank * pieces // len(rank) % 2)


def by_halves(whole: Problem, determined: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Half the difference between fits to two halves of the data: (parameters,).

    The result is 0 for a parameter whose surface or log is in one half only, and for all
    parameters with a single window.
    """
    half_of = halves(whole.shots.run)
    if len(half_of) < 2:
        return np.zeros(len(u))
    cars, charge = whole.cars_at(u), whole.charge_at(u)
    ends, in_both = np.tile(u, (2, 1)), np.full(len(u), True)
    for half, end in enumerate(ends):
        part = select(whole.shots, half_of == half)
        paths = list(dict.fromkeys(p.path for p in whole.parameters))
        problem = Problem(cars, part, paths, whole.cars, charge)
        columns = np.array([whole.parameters.index(p) for p in problem.parameters], int)
        free = determined[columns]
        end[columns[free]] = Held(problem, free).solve(u[columns[free]], 12).x
        in_both &= np.isin(np.arange(len(u)), columns)
    return np.where(in_both, np.abs(ends[1] - ends[0]) / 2, 0.0)


def errors(predicted: np.ndarray, shots: Shots) -> dict[str, Any]:
    """Errors of each measured quantity: simulated, and by persistence (no change after the start).

    `predicted` is what `Problem.predictions` returns. Each quantity has two numbers:
    `median_abs_error` at the ends of windows, and `rmse` over all.
    """
    start = np.stack(
        [shots.velocity.x, shots.velocity.y, shots.velocity.yaw, shots.wheel_speed], axis=1
    )[:, :, None]
    result: dict[str, Any] = {"windows": len(shots.surface)}
    for name, prediction in (("simulated", predicted), ("persistence", start)):
        error = prediction - shots.measured
        result[name] = {
            quantity: {
                "median_abs_error": float(np.nanmedian(np.abs(error[:, i, -1]))),
                "rmse": float(np.sqrt(np.nanmean(error[:, i] ** 2))),
            }
            for i, quantity in enumerate(QUANTITIES)
            if np.isfinite(shots.measured[:, i, -1]).any()
        }
    return result
