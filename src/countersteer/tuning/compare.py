"""A log against the simulator: open loop on the log's own commands, from many instants of it.

A window starts from the measured state and runs to its end without looking at the log again, but
for the commands. Windows start every 0.25 s where the dead-man switch is closed throughout and the
speed is at least 0.2 m/s, and at each throttle onset from rest. The reference is motion capture, or
the state itself where the run was simulated. Where there is neither, it is the logged encoder and
gyroscope, against simulated ones with the same lag and quantum.

How full the battery was, logs seldom tell, and a pack nearly empty turns the wheels a fifth slower.
Where `run.toml` does not, it is one number for the whole log, chosen so that the windows agree best
(`agreeing_charge`); the errors with a full battery stand beside.

A steady drift is predicted by doing nothing. So the same errors are given for the prediction that
nothing changes (`persistence`), and all of it for those windows in which something does
(`transient`), and for those in which the car drives forward and slides (`sliding`).
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize_scalar

from countersteer.car.car import Car
from countersteer.errors import InputError
from countersteer.runs.run import Run
from countersteer.tuning import fit
from countersteer.tuning.windows import (
    CHANGES,
    EARLY,
    QUANTITIES,
    SLOWEST,
    Measured,
    Reference,
    find_references,
    read_measured,
    simulate,
    speed_at,
    states_at,
    window_starts,
)

if TYPE_CHECKING:
    pass

HORIZON = 1.0  # s, unless given
SAMPLE = 0.01  # s between the instants at which states are compared
SLIDE = math.radians(20)  # sideslip that a sliding window reaches
CHARGED_BY = 128  # windows of a log, at most, that its battery is judged by
CHARGE_WITHIN = 0.01  # of a full one


class Compared(NamedTuple):
    """One quantity in one window."""

    time: np.ndarray  # s
    measured: np.ndarray
    simulated: np.ndarray
    unchanged: np.ndarray  # predicted by doing nothing


Window = dict[str, Compared]  # by quantity


def compare(
    run: Run, car: Car, horizon: float | None = HORIZON, dt: float = 0.001
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare a car with a log of it over windows of `horizon` seconds, at steps of dt seconds.

    Without a horizon there is one window, from the first command to the last. Returns what the
    command line prints as JSON, and the series that `draw_comparison` draws: `median_abs_error` is
    at the windows' ends (the last reading before it, for a sensor), `rmse` over the whole of them.
    Windows that lack a reference are dropped; raises `InputError` where none is left.

    Not in the log and taken as known: nothing was asked of the car before the first command; the
    servo is where the car's own law puts it for these commands; the battery is as `run.toml` says,
    or else as full as agrees best (then `as_if_full` has the errors with a full one).
    """
    if horizon is not None and not dt <= horizon < math.inf:
        raise InputError(f"--horizon {horizon:g}: give at least a step of {dt:g} s, or run")
    car = jax.tree.map(np.float64, car)
    measured = read_measured(run, car)
    commands = run.commands
    if horizon is None:
        first, last = float(commands["time_s"][0]), float(commands["time_s"][-1])
        starts = np.array([math.ceil(first / dt - EARLY)])
        resting = speed_at(measured, starts * dt, True) < SLOWEST
        ticks = math.floor(last / dt + EARLY) - int(starts[0])
        if ticks < 1:
            raise InputError(f"{run.path}: holds no time between its first command and its last")
    else:
        ticks = max(1, round(horizon / dt))
        starts, resting = window_starts(measured, commands, ticks, dt)
    if len(starts) == 0:
        raise InputError(
            f"{run.path}: no window of {ticks * dt:g} s in which the dead-man switch is closed and "
            f"the car starts at {SLOWEST:g} m/s or more, or from rest with a throttle onset"
        )
    known = "battery_charge" in run.about
    full = {**run.about, "battery_charge": fit.FULL}
    run = run if known else dataclasses.replace(run, about=full)
    whole = horizon is None
    simulation = Simulation(run, car, measured, starts, resting, ticks, dt, whole)
    windows, kept = simulation.windows()
    if not windows:
        raise InputError(
            f"{run.path}: no window of {ticks * dt:g} s has a whole reference: motion capture, or "
            "wheel_speed_mps and gyro_radps in telemetry.csv"
        )
    charge, as_if_full = float(run.about["battery_charge"]), {}
    if not known:
        as_if_full = {"as_if_full": scores(windows)}
        charge = agreeing_charge(run, car, measured, dt)
        windows, kept = simulation.windows(charge)
    lively = [window for window in windows if changes(window)]
    sliding = [window for window in windows if slides(window)]
    result = {
        "windows": len(windows),
        "horizon_s": round(ticks * dt, 9),
        "battery_charge": charge,
        "battery_known": known,
        **scores(windows),
        **as_if_full,
        "transient": {"windows": len(lively), **scores(lively)},
        "sliding": {"windows": len(sliding), **scores(sliding)},
    }
    series_of_all = {
        "title": run.path.name,
        "result": result,
        "starts_s": kept,
        "windows": windows,
        "measured": {n: reference.signal for n, reference in simulation.references.items()},
        "commands": commands,
        "armed": measured.armed,
    }
    return result, series_of_all


