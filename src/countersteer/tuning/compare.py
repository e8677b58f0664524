"""Compare a log with the simulator in many windows, open loop on the log's own commands.

A window starts from the measured state. After that, the simulation gets only the log's commands.
Windows start every 0.25 s at 0.2 m/s or more, and at each throttle onset from rest. The dead-man
switch is closed throughout a window. The reference is motion capture, or the state itself for a
simulated run. Without both, it is the logged encoder and gyroscope. They are compared with
simulated sensors of the same lag and quantum.

Logs seldom state the battery charge, and a nearly empty pack turns the wheels a fifth slower. If
neither `run.toml` nor the log's voltmeter tells it, one charge for the whole log is fitted to the
windows (`agreeing_charge`). The errors with a full battery are given too.

A steady drift is predicted well by persistence, the prediction that nothing changes. So the same
errors are given for `persistence`. All errors are repeated for windows in which something changes
(`transient`), for the others (`steady`), and for windows in which the car drives forward and slides
(`sliding`).
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize_scalar

from countersteer.car.car import Car
from countersteer.errors import InputError
from countersteer.runs import defects
from countersteer.runs.run import Run
from countersteer.tuning import belief, fit
from countersteer.tuning.log_sensors import LogSensors, resolve
from countersteer.tuning.windows import (
    CHANGES,
    EARLY,
    MEAN,
    QUANTITIES,
    SLOWEST,
    VELOCITY,
    Measured,
    Reference,
    find_references,
    measured_for,
    simulate,
    speed_at,
    states_at,
    why_no_window,
    window_starts,
)

if TYPE_CHECKING:
    pass

HORIZON = 1.0  # s, by default
SAMPLE = 0.01  # s between compared states
SLIDE = math.radians(20)  # least peak sideslip of a sliding window
CHARGED_BY = 128  # most windows of a log in the fit of its battery charge
CHARGE_WITHIN = 0.01  # tolerance of the fitted charge; a full battery has 1


class Compared(NamedTuple):
    """One quantity in one window, at the compared instants."""

    time: np.ndarray  # s
    measured: np.ndarray
    simulated: np.ndarray
    unchanged: np.ndarray  # predicted by persistence


Window = dict[str, Compared]  # by quantity


def compare(
    run: Run, car: Car, horizon: float | None = HORIZON, dt: float = 0.001
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare a car with a log of it over windows of `horizon` seconds, at steps of dt seconds.

    Without a horizon there is one window, from the first command to the last. Returns the JSON of
    the command line, and the series for `draw_comparison`. `median_abs_error` is taken at the ends
    of windows (for a sensor, at the last reading before), `rmse` over whole windows. Windows
    without a reference are dropped. Raises `InputError` if none is left.

    Three assumptions replace what a log lacks. There was no command before the first one. The
    servo follows the car's own law. The battery has the charge of `run.toml` or of the voltmeter,
    or else the one that agrees best; then `as_if_full` has the errors with a full battery.

    `sensors` has what the log tells of its sensors. `warnings` has a line for each reason not to
    believe the car on this log (`belief`), and for each doubt about the log itself.
    """
    simulation, sensors, repairs = simulation_of(run, car, horizon, dt)
    run, commands = simulation.run, simulation.run.commands
    known = "battery_charge" in sensors.run.about
    windows, kept = simulation.windows()
    if not windows:
        raise InputError(
            f"{run.path}: no window of {simulation.ticks * dt:g} s has a whole reference: "
            + " and ".join(simulation.references or ("motion capture",))
            + " are known in none throughout"
        )
    charge, as_if_full = float(run.about["battery_charge"]), {}
    if not known:
        as_if_full = {"as_if_full": scores(windows)}
        charge = agreeing_charge(run, simulation.car, simulation.measured, dt)
        windows, kept = simulation.windows(charge)
    lively = [window for window in windows if changes(window)]
    steady = [window for window in windows if not changes(window)]
    sliding = [window for window in windows if slides(window)]
    result = {
        "windows": len(windows),
        "horizon_s": round(simulation.ticks * dt, 9),
        "battery_charge": charge,
        "battery_known": known,
        "battery_from": sensors.charge_from or "fit",
        **scores(windows),
        **as_if_full,
        "steady": {"windows": len(steady), **scores(steady)},
        "transient": {"windows": len(lively), **scores(lively)},
        "sliding": {"windows": len(sliding), **scores(sliding)},
        "spins": belief.spin_count(motions(windows)),
        "sensors": sensors.as_json(),
    }
    doubts = belief.of_comparison(result, yaw_rates(windows))
    result["warnings"] = [*doubts, *repairs, *sensors.warnings]
    series_of_all = {
        "title": run.path.name,
        "result": result,
        "starts_s": kept,
        "windows": windows,
        "measured": {n: reference.signal for n, reference in simulation.references.items()},
        "commands": commands,
        "armed": simulation.measured.armed,
    }
    return result, series_of_all


