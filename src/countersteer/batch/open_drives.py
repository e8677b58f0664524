"""Many short open drives at once, sampled on the way, for trials and experiments.

Each lane has its own car, charge, initial velocity and driver parameters. There are no sensors, no
link and no judge. The driver is called at each tick with the time and the true motion. Without
walls, the floor is open.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from countersteer.batch import engine
from countersteer.batch.engine import LANES
from countersteer.car.car import Car
from countersteer.drivers.driver import Driver, Heard, Observation
from countersteer.drivers.replay import Replay
from countersteer.estimation.estimate import Estimate
from countersteer.signals import Array, Command, Motion
from countersteer.task.judge import PERIOD
from countersteer.world import planar
from countersteer.world.floor import Floor
from countersteer.world.state import State
from countersteer.world.walls import padded

PIECE = 100  # samples in each call, for any length of the drives
DT = 0.001  # s
STEPS = 4
NOTHING = Heard(math.nan, math.inf)


class OpenDrive(NamedTuple):
    """A drive's own part; in a batch, leaves have a leading axis of drives."""

    car: Car
    driver: Any
    charge: Array
    velocity: Array
    pose: Array
    floor: Floor | None


class Sampled(NamedTuple):
    """The samples of the drives: arrays of (drives, samples)."""

    time: np.ndarray  # (samples,), s
    motion: Motion
    command: Command
    wall_contacts: np.ndarray


def drives(
    cars: Car,
    charge: Array,
    drivers: Sequence[Driver],
    velocity: Array,
    longest: float,
    pose: Array | None = None,
    walls: Array | None = None,
    floor: Floor | None = None,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int = LANES,
) -> Sampled:
    """One drive of `longest` seconds for each driver, sampled each `PERIOD` seconds.

    `velocity` (drives, 3) is vx, vy and yaw rate at the start, where the wheels roll. `pose`
    (drives, 3) is x, y and heading. `walls` (n, 4) are the same for all. Leaves of `cars` and
    `floor` have a leading axis of drives. The precision is that of `charge`.
    """
    dtype = np.asarray(charge).dtype
    driver = jax.tree.map(lambda *leaves: np.stack(leaves).astype(dtype), *drivers)
    pose = np.zeros((len(drivers), 3)) if pose is None else pose
    own = OpenDrive(
        cars, driver, charge, np.asarray(velocity, dtype), np.asarray(pose, dtype), floor
    )
    around = padded(np.zeros((0, 4)) if walls is None else walls, dtype)
    mesh = engine.all_cores()
    pieces, samples = math.ceil(longest / (PIECE * PERIOD)), round(longest / PERIOD)
    slots = planar.delay_slots(cars, DT)

    def run(block: OpenDrive, done: Callable[[float], None]) -> Any:
        loop, records = _start(mesh, slots, block), []
        for piece in range(pieces):
            tick = np.int32(piece * PIECE * round(PERIOD / DT))
            loop, record = _piece(mesh, block, loop, around, tick)
            records.append(jax.tree.map(np.asarray, record))
            done((piece + 1) / pieces)
        return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :samples], *records)

    return Sampled(
        PERIOD * np.arange(samples), *engine.in_turn(run, own, lanes * mesh.size, report)
    )


@partial(jax.jit, static_argnums=(0, 1))
def _start(mesh: Mesh, slots: int, block: Any) -> Any:
    """The states and the drivers' memories before the first tick."""

    def one(own: OpenDrive) -> Any:
        v, at = own.velocity, own.pose
        state = planar.initial_state(
            own.car, DT, (at[0], at[1], at[2]), (v[0], v[1], v[2]), own.charge, slots
        )
        return jax.tree.map(
            lambda leaf: jnp.asarray(leaf) if jnp.ndim(leaf) else leaf + jnp.zeros_like(own.charge),
            (state, own.driver.reset(jax.random.key(0))),
        )

    return engine.on_cores(jax.vmap(one), mesh, (True,))(block)


@partial(jax.jit, static_argnums=0)
def _piece(mesh: Mesh, block: Any, loop: Any, walls: Any, tick: Any) -> Any:
    """The next `PIECE` samples: the motion and the command at each."""
    every = round(PERIOD / DT)

    def one(own: OpenDrive, loop: Any, walls: Any) -> Any:
        def next_tick(carry: Any, count: Any) -> Any:
            state, memory = carry
            command, after = own.driver.act(memory, observed(state, count))
            after = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), after, memory)
            state = planar.step(own.car, walls, state, command, count, DT, own.floor)
            return (state, after), command

        def look(carry: Any, first: Any) -> Any:
            counts = first + jnp.arange(every, dtype=jnp.int32)
            after, commands = jax.lax.scan(next_tick, carry, counts)
            asked = jax.tree.map(lambda leaf: leaf[0], commands)
            return after, (carry[0].motion, asked, carry[0].wall_contacts)

        firsts = tick + every * jnp.arange(PIECE, dtype=jnp.int32)
        return jax.lax.scan(look, loop, firsts)

    lanes = jax.vmap(one, (0, 0, None))
    return engine.on_cores(lanes, mesh, (True, True, False))(block, loop, walls)


def observed(state: State, count: Any) -> Observation:
    """The observation of a driver: the time and the true motion."""
    m = state.motion
    known = Estimate(m.x, m.y, m.heading, m.vx, m.vy, m.yaw_rate)
    time = DT * count.astype(m.x.dtype)
    heard: Any = dict.fromkeys(Observation._fields, NOTHING)
    return Observation(**heard | {"time": time, "sonar": (), "estimate": known})


def commands(*steps: tuple[float, float, float]) -> Replay:
    """A driver with up to `STEPS` open-loop steps of time (s), throttle and steering (rad)."""
    # The same number for all, so that they share a program.
    padded = np.array([*steps, *[steps[-1]] * (STEPS - len(steps))]).T
    return Replay(times=padded[0], commands=Command(padded[1], padded[2]))


def repeated(car: Car, count: int) -> Car:
    """`count` copies of one car, in 32 bits."""
    many: Car = jax.tree.map(lambda leaf: np.broadcast_to(np.float32(leaf), (count,)), car)
    return many
