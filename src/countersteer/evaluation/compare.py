"""A log against the simulator: open loop on the log's own commands, from many instants of it.

A window starts from the measured state and runs to its end without looking at the log again, but
for the commands. Windows start every 0.25 s where the dead-man switch is closed throughout and the
speed is at least 0.2 m/s, and at each throttle onset from rest. The reference is motion capture, or
the state itself where the run was simulated. Where there is neither, it is the logged encoder and
gyroscope, against simulated ones with the same lag and quantum.

A steady drift is predicted by doing nothing. So the same errors are given for the prediction that
nothing changes (`persistence`), and all of it for those windows in which something does
(`transient`).
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

from countersteer.car.car import Car, Wheels
from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.runs.run import Run
from countersteer.world import motor, planar, servo
from countersteer.world.chassis import Vector, dot
from countersteer.world.planar import Command
from countersteer.world.state import Motion, State

if TYPE_CHECKING:
    pass

QUANTITIES = ("vx_mps", "vy_mps", "yaw_rate_radps", "wheel_speed_mps")
HORIZON = 1.0  # s, unless told
EVERY = 0.25  # s between the starts of windows
SLOWEST = 0.2  # m/s from which a window starts
CHANGES = {"vx_mps": 0.3, "vy_mps": 0.3, "yaw_rate_radps": 1.0}  # that make a window transient

SMOOTHED_OVER, DEGREE = 0.15, 3  # s and degree of the Savitzky-Golay filter
GAP = 0.035  # s without motion capture over which nothing is interpolated

# Lags of the DART car's sensors, from the instant to the row in which its reading first appears,
# measured against motion capture on the four recordings that have it. The gyroscope's is sharp
# (rms 0.07 rad/s at 0.05 s, 0.16 to 0.41 at 0.09 s); the encoder's is that of straight driving in
# grip (rms 0.024 m/s at 0.055 s, 0.08 at 0.13 s), about half of the 0.1 s over which it counts. The
# 0.09 s and 0.11 to 0.15 s that have been reported for these logs are those of the columns as they
# stand in the file, which hold each reading for 0.1 s and so are 0.05 s later on average.
ENCODER_LAG, ENCODER_COUNTS = 0.06, 0.1  # s: lag of its middle, and time over which it counts
ENCODER_QUANTUM = 0.0413  # m/s
GYRO_LAG = 0.05  # s

SAMPLE = 0.01  # s between the instants at which states are compared
PIECE = 250  # ticks in a call of the compiled program, whatever the horizon
MOST_WINDOWS = 256  # simulated at once
EARLY = 1e-6  # s by which a command may come early, for times that were rounded


class Signal(NamedTuple):
    """Something over time; NaN where it is not known."""

    time: np.ndarray  # s, rising
    value: np.ndarray

    def at(self, time: np.ndarray) -> np.ndarray:
        """Interpolate; NaN outside and beside what is not known."""
        return np.interp(time, self.time, self.value, left=math.nan, right=math.nan)


class Measured(NamedTuple):
    """What a log says about the car's motion, in SI units; None where it says nothing."""

    vx: Signal | None  # with vy and yaw_rate; of the centre of mass in the body's axes
    vy: Signal | None
    yaw_rate: Signal | None
    wheels: tuple[Signal, ...] | None  # spin of the four, known for simulated cars alone
    encoder: Signal | None  # as reported
    gyro: Signal | None
    armed: Signal | None  # dead-man switch, held between its reports; None: always closed


