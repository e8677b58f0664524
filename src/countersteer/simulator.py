"""The closed loop: a pilot, a link, and a car with its sensors in a world.

    world.step ──► sensors ──► link ──► readings ──► pilot ─┐
        ▲                                                   │
        └──────────────── link ◄──── command ◄──────────────┘

`Simulator` holds the car, world, sensors and link: call `init`, then `readings` and `apply` in
turn. `Pilot` gives the commands. `run` closes the loop. Time is an integer tick. In each tick, the
command passes the link, the world takes a step, and the sensors measure the result.
"""

import dataclasses
import math
from collections.abc import Callable, Generator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer import random_streams
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.drivers.driver import Status
from countersteer.estimation.estimate import Estimate
from countersteer.kept_programs import kept
from countersteer.link.link import ONBOARD, Link, Packets, exchange, initial_packets
from countersteer.pilot import Pilot, PilotMemory
from countersteer.random_streams import Stream
from countersteer.sensing import all_sensors, sonar
from countersteer.sensing import faults as failing
from countersteer.sensing.faults import SensorFault
from countersteer.signals import AnyCommand, Array, Command, Motion, Readings, Scalar
from countersteer.world import drivetrain, motor
from countersteer.world.floor import Floor
from countersteer.world.planar import planar
from countersteer.world.walls import padded
from countersteer.world.world import World

PIECE = 0.5  # s of simulated time in one piece; records are flushed between pieces

MakeWorld = Callable[[Car, Array, Floor | None, float], World]


class Loop(NamedTuple):
    """The state of a `Simulator` between two ticks."""

    tick: Scalar
    state: Any  # the world's
    sensors: all_sensors.SensorMemory
    up: Packets | None  # None: the pilot is on board
    down: Packets | None
    faulty: Readings | None = None  # last reports with their faults; None: there are no faults

    @property
    def readings(self) -> Readings:
        """The sensors' last reports, before any link."""
        return self.sensors.readings if self.faulty is None else self.faulty


class Record(NamedTuple):
    """The record of a tick: the state at its start, and the command that the car executes in it."""

    tick: Scalar
    motion: Motion
    voltage: Scalar  # of the battery under load
    command: AnyCommand
    fresh: Scalar  # whether that command is a new one
    readings: Readings
    wall_contacts: Scalar
    rolled_over: Scalar
    status: Status  # the driver's status at its start
    estimate: Estimate | None = None  # the pilot's at its start; None: there was no pilot


