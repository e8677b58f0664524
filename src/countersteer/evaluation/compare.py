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
from pathlib import Path
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
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
PIECE = 100  # ticks in a call of the compiled program, whatever the horizon
SIZES = (1, 32, 256)  # windows simulated at once: few, for each is a program of its own
ENDS = 0.02  # s for which the first and the last sample of a state stand beyond it
EARLY = 1e-6  # s by which a command may come early, for times that were rounded


class Signal(NamedTuple):
    """Something over time; NaN where it is not known."""

    time: np.ndarray  # s, rising
    value: np.ndarray

    def at(self, time: np.ndarray) -> np.ndarray:
        """Interpolate; NaN beside what is not known, and beyond the ends but for two samples."""
        time = np.where(np.abs(time - self.time[0]) < ENDS, np.maximum(time, self.time[0]), time)
        time = np.where(np.abs(time - self.time[-1]) < ENDS, np.minimum(time, self.time[-1]), time)
        return np.interp(time, self.time, self.value, left=math.nan, right=math.nan)


class Measured(NamedTuple):
    """What a log says about the car's motion, in SI units; None where it says nothing."""

    vx: Signal | None  # with vy and yaw_rate; of the centre of mass in the body's axes
    vy: Signal | None
    yaw_rate: Signal | None
    wheels: tuple[Signal, ...] | None  # rim speed of the four, known for simulated cars alone
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

    def undone(self, time: np.ndarray, resting: np.ndarray | bool = False) -> np.ndarray:
        """Take the lag off: the quantity itself at these times, as far as the sensor tells.

        Where the car rests until then, the last reading tells more than a line to the next one,
        which shows what followed. Before the first reading it is that reading; NaN after the last.
        """
        times, values = self.signal
        last = values[np.maximum(np.searchsorted(times, time + EARLY, side="right") - 1, 0)]
        late = np.interp(time + self.lag, times, values, right=math.nan)
        return np.where(resting, last, late)


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
        resting = _speed(measured, starts * dt, True) < SLOWEST
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
    with jax.enable_x64(True):
        states = states_at(run, car, measured, starts, resting, dt)
        known = np.isfinite(states.motion.vx + states.motion.vy + states.motion.yaw_rate)
        starts, resting = starts[known], resting[known]
        states = jax.tree.map(lambda leaf: leaf[known], states)
        predicted = simulate(car, states, commands, starts, ticks, dt) if len(starts) else {}
    whole = horizon is None
    windows: list[Window] = []
    kept = []
    for i, start in enumerate(starts.tolist()):
        series = {name: values[i] for name, values in predicted.items()}
        window = compared(references, series, start * dt, dt, bool(resting[i]), whole)
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
        "horizon_s": round(ticks * dt, 9),
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
            wheels = tuple(
                Signal(time, radius * truth[name])
                for radius, name in zip(radii(car), names, strict=True)
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
    """Take a sensor's readings, without the rows in which it had nothing new."""
    if name not in table or not np.any(np.isfinite(table[name])):
        return None
    there = np.isfinite(table[name])
    return Signal(table["time_s"][there], table[name][there])


def radii(car: Car) -> list[Any]:
    """Give the radius of each wheel (m)."""
    front, rear = car.tires.front.radius, car.tires.rear.radius
    return [front, front, rear, rear]


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
    """Find what the log holds of each quantity."""
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


def window_starts(
    measured: Measured, commands: Table, ticks: int, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ticks at which windows of so many ticks may start, and whether the car rests until then."""
    times = commands["time_s"]
    first, last = float(times[0]), float(times[-1])
    regular = np.arange(math.ceil(first / EVERY) * EVERY, last + EARLY, EVERY)
    regular = regular[_speed(measured, regular, False) >= SLOWEST]
    throttle = commands["throttle"]
    onsets = times[(np.concatenate([[0.0], throttle[:-1]]) == 0) & (throttle > 0)]
    onsets = onsets[_speed(measured, onsets, True) < SLOWEST]
    moving = np.rint(regular / dt).astype(int)
    resting = np.ceil(onsets / dt - EARLY).astype(int)
    starts = np.union1d(moving, resting)
    starts = starts[(starts + ticks) * dt <= last + EARLY]
    starts = starts[_closed(measured.armed, starts * dt, (starts + ticks) * dt)]
    return starts, np.isin(starts, resting)


def _speed(measured: Measured, time: np.ndarray, resting: bool) -> np.ndarray:
    """Give the car's speed, as motion capture or else the encoder tells (m/s)."""
    if measured.vx is not None and measured.vy is not None:
        return np.hypot(measured.vx.at(time), measured.vy.at(time))
    reference = find_references(measured).get("wheel_speed_mps")
    return reference.undone(time, resting) if reference else np.full(len(time), math.nan)


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
    run: Run, car: Car, measured: Measured, starts: np.ndarray, resting: np.ndarray, dt: float
) -> State:
    """Set up the car at the starts of windows; the leaves have an axis of windows.

    NaN where the velocity was not measured. Wheels: the encoder's speed is the mean of the four,
    and they differ as their hubs' speeds do; without an encoder they roll.
    """
    time = starts * dt
    throttle, steering = asked(run.commands, np.arange(int(starts.max()) + 1), dt)
    angle, duty = (trace[starts] for trace in actuators(car, throttle, steering, dt))
    zero = np.zeros(len(time))
    vx, vy, yaw_rate, ax, ay = body_at(measured, time, resting)
    wheels = wheels_at(car, measured, Vector(vx, vy, yaw_rate), angle, time, resting)
    charge = zero + float(run.about.get("battery_charge", 1.0))
    motion = Motion(zero, zero, zero, vx, vy, yaw_rate, wheels, angle, duty, ax, ay, charge)
    slots = planar.delay_slots(car, dt)
    # A window's count starts at 0, so its slot s holds the command of the tick s - slots.
    before = starts[:, None] + np.arange(-slots, 0)
    throttle_line, steering_line = (
        np.where(before >= 0, line[np.maximum(before, 0)], 0.0) for line in (throttle, steering)
    )
    return State(motion, throttle_line, steering_line, *[zero] * 5)


def body_at(measured: Measured, time: np.ndarray, resting: np.ndarray) -> tuple[np.ndarray, ...]:
    """Velocity, yaw rate and the centre of mass's acceleration, in the body's axes, at these times.

    Without motion capture the car goes as fast as the encoder says and has no lateral velocity.
    """
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        vx, vy, yaw_rate = (
            signal.at(time) for signal in (measured.vx, measured.vy, measured.yaw_rate)
        )
        change_x, change_y = (_slope(signal).at(time) for signal in (measured.vx, measured.vy))
        ax, ay = change_x - yaw_rate * vy, change_y + yaw_rate * vx
        return vx, vy, yaw_rate, np.nan_to_num(ax), np.nan_to_num(ay)
    references = find_references(measured)
    vx, yaw_rate = (
        references[name].undone(time, resting) if name in references else np.zeros(len(time))
        for name in ("wheel_speed_mps", "yaw_rate_radps")
    )
    return vx, 0.0 * vx, yaw_rate, 0.0 * vx, yaw_rate * vx


def _slope(signal: Signal) -> Signal:
    """Differentiate; a signal of one sample changes nowhere."""
    if len(signal.time) < 2:
        return signal._replace(value=0.0 * signal.value)
    return signal._replace(value=np.gradient(signal.value, signal.time))


def wheels_at(
    car: Car,
    measured: Measured,
    velocity: Vector,
    steering: np.ndarray,
    time: np.ndarray,
    resting: np.ndarray,
) -> Wheels:
    """Spin of the four wheels at these times (rad/s)."""
    if measured.wheels is not None:
        rims = [wheel.at(time) for wheel in measured.wheels]
    else:
        reference = find_references(measured).get("wheel_speed_mps")
        steered = planar.Steered(*servo.directions(car.body, car.servo, steering))
        rolls, _ = planar.contact_directions(car, steered)
        rims = [np.asarray(dot(roll, velocity)) for roll in rolls]
        if reference is not None:
            slip = reference.undone(time, resting) - np.mean(rims, axis=0)
            rims = [rim + np.nan_to_num(slip) for rim in rims]
    return Wheels(*(rim / radius for rim, radius in zip(rims, radii(car), strict=True)))


def asked(commands: Table, ticks: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Look up throttle and steering (rad) asked for in these ticks: held; 0 before the first."""
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
    state = planar.initial_state(car, dt)
    # In pieces: one call for a whole log would be compiled for its length, and be slow besides.
    missing = -len(throttle) % PIECE
    padded = [np.pad(line, (0, missing), mode="edge") for line in (throttle, steering)]
    traces = []
    for begin in range(0, len(padded[0]), PIECE):
        count = np.arange(begin, begin + PIECE, dtype=np.int32)
        piece = (line[begin : begin + PIECE] for line in padded)
        state, trace = _actuators(car, state, count, *piece, dt)
        traces.append(np.asarray(trace))
    angle, duty = np.concatenate(traces, axis=1)[:, : len(throttle)]
    return angle, duty


@partial(jax.jit, static_argnames="dt")
def _actuators(
    car: Car, state: State, counts: jax.Array, throttle: jax.Array, steering: jax.Array, dt: float
) -> tuple[State, tuple[jax.Array, jax.Array]]:
    """Give the state after so many ticks, and steering angle and duty at the begin of each."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def tick(state: State, now: tuple[jax.Array, Command]) -> tuple[State, Any]:
        count, command = now
        begin = (state.motion.steering, state.motion.duty)
        work = planar.Tick(car, no_walls, command, command, count, dt)
        state, work = planar.delay(state, work)
        goal = Command(
            motor.duty(car.motor, work.asked.throttle),
            servo.target(car.servo, work.asked.steering),
        )
        return state._replace(motion=planar.follow(car, state.motion, goal, dt)), begin

    return jax.lax.scan(tick, state, (counts, Command(throttle, steering)))


def simulate(
    car: Car, states: State, commands: Table, starts: np.ndarray, ticks: int, dt: float
) -> dict[str, np.ndarray]:
    """Each quantity over (windows, ticks + 1), from the start on.

    Windows are padded to one of `SIZES`, and ticks to whole pieces, so that programs are shared.
    """
    chunks = []
    for begin in range(0, len(starts), SIZES[-1]):
        chosen = starts[begin : begin + SIZES[-1]]
        size = next(size for size in SIZES if size >= len(chosen))
        rows = np.minimum(np.arange(begin, begin + size), begin + len(chosen) - 1)
        state = jax.tree.map(lambda leaf, rows=rows: jnp.asarray(leaf[rows]), states)
        pieces = [np.stack([np.asarray(q) for q in _seen(car, state.motion)])[:, :, None]]
        for piece in range(0, ticks, PIECE):
            count = np.arange(piece, piece + PIECE, dtype=np.int32)
            throttle, steering = asked(commands, starts[rows][None, :] + count[:, None], dt)
            advance = _advance_one if size == 1 else _advance_batch
            state, seen = advance(car, state, count, throttle, steering, dt)
            pieces.append(np.stack([np.asarray(q).T for q in seen]))
        whole = np.concatenate(pieces, axis=2)
        chunks.append(whole[:, : len(chosen), : ticks + 1])
    return dict(zip(QUANTITIES, np.concatenate(chunks, axis=1), strict=True))


def _advance(
    car: Car, states: State, counts: jax.Array, throttle: jax.Array, steering: jax.Array, dt: float
) -> tuple[State, tuple[jax.Array, ...]]:
    """So many ticks of all windows; throttle and steering are (ticks, windows)."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def tick(states: State, now: tuple[jax.Array, Command]) -> tuple[State, Any]:
        count, command = now
        step = jax.vmap(planar.step, in_axes=(None, None, 0, 0, None, None))
        states = step(car, no_walls, states, command, count, dt)
        return states, _seen(car, states.motion)

    return jax.lax.scan(tick, states, (counts, Command(throttle, steering)))


_advance_one = jax.jit(_advance, static_argnames="dt")
# Without fusion a batch's program compiles in a third of the time and runs about as fast; a single
# car's, which may be wanted for minutes of car time, would be six times slower.
_advance_batch = jax.jit(
    _advance, static_argnames="dt", compiler_options={"xla_disable_hlo_passes": "fusion"}
)


def _seen(car: Car, motion: Motion) -> tuple[Any, ...]:
    """Pick the four quantities; an encoder between the differentials sees the wheels' mean."""
    rims = [radius * spin for radius, spin in zip(radii(car), motion.wheels, strict=True)]
    return motion.vx, motion.vy, motion.yaw_rate, sum(rims) / 4


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
            simulated, unchanged = (
                sensed(reference, time, series, at, resting) for series in (values, still)
            )
            window[name] = Compared(at, truth, simulated, unchanged)
    states = [name for name, reference in references.items() if not reference.sensor]
    if not window or any(name not in window for name in states):
        return None
    return window


def sensed(
    reference: Reference, time: np.ndarray, values: np.ndarray, at: np.ndarray, resting: bool
) -> np.ndarray:
    """Give what the reference's sensor would have reported at these times of a window.

    Readings early in a window reach back before its start: there, the measured quantity is taken.
    """
    if not reference.sensor:
        return np.interp(at, time, values)
    before = time[0] + np.arange(-(reference.lag + reference.over), -1e-9, SAMPLE)
    past = reference.undone(before, resting)
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


# -------------------------------------------------------------------------------------------------
# The picture
# -------------------------------------------------------------------------------------------------

_SIZE_IN, _DPI = (14.0, 9.0), 100
_PAPER, _INK, _SOFT, _LINE, _RELEASED = "#fffefb", "#1b2229", "#5a6570", "#e2ded3", "#f1efe8"
_MEASURED, _SIMULATED, _STEERED = "#8796a3", "#c4400f", "#0069a8"
_NAMES = {
    "vx_mps": ("Forward velocity", "m/s"),
    "vy_mps": ("Lateral velocity, left positive", "m/s"),
    "yaw_rate_radps": ("Yaw rate, left positive", "rad/s"),
    "wheel_speed_mps": ("Wheel speed", "m/s"),
}
_SHOWN_EVERY = 1.0  # s between the windows that are drawn
_LEFT, _RIGHT, _TOP, _BOTTOM, _CAPTION = 0.055, 0.955, 0.895, 0.065, 0.033  # parts of the figure


def draw_comparison(series: Mapping[str, Any], path: Path) -> None:
    """Write to `path`, as PNG, what `compare` gave as its series: measured against simulated.

    Windows are drawn every second at the most, each from its start, marked by a dot. An existing
    file is replaced.
    """
    # Matplotlib takes longer to import than the drawing: who draws nothing does not wait for it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor=_PAPER)
    canvas = FigureCanvasAgg(figure)
    result = series["result"]
    shown = _apart(series["starts_s"], max(_SHOWN_EVERY, result["horizon_s"]))
    _write_headline(figure, series["title"], result, len(shown))
    names = [name for name in QUANTITIES if name in series["measured"]]
    pitch = (_TOP - _BOTTOM) / (len(names) + 1)
    for k, name in enumerate([*names, "commands"]):
        bottom = _TOP - (k + 1) * pitch
        axes = figure.add_axes((_LEFT, bottom, _RIGHT - _LEFT, pitch - _CAPTION - 0.008))
        _dress(axes, series, is_last=name == "commands")
        if name == "commands":
            _draw_commands(axes, series["commands"])
            _write_caption(figure, bottom + pitch, "Commands", "")
            continue
        _draw_quantity(axes, series, name, shown)
        title, unit = _NAMES[name]
        _write_caption(figure, bottom + pitch, f"{title}, {unit}", _said(result, name, unit))
    canvas.print_png(str(path))


def _apart(starts: list[float], least: float) -> list[int]:
    """Choose windows so that each starts at least so long after the one before."""
    chosen: list[int] = []
    for i, start in enumerate(starts):
        if not chosen or start >= starts[chosen[-1]] + least - EARLY:
            chosen.append(i)
    return chosen


def _said(result: Mapping[str, Any], name: str, unit: str) -> str:
    """Say both errors of a quantity, beside those of doing nothing."""
    if name not in result["rmse"]:
        return ""
    still, errors = result["persistence"], []
    for words, key in (("median at the end", "median_abs_error"), ("RMS", "rmse")):
        errors.append(f"{words} {result[key][name]:.2f}  ({still[key][name]:.2f})")
    return f"error, {unit}:   " + "     ".join(errors)


def _write_headline(figure: "Figure", title: str, result: Mapping[str, Any], shown: int) -> None:
    """Write across the top what is compared, and the key."""
    from matplotlib.lines import Line2D

    figure.text(_LEFT, 0.962, title, color=_INK, size=15, weight="bold", va="center")
    count, seconds = result["windows"], f"{result['horizon_s']:.3g} s"
    windows = f"One window of {seconds}."
    if count > 1:
        drawn = "" if shown == count else f", {shown} of them drawn"
        lively = result["transient"]["windows"]
        windows = f"{count} windows of {seconds}{drawn}; something changes in {lively}."
    figure.text(
        _LEFT,
        0.927,
        f"{windows}   In brackets: the errors of predicting that nothing changes.",
        color=_SOFT,
        size=10.5,
        va="center",
    )
    for right, words, colour in (
        (0.845, "measured", _MEASURED),
        (_RIGHT, "simulated", _SIMULATED),
    ):
        figure.text(right, 0.927, words, color=colour, size=11, va="center", ha="right")
        figure.add_artist(
            Line2D(
                [right - 0.085, right - 0.063],
                [0.927] * 2,
                color=colour,
                linewidth=2.4,
                marker="o" if colour == _SIMULATED else None,
                markersize=5,
                markevery=[0],
            )
        )


def _write_caption(figure: "Figure", top: float, left: str, right: str) -> None:
    """Write above a strip what it shows, and how well."""
    y = top - _CAPTION / 2 - 0.004
    figure.text(_LEFT, y, left, color=_INK, size=10.5, weight="bold", va="center")
    figure.text(_RIGHT, y, right, color=_SOFT, size=10, va="center", ha="right")


def _dress(axes: "Axes", series: Mapping[str, Any], is_last: bool) -> None:
    """Prepare a strip: the log's time across, grey where the dead-man switch is released."""
    time = series["commands"]["time_s"]
    end = max(float(time[-1]), float(time[0]) + 1e-3)
    axes.set_xlim(float(time[0]), end)
    armed = series["armed"]
    if armed is not None:
        until = np.append(armed.time[1:], end)
        for begin, finish in _pieces(armed.value < 0.5):
            span = (armed.time[begin], until[finish - 1])
            axes.axvspan(*span, color=_RELEASED, linewidth=0, zorder=0)
    axes.grid(color=_LINE, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_frame_on(False)
    axes.tick_params(length=0, labelsize=9.5, labelcolor=_SOFT, pad=5, labelbottom=is_last)
    axes.locator_params(axis="y", nbins=5)
    if is_last:
        axes.set_xlabel("time, s  (grey: dead-man switch released)", color=_SOFT, size=9.5)


def _draw_quantity(
    axes: "Axes", series: Mapping[str, Any], name: str, shown: Iterable[int]
) -> None:
    """Draw a quantity as measured, and as simulated from the starts of the windows shown."""
    signal = series["measured"][name]
    axes.plot(signal.time, signal.value, color=_MEASURED, linewidth=2.2, zorder=2)
    within = (signal.time >= axes.get_xlim()[0]) & (signal.time <= axes.get_xlim()[1])
    seen = [signal.value[within]]
    for i in shown:
        window: Window = series["windows"][i]
        if name not in window:
            continue
        time, simulated = window[name].time, window[name].simulated
        start = series["starts_s"][i]
        time = np.concatenate([[start], time])
        simulated = np.concatenate([window[name].unchanged[:1], simulated])
        axes.plot(time, simulated, color=_SIMULATED, linewidth=1.5, zorder=3)
        axes.plot(time[:1], simulated[:1], "o", color=_SIMULATED, markersize=3.2, zorder=3)
        seen.append(simulated)
    low, high = np.nanmin(np.concatenate(seen)), np.nanmax(np.concatenate(seen))
    span = max(float(high - low), 0.1)
    axes.set_ylim(low - 0.06 * span, high + 0.06 * span)


def _draw_commands(axes: "Axes", commands: Table) -> None:
    """Draw throttle on the left scale and steering on the right one."""
    time, throttle = commands["time_s"], 100 * commands["throttle"]
    axes.step(time, throttle, where="post", color=_INK, linewidth=1.3)
    top = max(100.0, float(np.max(np.abs(throttle))))
    axes.set_ylim(-1.06 * top if np.min(throttle) < 0 else -0.06 * top, 1.06 * top)
    axes.set_ylabel("throttle, %", color=_INK, size=9.5)
    right = axes.twinx()
    degrees = np.degrees(commands["steering"])
    right.step(time, degrees, where="post", color=_STEERED, linewidth=1.3)
    most = max(10.0, float(np.max(np.abs(degrees))))
    right.set_ylim(-1.08 * most, 1.08 * most)
    right.set_ylabel("steering asked for, °", color=_STEERED, size=9.5)
    right.set_frame_on(False)
    right.tick_params(length=0, labelsize=9.5, labelcolor=_STEERED, pad=5)
    right.locator_params(axis="y", nbins=5)
