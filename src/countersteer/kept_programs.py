"""Compiled functions that are traced once and kept between processes.

Tracing and lowering a drive takes longer than driving it. `kept` stores the lowered program
(`jax.export`) in the user's cache. The key is made of all that the program depends on: the source
of this package, the versions of JAX, the function, and the types of its arguments. Values are no
part of it: another seed, or another car with the same parts, finds the same program. What the
program compiles to is in JAX's own cache.

A stored program is StableHLO, and the structure of its result as JSON. Reading one executes
nothing, and imports only classes of this package.
"""

import contextlib
import functools
import hashlib
import importlib
import json
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import countersteer
from countersteer.cache import cache_folder

FORMAT = 1
PACKAGE = "countersteer"


class Kept:
    """A pure function, as `jax.jit` would have it; `static` are the positions of static arguments.

    Under a trace it is the function itself. A program is kept only if every class in the arguments
    is of this package: nothing else is known to change its source when it changes.
    """

    def __init__(self, function: Callable[..., Any], static: Sequence[int] = ()) -> None:
        """Nothing is read or traced before the first call."""
        self.function, self.static = function, frozenset(static)
        self._jitted = jax.jit(function, static_argnums=tuple(static))
        self._programs: dict[Any, _Program | None] = {}
        self._lock = threading.Lock()
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        """The function's result."""
        dynamic = [a for i, a in enumerate(arguments) if i not in self.static]
        leaves, tree = jax.tree.flatten(dynamic)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.function(*arguments)
        program = self._program(arguments, leaves, tree)
        if program is None:
            return self._jitted(*arguments)
        return jax.tree.unflatten(program.tree, program.run(*map(_strong, leaves)))

    def ready(self, *arguments: Any) -> None:
        """Loads or makes the program for such arguments, and compiles it, but does not run it."""
        dynamic = [a for i, a in enumerate(arguments) if i not in self.static]
        leaves, tree = jax.tree.flatten(dynamic)
        program = self._program(arguments, leaves, tree)
        if program is None:
            self._jitted.lower(*arguments).compile()
        else:
            program.compiled([*map(_strong, leaves)])

    def _program(self, arguments: Sequence[Any], leaves: list[Any], tree: Any) -> "_Program | None":
        types = tuple(_type(leaf) for leaf in leaves)
        static = tuple(arguments[i] for i in sorted(self.static))
        signature = (tree, types, static, jnp.result_type(float), _device())
        with self._lock:
            if signature not in self._programs:
                self._programs[signature] = self._find(arguments, leaves, tree, types, static)
            return self._programs[signature]

    def _find(
        self, arguments: Sequence[Any], leaves: list[Any], tree: Any, types: Any, static: Any
    ) -> "_Program | None":
        """From the cache, or made and put there; None if it cannot be kept."""
        if not _own(tree):
            return None
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        versions = (FORMAT, source(), jax.__version__, jax.lib.__version__)
        text = repr((*versions, str(jnp.result_type(float)), name, static, types, str(tree)))
        if " at 0x" in text:  # something without a lasting name
            return None
        key = hashlib.sha256(text.encode()).hexdigest()[:32]
        folder = cache_folder() / "programs"
        return _read(folder, key) or self._make(arguments, leaves, tree, folder, key)

    def _make(
        self, arguments: Sequence[Any], leaves: list[Any], tree: Any, folder: Path, key: str
    ) -> "_Program | None":
        """Traces and exports the function, and stores it if it can be."""
        from jax import export

        result: list[Any] = []

        def flat(*leaves: Any) -> list[Any]:
            dynamic = iter(jax.tree.unflatten(tree, leaves))
            given = [a if i in self.static else next(dynamic) for i, a in enumerate(arguments)]
            found, found_tree = jax.tree.flatten(self.function(*given))
            result[:] = [found_tree]
            return found

        exported = export.export(jax.jit(flat))(*leaves)
        structure = _described(jax.tree.unflatten(result[0], range(result[0].num_leaves)))
        if structure is None:
            return None
        head = json.dumps({"format": FORMAT, "result": structure}).encode()
        with contextlib.suppress(OSError):  # a cache that cannot be written is no cache
            folder.mkdir(parents=True, exist_ok=True)
            _write(folder / key, len(head).to_bytes(8, "little") + head + exported.serialize())
        return _Program(exported, result[0])


