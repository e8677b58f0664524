"""The world's step as C, from JAX's own trace of it: the limit of SIMD for the same equations."""

import ctypes
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from countersteer.world import planar

BLOCK = 64  # lanes; over all ticks, their numbers stay in registers and the first cache
WIDTH = 16  # lanes of a vector
COMPILE = ("cc", "-O3", "-march=native", "-ffast-math", "-fPIC", "-c")
# Linked separately: with -ffast-math, a library makes the whole process flush denormals.
LINK = ("cc", "-shared")
COMPILE_TIME = 600  # s: a guard against a compiler that hangs, also on a busy machine

PRELUDE = """
#include <math.h>
typedef float V __attribute__((vector_size(64)));
typedef int M __attribute__((vector_size(64)));
typedef float U __attribute__((vector_size(64), aligned(4)));
static inline V v_float(float x) { return (V){} + x; }
static inline M v_int(int x) { return (M){} + x; }
static inline M v_bool(int x) { return (M){} - (x != 0); }
static inline V v_select(M m, V a, V b) { return (V)((m & (M)b) | (~m & (M)a)); }
static inline M v_choose(M m, M a, M b) { return (m & b) | (~m & a); }
static inline V v_max(V a, V b) { return v_select(a < b, a, b); }
static inline V v_min(V a, V b) { return v_select(a > b, a, b); }
static inline V v_abs(V a) { return (V)((M)a & 0x7fffffff); }
#define EACH(f) V r; for (int k = 0; k < 16; k++) r[k] = f(a[k]); return r
static inline V v_sqrt(V a) { EACH(sqrtf); }
static inline V v_floor(V a) { EACH(floorf); }
static inline V v_round(V a) { EACH(rintf); }
static inline V v_exp(V a) { EACH(expf); }
static inline V v_tanh(V a) {
  V e = v_exp(-2 * v_abs(a)), t = (1 - e) / (1 + e);
  return v_select(a < 0, t, -t);
}
"""

CHAINS = 12  # of fused multiply-adds; the chains are independent of each other
PEAK = f"""
void peak(float *out, long n) {{
  V x[{CHAINS}];
  for (int k = 0; k < {CHAINS}; k++) x[k] = v_float(out[k]);
  for (long i = 0; i < n; i++)
    for (int k = 0; k < {CHAINS}; k++) x[k] = x[k] * out[12] + out[13];
  for (int k = 0; k < {CHAINS}; k++) out[k] = x[k][0];
}}
"""

BINARY = {"add": "+", "sub": "-", "mul": "*", "div": "/", "add_any": "+", "and": "&", "or": "|"}
BINARY |= {"rem": "%", "gt": ">", "lt": "<", "ge": ">=", "le": "<=", "eq": "==", "ne": "!="}
# The C of each primitive: for one number, and for a vector
FORMS = {name: (f"({{0}}{sign}{{1}})",) * 2 for name, sign in BINARY.items()}
FORMS |= {
    "max": ("fmaxf({0},{1})", "v_max({0},{1})"),
    "min": ("fminf({0},{1})", "v_min({0},{1})"),
    "neg": ("(-{0})",) * 2,
    "abs": ("fabsf({0})", "v_abs({0})"),
    "sqrt": ("sqrtf({0})", "v_sqrt({0})"),
    "rsqrt": ("(1/sqrtf({0}))", "(1/v_sqrt({0}))"),
    "exp": ("expf({0})", "v_exp({0})"),
    "expm1": ("expm1f({0})", "(v_exp({0})-1)"),
    "tanh": ("tanhf({0})", "v_tanh({0})"),
    "floor": ("floorf({0})", "v_floor({0})"),
    "round": ("rintf({0})", "v_round({0})"),
    "square": ("({0}*{0})",) * 2,
    "sign": ("(({0}>0)-({0}<0))", "__builtin_convertvector(({0}<0)-({0}>0),V)"),
    "not": ("(!{0})", "(~{0})"),
    "clamp": ("fminf(fmaxf({0},{1}),{2})", "v_min(v_max({0},{1}),{2})"),
    "select_n": ("({0}?{2}:{1})", "v_select({0},{1},{2})"),
    "stop_gradient": ("({0})",) * 2,
    "copy": ("({0})",) * 2,
}


