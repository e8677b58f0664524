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
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from countersteer.compiling import compiler_flags
from countersteer.signals import Array

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


def shared_out(trees: Any, cores: int | None = None) -> Any:
    """The same leaves, each core with its share of the leading axis.

    What goes into many calls of a program is placed once, or each call moves it again.
    """
    return jax.device_put(trees, NamedSharding(all_cores(cores), PartitionSpec("core")))


def on_each(trees: Any, cores: int | None = None) -> Any:
    """The same leaves, whole on each core."""
    return jax.device_put(trees, NamedSharding(all_cores(cores), PartitionSpec()))


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

    def on_core(own: Any, *shared: Any) -> Any:
        mine = in_blocks(own, lanes)
        first = jax.tree.map(lambda leaf: leaf[0], mine)
        unpack = unpacking(first)
        unpack_result = unpacking(jax.eval_shape(run, first, *shared))

        def block(numbers: Any) -> Any:
            return packed(run(unpack(numbers), *shared))

        after = jax.vmap(unpack_result)(jax.lax.map(block, jax.vmap(packed)(mine)))
        return jax.tree.map(
            lambda leaf: leaf.reshape(math.prod(leaf.shape[:2]), *leaf.shape[2:]), after
        )

    return _compiled(on_core, cores)


def on_blocks(run: Callable[..., Any]) -> Callable[..., Any]:
    """`run(own, *shared)` for each block, in one program, on the core that calls it.

    `own` and the result have a leading axis of blocks. The loop is fast where they are few arrays:
    see `packed`.
    """

    def on_core(own: Any, *shared: Any) -> Any:
        return jax.lax.map(lambda one: run(one, *shared), own)

    return jax.jit(on_core)


def _compiled(on_core: Callable[..., Any], cores: int | None) -> Callable[..., Any]:
    """`on_core(own, *shared)`, compiled, each core with its share of `own`."""
    mesh = all_cores(cores)

    def whole(own: Any, *shared: Any) -> Any:
        return on_cores(on_core, mesh, (True, *(False for _ in shared)))(own, *shared)

    return jax.jit(whole)


def parted(trees: Any) -> tuple[Any, Any]:
    """What differs among lanes, and what does not, as one lane has it; None in the other's place.

    What is alike need not pass through memory for each lane. `joined` is the inverse for a lane.
    """
    leaves, form = jax.tree.flatten(trees)
    arrays = [np.asarray(leaf) for leaf in leaves]
    alike = [bool(np.all(array == array[:1])) for array in arrays]
    pairs = list(zip(leaves, arrays, alike, strict=True))
    apart = [None if same else leaf for leaf, _, same in pairs]
    once = [array[0] if same else None for _, array, same in pairs]
    return jax.tree.unflatten(form, apart), jax.tree.unflatten(form, once)


def joined(apart: Any, once: Any) -> Any:
    """The whole of a lane, from the two trees of `parted`."""
    return jax.tree.map(
        lambda a, b: b if a is None else a, apart, once, is_leaf=lambda leaf: leaf is None
    )


def in_blocks(trees: Any, lanes: int) -> Any:
    """Leaves (blocks, lanes, …) from leaves (blocks · lanes, …)."""
    return jax.tree.map(
        lambda leaf: leaf.reshape(len(leaf) // lanes, lanes, *leaf.shape[1:]), trees
    )


def packed(block: Any) -> tuple[Array, ...]:
    """A block's leaves (lanes, …) as an array (numbers of a lane, lanes) for each type of number.

    A quantity of all lanes is then a row, read and written in one piece. Who calls a program often
    keeps the arrays between the calls.
    """
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(block)]
    flat = [leaf.reshape(len(leaf), math.prod(leaf.shape[1:])).T for leaf in leaves]
    return tuple(
        jnp.concatenate([leaf for leaf in flat if leaf.dtype == kind]) for kind in _kinds(leaves)
    )


def unpacking(like: Any) -> Callable[[tuple[Array, ...]], Any]:
    """The inverse of `packed`, for blocks as this one."""
    leaves, form = jax.tree.flatten(like)
    kinds = _kinds(leaves)
    shapes = [leaf.shape for leaf in leaves]

    def unpack(arrays: tuple[Array, ...]) -> Any:
        used, found = [0] * len(kinds), []
        for leaf, shape in zip(leaves, shapes, strict=True):
            kind = kinds.index(leaf.dtype)
            first = used[kind]
            used[kind] += math.prod(shape[1:])
            found.append(arrays[kind][first : used[kind]].T.reshape(shape))
        return jax.tree.unflatten(form, found)

    return unpack


def _kinds(leaves: Sequence[Any]) -> list[Any]:
    """The types of number."""
    return sorted({leaf.dtype for leaf in leaves}, key=str)


def whole_blocks(count: int, lanes: int, cores: int) -> int:
    """The least number of lanes, at least `count`, that fills whole blocks on all cores."""
    return math.ceil(count / (lanes * cores)) * lanes * cores