@pytree
class Simulator:
    """A car in a world, with its sensors and its link to the pilot.

    Its precision is that of the car's leaves: 64-bit leaves run in 64 bits. `of` constructs it.
    """

    world: World
    walls: Array  # (n, 4), for the sensors, padded with rows of NaN
    corners: Array  # (2n, 3), from `sonar.edges`
    pose: tuple[Scalar, Scalar, Scalar]  # at the start: x, y, heading
    velocity: tuple[Scalar, Scalar, Scalar]  # vx, vy, yaw rate
    charge: Scalar  # of the battery
    seed: Scalar
    faults: tuple[SensorFault, ...]
    loss: Scalar  # chance that the radio loses a packet
    link: Link = dataclasses.field(metadata={"static": True})
    every: all_sensors.Periods = dataclasses.field(metadata={"static": True})
    slots: int = dataclasses.field(metadata={"static": True})  # poses kept for the position's delay

    @classmethod
    def of(
        cls,
        course: Course | None,
        car: Car,
        *,
        link: Link = ONBOARD,
        dt: float = 0.001,
        seed: int = 0,
        charge: float = 1.0,
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        start: tuple[float, float, float] | None = None,
        floor: Floor | None = None,
        faults: tuple[SensorFault, ...] = (),
        world: MakeWorld = planar,
    ) -> "Simulator":
        """A car on a course (None: open floor), at the course's start unless `start` is given.

        `floor` gives friction that varies with position. `world` makes the physics. Raises
        `InputError` if a fault has an unknown kind or a sensor that the car lacks.
        """
        failing.check(faults, car)
        dtype = np.asarray(car.body.mass).dtype
        cast = partial(jax.tree.map, dtype.type)
        walls = padded(course.walls if course else np.zeros((0, 4)), dtype)
        return cls(
            world=world(car, walls, cast(floor), dt),
            walls=walls,
            corners=sonar.edges(walls),
            pose=start or (course.start if course else (0.0, 0.0, 0.0)),
            velocity=velocity,
            charge=charge,
            seed=np.int32(seed),
            faults=cast(faults),
            loss=dtype.type(link.loss),
            link=link,
            every=all_sensors.periods(car, dt),
            slots=all_sensors.position_slots(car, dt),
        )

    @property
    def car(self) -> Car:
        """The simulated car."""
        return self.world.car

    @property
    def dt(self) -> float:
        """Length of a tick (s)."""
        return self.world.dt

    @property
    def dtype(self) -> Any:
        """The precision of the simulation."""
        # Not `jnp.result_type`: it returns 32 bits unless 64 bits are enabled.
        return np.dtype(getattr(self.car.body.mass, "dtype", np.float64))

    @property
    def root(self) -> jax.Array:
        """The random key of the drive. All keys of its draws derive from it."""
        return random_streams.root(self.seed)

    def init(self) -> Loop:
        """The state before the first tick."""
        with self._precision():
            return begin(self)

    def readings(self, loop: Loop) -> Readings:
        """The readings that have reached the pilot. `truth` is for the estimator `truth` only."""
        return heard(self, loop)

    def apply(self, loop: Loop, command: AnyCommand, ticks: int) -> tuple[Loop, Record]:
        """Advance by `ticks`, with the command given at the first one and held.

        The record has a leading axis of ticks. A radio sends commands at its own period.
        """
        with self._precision():
            return _apply(self, ticks, loop, command)

    def run(self, pilot: Pilot, longest: float) -> Generator[Record, None, None]:
        """Drive for `longest` seconds, rounded up to whole pieces of about `PIECE` seconds.

        Yields the record of each piece. The caller may stop early, such as at the goal.
        """
        pilot = pilot.typed(self.dtype)
        ticks = max(1, round(PIECE / self.dt / pilot.control)) * pilot.control
        piece = scan if pilot.traced else steps
        with self._precision():
            loop, memory = begin(self), pilot.init(self.root)
        before = None
        for _ in range(math.ceil(longest / (ticks * self.dt))):
            try:
                with self._precision():
                    loop, memory, record = piece(self, pilot, ticks, loop, memory)
            except BaseException:
                # If the driver fails, the record before this piece is not lost.
                if before is not None:
                    yield jax.tree.map(np.asarray, before)
                raise
            # This piece is computed while the caller reads the one before it.
            if before is not None:
                yield jax.tree.map(np.asarray, before)
            before = record
        if before is not None:
            yield jax.tree.map(np.asarray, before)

    def record(self, pilot: Pilot, longest: float) -> Record:
        """All records of `run` in one, cut off at `longest` seconds. For drives up to minutes."""
        last, pieces = round(longest / self.dt), self.run(pilot, longest)
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:last], *pieces)

    def _precision(self) -> Any:
        return jax.enable_x64(self.dtype == np.float64)


def begin(simulator: Simulator) -> Loop:
    """`Simulator.init`, for use under `jit`."""
    world, link = simulator.world, simulator.link.in_ticks(simulator.dt)
    state = world.init(simulator.pose, simulator.velocity, simulator.charge)
    motion = world.motion(state)
    sensors = all_sensors.initial_memory(world.car, motion, world.dt, simulator.slots)
    up = down = None
    if not link.onboard:
        zero = simulator.dtype.type(0)
        up = initial_packets(Command(zero, zero), link.control, link.delay)
        down = initial_packets(sensors.readings, link.telemetry, link.delay)
    faulty = sensors.readings if simulator.faults else None
    return Loop(np.int32(0), state, sensors, up, down, faulty)


def heard(simulator: Simulator, loop: Loop) -> Readings:
    """`Simulator.readings`, for use under `jit`."""
    latest: Readings = loop.readings if loop.down is None else loop.down.latest
    return latest._replace(truth=simulator.world.motion(loop.state))


def advance(
    simulator: Simulator, loop: Loop, command: AnyCommand, fresh: Scalar
) -> tuple[Loop, Record]:
    """One tick: command over the link, world, sensors, readings over the link."""
    world, link, root = simulator.world, simulator.link.in_ticks(simulator.dt), simulator.root
    car, tick, after = world.car, loop.tick, loop.tick + 1
    up, down = loop.up, loop.down
    if up is not None:
        key = random_streams.key(root, Stream.LINK, tick)
        lost = jax.random.uniform(key, (2,)) < simulator.loss
        up = exchange(up, command, lost[0], tick, link.control, link.delay)
        fresh = up.arrived == tick
        silent = tick - up.arrived > link.timeout
        stops = silent & (up.arrived >= 0) if link.timeout else jnp.asarray(False)
        command = up.latest._replace(throttle=jnp.where(stops, 0.0, up.latest.throttle))
        fresh = fresh | (stops & (tick - up.arrived == link.timeout + 1))
    before, events = world.motion(loop.state), world.events(loop.state)
    state = _step(world, loop.state, command, tick)
    sensors = all_sensors.sense(
        car,
        simulator.walls,
        simulator.corners,
        loop.sensors,
        world.motion(state),
        root,
        after,
        simulator.every,
        world.dt,
    )
    readings, faulty = sensors.readings, loop.faulty
    if faulty is not None:
        readings = faulty = failing.report(
            simulator.faults, car, faulty, readings, root, after, world.dt
        )
    if down is not None:
        down = exchange(down, readings, lost[1], after, link.telemetry, link.delay)
    record = Record(
        tick, before, voltage(car, before), command, fresh, loop.readings, *events, Status()
    )
    return Loop(after, state, sensors, up, down, faulty), record


