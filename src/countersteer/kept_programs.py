"""Compiled functions that are traced once and kept between processes.

Tracing and lowering a drive takes longer than driving it. `kept` stores the lowered program
(`jax.export`) in the user's cache. The key is made of all that the program depends on: the source
of this package, the versions of JAX, the function, and the types of its arguments. Values are no
part of it: another seed, or another car with the same parts, finds the same program. What the
program compiles to is in JAX's own cache.

A stored program is StableHLO with its digest, and the structure of its result as JSON. Reading one
executes nothing, and imports only classes of this package.
"""

import atexit
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax._src.export._export import _module_to_bytecode as _serialized
from jax._src.interpreters.mlir import make_ir_context
from jax._src.lax import linalg
from jaxlib.mlir import ir
from jaxlib.mlir.passmanager import PassManager

import countersteer
from countersteer.cache import cache_folder
from countersteer.errors import InputError
from countersteer.writing import write_whole

_INITIALIZE = getattr(linalg, "initialize_lapack", None)  # JAX has no public switch for it
FORMAT = 2
PATIENCE = 20.0  # s; a program that another thread loads for longer is loaded here
PACKAGE = "countersteer"


class Kept:
    """A pure function, as `jax.jit` would have it; `static` are the positions of static arguments.

    Under a trace it is the function itself. A program is kept only if every class in the arguments
    is of this package: nothing else is known to change its source when it changes. So it is with
    structures of trees among the static arguments.
    """

    def __init__(self, function: Callable[..., Any], static: Sequence[int] = ()) -> None:
        """Nothing is read or traced before the first call."""
        self.function, self.static = function, frozenset(static)
        self._jitted = jax.jit(function, static_argnums=tuple(static))
        self._programs: dict[Any, _Program | None] = {}
        self._last: tuple[Any, list[Any], _Program] | None = None
        self._lock = threading.Lock()
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        """The function's result."""
        dynamic = [a for i, a in enumerate(arguments) if i not in self.static]
        leaves, tree = jax.tree.flatten(dynamic)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.function(*arguments)
        leaves = [*map(_strong, leaves)]
        static = tuple(arguments[i] for i in sorted(self.static))
        about = (tree, static, jnp.result_type(float), _device())
        types = [(leaf.shape, leaf.dtype) for leaf in leaves]
        last = self._last
        if last is not None and last[0] == about and last[1] == types:
            program: _Program | None = last[2]
        else:
            program = self._program(about, tuple(types), arguments, leaves)
            if program is not None:
                self._last = (about, types, program)
        if program is None:
            return self._jitted(*arguments)
        return jax.tree.unflatten(program.tree, program.run(*leaves))

    def _program(
        self, about: tuple[Any, ...], types: Any, arguments: Sequence[Any], leaves: list[Any]
    ) -> "_Program | None":
        """From this process, from the cache, or made and put there; None if it cannot be kept."""
        tree, static, default, device = about
        signature = (*about, types)
        with self._lock:
            if signature not in self._programs:
                made = None
                if _own(tree) and all(map(_own, _trees(static))):
                    name = f"{self.function.__module__}.{self.function.__qualname__}"
                    versions = (FORMAT, source(), jax.__version__, jax.lib.__version__)
                    typed = tuple((shape, str(dtype)) for shape, dtype in types)
                    text = repr((*versions, str(default), name, static, typed, str(tree)))
                    if " at 0x" not in text:  # else something without a lasting name
                        key = hashlib.sha256(text.encode()).hexdigest()[:32]
                        made = _find(key, device) or self._make(arguments, leaves, tree, key)
                self._programs[signature] = made
            return self._programs[signature]

    def _make(
        self, arguments: Sequence[Any], leaves: list[Any], tree: Any, key: str
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
        exported = _without_places(exported)
        program = bytes(exported.serialize())
        about = {"format": FORMAT, "result": structure, "sha256": _digest(program)}
        head = json.dumps(about).encode()
        with contextlib.suppress(OSError, InputError):  # a cache that cannot be written is no cache
            _write(key, len(head).to_bytes(8, "little") + head + program)
        return _Program(exported, result[0], _device())


def kept(*static: int) -> Callable[[Callable[..., Any]], Kept]:
    """`Kept`, as a decorator."""
    return lambda function: Kept(function, static)


# Programs that another thread loads, by key and device, and all that this process has used.
_coming: dict[tuple[str, Any], Future[Any]] = {}
_used: list[dict[str, Any]] = []


def preload(what: str) -> None:
    """Begins to load, beside all else, the programs that the last process remembered as `what`.

    They are loaded in their order. A guess that is wrong costs nothing but the other core's time.
    """
    try:
        last = json.loads((_folder() / f"{what}.json").read_text())["programs"]
        found = [(str(w["key"]), jax.devices()[int(w["device"])], bool(w["wide"])) for w in last]
        wanted = list(dict.fromkeys(found))
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return
    if _used or _coming:  # this process has begun
        return
    for key, device, _ in wanted:
        _coming[key, device] = Future()

    ends = threading.Event()

    def load(programs: list[tuple[str, Any, bool]]) -> None:
        for key, device, wide in programs:
            program = None  # then it is loaded or made again where it is needed
            with contextlib.suppress(BaseException):
                if not ends.is_set():
                    with jax.enable_x64(wide), jax.default_device(device):
                        program = _read(key, device)
            _coming[key, device].set_result(program)

    # The largest takes as long as all else: the others do not wait for it.
    parts = [part for part in (wanted[:1], wanted[1:]) if part]
    threads = [threading.Thread(target=load, args=(part,), daemon=True) for part in parts]

    def end() -> None:
        ends.set()
        for thread in threads:
            thread.join()

    # Python stops a thread that runs when it ends, and XLA aborts the process where one of its own
    # functions is stopped. So the end waits for the programs that are being loaded.
    atexit.register(end)
    for thread in threads:
        thread.start()


def remember(what: str) -> None:
    """Keeps the names of the programs of this process for `preload`, the largest first."""

    def size(one: dict[str, Any]) -> int:
        return (_folder() / one["key"]).stat().st_size

    with contextlib.suppress(OSError, InputError):
        programs = sorted(_used, key=size, reverse=True)
        _write(f"{what}.json", json.dumps({"format": FORMAT, "programs": programs}).encode())


class _Program:
    """A program compiled for a device, and the tree of its result."""

    def __init__(self, exported: Any, tree: Any, device: Any) -> None:
        self.tree = tree
        # Without a named device, JAX compiles again for the results of a call before.
        here = jax.sharding.SingleDeviceSharding(device)
        types = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in exported.in_avals]
        run = jax.jit(exported.call, in_shardings=here, out_shardings=here)
        with _without_lapack(exported):
            self.run = run.lower(*types).compile()


