"""The closed loop: a driver, a link, a car and its sensors in a world.

    course ─┐
    car ────┤                                      ┌─► record
            ▼                                      │
      world.step ─► sensors ─► link ─► estimate ───┴► driver ─► link ─┐
            ▲                                                         │
            └───────────────────── command ◄──────────────────────────┘

Time is an integer tick. In each tick the driver (when its time has come) acts on what it has heard,
the link carries the command, the world takes one step, and the sensors look at where it led.
"""

import dataclasses
import math
import os
import warnings
from collections.abc import Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Wheels
from countersteer.car.parameter import Array, Scalar
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver, Heard, Observation
from countersteer.estimation import dead_reckoning, pose, velocity
from countersteer.estimation.estimate import Estimate
from countersteer.link.link import ONBOARD, Channel, Link, exchange, initial_channel
from countersteer.sensing import faults, sonar, suite
from countersteer.sensing.faults import Fault
from countersteer.sensing.suite import Reading, Readings
from countersteer.world import drivetrain, motor, planar
from countersteer.world.floor import Floor
from countersteer.world.planar import Command
from countersteer.world.state import Motion, State

PIECE = 0.5  # s of car time that are scanned at once; records are flushed between pieces
FILTERING = 0.005  # s between two steps of the velocity filter
LOCATING = 0.025  # s between two steps of the pose filter
PARTICLES = 500


class Plan(NamedTuple):
    """What a program is compiled for: periods in ticks, and what is wired to what. Hashable."""

    dt: float
    control: int
    telemetry: int
    delay: int
    timeout: int  # 0: none
    onboard: bool
    estimate: str  # as in `Simulator`
    filtering: int
    sensors: suite.Periods
    slots: int  # of the delay lines,
    told: int  # and of the poses that the position sensor tells late
    fails: bool  # whether any sensor ever does


class Surroundings(NamedTuple):
    """What stays the same during a drive."""

    walls: Array  # (n, 4), padded with NaN
    corners: Array  # (2n, 3), from `sonar.edges`
    key: jax.Array
    loss: Scalar
    nominal: Car  # what the estimate knows of the car
    floor: Floor | None = None  # None: the same friction everywhere
    faults: tuple[Fault, ...] = ()


class Loop(NamedTuple):
    """Everything between two ticks."""

    tick: Scalar
    state: State
    sensors: suite.Memory
    estimate: Any  # the filter's memory
    command: Command  # the driver's last
    up: Channel | None
    down: Channel | None
    memory: Any  # the driver's
    faulty: Readings | None = None  # what failing sensors have reported; None: none ever fails

    @property
    def readings(self) -> Readings:
        """The sensors' last reports."""
        return self.sensors.readings if self.faulty is None else self.faulty


class Record(NamedTuple):
    """What is kept of a tick: the state at its start, and the command that the car runs in it."""

    tick: Scalar
    motion: Motion
    voltage: Scalar
    command: Command
    fresh: Scalar  # whether that command is a new one
    readings: Readings
    turn: Scalar  # turns that the driver has begun
    wall_contacts: Scalar
    rolled_over: Scalar
    forces: Wheels