def simulation_of(
    run: Run, car: Car, horizon: float | None, dt: float
) -> tuple["Simulation", LogSensors, list[str]]:
    """The windows of a log for a car, what the log tells of its sensors, and a line a repair.

    A battery whose charge neither `run.toml` nor the voltmeter tells is full. Raises `InputError`
    if the log has no window of `horizon` seconds. Without a horizon, the whole log is one window.
    """
    if horizon is not None and not dt <= horizon < math.inf:
        raise InputError(f"--horizon {horizon:g}: give at least a step of {dt:g} s, or run")
    car = jax.tree.map(np.float64, car)
    defects.refuse(run, car)
    run, repairs = defects.repair(run)
    sensors = resolve(run, car, dt)
    run = sensors.run
    measured = measured_for(run, car)
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
        raise InputError(why_no_window(run, measured, ticks * dt))
    if "battery_charge" not in run.about:
        run = dataclasses.replace(run, about={**run.about, "battery_charge": fit.FULL})
    whole = horizon is None
    return Simulation(run, car, measured, starts, resting, ticks, dt, whole), sensors, repairs


class Simulation:
    """A log's windows, each simulated from the measured state at its start."""

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
        """`starts` are ticks, and a window has `ticks` of them. See `compared` for `whole`."""
        self.run, self.car, self.measured, self.ticks, self.dt = run, car, measured, ticks, dt
        self.references, self.whole = find_references(measured), whole
        wheel = self.references.get("wheel_speed_mps")
        self.sees = MEAN if wheel is None else wheel.sees
        with jax.enable_x64(True):
            states = states_at(run, car, measured, starts, resting, dt)
        known = np.isfinite(states.motion.vx + states.motion.vy + states.motion.yaw_rate)
        self.starts, self.resting = starts[known], resting[known]
        self.states = jax.tree.map(lambda leaf: leaf[known], states)

    def windows(self, charge: float | None = None) -> tuple[list[Window], list[float]]:
        """The windows with a reference, and their start times (s). `charge` replaces the run's."""
        if not len(self.starts):
            return [], []
        states = self.states
        if charge is not None:
            motion = states.motion
            states = states._replace(motion=motion._replace(charge=0 * motion.charge + charge))
        with jax.enable_x64(True):
            predicted = simulate(
                self.car, states, self.run.commands, self.starts, self.ticks, self.dt, self.sees
            )
        return self.windows_of(predicted)

    def windows_of(self, predicted: Mapping[str, np.ndarray]) -> tuple[list[Window], list[float]]:
        """The windows as `predicted` by anyone: quantities at each tick, (windows, ticks + 1)."""
        found: list[Window] = []
        kept = []
        for i, start in enumerate(self.starts.tolist()):
            series = {name: values[i] for name, values in predicted.items()}
            window = compared(
                self.references,
                series,
                start * self.dt,
                self.dt,
                bool(self.resting[i]),
                self.whole,
            )
            if window is not None:
                found.append(window)
                kept.append(start * self.dt)
        return found, kept


def agreeing_charge(run: Run, car: Car, measured: Measured, dt: float) -> float:
    """The battery charge that minimises the cost of `fit` over the windows of a log."""
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
        return float(fit.loss(np.concatenate([*residuals, []]))[0].sum() + expected**2 / 2)

    found = minimize_scalar(
        cost, bounds=(fit.EMPTY, fit.FULL), method="bounded", options={"xatol": CHARGE_WITHIN}
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
    """A window of simulated quantities with a value for each tick; None if a reference is missing.

    A sensor without a reading in a short window is left out, if another quantity can be compared.
    With `whole`, samples without a reference are left out too.
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
    """The simulated readings of the reference's sensor at the times `at` of a window.

    Early readings cover time before the start of the window. The measured quantity is used there.
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
    """True if the motion changes from its start by more than `CHANGES`.

    The wheel speed replaces a forward velocity that was not measured.
    """
    limits = CHANGES if "vx_mps" in window else CHANGES | {"wheel_speed_mps": CHANGES["vx_mps"]}
    return any(
        np.any(np.abs(window[name].measured - window[name].unchanged) > limit)
        for name, limit in limits.items()
        if name in window
    )


def slides(window: Window) -> bool:
    """True if the measured car drives forward throughout the window and reaches `SLIDE`."""
    if not {"vx_mps", "vy_mps"} <= window.keys():
        return False
    both = (window["vx_mps"], window["vy_mps"])
    vx, vy = (np.append(one.unchanged[:1], one.measured) for one in both)
    return bool(np.all(vx > 0) and np.any(np.arctan2(np.abs(vy), vx) >= SLIDE))


def motions(windows: Iterable[Window]) -> Iterator[tuple[belief.Motion, belief.Motion]]:
    """Measured and simulated motion of the body in the windows that have it whole."""
    for window in windows:
        if all(name in window for name in VELOCITY):
            vx, vy, yaw_rate = (window[name] for name in VELOCITY)
            yield (
                (vx.measured, vy.measured, yaw_rate.measured),
                (vx.simulated, vy.simulated, yaw_rate.simulated),
            )


def yaw_rates(windows: Iterable[Window]) -> np.ndarray:
    """The yaw rate (rad/s) as measured at the ends of the windows that have it."""
    name = "yaw_rate_radps"
    return np.array([window[name].measured[-1] for window in windows if name in window])


def scores(windows: Iterable[Window]) -> dict[str, Any]:
    """Both measures of error, by quantity, of the simulation and of persistence."""
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
