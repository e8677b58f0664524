"""Windows of a log: the measured motion in them, and its simulation.

A window starts from the measured state and runs open loop on the log's own commands. The measured
motion is motion capture, or the state itself for a simulated run. Without both, it is the car's
encoder and gyroscope, with lag and quantum.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

from countersteer.car.car import Car
from countersteer.car.files import require_speed_controller
from countersteer.errors import InputError
from countersteer.runs.declared import sensor_tables
from countersteer.runs.defects import stretches
from countersteer.runs.files import Table, drive_column
from countersteer.runs.keys import WHEELS
from countersteer.runs.run import Run, refuse_long
from countersteer.signals import AnyCommand, Command, Motion, Scalar, SpeedCommand, Wheels
from countersteer.world import planar, servo, speed_controller
from countersteer.world.chassis import Vector, dot
from countersteer.world.state import State

QUANTITIES = ("vx_mps", "vy_mps", "yaw_rate_radps", "wheel_speed_mps")
VELOCITY = QUANTITIES[:3]  # of the body
CHANGES = {"vx_mps": 0.3, "vy_mps": 0.3, "yaw_rate_radps": 1.0}  # beyond, a window is transient
EVERY = 0.25  # s between the starts of windows
SLOWEST = 0.2  # m/s, least speed at the start of a window

SMOOTHED_OVER, DEGREE = 0.15, 3  # s, width of the Savitzky-Golay filter, and its degree
MOST_POSES = 10_000_000  # after resampling
GAP = 0.035  # s; longer gaps of motion capture are not interpolated

MEAN = Wheels(0.25, 0.25, 0.25, 0.25)  # share of each wheel in their mean

PIECE = 100  # ticks in each call of the compiled program, for any horizon
SIZES = (1, 32, 256)  # windows simulated at once; few sizes, as each compiles its own program
ENDS = 0.02  # s before the first and after the last sample of a signal, in which it still holds
EARLY = 1e-6  # s by which a command may come early, since times are rounded


class Signal(NamedTuple):
    """A quantity over time; NaN where unknown."""

    time: np.ndarray  # s, rising
    value: np.ndarray

    def at(self, time: np.ndarray) -> np.ndarray:
        """Interpolate; NaN next to unknown samples, and more than `ENDS` beyond the ends."""
        time = np.where(np.abs(time - self.time[0]) < ENDS, np.maximum(time, self.time[0]), time)
        time = np.where(np.abs(time - self.time[-1]) < ENDS, np.minimum(time, self.time[-1]), time)
        return np.interp(time, self.time, self.value, left=math.nan, right=math.nan)


class Timing(NamedTuple):
    """Lag of a reading (s), its averaging time (s), and its quantum."""

    lag: float = 0.0
    over: float = 0.0
    step: float = 0.0


class Measured(NamedTuple):
    """The measured motion of a log, in SI units; None: not in the log."""

    vx: Signal | None  # with vy and yaw_rate; of the centre of mass in the body's axes
    vy: Signal | None
    yaw_rate: Signal | None
    wheels: tuple[Signal, ...] | None  # rim speeds of the four, for simulated cars only
    encoder: Signal | None  # as reported
    encoder_timing: Timing
    gyro: Signal | None
    gyro_timing: Timing
    armed: Signal | None  # dead-man switch, held between its reports; None: always closed
    encoder_sees: Wheels = MEAN  # share of each wheel in the encoder's speed


class Reference(NamedTuple):
    """A measured quantity for comparison: a state, or readings of a sensor."""

    signal: Signal
    timing: Timing | None = None  # None: a state
    sees: Wheels = MEAN  # of a wheel speed: share of each wheel in it

    def undone(self, time: np.ndarray, resting: np.ndarray | bool = False) -> np.ndarray:
        """The quantity at these times, without the sensor's lag.

        Where the car rests until then, this is the last reading. Interpolation to the next one
        would show later motion. Before the first reading, this is the first; NaN after the last.
        """
        times, values = self.signal
        lag = 0.0 if self.timing is None else self.timing.lag
        last = values[np.maximum(np.searchsorted(times, time + EARLY, side="right") - 1, 0)]
        late = np.interp(time + lag, times, values, right=math.nan)
        return np.where(resting, last, late)


# -------------------------------------------------------------------------------------------------
# Measurement
# -------------------------------------------------------------------------------------------------


def measured_for(run: Run, car: Car) -> Measured:
    """`read_measured` of a run that the car is to be simulated on.

    Raises `InputError` also if it is commanded in m/s and the car has no speed controller.
    """
    if "speed" in run.commands:
        require_speed_controller(car, f"{run.path}/commands.csv")
    return read_measured(run, car)


def read_measured(run: Run, car: Car) -> Measured:
    """Body velocities, wheel speeds and sensor readings of a run.

    Raises `InputError` if the run is too long, or if its poses are too close in time.
    """
    refuse_long(run)
    vx = vy = yaw_rate = wheels = None
    truth = run.truth
    if truth is not None and len(truth):
        time = truth["time_s"]
        if set(VELOCITY) <= truth.keys():
            when = time - float(run.about.get("velocity_lag_s", 0.0))  # measured by the importer
            vx, vy, yaw_rate = (Signal(when, _known(truth[name])) for name in VELOCITY)
        else:
            vx, vy, yaw_rate = velocities(time, truth["x_m"], truth["y_m"], truth["heading_rad"])
        names = [f"wheel_{place}_radps" for place in ("fl", "fr", "rl", "rr")]
        if set(names) <= truth.keys():
            wheels = tuple(
                Signal(time, radius * _known(truth[name]))
                for radius, name in zip(radii(car), names, strict=True)
            )
    telemetry = run.telemetry if run.telemetry is not None else Table()
    return Measured(
        vx,
        vy,
        yaw_rate,
        wheels,
        _reported(telemetry, "wheel_speed_mps"),
        encoder_timing(run, car),
        _reported(telemetry, "gyro_radps"),
        gyro_timing(run),
        _reported(telemetry, "armed"),
        encoder_sees(run, car),
    )


def _known(values: np.ndarray) -> np.ndarray:
    """The values; NaN for infinite ones."""
    return np.where(np.isfinite(values), values, math.nan)


def encoder_on(run: Run, car: Car) -> str:
    """Where the encoder sits: by `[sensors.encoder]` of the run, by the run's own car, or `car`."""
    own = run.car or car
    return str(sensor_tables(run.about, "encoder").get("on", own.sensors.encoder.on))


