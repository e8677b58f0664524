"""Many cars at once on a CPU, at the speed of its vector units.

XLA runs a scan as one small kernel after another, with the whole batch's numbers travelling
through memory between them. So the batch is cut into blocks whose numbers stay in the core's own
caches: within a block goes the scan over the ticks, compiled into one function, outside it the
loop over blocks, and around all the CPU's cores. Needs the flags of `flags`, set before JAX starts;
without them it is as right, and a tenth as fast.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from countersteer.car.car import Car
from countersteer.signals import Command
from countersteer.simulator import compiler_flags
from countersteer.world import planar
from countersteer.world.state import State

LANES = 256  # cars of a block: enough for the loops' overhead, few enough for the caches
# In a block each delay line has its slots first: each slot's lanes lie side by side.
MOTION: Any = 0  # an axis stands for all of a motion
AXES = State(MOTION, 1, 1, 0, 0, 0, 0, 0)


def flags(cores: int) -> str:
    """What XLA_FLAGS must be before JAX starts."""
    # Kernels with many results are vectorised too, whatever it takes to show that their results do
    # not overlap (options of LLVM).
    backend = (
        "-runtime-memory-check-threshold=1000000",
        "-vectorize-memory-check-threshold=1000000",
        "-memory-check-merge-threshold=1000000",
    )
    return compiler_flags(blocks=True, backend=backend, cores=cores)


def advance(
    cars: Car, walls: Any, states: State, commands: Command, first: Any, dt: float, ticks: int
) -> State:
    """A block of states after so many ticks, each with its own command; plain `vmap`.

    `cars` has an axis of lanes, as states and commands do, or is one for all.
    """
    axes = (0 if np.ndim(cars.body.mass) else None, None, AXES, 0, None, None)
    step = jax.vmap(planar.step, axes, AXES)

    def turned(states: State) -> State:
        return states._replace(
            throttle_line=states.throttle_line.T, steering_line=states.steering_line.T
        )

    counts = first + jnp.arange(ticks, dtype=jnp.int32)
    last, _ = jax.lax.scan(
        lambda states, count: (step(cars, walls, states, commands, count, dt), None),
        turned(states),
        counts,
    )
    return turned(last)


def in_blocks(
    dt: float, ticks: int, lanes: int = LANES, cores: int | None = None
) -> Callable[[Car, Any, State, Command, Any], State]:
    """`advance` in blocks of so many lanes, on so many of JAX's devices (all), compiled.

    The number of cars is a multiple of lanes times cores.
    """
    mesh = Mesh(np.array(jax.devices()[:cores]), ("core",))

    def on_core(cars: Car, walls: Any, states: State, commands: Command, first: Any) -> State:
        varied = np.ndim(cars.body.mass) > 0
        inputs = (cars, states, commands) if varied else (None, states, commands)
        # A block's numbers are one array: that goes in and out of the loop in place.
        _, unpack = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], inputs))
        blocks = _packed(inputs)
        blocks = blocks.reshape(-1, lanes, blocks.shape[-1])

        def block(numbers: Any) -> Any:
            own, states, commands = jax.vmap(unpack)(numbers)
            return _packed(
                advance(own if varied else cars, walls, states, commands, first, dt, ticks)
            )

        after = jax.lax.map(block, blocks)
        _, unpack = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], states))
        last: State = jax.vmap(unpack)(after.reshape(-1, after.shape[-1]))
        return last

    def whole(cars: Car, *others: Any) -> State:
        cut, same = PartitionSpec("core"), PartitionSpec()
        specs = (cut if np.ndim(cars.body.mass) else same, same, cut, cut, same)
        run = jax.shard_map(on_core, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False)
        last: State = run(cars, *others)
        return last

    return jax.jit(whole)


def _packed(trees: Any) -> Any:
    """(n, numbers of one) for a pytree of n."""
    return jax.vmap(lambda tree: ravel_pytree(tree)[0])(trees)


def spread(count: int, lanes: int, cores: int) -> int:
    """The least number of cars that holds `count` and fills whole blocks."""
    return math.ceil(count / (lanes * cores)) * lanes * cores