def _without_places(exported: Any) -> Any:
    """The program without the places in the source: they are a third of what XLA has to load."""
    try:
        with make_ir_context():
            module = ir.Module.parse(exported.mlir_module())
            PassManager.parse("builtin.module(strip-debuginfo)").run(module.operation)
            return dataclasses.replace(exported, mlir_module_serialized=_serialized(module))
    except Exception:  # JAX has no public way to do it: if it changes, the program is larger
        return exported


def _find(key: str, device: Any) -> _Program | None:
    """A stored program, or one that is being loaded; None where there is none."""
    wide = jnp.result_type(float) == np.float64
    use = {"key": key, "device": jax.devices().index(device), "wide": bool(wide)}
    if use not in _used:
        _used.append(use)
    coming = _coming.get((key, device))
    found: _Program | None = None
    if coming is not None:
        with contextlib.suppress(TimeoutError):
            found = coming.result(timeout=PATIENCE)
    return found or _read(key, device)


def _read(key: str, device: Any) -> _Program | None:
    """A stored program; None where there is none that can be read."""
    from jax import export

    try:
        data = (_folder() / key).read_bytes()
        size = int.from_bytes(data[:8], "little")
        head, program = json.loads(data[8 : 8 + size]), data[8 + size :]
        if head["sha256"] != _digest(program):  # XLA may crash on a damaged one
            return None
        tree = jax.tree.structure(_built(head["result"]))
        return _Program(export.deserialize(bytearray(program)), tree, device)
    except FileNotFoundError:
        return None
    except Exception:  # cut off, or of another version: it is made again
        return None


def _digest(program: bytes) -> str:
    return hashlib.sha256(program).hexdigest()


def _folder() -> Path:
    return cache_folder() / "programs"


def _write(name: str, data: bytes) -> None:
    """Raises `OSError`, or `InputError` where something other than a file stands."""
    _folder().mkdir(parents=True, exist_ok=True)
    write_whole(_folder() / name, data)


@contextlib.contextmanager
def _without_lapack(exported: Any) -> Iterator[None]:
    """Spares JAX the import of SciPy's LAPACK (0.2 s), for a program that does not call it."""
    if _INITIALIZE is None:
        yield
        return
    if b"lapack" in exported.mlir_module_serialized:
        _INITIALIZE()  # here, since another thread may be inside this context
    linalg.initialize_lapack = lambda: None
    try:
        yield
    finally:
        linalg.initialize_lapack = _INITIALIZE


def _device() -> Any:
    """The device that JAX computes on now."""
    return getattr(jax.config, "jax_default_device", None) or jax.devices()[0]


def _strong(leaf: Any) -> Any:
    """The argument with a type of its own, so that all calls share what was compiled."""
    if isinstance(leaf, jax.Array) and not getattr(leaf, "weak_type", False):
        return leaf
    known = isinstance(leaf, np.ndarray | np.generic)  # to ask JAX for it takes 30 times as long
    dtype = leaf.dtype if known else jnp.result_type(leaf)
    return np.asarray(leaf, jax.dtypes.canonicalize_dtype(dtype))


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


def _trees(static: Any) -> Iterator[Any]:
    """The structures of trees among static arguments, which may be tuples."""
    if isinstance(static, tuple):
        for part in static:
            yield from _trees(part)
    elif isinstance(static, jax.tree_util.PyTreeDef):
        yield static


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