def encoder_sees(run: Run, car: Car) -> Wheels:
    """The share of each wheel in the encoder's speed."""
    return shares(encoder_on(run, car), car)


def shares(on: str, car: Car) -> Wheels:
    """The share of each wheel in what an encoder sees there; the shaft's is of driven wheels."""
    if on == "wheels":
        return MEAN
    if on != "shaft":
        return Wheels(*(float(on == place) for place in WHEELS))
    front = float(car.drivetrain.front_share) / 2
    return Wheels(front, front, 0.5 - front, 0.5 - front)


def encoder_timing(run: Run, car: Car) -> Timing:
    """The encoder's timing, from `[sensors.encoder]` of the run, else as its car declares it.

    The car is the run's own, or else `car`. Its encoder counts regions over its update time. So a
    reading lags by half of it.
    """
    part = (run.car or car).sensors.encoder
    of_car = {"over_s": part.update, "regions": part.regions}
    declared = of_car | sensor_tables(run.about, "encoder")
    over, regions = float(declared["over_s"]), float(declared["regions"])
    tire = car.tires.rear if "rear" in encoder_on(run, car) else car.tires.front
    step = math.pi * float(tire.radius) / regions / over if over else 0.0
    return Timing(declared.get("lag_s", over / 2), over, declared.get("step_mps", step))


def gyro_timing(run: Run) -> Timing:
    """The gyroscope's timing, from `[sensors.gyroscope]` of the run, else without a lag."""
    return Timing(sensor_tables(run.about, "gyroscope").get("lag_s", 0.0))


def _reported(table: Table, name: str) -> Signal | None:
    """A sensor's readings, without rows that have no new one; None if there are none."""
    if name not in table or not np.any(np.isfinite(table[name])):
        return None
    there = np.isfinite(table[name])
    return Signal(table["time_s"][there], table[name][there])


def radii(car: Car) -> list[Any]:
    """The radius of each wheel (m)."""
    front, rear = car.tires.front.radius, car.tires.rear.radius
    return [front, front, rear, rear]