class Simulation:
    """A log's windows, simulated from what was measured at their starts."""

    def __init__(
        self,
        run: Run,
        car: Car,
        measured: Measured,
        starts: np.ndarray,
        resting: np.ndarray,
        ticks: int,
        dt: float,
        whole: bool,
    ) -> None:
        """Windows of so many ticks; see `compared` for `whole`."""
        self.car, self.commands, self.ticks, self.dt = car, run.commands, ticks, dt
        self.references, self.whole = find_references(measured), whole
        with jax.enable_x64(True):
            states = states_at(run, car, measured, starts, resting, dt)
        known = np.isfinite(states.motion.vx + states.motion.vy + states.motion.yaw_rate)
        self.starts, self.resting = starts[known], resting[known]
        self.states = jax.tree.map(lambda leaf: leaf[known], states)

    def windows(self, charge: float | None = None) -> tuple[list[Window], list[float]]:
        """Those that have a reference, and when they start (s); with another charge, if given."""
        if not len(self.starts):
            return [], []
        states, dt = self.states, self.dt
        if charge is not None:
            motion = states.motion
            states = states._replace(motion=motion._replace(charge=0 * motion.charge + charge))
        with jax.enable_x64(True):
            predicted = simulate(self.car, states, self.commands, self.starts, self.ticks, dt)
        found: list[Window] = []
        kept = []
        for i, start in enumerate(self.starts.tolist()):
            series = {name: values[i] for name, values in predicted.items()}
            window = compared(
                self.references, series, start * dt, dt, bool(self.resting[i]), self.whole
            )
            if window is not None:
                found.append(window)
                kept.append(start * dt)
        return found, kept


def agreeing_charge(run: Run, car: Car, measured: Measured, dt: float) -> float:
    """How full the battery was, by the same cost over windows of a log as `fit` minimises."""
    ticks = round(fit.HORIZON / dt)
    starts, resting = window_starts(measured, run.commands, ticks, dt)
    chosen = np.arange(0, len(starts), max(1, math.ceil(len(starts) / CHARGED_BY)))
    if not len(chosen):
        return fit.FULL
    simulation = Simulation(
        run, car, measured, starts[chosen], resting[chosen], ticks, dt, whole=False
    )

    def cost(charge: float) -> float:
        residuals = [
            (one.simulated - one.measured) / scale / math.sqrt(len(one.time))
            for window in simulation.windows(charge)[0]
            for name, scale in zip(QUANTITIES, fit.SCALES, strict=True)
            if (one := window.get(name)) is not None
        ]
        expected = (charge - fit.FULL) / fit.ABSOLUTE[fit.CHARGE]
        return float(fit.loss(np.append(np.concatenate([*residuals, []]), expected))[0].sum())

    found = minimize_scalar(
        cost, bounds=(0.0, fit.FULL), method="bounded", options={"xatol": CHARGE_WITHIN}
    )
    return float(found.x) if found.fun < cost(fit.FULL) else fit.FULL


# -------------------------------------------------------------------------------------------------
# Errors
# -------------------------------------------------------------------------------------------------


