"""The engine of a batch: many lanes on all cores of a CPU, at the speed of its vector units.

A batch is cut into blocks of lanes. Each core works through its share. There are two loops over
blocks:

- `in_turn` is outside the compiled program. It is for drives of seconds, and reports progress.
- `in_one_program` is inside. XLA runs a scan as one small kernel after another. Between kernels,
  the numbers of a whole batch pass through memory. Those of a block stay in the core's caches. It
  needs the flags of `flags` before JAX starts. Without them it is correct, at a tenth of the speed.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from countersteer.compiling import compiler_flags

LANES = 128  # of a block of `in_turn`
CACHED_LANES = 256  # of a block of `in_one_program`: many for the loop's overhead, few for caches


def flags(cores: int) -> str:
    """The value of XLA_FLAGS. It must be set before JAX starts."""
    # So LLVM vectorises kernels with many results too, although its checks for overlaps are long.
    backend = (
        "-runtime-memory-check-threshold=1000000",
        "-vectorize-memory-check-threshold=1000000",
        "-memory-check-merge-threshold=1000000",
    )
    return compiler_flags(blocks=True, backend=backend, cores=cores)


def all_cores(cores: int | None = None) -> Mesh:
    """A mesh of the first `cores` of JAX's devices, by default of all."""
    return Mesh(np.array(jax.devices()[:cores]), ("core",))


def on_cores(run: Callable[..., Any], mesh: Mesh, lanes: Sequence[bool]) -> Callable[..., Any]:
    """`run` on each core, with the core's share of the arguments.

    `lanes` is True for arguments with a leading axis of lanes. The others are the same on each
    core. Results have a leading axis of lanes.
    """
    cut, same = PartitionSpec("core"), PartitionSpec()
    specs = tuple(cut if has else same for has in lanes)
    made: Callable[..., Any] = jax.shard_map(
        run, mesh=mesh, in_specs=specs, out_specs=cut, check_vma=False
    )
    return made


def in_turn(
    run: Callable[[Any, Callable[[float], None]], Any],
    own: Any,
    width: int,
    report: Callable[[int, int], None] = lambda *_: None,
) -> Any:
    """The results of `run` for blocks of `width` lanes, one block after another.

    Leaves of `own` and of the results have a leading axis of lanes. The last block is filled up
    with lanes from the start, whose results are dropped. `run` may report the finished part of its
    block (0 to 1).
    """
    count = len(jax.tree.leaves(own)[0])
    found = []
    for first in range(0, count, width):
        picked, rows = np.arange(first, first + width) % count, min(width, count - first)

        def done(part: float, first: int = first, rows: int = rows) -> None:
            report(round(first + part * rows), count)

        results = run(jax.tree.map(lambda leaf, at=picked: np.asarray(leaf)[at], own), done)
        found.append(jax.tree.map(lambda leaf, n=rows: np.asarray(leaf)[:n], results))
        done(1.0)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def in_one_program(
    run: Callable[..., Any], lanes: int = CACHED_LANES, cores: int | None = None
) -> Callable[..., Any]:
    """`run(own, *shared)` for a batch, compiled with the loop over blocks inside the program.

    `own` and the result have a leading axis of lanes. Within `run`, it has the lanes of one block.
    The number of lanes must be a multiple of `lanes` times cores (`whole_blocks`).
    """
    mesh = all_cores(cores)

    def on_core(own: Any, *shared: Any) -> Any:
        # A block's numbers are one array, so that the loop updates it in place.
        numbers, unpack = packed(own)
        shapes = jax.eval_shape(run, jax.tree.map(lambda leaf: leaf[:lanes], own), *shared)
        empty = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
        _, unpack_result = packed(empty)

        def block(numbers: Any) -> Any:
            return packed(run(jax.vmap(unpack)(numbers), *shared))[0]

        after = jax.lax.map(block, numbers.reshape(-1, lanes, numbers.shape[-1]))
        return jax.vmap(unpack_result)(after.reshape(-1, after.shape[-1]))

    def whole(own: Any, *shared: Any) -> Any:
        return on_cores(on_core, mesh, (True, *(False for _ in shared)))(own, *shared)

    return jax.jit(whole)


def packed(trees: Any) -> tuple[Any, Callable[[Any], Any]]:
    """A pytree of lanes as an array (lanes, numbers of one), and the inverse for one lane.

    Who calls a program often keeps the array between the calls: packing passes through all memory.
    """
    _, unpack = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], trees))
    return jax.vmap(lambda tree: ravel_pytree(tree)[0])(trees), unpack


def whole_blocks(count: int, lanes: int, cores: int) -> int:
    """The least number of lanes, at least `count`, that fills whole blocks on all cores."""
    return math.ceil(count / (lanes * cores)) * lanes * cores