class Printer:
    """Prints a jaxpr as statements of C, element by element.

    Values are NumPy arrays of C expressions, so operations on shapes cost nothing. A statement that
    is the same for all lanes goes before the loop over lanes.
    """

    def __init__(self, lanes: set[str]):
        """`lanes` are the names of values that differ between lanes."""
        self.before: list[str] = []
        self.inside: list[str] = []
        self._lanes = set(lanes)
        self._known: dict[str, str] = {}

    def name(self, primitive: str, parts: list[str], kinds: list[str], kind: str) -> str:
        """A variable with the primitive's value for these parts. Kinds are NumPy's type kinds."""
        varies = any(part in self._lanes for part in parts)
        if varies:
            lift = {"f": "v_float", "i": "v_int", "b": "v_bool"}
            parts = [
                part if part in self._lanes else f"{lift[k]}({part})"
                for part, k in zip(parts, kinds, strict=True)
            ]
        if primitive == "convert_element_type":
            one = "({0})" if kind != "f" else "((float){0})"
            own = "(-{0})" if kinds[0] == "b" else "{0}"
            many = f"__builtin_convertvector({own},{'V' if kind == 'f' else 'M'})"
        elif primitive == "select_n" and kind != "f":
            one, many = FORMS[primitive][0], "v_choose({0},{1},{2})"
        else:
            one, many = FORMS[primitive]
        expression = (many if varies else one).format(*parts)
        if expression not in self._known:
            self._known[expression] = made = f"v{len(self._known)}"
            type_ = ("V" if kind == "f" else "M") if varies else ("float" if kind == "f" else "int")
            (self.inside if varies else self.before).append(f"const {type_} {made} = {expression};")
            if varies:
                self._lanes.add(made)
        return self._known[expression]

    def run(self, jaxpr: Any, constants: list[Any], inputs: list[np.ndarray]) -> list[np.ndarray]:
        """The C expressions of the jaxpr's results."""
        values: dict[Any, np.ndarray] = dict(zip(jaxpr.invars, inputs, strict=True))
        values |= dict(zip(jaxpr.constvars, map(literal, constants), strict=True))

        def read(atom: Any) -> np.ndarray:
            return literal(atom.val) if hasattr(atom, "val") else values[atom]

        for equation in jaxpr.eqns:
            arguments = [read(atom) for atom in equation.invars]
            results = self.equation(equation, arguments)
            values |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, a: list[np.ndarray]) -> list[np.ndarray]:
        """The results of one equation. Raises `NotImplementedError` for an unknown primitive."""
        primitive, options = equation.primitive.name, equation.params
        inner = options.get("jaxpr") or options.get("call_jaxpr")
        if inner is not None:
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), a)
        aval = equation.outvars[0].aval
        if primitive == "broadcast_in_dim":
            shape = [1] * len(aval.shape)
            for axis, size in zip(options["broadcast_dimensions"], a[0].shape, strict=True):
                shape[axis] = size
            return [np.broadcast_to(a[0].reshape(shape), aval.shape)]
        if primitive in ("reshape", "squeeze"):
            return [a[0].reshape(aval.shape)]
        if primitive == "slice":
            ranges = zip(options["start_indices"], options["limit_indices"], strict=True)
            return [a[0][tuple(slice(*bounds) for bounds in ranges)]]
        if primitive == "iota":
            return [literal(np.arange(aval.shape[0], dtype=aval.dtype))]
        if primitive == "concatenate":
            return [np.concatenate(a, axis=options["dimension"])]
        if primitive == "integer_pow":
            product, times = a[0], abs(options["y"]) - 1
            for _ in range(times):
                product = self.each("mul", [product, a[0]], aval.shape, "ff", "f")
            one = literal(np.float32(1))
            inverse = options["y"] < 0
            return [self.each("div", [one, product], aval.shape, "ff", "f") if inverse else product]
        if primitive not in FORMS and primitive != "convert_element_type":
            raise NotImplementedError(f"no C for {primitive}")
        kinds = [atom.aval.dtype.kind for atom in equation.invars]
        return [self.each(primitive, a, aval.shape, kinds, aval.dtype.kind)]

    def each(
        self, primitive: str, a: list[np.ndarray], shape: tuple[int, ...], kinds: Any, kind: str
    ) -> np.ndarray:
        """A primitive applied to each element."""
        parts = [np.broadcast_to(part, shape) for part in a]
        out = np.empty(shape, object)
        for index in np.ndindex(shape):
            own: list[Any] = [part[index] for part in parts]
            out[index] = self.name(primitive, own, list(kinds), kind)
        return out


def literal(value: Any) -> np.ndarray:
    """Constants as C."""
    array = np.asarray(value)
    out = np.empty(array.shape, object)
    for index in np.ndindex(array.shape):
        x = array[index]
        text = f"{float(x)!r}f" if array.dtype.kind == "f" else str(int(x))
        out[index] = text.replace("inff", "INFINITY").replace("nanf", "NAN")
    return out