def _step(world: World, state: Any, command: AnyCommand, tick: Scalar) -> Any:
    """`world.step`, as a loop of one round.

    XLA compiles a loop without branches into one function. Beside the branches of the sensors, it
    would compute much of the physics again for each of its results: a batch took twice as long.
    """

    def step(at: tuple[Any, Scalar]) -> tuple[Any, Scalar]:
        return world.step(at[0], command, at[1]), at[1] + 1

    return jax.lax.while_loop(lambda at: at[1] <= tick, step, (state, tick))[0]


@partial(jax.jit, static_argnums=1)
def _apply(
    simulator: Simulator, ticks: int, loop: Loop, command: AnyCommand
) -> tuple[Loop, Record]:
    first = loop.tick

    def one(loop: Loop, _: None) -> tuple[Loop, Record]:
        return advance(simulator, loop, command, loop.tick == first)

    # A scan of one tick would be unrolled. Its last digits would differ from a longer scan's.
    shapes = jax.eval_shape(one, loop, None)[1]
    lines = jax.tree.map(lambda leaf: jnp.zeros((ticks, *leaf.shape), leaf.dtype), shapes)

    def write(at: tuple[Loop, Record, Scalar]) -> tuple[Loop, Record, Scalar]:
        loop, lines, i = at
        loop, record = one(loop, None)
        return loop, jax.tree.map(lambda line, new: line.at[i].set(new), lines, record), i + 1

    last = first + ticks
    loop, lines, _ = jax.lax.while_loop(lambda at: at[0].tick < last, write, (loop, lines, 0))
    return loop, lines


def tick(
    simulator: Simulator, pilot: Pilot, loop: Loop, memory: PilotMemory
) -> tuple[Loop, PilotMemory, Record]:
    """One tick with a pilot that JAX can trace."""

    def act(memory: PilotMemory) -> PilotMemory:
        return pilot.act(memory, heard(simulator, loop), loop.tick)[1]

    status, estimate = pilot.status(memory), pilot.estimate(memory)
    # Traced even if each tick has a decision: code compiled apart gives the same digits.
    now = loop.tick % pilot.control == 0 if pilot.control > 1 else loop.tick >= 0
    memory = jax.lax.cond(now, act, lambda same: same, memory)
    loop, record = advance(simulator, loop, memory.command, now)
    return loop, memory, record._replace(status=status, estimate=estimate)


@kept(2)
def scan(
    simulator: Simulator, pilot: Pilot, ticks: int, loop: Loop, memory: PilotMemory
) -> tuple[Loop, PilotMemory, Record]:
    """Run `ticks` ticks with a pilot that JAX can trace."""

    def one(carry: tuple[Loop, PilotMemory], _: None) -> tuple[tuple[Loop, PilotMemory], Record]:
        loop, memory, record = tick(simulator, pilot, *carry)
        return (loop, memory), record

    (loop, memory), record = jax.lax.scan(one, (loop, memory), None, length=ticks)
    return loop, memory, record


def steps(
    simulator: Simulator, pilot: Pilot, ticks: int, loop: Loop, memory: PilotMemory
) -> tuple[Loop, PilotMemory, Record]:
    """`scan` for any pilot, one decision at a time."""
    records = []
    told = pilot.status(memory), pilot.estimate(memory)
    for _ in range(ticks // pilot.control):
        command, memory = pilot.act(memory, simulator.readings(loop), loop.tick)
        loop, record = simulator.apply(loop, command, pilot.control)
        before, told = told, (pilot.status(memory), pilot.estimate(memory))
        status, estimate = jax.tree.map(
            lambda before, after: np.array([before, *[after] * (pilot.control - 1)]), before, told
        )
        kept = jax.tree.map(np.asarray, record)
        records.append(kept._replace(status=status, estimate=estimate))
    return loop, memory, jax.tree.map(lambda *parts: np.concatenate(parts), *records)


def voltage(car: Car, motion: Motion) -> Scalar:
    """The battery's voltage under load (V)."""
    driven = drivetrain.driven_speed(car, motion.wheels)
    return motor.drive(
        car.motor, car.drivetrain, car.battery, motion.duty, motion.charge, driven
    ).battery_voltage