def compared(
    references: Mapping[str, Reference],
    predicted: Mapping[str, np.ndarray],
    start: float,
    dt: float,
    resting: bool,
    whole: bool,
) -> Window | None:
    """Make a window of simulated quantities, a value a tick; None where a reference is missing.

    A sensor may have no reading in a short window, as long as there is a state to compare with.
    With `whole`, what is missing is left out and the rest compared.
    """
    ticks = len(next(iter(predicted.values()))) - 1
    time = start + dt * np.arange(ticks + 1)
    every = max(1, round(SAMPLE / dt))
    samples = time[np.unique([*range(every, ticks + 1, every), ticks])]
    window: Window = {}
    for name, reference in references.items():
        signal = reference.signal
        at = samples
        if reference.timing is not None:
            at = signal.time[(signal.time > start + EARLY) & (signal.time <= time[-1] + EARLY)]
        truth = signal.at(at)
        known = np.isfinite(truth)
        if not whole and not np.all(known):
            return None
        if np.any(known):
            at, truth = at[known], truth[known]
            values = predicted[name]
            still = np.full(len(values), values[0])
            simulated, unchanged = (
                sensed(reference, time, series, at, resting) for series in (values, still)
            )
            window[name] = Compared(at, truth, simulated, unchanged)
    states = [name for name, reference in references.items() if reference.timing is None]
    if not window or any(name not in window for name in states):
        return None
    return window


def sensed(
    reference: Reference, time: np.ndarray, values: np.ndarray, at: np.ndarray, resting: bool
) -> np.ndarray:
    """Give what the reference's sensor would have reported at these times of a window.

    Readings early in a window reach back before its start: there, the measured quantity is taken.
    """
    if reference.timing is None:
        return np.interp(at, time, values)
    lag, over, step = reference.timing
    before = time[0] + np.arange(-(lag + over), -1e-9, SAMPLE)
    past = reference.undone(before, resting)
    past = np.where(np.isfinite(past), past, values[0])
    time, values = np.concatenate([before, time]), np.concatenate([past, values])
    middle = at - lag
    if over:
        area = np.concatenate([[0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2)])
        ends = [np.interp(middle + side * over / 2, time, area) for side in (-1, 1)]
        read = (ends[1] - ends[0]) / over
    else:
        read = np.interp(middle, time, values)
    return np.rint(read / step) * step if step else read


def changes(window: Window) -> bool:
    """Whether the motion departs from where it started by as much as `CHANGES`.

    Where the forward velocity is not measured, the wheel speed stands for it.
    """
    limits = CHANGES if "vx_mps" in window else CHANGES | {"wheel_speed_mps": CHANGES["vx_mps"]}
    return any(
        np.any(np.abs(window[name].measured - window[name].unchanged) > limit)
        for name, limit in limits.items()
        if name in window
    )


def slides(window: Window) -> bool:
    """Whether the car goes forward all through the window and reaches `SLIDE`, as measured."""
    if not {"vx_mps", "vy_mps"} <= window.keys():
        return False
    both = (window["vx_mps"], window["vy_mps"])
    vx, vy = (np.append(one.unchanged[:1], one.measured) for one in both)
    return bool(np.all(vx > 0) and np.any(np.arctan2(np.abs(vy), vx) >= SLIDE))


def scores(windows: Iterable[Window]) -> dict[str, Any]:
    """Both measures of error, by quantity, of the simulation and of the unchanging state."""
    windows = list(windows)
    result: dict[str, Any] = {"median_abs_error": {}, "rmse": {}}
    still: dict[str, Any] = {"median_abs_error": {}, "rmse": {}}
    for name in QUANTITIES:
        with_it = [window[name] for window in windows if name in window]
        if not with_it:
            continue
        for scored, errors in (
            (result, [one.simulated - one.measured for one in with_it]),
            (still, [one.unchanged - one.measured for one in with_it]),
        ):
            ends = [abs(error[-1]) for error in errors]
            scored["median_abs_error"][name] = float(np.median(ends))
            scored["rmse"][name] = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    return {**result, "persistence": still}