class Native:
    """A fleet driven by compiled C, with its cars spread over threads."""

    def __init__(self, fleet: Any, threads: int):
        """Compile the step. Raises `RuntimeError` if the compiler fails or takes too long."""
        one = jax.tree.map(lambda leaf: leaf[0], (fleet.states, fleet.commands))
        step = jax.make_jaxpr(partial(planar.step, dt=fleet.dt))(
            fleet.car, fleet.walls, *one, np.int32(0)
        )
        leaves, numbers = jax.tree.leaves((fleet.car, fleet.walls)), 0
        inputs, same = [], 0
        for leaf in leaves:
            size = np.size(leaf)
            inputs.append(
                np.array([f"u[{same + i}]" for i in range(size)], object).reshape(np.shape(leaf))
            )
            same += size
        names: list[str] = []
        for leaf in jax.tree.leaves(one):
            size = np.size(leaf)
            made = [f"s{numbers + i}" for i in range(size)]
            inputs.append(np.array(made, object).reshape(np.shape(leaf)))
            names += made
            numbers += size
        printer = Printer(set(names))
        results = printer.run(step.jaxpr, step.consts, [*inputs, np.array("count", object)])
        flat = [name for result in results for name in result.ravel()]
        self.operations = len(printer.inside)
        count = BLOCK // WIDTH
        lines = [
            PRELUDE,
            "void run(float *restrict state, const float *restrict u, int blocks, int ticks) {",
            "for (int b = 0; b < blocks; b++) {",
            f"U *restrict x = (U *)state + (long)b * {numbers * count};",
            "for (int count = 0; count < ticks; count++) {",
            *printer.before,
            f"for (int i = 0; i < {count}; i++) {{",
            *(f"const V {name} = x[{k * count} + i];" for k, name in enumerate(names)),
            *printer.inside,
            *(f"x[{k * count} + i] = {name};" for k, name in enumerate(flat)),
            "}}}}",
            PEAK,
        ]
        with tempfile.TemporaryDirectory() as folder:
            source, library = Path(folder) / "step.c", Path(folder) / "step.so"
            source.write_text("\n".join(lines))
            compiled = str(Path(folder) / "step.o")
            try:
                for order in (
                    [*COMPILE, str(source), "-o", compiled],
                    [*LINK, compiled, "-o", str(library), "-lm"],
                ):
                    subprocess.run(order, check=True, capture_output=True, timeout=COMPILE_TIME)
            except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
                raise RuntimeError(f"the C compiler failed: {error}") from error
            code = ctypes.CDLL(str(library))
        self._run, self._peak = code.run, code.peak
        self._threads = ThreadPoolExecutor(threads)
        batch = np.stack(
            [
                np.asarray(leaf).reshape(fleet.cars, -1)[:, k]
                for leaf in jax.tree.leaves((fleet.states, fleet.commands))
                for k in range(np.asarray(leaf).reshape(fleet.cars, -1).shape[1])
            ],
            axis=1,
        ).astype(np.float32)
        self.cars = fleet.cars
        blocked = batch.reshape(-1, BLOCK, numbers).transpose(0, 2, 1)
        self._start = np.array_split(np.ascontiguousarray(blocked), threads)
        self._same = np.concatenate([np.ravel(np.asarray(leaf)) for leaf in leaves])
        self._same = self._same.astype(np.float32)

    def run(self, ticks: int) -> np.ndarray:
        """All cars' numbers after `ticks` ticks: (cars, numbers in the pytree's order)."""

        def part(start: np.ndarray) -> np.ndarray:
            state = start.copy()
            pointer = ctypes.POINTER(ctypes.c_float)
            self._run(
                state.ctypes.data_as(pointer),
                self._same.ctypes.data_as(pointer),
                len(state),
                ticks,
            )
            return state

        ends = np.concatenate(list(self._threads.map(part, self._start)))
        whole: np.ndarray = ends.transpose(0, 2, 1).reshape(self.cars, -1)
        return whole

    def peak(self, rounds: int) -> float:
        """Run fused multiply-adds on all threads. Returns the number of operations."""
        threads = len(self._start)

        def part(_: int) -> None:
            numbers = np.array([1.0] * CHAINS + [0.999, 0.001], np.float32)
            pointer = numbers.ctypes.data_as(ctypes.POINTER(ctypes.c_float))
            self._peak(pointer, ctypes.c_long(rounds))

        list(self._threads.map(part, range(threads)))
        return 2.0 * WIDTH * CHAINS * rounds * threads
