"""Many drives at once on open floor, sampled as they go: what trials and experiments look at.

Each lane has its own car, charge, velocity at the start and driver's numbers. There is no course,
no sensor and no link: the driver is called at each tick, and told the time and the true motion.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from countersteer.car.car import Car
from countersteer.car.parameter import Array
from countersteer.drivers.driver import Command, Driver, Heard, Observation
from countersteer.estimation.estimate import Estimate
from countersteer.evaluation.rollout import LANES, LOOK
from countersteer.simulator import padded
from countersteer.world import planar
from countersteer.world.state import Motion, State

PIECE = 100  # samples of a call, whatever the length of the drives
DT = 0.001  # s
NOTHING = Heard(math.nan, math.inf)


class Sampled(NamedTuple):
    """What came of the drives: arrays of (drives, samples)."""

    time: np.ndarray  # (samples,), s
    motion: Motion
    command: Command


def drives(
    cars: Car,
    charge: Array,
    drivers: Sequence[Driver],
    velocity: Array,
    longest: float,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int = LANES,
) -> Sampled:
    """One drive of `longest` seconds for each driver, sampled each `LOOK` seconds.

    `velocity` (drives, 3) is vx, vy and yaw rate at the start, at which the wheels roll. Leaves of
    `cars` have an axis of drives in front; the precision is that of `charge`.
    """
    dtype = np.asarray(charge).dtype
    driver = jax.tree.map(lambda *leaves: np.stack(leaves).astype(dtype), *drivers)
    own = (cars, driver, charge, np.asarray(velocity, dtype))
    mesh = Mesh(np.array(jax.devices()), ("core",))
    count, width = len(drivers), lanes * mesh.size
    pieces, kept = math.ceil(longest / (PIECE * LOOK)), round(longest / LOOK)
    slots = planar.delay_slots(cars, DT)
    blocks = []
    for first in range(0, count, width):
        picked, rows = np.arange(first, first + width) % count, min(width, count - first)
        block = jax.tree.map(lambda leaf, picked=picked: np.asarray(leaf)[picked], own)
        loop = _start(mesh, slots, block)
        records = []
        for piece in range(pieces):
            tick = np.int32(piece * PIECE * round(LOOK / DT))
            loop, record = _piece(mesh, block, loop, tick)
            records.append(jax.tree.map(lambda leaf, n=rows: np.asarray(leaf)[:n], record))
            report(first * pieces + (piece + 1) * rows, count * pieces)
        blocks.append(
            jax.tree.map(lambda *parts: np.concatenate(parts, axis=1)[:, :kept], *records)
        )
    motion, command = jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)
    return Sampled(LOOK * np.arange(kept), motion, command)


@partial(jax.jit, static_argnums=(0, 1))
def _start(mesh: Mesh, slots: int, block: Any) -> Any:
    """State and driver's memory before the first tick."""

    def one(own: Any) -> Any:
        car, driver, charge, velocity = own
        v = (velocity[0], velocity[1], velocity[2])
        state = planar.initial_state(car, DT, (0.0, 0.0, 0.0), v, charge, slots)
        return jax.tree.map(
            lambda leaf: jnp.asarray(leaf) if jnp.ndim(leaf) else leaf + jnp.zeros_like(charge),
            (state, driver.reset(jax.random.key(0))),
        )

    return _on_cores(mesh, jax.vmap(one), 1)(block)


@partial(jax.jit, static_argnums=0)
def _piece(mesh: Mesh, block: Any, loop: Any, tick: Any) -> Any:
    """The next `PIECE` samples: the motion at each, and the command that is asked for then."""
    every = round(LOOK / DT)

    def one(own: Any, loop: Any) -> Any:
        car, driver, charge, _ = own
        walls = jnp.asarray(padded(np.zeros((0, 4)), charge.dtype))

        def next_tick(carry: Any, count: Any) -> Any:
            state, memory = carry
            command, memory = driver.act(memory, observed(state, count))
            memory = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), memory, carry[1])
            return (planar.step(car, walls, state, command, count, DT), memory), command

        def look(carry: Any, first: Any) -> Any:
            counts = first + jnp.arange(every, dtype=jnp.int32)
            after, commands = jax.lax.scan(next_tick, carry, counts)
            return after, (carry[0].motion, jax.tree.map(lambda leaf: leaf[0], commands))

        firsts = tick + every * jnp.arange(PIECE, dtype=jnp.int32)
        return jax.lax.scan(look, loop, firsts)

    return _on_cores(mesh, jax.vmap(one), 2)(block, loop)


def observed(state: State, count: Any) -> Observation:
    """What a driver is told here."""
    m = state.motion
    known = Estimate(m.x, m.y, m.heading, m.vx, m.vy, m.yaw_rate)
    time = DT * count.astype(m.x.dtype)
    return Observation(
        time, (), NOTHING, NOTHING, NOTHING, NOTHING, NOTHING, NOTHING, None, None, known
    )


def _on_cores(mesh: Mesh, run: Callable[..., Any], inputs: int) -> Callable[..., Any]:
    """A share of the lanes on each core."""
    cut = PartitionSpec("core")
    made: Callable[..., Any] = jax.shard_map(
        run, mesh=mesh, in_specs=(cut,) * inputs, out_specs=cut, check_vma=False
    )
    return made