class Reference(NamedTuple):
    """A quantity that simulated ones are compared with.

    A reading of a sensor shows what was `lag` seconds before, on average over a time of `over`, in
    steps of `quantum`. A state has none of it.
    """

    signal: Signal
    sensor: bool
    lag: float = 0.0
    over: float = 0.0
    quantum: float = 0.0

    def undone(self) -> Signal:
        """The quantity itself, as far as the sensor tells."""
        return self.signal._replace(time=self.signal.time - self.lag)


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
    battery is as full as `run.toml` says, or else full; the servo is where the car's own law puts
    it for these commands.
    """
    if horizon is not None and not dt <= horizon < math.inf:
        raise InputError(f"--horizon {horizon:g}: give at least a step of {dt:g} s, or run")
    car = jax.tree.map(np.float64, car)
    measured = read_measured(run, car)
    references = find_references(measured)
    commands = run.commands
    if horizon is None:
        first, last = float(commands["time_s"][0]), float(commands["time_s"][-1])
        starts = np.array([math.ceil(first / dt - EARLY)])
        ticks = math.floor(last / dt + EARLY) - int(starts[0])
        if ticks < 1:
            raise InputError(f"{run.path}: holds no time between its first command and its last")
    else:
        ticks = max(1, round(horizon / dt))
        starts = window_starts(measured, commands, ticks, dt)
    if len(starts) == 0:
        raise InputError(
            f"{run.path}: no window of {ticks * dt:g} s in which the dead-man switch is closed and "
            f"the car starts at {SLOWEST:g} m/s or more, or from rest with a throttle onset"
        )
    with jax.enable_x64(True):
        states = states_at(run, car, measured, starts, ticks, dt)
        known = np.isfinite(states.motion.vx + states.motion.vy + states.motion.yaw_rate)
        starts, states = starts[known], jax.tree.map(lambda leaf: leaf[known], states)
        predicted = simulate(car, states, commands, starts, ticks, dt) if len(starts) else {}
    whole = horizon is None
    windows: list[Window] = []
    kept = []
    for i, start in enumerate(starts.tolist()):
        series = {name: values[i] for name, values in predicted.items()}
        window = compared(references, series, start * dt, dt, whole)
        if window is not None:
            windows.append(window)
            kept.append(start * dt)
    if not windows:
        raise InputError(
            f"{run.path}: no window of {ticks * dt:g} s has a whole reference: motion capture, or "
            "wheel_speed_mps and gyro_radps in telemetry.csv"
        )
    lively = [window for window in windows if changes(window)]
    result = {
        "windows": len(windows),
        "horizon_s": ticks * dt,
        **scores(windows),
        "transient": {"windows": len(lively), **scores(lively)},
    }
    series_of_all = {
        "title": run.path.name,
        "result": result,
        "starts_s": kept,
        "windows": windows,
        "measured": {name: reference.signal for name, reference in references.items()},
        "commands": commands,
        "armed": measured.armed,
    }
    return result, series_of_all


# -------------------------------------------------------------------------------------------------
# What was measured
# -------------------------------------------------------------------------------------------------


def read_measured(run: Run, car: Car) -> Measured:
    """Body velocities and wheel speeds of a run, and the readings of its sensors."""
    vx = vy = yaw_rate = wheels = None
    truth = run.truth
    if truth is not None and len(truth):
        time = truth["time_s"]
        if {"vx_mps", "vy_mps", "yaw_rate_radps"} <= truth.keys():
            vx = Signal(time, truth["vx_mps"])
            vy = Signal(time, truth["vy_mps"])
            yaw_rate = Signal(time, truth["yaw_rate_radps"])
        else:
            vx, vy, yaw_rate = velocities(time, truth["x_m"], truth["y_m"], truth["heading_rad"])
        names = [f"wheel_{place}_radps" for place in ("fl", "fr", "rl", "rr")]
        if set(names) <= truth.keys():
            radii = (float(tire.radius) for tire in planar.tires_by_wheel(car))  # type: ignore[attr-defined]
            wheels = tuple(
                Signal(time, radius * truth[name])
                for radius, name in zip(radii, names, strict=True)
            )
    telemetry = run.telemetry if run.telemetry is not None else Table()
    return Measured(
        vx,
        vy,
        yaw_rate,
        wheels,
        _reported(telemetry, "wheel_speed_mps"),
        _reported(telemetry, "gyro_radps"),
        _reported(telemetry, "armed"),
    )


def _reported(table: Table, name: str) -> Signal | None:
    """A sensor's readings, without the rows in which it had nothing new."""
    if name not in table or not np.any(np.isfinite(table[name])):
        return None
    there = np.isfinite(table[name])
    return Signal(table["time_s"][there], table[name][there])


def velocities(
    time: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray
) -> tuple[Signal, Signal, Signal]:
    """Forward and lateral velocity (m/s) and yaw rate (rad/s) from poses.

    A cubic Savitzky-Golay filter over 0.15 s on poses resampled evenly; NaN where motion capture
    paused for longer than `GAP`, and where less than the filter's width of it is left.
    """
    there = np.isfinite(x + y + heading)
    time, x, y, heading = time[there], x[there], y[there], heading[there]
    none = Signal(np.zeros(1), np.full(1, math.nan))
    if len(time) < 2 or not np.median(np.diff(time)) > 0:
        return none, none, none
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1] + step / 2, step)
    after = np.clip(np.searchsorted(time, grid, side="right"), 1, len(time) - 1)
    known = time[after] - time[after - 1] <= max(GAP, 1.5 * step)
    width = max(DEGREE + 2, 2 * round(SMOOTHED_OVER / step / 2) + 1)
    out = np.full((3, len(grid)), math.nan)
    for begin, end in _pieces(known):
        if end - begin < width:
            continue
        pose = np.stack([np.interp(grid[begin:end], time, v) for v in (x, y, heading)])
        rates = savgol_filter(pose, width, DEGREE, deriv=1, delta=step)
        angle = savgol_filter(pose[2], width, DEGREE)
        cosine, sine = np.cos(angle), np.sin(angle)
        out[0, begin:end] = cosine * rates[0] + sine * rates[1]
        out[1, begin:end] = cosine * rates[1] - sine * rates[0]
        out[2, begin:end] = rates[2]
    return Signal(grid, out[0]), Signal(grid, out[1]), Signal(grid, out[2])