@dataclasses.dataclass(frozen=True)
class Simulator:
    """A car, driven. `run` yields the record of a drive in pieces of half a second.

    `course` may be None: open floor. `car` is what is simulated; a driver knows only what it was
    made for. The precision is that of the car's leaves: 64-bit leaves run in 64 bits.
    `estimate` is "filter" (the velocity filter, which knows the `nominal` car: by default the car
    itself), "pose" (the same with a particle filter for the pose), "reckoning" (dead reckoning) or
    "truth".
    """

    course: Course | None
    car: Car
    driver: Driver
    link: Link = ONBOARD
    estimate: str = "filter"
    dt: float = 0.001
    seed: int = 0
    charge: float = 1.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: tuple[float, float, float] | None = None  # instead of the course's
    nominal: Car | None = None
    floor: Floor | None = None  # where friction varies from place to place
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        """Raises `InputError` for a fault of a sensor that the car has not."""
        faults.check(self.faults, self.car)

    def plan(self) -> Plan:
        """Periods in whole ticks, at least one each."""
        ticks = lambda time: max(1, round(time / self.dt))  # noqa: E731  # used twice
        timeout, control = self.link.timeout, ticks(self.link.control_period)
        return Plan(
            self.dt,
            control,
            ticks(self.link.telemetry_period),
            round(self.link.delay / self.dt),
            0 if math.isinf(timeout) else ticks(timeout),
            self.link.onboard,
            self.estimate,
            control * max(1, round(FILTERING / self.dt / control)),
            suite.periods(self.car, self.dt),
            planar.delay_slots(self.car, self.dt),
            suite.position_slots(self.car, self.dt),
            bool(self.faults),
        )

    def run(self, longest: float) -> Generator[Record, None, None]:
        """Drives for at most so many seconds. Each record has a leading axis of ticks.

        Whoever reads the pieces may stop when the goal is reached.
        """
        wide = np.asarray(self.car.body.mass).dtype == np.float64
        plan = self.plan()
        ticks = max(1, round(PIECE / self.dt / plan.control)) * plan.control
        with jax.enable_x64(wide):
            around, loop = self.begin(plan)
            scanned = not jax.tree_util.all_leaves([self.driver])
        before = None
        for _ in range(math.ceil(longest / (ticks * self.dt))):
            with jax.enable_x64(wide):
                if scanned:
                    loop, record = scan(plan, ticks, self.car, around, self.driver, loop)
                else:
                    loop, record = self._stepped(plan, ticks, around, loop)
            # This piece is computed while the one before it is read.
            if before is not None:
                yield jax.tree.map(np.asarray, before)
            before = record
        yield jax.tree.map(np.asarray, before)

    def record(self, longest: float) -> Record:
        """The whole of `run` at once, cut off at `longest`: for drives of seconds to minutes."""
        last = round(longest / self.dt)
        return jax.tree.map(lambda *pieces: np.concatenate(pieces)[:last], *self.run(longest))

    def begin(self, plan: Plan) -> tuple[Surroundings, Loop]:
        """The loop before its first tick."""
        dtype = np.asarray(self.car.body.mass).dtype
        start = self.start or (self.course.start if self.course else (0.0, 0.0, 0.0))
        walls = padded(self.course.walls if self.course else np.zeros((0, 4)), dtype)
        key, driver_key = jax.random.split(jax.random.key(self.seed))
        nominal = jax.tree.map(dtype.type, self.nominal or self.car)
        loss = dtype.type(self.link.loss)
        around = Surroundings(walls, sonar.edges(walls), key, loss, nominal)
        if self.floor is not None or self.faults:
            cast = partial(jax.tree.map, dtype.type)
            around = around._replace(floor=cast(self.floor), faults=cast(self.faults))
        # What the driver takes for its start is the course's, wherever the car stands.
        believed = self.course.start if self.course else start
        loop = begin(
            plan,
            self.car,
            around,
            self.driver,
            start,
            believed,
            self.velocity,
            self.charge,
            driver_key,
        )
        return around, loop

    def _stepped(
        self, plan: Plan, ticks: int, around: Surroundings, loop: Loop
    ) -> tuple[Loop, Record]:
        """The same as `scan` for a driver that is called from Python."""
        records = []
        memory = loop.memory
        loop = loop._replace(memory=())
        for _ in range(ticks // plan.control):
            loop, observation = jitted_observe(plan, around, loop)
            command, memory = self.driver.act(memory, jax.tree.map(np.asarray, observation))
            loop = loop._replace(command=_like(command, loop.command))
            loop, record = hold(plan, self.car, around, loop)
            turn = np.full(plan.control, getattr(memory, "turn", 0))
            records.append(jax.tree.map(np.asarray, record)._replace(turn=turn))
        whole = jax.tree.map(lambda *pieces: np.concatenate(pieces), *records)
        return loop._replace(memory=memory), whole


def begin(
    plan: Plan,
    car: Car,
    around: Surroundings,
    driver: Driver,
    start: tuple[Scalar, Scalar, Scalar],
    believed: tuple[Scalar, Scalar, Scalar],
    moving: tuple[Scalar, Scalar, Scalar],
    charge: Scalar,
    key: jax.Array,
) -> Loop:
    """The loop before its first tick, with the pose that the driver believes; `key` is its."""
    dtype, nominal = jnp.result_type(car.body.mass), around.nominal
    state = planar.initial_state(car, plan.dt, start, moving, charge, plan.slots)
    sensors = suite.initial_memory(car, state.motion, plan.dt, plan.told)
    zero = dtype.type(0)
    still = Command(zero, zero)
    up = down = None
    if not plan.onboard:
        up = initial_channel(still, plan.control, plan.delay)
        down = initial_channel(sensors.readings, plan.telemetry, plan.delay)
    estimate: Any = dead_reckoning.initial_memory(believed, dtype)
    if plan.estimate in ("filter", "pose"):
        estimate = velocity.initial_memory(nominal, believed, dtype)
    if plan.estimate == "pose":
        known = velocity.estimate(nominal, estimate, plan.dt)
        cloud = locator(around).known(believed, jax.random.fold_in(key, 1), PARTICLES, known)
        estimate = estimate, pose.Located(cloud, pose.best(cloud))
    memory = driver.reset(key)
    if not jax.tree_util.all_leaves([driver]):
        memory = jax.tree.map(lambda leaf: _typed(leaf, dtype), memory)
    faulty = sensors.readings if plan.fails else None
    return Loop(np.int32(0), state, sensors, estimate, still, up, down, memory, faulty)


@partial(jax.jit, static_argnums=(0, 1))
def scan(
    plan: Plan, ticks: int, car: Car, around: Surroundings, driver: Driver, loop: Loop
) -> tuple[Loop, Record]:
    """So many ticks with a driver that JAX can trace."""
    return jax.lax.scan(
        lambda carry, _: tick(plan, car, around, driver, carry), loop, None, length=ticks
    )


def tick(
    plan: Plan, car: Car, around: Surroundings, driver: Driver, loop: Loop
) -> tuple[Loop, Record]:
    """One tick with a driver that JAX can trace."""

    def act(loop: Loop) -> Loop:
        loop, observation = observe(plan, around, loop)
        command, memory = driver.act(loop.memory, observation)
        memory = jax.tree.map(_like, memory, loop.memory)
        return loop._replace(command=jax.tree.map(_like, command, loop.command), memory=memory)

    if plan.control == 1:
        loop = act(loop)
    else:
        loop = jax.lax.cond(loop.tick % plan.control == 0, act, lambda same: same, loop)
    return advance(plan, car, around, loop)


@partial(jax.jit, static_argnums=0)
def hold(plan: Plan, car: Car, around: Surroundings, loop: Loop) -> tuple[Loop, Record]:
    """The ticks of one control period with the command as it is."""
    return jax.lax.scan(
        lambda carry, _: advance(plan, car, around, carry), loop, None, length=plan.control
    )


def observe(plan: Plan, around: Surroundings, loop: Loop) -> tuple[Loop, Observation]:
    """What the driver is told at this tick: the readings that it has heard, and the estimate."""
    readings = loop.readings if loop.down is None else loop.down.latest
    motion = loop.state.motion
    if plan.estimate in ("filter", "pose"):
        memory, known = estimated(plan, around, loop, readings)
    else:
        memory = dead_reckoning.update(loop.estimate, readings, plan.dt)
        known = memory.estimate
    if plan.estimate == "truth":
        known = Estimate(motion.x, motion.y, motion.heading, motion.vx, motion.vy, motion.yaw_rate)

    def heard(reading: Reading) -> Heard:
        age = plan.dt * (loop.tick - reading.tick).astype(jnp.result_type(motion.x))
        return Heard(reading.value, jnp.where(reading.tick >= 0, age, jnp.inf))

    told: Any = jax.tree.map(heard, readings, is_leaf=lambda node: isinstance(node, Reading))
    time = plan.dt * loop.tick.astype(jnp.result_type(motion.x))
    return loop._replace(estimate=memory), Observation(*(time, *told, known))


def estimated(
    plan: Plan, around: Surroundings, loop: Loop, readings: Readings
) -> tuple[Any, Estimate]:
    """The filters' memory at this tick, and what they believe."""
    memory, place = loop.estimate if plan.estimate == "pose" else (loop.estimate, None)

    def filtered(memory: velocity.Memory) -> velocity.Memory:
        return velocity.update(around.nominal, memory, readings, loop.command, loop.tick, plan.dt)

    now = loop.tick % plan.filtering == 0
    memory = jax.lax.cond(now, filtered, lambda same: same, memory)
    known = velocity.estimate(around.nominal, memory, plan.dt)
    if place is None:
        return memory, known
    every = plan.filtering * max(1, round(LOCATING / plan.dt / plan.filtering))

    def moved(place: pose.Located) -> pose.Located:
        cloud = locator(around).update(place.cloud, readings.sonar, known, plan.dt * every)
        return pose.Located(cloud, pose.best(cloud))

    place = jax.lax.cond(loop.tick % every == 0, moved, lambda same: same, place)
    return (memory, place), pose.located(place, known)


def locator(around: Surroundings) -> pose.PoseFilter:
    """The pose filter for these surroundings."""
    return pose.PoseFilter(walls=around.walls, sonar=around.nominal.sensors.sonar)


jitted_observe = jax.jit(observe, static_argnums=0)


def advance(plan: Plan, car: Car, around: Surroundings, loop: Loop) -> tuple[Loop, Record]:
    """One tick: command over the link, world, sensors, readings over the link."""
    command, fresh = loop.command, loop.tick % plan.control == 0
    up, down = loop.up, loop.down
    if up is not None and down is not None:
        lost = (
            jax.random.uniform(
                jax.random.fold_in(jax.random.fold_in(around.key, loop.tick), 7), (2,)
            )
            < around.loss
        )
        up = exchange(up, command, lost[0], loop.tick, plan.control, plan.delay)
        fresh = up.arrived == loop.tick
        silent = loop.tick - up.arrived > plan.timeout
        stops = silent & (up.arrived >= 0) if plan.timeout else jnp.asarray(False)
        command = up.latest._replace(throttle=jnp.where(stops, 0.0, up.latest.throttle))
        fresh = fresh | (stops & (loop.tick - up.arrived == plan.timeout + 1))
    state = planar.step(car, around.walls, loop.state, command, loop.tick, plan.dt, around.floor)
    after = loop.tick + 1
    sensors = suite.sense(
        car,
        around.walls,
        around.corners,
        loop.sensors,
        state.motion,
        around.key,
        after,
        plan.sensors,
        plan.dt,
    )
    readings, faulty = sensors.readings, loop.faulty
    if faulty is not None:
        readings = faulty = faults.report(
            around.faults, car, faulty, readings, around.key, after, plan.dt
        )
    if down is not None:
        down = exchange(down, readings, lost[1], after, plan.telemetry, plan.delay)
    before = loop.state.motion
    record = Record(
        loop.tick,
        before,
        voltage(car, before),
        command,
        fresh,
        loop.readings,
        jnp.asarray(getattr(loop.memory, "turn", 0)),
        loop.state.wall_contacts,
        loop.state.rolled_over,
        planar.forces(car, before, around.floor),
    )
    loop = loop._replace(tick=after, state=state, sensors=sensors, up=up, down=down, faulty=faulty)
    return loop, record


def voltage(car: Car, motion: Motion) -> Scalar:
    """The battery's voltage under load (V)."""
    driven = drivetrain.driven_speed(car, motion.wheels)
    return motor.drive(
        car.motor, car.drivetrain, car.battery, motion.duty, motion.charge, driven
    ).battery_voltage


def padded(walls: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Walls with rows of NaN up to a power of two, so that like courses share a program."""
    rows = max(8, 1 << math.ceil(math.log2(max(len(walls), 1))))
    full = np.full((rows, 4), np.nan, dtype)
    full[: len(walls)] = walls
    return full


def _typed(leaf: Any, dtype: np.dtype) -> Any:
    """A driver's number with a type of its own: that of the car, or a 32-bit integer."""
    if isinstance(leaf, bool | int):
        return np.int32(leaf)
    return dtype.type(leaf) if isinstance(leaf, float) else leaf


def _like(new: Any, old: Any) -> Any:
    """What a driver gave, with the type that the loop carries."""
    return jax.tree.map(lambda n, o: jnp.asarray(n, o.dtype), new, old)


def keep_programs(batches: bool = True, blocks: bool = False, cores: int = 1) -> None:
    """Settings for the process: compile well, and keep compiled programs in the user's cache.

    To be called before JAX computes anything; the command line does. A library does not do this
    behind its user's back. Without it all works, but starts and runs at half the speed or less.
    A process that drives one car at a time may say so, and drives it twice as fast. One that works
    through many cars in blocks of some hundred may say `blocks`: then a whole loop is one function
    whose numbers stay in the core's caches. `cores` is how many devices JAX makes of the CPU.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {compiler_flags(batches, blocks, cores=cores)}".strip()
    # A cache that cannot be read or written is no cache, and nothing to trouble anyone with.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(Path(home) / "countersteer" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def compiler_flags(
    batches: bool = True, blocks: bool = False, backend: Sequence[str] = (), cores: int = 1
) -> str:
    """What XLA is told (`keep_programs`); `backend` holds further options of its backend."""
    # Without this, scalars that several results need are computed anew for each of them.
    options = ["xla_cpu_use_multi_output_fusion"]
    flags = []
    if batches:
        # XLA's newer emitters abort the process on some batched programs with it (0.10.2).
        flags.append("--xla_cpu_use_fusion_emitters=false")
    if blocks:
        # A loop whose numbers take less bytes is compiled into one function.
        options.append("xla_cpu_small_while_loop_byte_threshold=100000000")
        flags.append("--xla_cpu_prefer_vector_width=512")
    if cores > 1:
        flags.append(f"--xla_force_host_platform_device_count={cores}")
    return " ".join([f"--xla_backend_extra_options={','.join([*options, *backend])}", *flags])