def velocities(
    time: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray
) -> tuple[Signal, Signal, Signal]:
    """Forward and lateral velocity (m/s) and yaw rate (rad/s) from poses.

    They are the derivatives by a cubic Savitzky-Golay filter over 0.15 s on evenly resampled poses.
    They are NaN in gaps longer than `GAP` and 1.5 periods, and in pieces shorter than the filter.
    """
    there = np.isfinite(x + y + heading)
    time, x, y, heading = time[there], x[there], y[there], heading[there]
    none = Signal(np.zeros(1), np.full(1, math.nan))
    if len(time) < 2 or not np.median(np.diff(time)) > 0:
        return none, none, none
    step = float(np.median(np.diff(time)))
    if (time[-1] - time[0]) / step > MOST_POSES:
        raise InputError(f"truth.csv: poses are {step:g} s apart: that is no rate of measurement")
    grid = np.arange(time[0], time[-1] + step / 2, step)
    after = np.clip(np.searchsorted(time, grid, side="right"), 1, len(time) - 1)
    known = time[after] - time[after - 1] <= max(GAP, 1.5 * step)
    width = max(DEGREE + 2, 2 * round(SMOOTHED_OVER / step / 2) + 1)
    out = np.full((3, len(grid)), math.nan)
    for first, last in stretches(known):
        begin, end = first, last + 1
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


def find_references(measured: Measured) -> dict[str, Reference]:
    """The reference of each quantity that the log holds."""
    found: dict[str, Reference] = {}
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        found["vx_mps"] = Reference(measured.vx)
        found["vy_mps"] = Reference(measured.vy)
        found["yaw_rate_radps"] = Reference(measured.yaw_rate)
    elif measured.gyro is not None:
        found["yaw_rate_radps"] = Reference(measured.gyro, measured.gyro_timing)
    if measured.wheels is not None:
        mean = np.mean([wheel.value for wheel in measured.wheels], axis=0)
        found["wheel_speed_mps"] = Reference(Signal(measured.wheels[0].time, mean))
    elif measured.encoder is not None:
        found["wheel_speed_mps"] = Reference(
            measured.encoder, measured.encoder_timing, measured.encoder_sees
        )
    return found