def kept(*static: int) -> Callable[[Callable[..., Any]], Kept]:
    """`Kept`, as a decorator."""
    return lambda function: Kept(function, static)


class _Program:
    """An exported program, and the tree of its result."""

    def __init__(self, exported: Any, tree: Any) -> None:
        # Without a named device, JAX compiles again for the results of a call before.
        here = jax.sharding.SingleDeviceSharding(_device())
        self.tree = tree
        self.run = jax.jit(exported.call, in_shardings=here, out_shardings=here)

    def compiled(self, leaves: Sequence[Any]) -> None:
        """Compiles it for arguments of these types."""
        self.run.lower(*leaves).compile()


def _read(folder: Path, key: str) -> _Program | None:
    """The stored program; None where there is none that can be read."""
    from jax import export

    try:
        data = (folder / key).read_bytes()
        size = int.from_bytes(data[:8], "little")
        head = json.loads(data[8 : 8 + size])
        tree = jax.tree.structure(_built(head["result"]))
        return _Program(export.deserialize(bytearray(data[8 + size :])), tree)
    except FileNotFoundError:
        return None
    except Exception:  # cut off, or of another version: it is made again
        return None


def _write(file: Path, data: bytes) -> None:
    """All or nothing, as two processes may write at once."""
    part = file.with_suffix(f".{os.getpid()}")
    part.write_bytes(data)
    part.replace(file)


def _type(leaf: Any) -> tuple[Any, ...]:
    """Shape and type of an argument; a number of Python is an array of JAX's default type."""
    dtype = getattr(leaf, "dtype", None) or jnp.result_type(leaf)
    if jnp.issubdtype(dtype, jax.dtypes.extended):  # a key
        return (np.shape(leaf), str(dtype))
    return (np.shape(leaf), str(jax.dtypes.canonicalize_dtype(dtype)))


def _device() -> Any:
    """The device that JAX computes on now."""
    return getattr(jax.config, "jax_default_device", None) or jax.devices()[0]


def _strong(leaf: Any) -> Any:
    """The argument with a type of its own, so that all calls share what was compiled."""
    if hasattr(leaf, "dtype") and not getattr(leaf, "weak_type", False):
        return leaf
    return np.asarray(leaf, jax.dtypes.canonicalize_dtype(jnp.result_type(leaf)))


@functools.cache
def source() -> str:
    """A digest of the package's source."""
    digest = hashlib.sha256()
    for file in sorted(Path(countersteer.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _own(tree: Any) -> bool:
    """Whether all classes of a tree are Python's own or this package's."""
    found = tree.node_data()
    if found is not None:
        module = found[0].__module__
        if module != "builtins" and module.partition(".")[0] != PACKAGE:
            return False
    return all(_own(child) for child in tree.children())


def _described(tree: Any) -> Any:
    """A tree of named tuples, tuples, lists and dictionaries as JSON; None if it has others."""
    if tree is None:
        return {"none": True}
    if isinstance(tree, int):
        return tree
    if isinstance(tree, tuple) and hasattr(tree, "_fields"):
        name = f"{type(tree).__module__}:{type(tree).__qualname__}"
        if not name.startswith(f"{PACKAGE}."):
            return None
        children, kind = list(tree), {"class": name}
    elif isinstance(tree, tuple | list):
        children, kind = list(tree), {"class": type(tree).__name__}
    else:
        return None
    described = [_described(child) for child in children]
    return None if None in described else kind | {"children": described}


def _built(described: Any) -> Any:
    """The tree that was described. Raises an exception where it is none."""
    if isinstance(described, int):
        return described
    if "none" in described:
        return None
    children = [_built(child) for child in described["children"]]
    name = described["class"]
    if name in ("tuple", "list"):
        return tuple(children) if name == "tuple" else children
    module, _, qualified = name.partition(":")
    if not module.startswith(f"{PACKAGE}."):
        raise ValueError(name)
    made = getattr(importlib.import_module(module), qualified)
    if not (isinstance(made, type) and issubclass(made, tuple)):
        raise ValueError(name)
    return made(*children)