def _pieces(known: np.ndarray) -> Iterator[tuple[int, int]]:
    """Begin and end of each run of True."""
    edges = np.nonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))[0]
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def find_references(measured: Measured) -> dict[str, Reference]:
    """What the log holds of each quantity."""
    found: dict[str, Reference] = {}
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        found["vx_mps"] = Reference(measured.vx, sensor=False)
        found["vy_mps"] = Reference(measured.vy, sensor=False)
        found["yaw_rate_radps"] = Reference(measured.yaw_rate, sensor=False)
    elif measured.gyro is not None:
        found["yaw_rate_radps"] = Reference(measured.gyro, sensor=True, lag=GYRO_LAG)
    if measured.wheels is not None:
        mean = np.mean([wheel.value for wheel in measured.wheels], axis=0)
        found["wheel_speed_mps"] = Reference(Signal(measured.wheels[0].time, mean), sensor=False)
    elif measured.encoder is not None:
        found["wheel_speed_mps"] = Reference(
            measured.encoder, True, ENCODER_LAG, ENCODER_COUNTS, ENCODER_QUANTUM
        )
    return found


def window_starts(measured: Measured, commands: Table, ticks: int, dt: float) -> np.ndarray:
    """Ticks at which windows of so many ticks may start."""
    times = commands["time_s"]
    first, last = float(times[0]), float(times[-1])
    regular = np.arange(math.ceil(first / EVERY) * EVERY, last + EARLY, EVERY)
    throttle = commands["throttle"]
    onsets = times[(np.concatenate([[0.0], throttle[:-1]]) == 0) & (throttle > 0)]
    starts = np.concatenate(
        [
            np.rint(regular[_speed(measured, regular) >= SLOWEST] / dt),
            np.ceil(onsets[_speed(measured, onsets) < SLOWEST] / dt - EARLY),
        ]
    )
    starts = np.unique(starts.astype(int))
    starts = starts[(starts + ticks) * dt <= last + EARLY]
    return starts[_closed(measured.armed, starts * dt, (starts + ticks) * dt)]


def _speed(measured: Measured, time: np.ndarray) -> np.ndarray:
    """The car's speed, as motion capture or else the encoder tells (m/s)."""
    if measured.vx is not None and measured.vy is not None:
        return np.hypot(measured.vx.at(time), measured.vy.at(time))
    reference = find_references(measured).get("wheel_speed_mps")
    return reference.undone().at(time) if reference else np.full(len(time), math.nan)