def window_starts(
    measured: Measured, commands: Table, ticks: int, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Start ticks of windows of `ticks` ticks, and True where the car rests until the start."""
    times = commands["time_s"]
    first, last = float(times[0]), float(times[-1])
    regular = np.arange(math.ceil(first / EVERY) * EVERY, last + EARLY, EVERY)
    regular = regular[speed_at(measured, regular, False) >= SLOWEST]
    drive = commands[drive_column(commands)]
    onsets = times[(np.concatenate([[0.0], drive[:-1]]) == 0) & (drive > 0)]
    onsets = onsets[speed_at(measured, onsets, True) < SLOWEST]
    moving = np.rint(regular / dt).astype(int)
    resting = np.ceil(onsets / dt - EARLY).astype(int)
    starts = np.union1d(moving, resting)
    starts = starts[(starts + ticks) * dt <= last + EARLY]
    starts = starts[_closed(measured.armed, starts * dt, (starts + ticks) * dt)]
    return starts, np.isin(starts, resting)


def speed_at(measured: Measured, time: np.ndarray, resting: bool) -> np.ndarray:
    """The car's speed (m/s) by motion capture, else by the wheels."""
    if measured.vx is not None and measured.vy is not None:
        return np.hypot(measured.vx.at(time), measured.vy.at(time))
    reference = find_references(measured).get("wheel_speed_mps")
    return reference.undone(time, resting) if reference else np.full(len(time), math.nan)


def _closed(armed: Signal | None, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """True where the dead-man switch is closed from begin to end."""
    if armed is None:
        return np.full(len(begin), True)
    opened = np.concatenate([[0], np.cumsum(armed.value < 0.5)])
    first = np.searchsorted(armed.time, begin + EARLY, side="right") - 1
    beyond = np.searchsorted(armed.time, end + EARLY, side="right")
    return (first >= 0) & (opened[beyond] == opened[np.maximum(first, 0)])


def why_no_window(run: Run, measured: Measured, horizon: float) -> str:
    """Why a run has no window of `horizon` seconds."""
    where = f"{run.path}: no window of {horizon:g} s: "
    if measured.vx is None and "wheel_speed_mps" not in find_references(measured):
        empty = run.telemetry is not None and "wheel_speed_mps" in run.telemetry
        cause = "is empty" if empty else "is missing"
        return f"{where}it has no speed signal: wheel_speed_mps {cause} in telemetry.csv, and " + (
            "truth.csv holds no poses" if run.truth is not None else "there is no truth.csv"
        )
    time = run.commands["time_s"]
    if time[-1] - time[0] < horizon:
        return f"{where}its commands last {time[-1] - time[0]:.3g} s"
    if measured.armed is not None and not np.any(measured.armed.value >= 0.5):
        return f"{where}the dead-man switch is never closed (armed in telemetry.csv)"
    every = np.arange(time[0], time[-1], 0.05)
    speed = speed_at(measured, every, False)
    if not np.any(np.isfinite(speed)):
        return f"{where}its speed is not known while it has commands: do the clocks agree?"
    if np.nanmax(speed) < SLOWEST:
        return f"{where}its speed stays below {SLOWEST:g} m/s (at most {np.nanmax(speed):.2g})"
    return (
        f"{where}in none is the dead-man switch closed and the car at {SLOWEST:g} m/s or more, or "
        "at rest with a throttle onset"
    )


# -------------------------------------------------------------------------------------------------
# Simulation
# -------------------------------------------------------------------------------------------------


def states_at(
    run: Run, car: Car, measured: Measured, starts: np.ndarray, resting: np.ndarray, dt: float
) -> State:
    """The car's states at the starts of windows; the leaves have a leading axis of windows.

    A velocity that was not measured is NaN. The wheel with the encoder has its speed (on the shaft,
    the driven wheels have it on average). The wheels differ as their hubs' speeds do. Without an
    encoder they roll.
    """
    time = starts * dt
    ticks = np.arange(int(starts.max()) + 1)
    commands = asked(run.commands, ticks, dt)
    angle, duty = (trace[starts] for trace in actuators(car, measured, commands, dt))
    zero = np.zeros(len(time))
    vx, vy, yaw_rate, ax, ay = body_at(car, measured, angle, time, resting)
    wheels = wheels_at(car, measured, Vector(vx, vy, yaw_rate), angle, time, resting)
    charge = charges(run, time, 1.0)
    motion = Motion(zero, zero, zero, vx, vy, yaw_rate, wheels, angle, duty, ax, ay, charge)
    slots = planar.delay_slots(car, dt)
    # A window's count starts at 0, so its slot s holds the command of the tick s - slots.
    before = starts[:, None] + np.arange(-slots, 0)
    lines = (np.where(before >= 0, line[np.maximum(before, 0)], 0.0) for line in commands)
    return State(motion, *lines, *[zero] * 5)


def rims_at(measured: Measured, time: np.ndarray) -> np.ndarray:
    """The measured mean rim speed at any times (m/s), for a speed controller; 0 if unknown."""
    reference = find_references(measured).get("wheel_speed_mps")
    if reference is None:
        return np.zeros_like(time)
    known = np.isfinite(reference.signal.value)
    signal = Signal(*(part[known] for part in reference.signal))
    lag = 0.0 if reference.timing is None else reference.timing.lag
    return np.interp(time + lag, *signal) if np.any(known) else np.zeros_like(time)


def charges(run: Run, time: np.ndarray, unknown: float) -> np.ndarray:
    """The battery's charge at these times as the run states it, else `unknown`.

    `battery_charge` is that of its first command. It falls evenly to `battery_charge_end`.
    """
    begin = float(run.about.get("battery_charge", unknown))
    end = float(run.about.get("battery_charge_end", begin))
    first, last = run.commands["time_s"][[0, -1]]
    return np.interp(time, [first, max(last, first + EARLY)], [begin, end])


def body_at(
    car: Car, measured: Measured, angle: np.ndarray, time: np.ndarray, resting: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Velocity, yaw rate and acceleration of the centre of mass at these times, in the body's axes.

    Without motion capture, the lateral velocity is 0, and the forward velocity is the one at which
    the encoder's wheel rolls as fast as it reads. `angle` is that of the steering (rad). Without a
    gyroscope, the car turns as its front wheels point.
    """
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        vx, vy, yaw_rate = (
            signal.at(time) for signal in (measured.vx, measured.vy, measured.yaw_rate)
        )
        change_x, change_y = (_slope(signal).at(time) for signal in (measured.vx, measured.vy))
        ax, ay = change_x - yaw_rate * vy, change_y + yaw_rate * vx
        return vx, vy, yaw_rate, np.nan_to_num(ax), np.nan_to_num(ay)
    references = find_references(measured)
    wheel, gyro = (references.get(name) for name in ("wheel_speed_mps", "yaw_rate_radps"))
    speed = np.zeros(len(time)) if wheel is None else wheel.undone(time, resting)
    bend = np.tan(angle) / float(car.body.wheelbase)
    yaw_rate = speed * bend if gyro is None else gyro.undone(time, resting)
    vx = speed
    if wheel is not None:
        roll = seen_by(wheel.sees, rolls(car, angle))
        vx = (speed - np.asarray(roll.yaw) * yaw_rate) / np.asarray(roll.x)
    return vx, 0.0 * vx, yaw_rate, 0.0 * vx, yaw_rate * vx


def _slope(signal: Signal) -> Signal:
    """The derivative of a signal; 0 for one sample. Of equal times, the first counts."""
    time, rows = np.unique(signal.time, return_index=True)
    if len(time) < 2:
        return signal._replace(value=0.0 * signal.value)
    return Signal(time, np.gradient(signal.value[rows], time))


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
        rims = tuple(wheel.at(time) for wheel in measured.wheels)
    else:
        reference = find_references(measured).get("wheel_speed_mps")
        nothing = np.full(len(time), math.nan)
        speed = nothing if reference is None else reference.undone(time, resting)
        sees = MEAN if reference is None else reference.sees
        rims = rolling(car, velocity, steering, speed, sees)
    return Wheels(*(rim / radius for rim, radius in zip(rims, radii(car), strict=True)))


def rolls(car: Car, steering: Scalar) -> Wheels:
    """The direction of each wheel's hub speed: its dot product with a velocity (m/s)."""
    steered = planar.Steered(*servo.directions(car.body, car.servo, steering))
    return planar.contact_directions(car, steered)[0]


def seen_by(sees: Wheels, directions: Wheels) -> Vector:
    """The direction of the hub speed that an encoder sees."""
    return Vector(
        *(
            sum(share * part for share, part in zip(sees, parts, strict=True))
            for parts in zip(*directions, strict=True)
        )
    )


def rolling(
    car: Car, velocity: Vector, steering: Scalar, seen: Scalar, sees: Wheels
) -> tuple[Scalar, ...]:
    """Rim speeds of the four wheels (m/s), of which an encoder that `sees` them reads `seen`.

    What `seen` exceeds the hubs' speed by is slip. The driven wheels share it. If the encoder is
    on a wheel that is not driven, only its axle has it. Where `seen` is NaN, the wheels roll.
    """
    hubs = [dot(roll, velocity) for roll in rolls(car, steering)]
    shares = list(zip(sees, hubs, strict=True))
    slip = jnp.nan_to_num(seen - sum(share * hub for share, hub in shares))
    drive = car.drivetrain
    joined = drive.center_lock > 0
    front, rear = (drive.front_share > 0) | joined, (drive.front_share < 1) | joined
    sees_front, sees_rear = (sees.front_left + sees.front_right, sees.rear_left + sees.rear_right)
    seen_driven = front * sees_front + rear * sees_rear  # part of the reading that can slip
    share = jnp.where(seen_driven > 0, seen_driven, 1.0)
    slips = [
        slip / share * jnp.where(seen_driven > 0, driven, saw > 0)
        for driven, saw in ((front, sees_front), (rear, sees_rear))
    ]
    return tuple(hub + slips[axle] for hub, axle in zip(hubs, (0, 0, 1, 1), strict=True))


def asked(commands: Table, ticks: np.ndarray, dt: float) -> AnyCommand:
    """The commands in these ticks: held; 0 before the first."""
    last = np.searchsorted(commands["time_s"], ticks * dt + EARLY, side="right") - 1
    held = np.maximum(last, 0)
    drive = drive_column(commands)
    return (SpeedCommand if drive == "speed" else Command)(
        np.where(last >= 0, commands[drive][held], 0.0),
        np.where(last >= 0, commands["steering"][held], 0.0),
    )


def actuators(
    car: Car, measured: Measured, commands: AnyCommand, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Steering angle (rad) and duty at the start of each tick, for the commands of all ticks.

    The laws and delays are those of `planar.step`. Only a speed controller depends on the motion:
    it is told the measured speed of the rims.
    """
    rims = None
    if isinstance(commands, SpeedCommand):
        rims = rims_at(measured, dt * np.arange(len(commands.steering)))
    state = planar.initial_state(car, dt)
    # In pieces: one call for a whole log would be compiled for its length, and it would be slow.
    ticks = len(commands.steering)
    padded = jax.tree.map(
        lambda line: np.pad(line, (0, -ticks % PIECE), mode="edge"), (commands, rims)
    )
    traces = []
    for begin in range(0, ticks, PIECE):
        count = np.arange(begin, begin + PIECE, dtype=np.int32)
        piece = jax.tree.map(lambda line, at=begin: line[at : at + PIECE], padded)
        state, trace = _actuators(car, state, count, *piece, dt)
        traces.append(np.asarray(trace))
    angle, duty = np.concatenate(traces, axis=1)[:, :ticks]
    return angle, duty


@partial(jax.jit, static_argnames="dt")
def _actuators(
    car: Car,
    state: State,
    counts: jax.Array,
    commands: AnyCommand,
    rims: jax.Array | None,
    dt: float,
) -> tuple[State, tuple[jax.Array, jax.Array]]:
    """The state after these ticks, and steering angle and duty at the start of each."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def tick(state: State, now: tuple[Any, ...]) -> tuple[State, Any]:
        count, command, rim = now
        begin = (state.motion.steering, state.motion.duty)
        work = planar.Tick(car, no_walls, command, command, count, dt)
        state, work = planar.delay(state, work)
        wheels = state.motion.wheels if rim is None else spins(car, rim)
        goal = speed_controller.goals(car, work.asked, wheels)
        return state._replace(motion=planar.follow(car, state.motion, goal, dt)), begin

    return jax.lax.scan(tick, state, (counts, commands, rims))


def spins(car: Car, rim: Scalar) -> Wheels:
    """Spins of wheels that all have the rim speed `rim`."""
    return Wheels(*(rim / radius for radius in radii(car)))


def simulate(
    car: Car,
    states: State,
    commands: Table,
    starts: np.ndarray,
    ticks: int,
    dt: float,
    sees: Wheels = MEAN,
) -> dict[str, np.ndarray]:
    """Each simulated quantity from the start on: (windows, ticks + 1).

    `sees` gives the share of each wheel in the wheel speed.

    Windows are padded to one of `SIZES`, and ticks to whole pieces, to reuse compiled programs.
    """
    chunks = []
    for begin in range(0, len(starts), SIZES[-1]):
        chosen = starts[begin : begin + SIZES[-1]]
        size = next(size for size in SIZES if size >= len(chosen))
        rows = np.minimum(np.arange(begin, begin + size), begin + len(chosen) - 1)
        state = jax.tree.map(lambda leaf, rows=rows: jnp.asarray(leaf[rows]), states)
        first = quantities_of(car, state.motion, sees)
        pieces = [np.stack([np.asarray(q) for q in first])[:, :, None]]
        for piece in range(0, ticks, PIECE):
            count = np.arange(piece, piece + PIECE, dtype=np.int32)
            now = asked(commands, starts[rows][None, :] + count[:, None], dt)
            state, seen = _advance(car, state, count, now, sees, dt)
            pieces.append(np.stack([np.asarray(q).T for q in seen]))
        whole = np.concatenate(pieces, axis=2)
        chunks.append(whole[:, : len(chosen), : ticks + 1])
    return dict(zip(QUANTITIES, np.concatenate(chunks, axis=1), strict=True))


@partial(jax.jit, static_argnames="dt")
def _advance(
    car: Car, states: State, counts: jax.Array, commands: AnyCommand, sees: Wheels, dt: float
) -> tuple[State, tuple[jax.Array, ...]]:
    """The states after some ticks of all windows; commands are (ticks, windows)."""
    no_walls = jnp.full((1, 4), jnp.nan)

    def tick(states: State, now: tuple[jax.Array, AnyCommand]) -> tuple[State, Any]:
        count, command = now
        step = jax.vmap(planar.step, in_axes=(None, None, 0, 0, None, None))
        states = step(car, no_walls, states, command, count, dt)
        return states, quantities_of(car, states.motion, sees)

    return jax.lax.scan(tick, states, (counts, commands))


def quantities_of(car: Car, motion: Motion, sees: Wheels = MEAN) -> tuple[Scalar, ...]:
    """The four quantities. The wheel speed is of the wheels that an encoder `sees`."""
    rims = [radius * spin for radius, spin in zip(radii(car), motion.wheels, strict=True)]
    seen = sum(share * rim for share, rim in zip(sees, rims, strict=True))
    return motion.vx, motion.vy, motion.yaw_rate, seen