def _closed(armed: Signal | None, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether the dead-man switch is closed from begin to end."""
    if armed is None:
        return np.full(len(begin), True)
    opened = np.concatenate([[0], np.cumsum(armed.value < 0.5)])
    first = np.searchsorted(armed.time, begin + EARLY, side="right") - 1
    beyond = np.searchsorted(armed.time, end + EARLY, side="right")
    return (first >= 0) & (opened[beyond] == opened[np.maximum(first, 0)])


# -------------------------------------------------------------------------------------------------
# What is simulated
# -------------------------------------------------------------------------------------------------


def states_at(
    run: Run, car: Car, measured: Measured, starts: np.ndarray, ticks: int, dt: float
) -> State:
    """The car at the starts of windows, as far as it was measured; leaves have an axis of windows.

    NaN where the velocity is not known. Wheels: the encoder's speed is the mean of the four, and
    they differ as their hubs' speeds do; without it they roll.
    """
    time = starts * dt
    throttle, steering = asked(run.commands, np.arange(int(starts.max()) + 1), dt)
    angle, duty = (trace[starts] for trace in actuators(car, throttle, steering, dt))
    references = find_references(measured)
    wheel_speed = references.get("wheel_speed_mps")
    mean = wheel_speed.undone().at(time) if wheel_speed else np.full(len(time), math.nan)
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        vx, vy, yaw_rate = (
            signal.at(time) for signal in (measured.vx, measured.vy, measured.yaw_rate)
        )
        ax, ay = (
            Signal(signal.time, np.gradient(signal.value, signal.time)).at(time)
            if len(signal.time) > 1
            else np.zeros(len(time))
            for signal in (measured.vx, measured.vy)
        )
        ax, ay = np.nan_to_num(ax - yaw_rate * vy), np.nan_to_num(ay + yaw_rate * vx)
    else:
        gyro = references.get("yaw_rate_radps")
        yaw_rate = gyro.undone().at(time) if gyro else np.zeros(len(time))
        # Before the first reading is before the car has moved.
        vx, yaw_rate = _held_back(wheel_speed, mean, time), _held_back(gyro, yaw_rate, time)
        vy, ax, ay = np.zeros(len(time)), np.zeros(len(time)), yaw_rate * vx
    wheels = _wheels(car, measured, Vector(vx, vy, yaw_rate), angle, mean, time)
    zero = np.zeros(len(time))
    charge = np.full(len(time), float(run.about.get("battery_charge", 1.0)))
    motion = Motion(zero, zero, zero, vx, vy, yaw_rate, wheels, angle, duty, ax, ay, charge)
    slots = planar.delay_slots(car, dt)
    # A window's count starts at 0, so its slot s holds the command of the tick s - slots.
    before = starts[:, None] + np.arange(-slots, 0)
    lines = [
        np.where(before >= 0, line[np.maximum(before, 0)], 0.0) for line in (throttle, steering)
    ]
    del ticks
    return State(motion, lines[0], lines[1], zero, zero, zero, zero)


def _held_back(reference: Reference | None, value: np.ndarray, time: np.ndarray) -> np.ndarray:
    """The value, and before the sensor's first reading that reading."""
    if reference is None:
        return value
    signal = reference.undone()
    return np.where(time < signal.time[0], signal.value[0], value)


def _wheels(
    car: Car,
    measured: Measured,
    velocity: Vector,
    steering: np.ndarray,
    mean: np.ndarray,
    time: np.ndarray,
) -> Wheels:
    """Spin of the four wheels (rad/s)."""
    tires = planar.tires_by_wheel(car)
    if measured.wheels is not None:
        rims = [wheel.at(time) for wheel in measured.wheels]
    else:
        rolls, _ = planar.contact_directions(car, jnp.asarray(steering))
        hubs = [np.asarray(dot(roll, velocity)) for roll in rolls]  # type: ignore[arg-type]
        missing = np.nan_to_num(mean - np.mean(hubs, axis=0))
        rims = [hub + missing for hub in hubs]
    return Wheels(*(rim / tire.radius for rim, tire in zip(rims, tires, strict=True)))  # type: ignore[attr-defined]


def asked(commands: Table, ticks: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Throttle and steering (rad) that are asked for in these ticks; held, and 0 before the first."""
    last = np.searchsorted(commands["time_s"], ticks * dt + EARLY, side="right") - 1
    held = np.maximum(last, 0)
    return (
        np.where(last >= 0, commands["throttle"][held], 0.0),
        np.where(last >= 0, commands["steering"][held], 0.0),
    )


def actuators(
    car: Car, throttle: np.ndarray, steering: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Steering angle (rad) and duty at the begin of each tick, for what is asked from the first on.

    They do not depend on the car's motion: the laws and delays are those of `planar.step`.
    """
    length = 1 << max(12, math.ceil(math.log2(len(throttle))))  # so that logs share a program
    padded = [np.pad(line, (0, length - len(line)), mode="edge") for line in (throttle, steering)]
    slots = planar.delay_slots(car, dt)
    angle, duty = _actuators(car, np.zeros(slots), *padded, dt)
    return np.asarray(angle)[: len(throttle)], np.asarray(duty)[: len(throttle)]


@partial(jax.jit, static_argnames="dt")
def _actuators(
    car: Car, line: jax.Array, throttle: jax.Array, steering: jax.Array, dt: float
) -> tuple[jax.Array, jax.Array]:
    zero = jnp.zeros(())
    motion = Motion(*[zero] * 6, Wheels(*[zero] * 4), *[zero] * 5)
    start = State(motion, line, line, *[zero] * 4)

    def tick(state: State, now: tuple[jax.Array, Command]) -> tuple[State, Any]:
        count, command = now
        begin = (state.motion.steering, state.motion.duty)
        work = planar.Tick(car, zero, command, command, count, dt)
        state, work = planar.delay(state, work)
        goal = Command(
            motor.duty(car.motor, work.asked.throttle),
            servo.target(car.servo, work.asked.steering),
        )
        return state._replace(motion=planar.follow(car, state.motion, goal, dt)), begin

    counts = jnp.arange(throttle.shape[0], dtype=jnp.int32)
    _, (angle, duty) = jax.lax.scan(tick, start, (counts, Command(throttle, steering)))
    return angle, duty


def simulate(
    car: Car, states: State, commands: Table, starts: np.ndarray, ticks: int, dt: float
) -> dict[str, np.ndarray]:
    """Each quantity over (windows, ticks + 1), from the start on.

    Windows are padded to a power of two, and ticks to whole pieces, so that programs are shared.
    """
    chunks = []
    for begin in range(0, len(starts), MOST_WINDOWS):
        chosen = starts[begin : begin + MOST_WINDOWS]
        size = 1 << math.ceil(math.log2(len(chosen)))
        rows = np.minimum(np.arange(begin, begin + size), begin + len(chosen) - 1)
        state = jax.tree.map(lambda leaf, rows=rows: jnp.asarray(leaf[rows]), states)
        pieces = [np.stack([np.asarray(q) for q in _seen(car, state.motion)])[:, :, None]]
        for piece in range(0, ticks, PIECE):
            count = np.arange(piece, piece + PIECE, dtype=np.int32)
            throttle, steering = asked(commands, starts[rows][None, :] + count[:, None], dt)
            state, seen = _advance(car, state, count, throttle, steering, dt)
            pieces.append(np.stack([np.asarray(q).T for q in seen]))
        whole = np.concatenate(pieces, axis=2)
        chunks.append(whole[:, : len(chosen), : ticks + 1])
    return dict(zip(QUANTITIES, np.concatenate(chunks, axis=1), strict=True))


@partial(jax.jit, static_argnames="dt")
def _advance(
    car: Car, states: State, counts: jax.Array, throttle: jax.Array, steering: jax.Array, dt: float
) -> tuple[State, tuple[jax.Array, ...]]:
    """So many ticks of all windows; throttle and steering are (ticks, windows)."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def tick(states: State, now: tuple[jax.Array, Command]) -> tuple[State, Any]:
        count, command = now
        step = lambda state, asked: planar.step(car, no_walls, state, asked, count, dt)  # noqa: E731
        states = jax.vmap(step)(states, command)
        return states, _seen(car, states.motion)

    return jax.lax.scan(tick, states, (counts, Command(throttle, steering)))


def _seen(car: Car, motion: Motion) -> tuple[Any, ...]:
    """The four quantities: an encoder between the differentials sees the mean of the wheels."""
    rims = [
        tire.radius * wheel  # type: ignore[attr-defined]
        for tire, wheel in zip(planar.tires_by_wheel(car), motion.wheels, strict=True)
    ]
    return motion.vx, motion.vy, motion.yaw_rate, sum(rims) / 4


# -------------------------------------------------------------------------------------------------
# Errors
# -------------------------------------------------------------------------------------------------


def compared(
    references: Mapping[str, Reference],
    predicted: Mapping[str, np.ndarray],
    start: float,
    dt: float,
    whole: bool,
) -> Window | None:
    """A window from its simulated quantities, a value a tick; None where a reference is missing.

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
        if reference.sensor:
            at = signal.time[(signal.time > start + EARLY) & (signal.time <= time[-1] + EARLY)]
        truth = signal.at(at)
        known = np.isfinite(truth)
        if not whole and not np.all(known):
            return None
        if np.any(known):
            at, truth = at[known], truth[known]
            values = predicted[name]
            still = np.full(len(values), values[0])
            window[name] = Compared(
                at, truth, sensed(reference, time, values, at), sensed(reference, time, still, at)
            )
    states = [name for name, reference in references.items() if not reference.sensor]
    if not window or any(name not in window for name in states):
        return None
    return window


def sensed(
    reference: Reference, time: np.ndarray, values: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """What the reference's sensor would have reported at these times of a window's quantity.

    Readings early in a window reach back before its start: there, the measured quantity is taken.
    """
    if not reference.sensor:
        return np.interp(at, time, values)
    before = time[0] + np.arange(-(reference.lag + reference.over), -1e-9, SAMPLE)
    past = reference.undone().at(before)
    past = np.where(np.isfinite(past), past, values[0])
    time, values = np.concatenate([before, time]), np.concatenate([past, values])
    middle = at - reference.lag
    if reference.over:
        area = np.concatenate([[0.0], np.cumsum(np.diff(time) * (values[1:] + values[:-1]) / 2)])
        ends = [np.interp(middle + side * reference.over / 2, time, area) for side in (-1, 1)]
        read = (ends[1] - ends[0]) / reference.over
    else:
        read = np.interp(middle, time, values)
    return np.rint(read / reference.quantum) * reference.quantum if reference.quantum else read


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
