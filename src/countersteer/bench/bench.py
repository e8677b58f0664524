"""`bench`: how fast it is, beside what it is compared to, measured in one run.

Each side is a process of its own, as the compiler's flags are a process's. All are made ready
first; then they take turns, round after round, so that what else the machine does hits all alike.
"""

import contextlib
import datetime
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

GOAL = 1e-3  # m that a car may be off after a second of a manoeuvre
DT, LARGE_DT = 1e-3, 5e-3  # s: the default step, and the largest of docs/accuracy.md that may do
Figures = dict[str, float]


class Size(NamedTuple):
    """How much is measured."""

    rounds: int = 7
    least: float = 0.3  # s that a measurement takes
    cars: int = 32768
    ticks: int = 100
    growth: tuple[int, ...] = (1, 8, 64, 512, 2048, 8192, 32768)
    warms: int = 3  # drives in a process of their own, after one with an empty cache
    variants: bool = True  # of the planar batch, each of which has to be compiled


FULL = Size()
QUICK = Size(rounds=3, least=0.1, growth=(32768,), warms=1, variants=False)


def cores() -> int:
    """How many the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def rate(work: float, run: Callable[[], Any], least: float) -> float:
    """Work per second of calls that go on for at least so long."""
    begin, calls = time.perf_counter(), 0
    while (spent := time.perf_counter() - begin) < least or calls == 0:
        run()
        calls += 1
    return calls * work / spent


# Sides. Each prepares, yields what it found out once, then a round of figures each time.


def planar_side(size: Size) -> Iterator[dict[str, Any]]:
    """The planar world in 32 bits, rx7 on box with walls and all stages."""
    from countersteer.batch.engine import CACHED_LANES, in_one_program
    from countersteer.bench.fleet import Fleet, advance
    from countersteer.bench.profile import profile

    count = cores()
    runs: dict[str, tuple[float, Callable[[], Any]]] = {}
    problem = Fleet(size.cars, count)
    program = problem.compiled(whole := in_one_program(partial(advance, dt=DT, ticks=size.ticks)))
    work = float(problem.cars * size.ticks)
    runs["planar_batch_steps_per_s"] = (work, problem.call(program))
    facts: dict[str, Any] = {"profile": profile(program.as_text(), CACHED_LANES)}
    facts |= {"ends": problem.manoeuvres(program, size.ticks)}
    if size.variants:
        varied = Fleet(size.cars, count, varied=True)
        runs["planar_varied_steps_per_s"] = (work, varied.call(varied.compiled(whole)))
        large = Fleet(size.cars, count, dt=LARGE_DT)
        at_large = large.compiled(in_one_program(partial(advance, dt=LARGE_DT, ticks=size.ticks)))
        runs["planar_large_step_steps_per_s"] = (work, large.call(at_large))
        facts |= {"ends_large": large.manoeuvres(at_large, size.ticks)}
        alone = Fleet(size.cars, 1)
        one_core = alone.compiled(
            in_one_program(partial(advance, dt=DT, ticks=size.ticks), cores=1)
        )
        runs["planar_one_core_steps_per_s"] = (
            float(alone.cars * size.ticks),
            alone.call(one_core),
        )
    for lanes in size.growth:
        if lanes == size.cars:
            continue
        spread = lanes >= CACHED_LANES * count
        fleet = Fleet(lanes, count) if spread else Fleet(lanes, 1, block=lanes)
        stepped = in_one_program(
            partial(advance, dt=DT, ticks=size.ticks),
            CACHED_LANES if spread else lanes,
            count if spread else 1,
        )
        run = fleet.call(fleet.compiled(stepped))
        runs[f"lanes_{lanes}"] = (float(lanes * size.ticks), run)
    yield facts
    while True:
        yield {name: rate(work, run, size.least) for name, (work, run) in runs.items()}


def plain_side(size: Size) -> Iterator[dict[str, Any]]:
    """The same batch by `vmap` alone, and the converged manoeuvres in 64 bits."""
    import jax

    from countersteer.bench import accuracy
    from countersteer.bench.fleet import Fleet, advance
    from countersteer.car.files import load_car

    fleet = Fleet(min(size.cars, 2048), 1)
    ticks = min(size.ticks, 20)
    program = fleet.compiled(jax.jit(partial(advance, dt=DT, ticks=ticks)))
    yield {"converged": accuracy.positions(load_car("rx7"), accuracy.FINEST)[:, :2].tolist()}
    while True:
        work = float(fleet.cars * ticks)
        yield {"planar_plain_vmap_steps_per_s": rate(work, fleet.call(program), size.least)}


def mujoco_side(size: Size) -> Iterator[dict[str, Any]]:
    """A like car in MuJoCo, on all cores and on one."""
    from countersteer.bench.mujoco_car import batch, model
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course

    compiled = model(load_car("rx7"), load_course("box"), DT)
    cars, steps = 64, 200
    runs = {
        "mujoco_steps_per_s": batch(compiled, cars, steps, cores()),
        "mujoco_one_core_steps_per_s": batch(compiled, cars, steps, 1),
    }
    for run in runs.values():
        run()
    yield {}
    while True:
        yield {name: rate(cars * steps, run, size.least) for name, run in runs.items()}


def drive_side(size: Size) -> Iterator[dict[str, Any]]:
    """One car in the closed loop with its sensors and driver, in 64 bits."""
    import jax

    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.drift_turn import drift_turn
    from countersteer.pilot import Pilot
    from countersteer.simulator import PIECE, Simulator

    course, car = load_course("box"), load_car("rx7")
    simulator = Simulator.of(course, car)
    pilot = Pilot.of(drift_turn(course, car, laps=1000), course, car)
    pieces = simulator.run(pilot, 1e6)
    for _ in range(4):
        next(pieces)
    act, memory, seen = thinking(simulator, pilot)
    yield {}
    while True:
        yield {
            "drive_realtime_factor": rate(PIECE, lambda: next(pieces), size.least),
            "driver_act_s": 1 / rate(1, lambda: jax.block_until_ready(act(memory, seen)), 0.2),
        }


def thinking(simulator: Any, pilot: Any) -> tuple[Any, Any, Any]:
    """A driver's `act`, compiled, with a memory and an observation at which it thinks."""
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        loop, memory = simulator.init(), pilot.init(simulator.root)
        _, seen = jax.jit(type(pilot).observe)(pilot, memory, simulator.readings(loop), loop.tick)
        seen = seen._replace(time=jnp.asarray(1.0))
        act = jax.jit(pilot.driver.act).lower(memory.driver, seen).compile()
        return act, *jax.tree.map(jnp.asarray, (memory.driver, seen))


def native_side(size: Size) -> Iterator[dict[str, Any]]:
    """The same equations as C, compiled for this machine's vectors; and the machine's peak."""
    from countersteer.bench.fleet import Fleet
    from countersteer.bench.native import Native

    native = Native(Fleet(size.cars, 1), cores())
    work = float(native.cars * size.ticks)
    rounds = 1_000_000
    peak = native.peak(rounds)
    yield {"operations": native.operations}
    while True:
        yield {
            "native_steps_per_s": rate(work, lambda: native.run(size.ticks), size.least),
            "peak_flops_per_s": rate(peak, lambda: native.peak(rounds), size.least),
        }


SIDES: dict[str, Callable[[Size], Iterator[dict[str, Any]]]] = {
    "planar": planar_side,
    "plain": plain_side,
    "mujoco": mujoco_side,
    "drive": drive_side,
    "native": native_side,
}


def serve(side: str, size: Size) -> None:
    """A side's process: a line of JSON when ready, and one for each line that it is sent."""
    from countersteer.compiling import configure_jax

    if side == "planar":
        from countersteer.batch.engine import flags

        os.environ["XLA_FLAGS"] = flags(cores())
    configure_jax(batches=side != "drive")
    rounds = SIDES[side](size)
    print(json.dumps(next(rounds)), flush=True)
    for _ in sys.stdin:
        print(json.dumps(next(rounds)), flush=True)


class Side:
    """The other end of `serve`."""

    def __init__(self, name: str, size: Size):
        """Starts the process."""
        self.name = name
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # as long as the process
        order = f"from countersteer.bench import bench; bench.serve({name!r}, bench.{size!r})"
        environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", order],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=environment,
            text=True,
        )

    def answer(self) -> dict[str, Any]:
        """What it says next. Raises `RuntimeError` with its last words if it ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._errors.seek(0)
            words = self._errors.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"bench: {self.name}: {words[-1] if words else 'ended'}")
        found: dict[str, Any] = json.loads(line)
        return found

    def round(self) -> Figures:
        """One more round."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()
        self._errors.close()


def missing_sides(size: Size) -> dict[str, str]:
    """Those that cannot be run here, and why."""
    missing = {}
    if importlib.util.find_spec("mujoco") is None:
        missing["mujoco"] = "MuJoCo is not installed: pip install mujoco"
    if shutil.which("cc") is None:
        missing["native"] = "no C compiler (cc)"
    if not size.variants:
        missing["plain"] = "of the whole bench, without --quick"
    return missing


def measure(size: Size, show: Callable[[float, float], None]) -> dict[str, Any]:
    """Everything; `show` is told how far it has come. The result is the JSON of `bench`."""
    skipped = missing_sides(size)
    begin, load = time.time(), os.getloadavg()[0]
    steps = float(len(SIDES) + size.rounds + size.warms + 3)
    done = 0.0
    samples: dict[str, list[float]] = {}

    def add(figures: Figures, part: float) -> None:
        nonlocal done
        for name, value in figures.items():
            samples.setdefault(name, []).append(value)
        done += part
        show(done, steps)

    with contextlib.ExitStack() as stack:
        processes = []
        for name in SIDES:
            if name not in skipped:
                processes.append(Side(name, size))
                stack.callback(processes[-1].close)
        facts: dict[str, Any] = {}
        for side in processes:
            try:
                facts |= side.answer()
            except RuntimeError as error:
                if side.name == "planar":
                    raise
                skipped[side.name] = str(error)
            add({}, 1)
        processes = [side for side in processes if side.name not in skipped]
        for _ in range(size.rounds):
            for side in processes:
                add(side.round(), 1 / len(processes))
    if size.warms:
        with tempfile.TemporaryDirectory() as cache:
            add({"drive_cold_s": drive_time(cache)}, 3)
            for _ in range(size.warms):
                add({"drive_warm_s": drive_time(cache)}, 1)
    return result(size, samples, facts, skipped, (load, os.getloadavg()[0]), time.time() - begin)


def drive_time(cache: str) -> float:
    """Seconds that `countersteer drive box` takes with this cache directory."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [
                sys.executable,
                "-m",
                "countersteer",
                "drive",
                "box",
                "--json",
                "--out",
                f"{folder}/r",
            ],
            env=os.environ | {"XDG_CACHE_HOME": cache},
            stdout=subprocess.DEVNULL,
            check=True,
        )
    return time.perf_counter() - begin


def result(
    size: Size,
    samples: dict[str, list[float]],
    facts: dict[str, Any],
    skipped: dict[str, str],
    load: tuple[float, float],
    duration: float,
) -> dict[str, Any]:
    """The JSON: medians under the figures' names, all samples under `samples`."""
    found: dict[str, Any] = {
        "planar_batch_steps_per_s": None,
        "mujoco_steps_per_s": None,
        "drive_realtime_factor": None,
        "drive_warm_s": None,
        "drive_cold_s": None,
    }
    found |= {name: statistics.median(values) for name, values in samples.items()}
    growth = {n: found.pop(f"lanes_{n}", found["planar_batch_steps_per_s"]) for n in size.growth}
    found["planar_step_s"] = DT
    if "converged" in facts:
        found["planar_error_mm"] = error_mm(facts["ends"], facts["converged"])
    if "ends_large" in facts and "converged" in facts:
        found["planar_large_step_s"] = LARGE_DT
        found["planar_large_step_error_mm"] = error_mm(facts["ends_large"], facts["converged"])
    if found["mujoco_steps_per_s"]:
        found["planar_over_mujoco"] = (
            found["planar_batch_steps_per_s"] / found["mujoco_steps_per_s"]
        )
    if found.get("native_steps_per_s"):
        found["planar_over_native"] = (
            found["planar_batch_steps_per_s"] / found["native_steps_per_s"]
        )
    return found | {
        "planar_steps_per_s_by_cars": {str(n): value for n, value in growth.items()},
        "profile": facts.get("profile", {}) | {"native_operations": facts.get("operations")},
        "skipped": skipped,
        "machine": machine(load),
        "duration_s": duration,
        "samples": samples,
    }


def error_mm(ends: list[list[float]], converged: list[list[float]]) -> float:
    """The largest distance between where manoeuvres end and where they should (mm)."""
    return 1e3 * float(np.max(np.hypot(*(np.array(ends) - np.array(converged)).T)))


def machine(load: tuple[float, float]) -> dict[str, Any]:
    """Where it was measured."""
    info = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    name = re.search(r"model name\s*: (.+)", info)
    wide = [isa for isa in ("avx512f", "avx2", "asimd") if re.search(rf"\b{isa}\b", info)]
    versions = {}
    for package in ("jax", "jaxlib", "mujoco", "numpy"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "processor": name[1] if name else platform.processor(),
        "isa": wide[0] if wide else "",
        "cores": cores(),
        "load_before": load[0],
        "load_after": load[1],
        "python": platform.python_version(),
        "versions": versions,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """What `bench` prints for a person."""

    def millions(name: str) -> str:
        return f"{found[name] / 1e6:.2f} M" if found.get(name) else "-"

    out = [
        f"planar batch     {millions('planar_batch_steps_per_s'):>9} steps/s "
        f"(each another car: {millions('planar_varied_steps_per_s')})",
        f"MuJoCo           {millions('mujoco_steps_per_s'):>9} steps/s",
        f"same equations, C{millions('native_steps_per_s'):>9} steps/s",
    ]
    if found.get("planar_over_mujoco"):
        out.append(f"planar / MuJoCo  {found['planar_over_mujoco']:>9.0f}")
    out.append(f"a drive          {found['drive_realtime_factor']:>9.0f} times real time")
    if found["drive_warm_s"]:
        out.append(
            f"drive box        {found['drive_warm_s']:>9.2f} s warm, "
            f"{found['drive_cold_s']:.1f} s with an empty cache"
        )
    return out + [f"{side}: skipped: {why}" for side, why in found["skipped"].items()]


ROWS = (
    ("planar_batch_steps_per_s", "planar batch, all cores", 1e6, "M steps/s"),
    ("planar_varied_steps_per_s", "the same, each lane another car", 1e6, "M steps/s"),
    ("planar_large_step_steps_per_s", "the same at a step of 5 ms", 1e6, "M steps/s"),
    ("planar_one_core_steps_per_s", "planar batch, one core", 1e6, "M steps/s"),
    ("planar_plain_vmap_steps_per_s", "`vmap` alone, without blocks or flags", 1e6, "M steps/s"),
    ("native_steps_per_s", "the same equations as C, all cores", 1e6, "M steps/s"),
    ("mujoco_steps_per_s", "MuJoCo, all cores", 1e6, "M steps/s"),
    ("mujoco_one_core_steps_per_s", "MuJoCo, one core", 1e6, "M steps/s"),
    ("drive_realtime_factor", "one drive in the closed loop", 1, "times real time"),
    ("driver_act_s", "one thought of the drift-turn driver, called alone", 1e-3, "ms"),
    ("drive_warm_s", "`drive box`, whole process, warm", 1, "s"),
    ("drive_cold_s", "`drive box` with an empty cache", 1, "s"),
    ("peak_flops_per_s", "peak: chains of fused multiply-adds, f32, all cores", 1e9, "Gflop/s"),
)


def page(found: dict[str, Any], picture: str) -> str:
    """docs/speed.md."""
    at, samples, counted = found["machine"], found["samples"], found["profile"]
    versions = ", ".join(f"{name} {version}" for name, version in at["versions"].items())
    text = [
        "# Speed",
        "",
        "Made by `make bench`. All sides were measured in one run, taking turns; medians over the",
        "rounds, with the least and the most.",
        "",
        f"{at['processor']}, {at['cores']} cores, {at['isa']}; Python {at['python']}, {versions}.",
        f"{at['date']}; the machine's load was {at['load_before']:.1f} before and "
        f"{at['load_after']:.1f} after (the bench itself is a load of {at['cores']}).",
        "",
        "| | median | least | most | |",
        "| --- | ---: | ---: | ---: | --- |",
    ]
    for name, meaning, unit, of in ROWS:
        values = samples.get(name)
        if values:
            cells = (statistics.median(values), min(values), max(values))
            text.append(
                f"| {meaning} | " + " | ".join(f"{v / unit:.3g}" for v in cells) + f" | {of} |"
            )
    text += ["", *(f"Not measured: {side}: {why}." for side, why in found["skipped"].items())]
    text += [
        "The planar batch is `rx7` on `box`, with walls and all stages, in 32 bits, at a step of",
        "1 ms; each lane has its own state and commands. MuJoCo steps a chassis with four wheels",
        "between the same walls at 1 ms (`bench/mujoco_car.py`), by its own threads.",
    ]
    if found.get("planar_over_mujoco"):
        text.append(f"**The planar batch is {found['planar_over_mujoco']:.0f} times MuJoCo.**")
    if "planar_large_step_error_mm" in found:
        large = found["planar_large_step_steps_per_s"] * found["planar_large_step_s"]
        small = found["planar_batch_steps_per_s"] * DT
        text += [
            "",
            "Error of the benched program (32 bits) after a second of the manoeuvres of",
            "[accuracy](accuracy.md), against 20 µs in 64 bits, the worst of them:",
            f"{found['planar_error_mm']:.3f} mm at 1 ms, "
            f"{found['planar_large_step_error_mm']:.3f} mm at 5 ms. So the batch drives",
            f"{small:,.0f} seconds of cars a second at 1 ms, {large:,.0f} at 5 ms.",
        ]
    text += [
        "",
        f"![Planar steps per second against the number of cars]({picture})",
        "",
        "| cars | M steps/s |",
        "| ---: | ---: |",
    ]
    for cars, value in found["planar_steps_per_s_by_cars"].items():
        text.append(f"| {int(cars):,} | {value / 1e6:.2f} |")
    text += ["", "## What bounds it", "", *bounds(found, counted)]
    return "\n".join(text) + "\n"


def bounds(found: dict[str, Any], counted: dict[str, Any]) -> list[str]:
    """The page's last section: arithmetic, memory and launches of a step."""
    if not counted.get("flops"):
        return ["Nothing was counted."]
    speed, count = found["planar_batch_steps_per_s"], found["machine"]["cores"]
    text = [
        f"Compiled, a step of a car is {counted['flops']} floating-point operations (a division or",
        f"root counted as one) in {counted['kernels']} kernels, that is loops over the lanes of a",
        f"block, and {counted['bytes']} bytes that kernels read and write, nearly all of it within",
        "the core's own caches. A whole scan is one function, so nothing is launched between them.",
        "",
        "| operation | a step |",
        "| --- | ---: |",
        *(f"| {name} | {n} |" for name, n in counted["operations"].items()),
        "",
    ]
    if found.get("peak_flops_per_s"):
        reached = counted["flops"] * speed
        text += [
            f"At {speed / 1e6:.1f} M steps/s that is {reached / 1e9:.0f} Gflop/s, "
            f"{100 * reached / found['peak_flops_per_s']:.0f} % of what chains of fused",
            f"multiply-adds reach here ({found['peak_flops_per_s'] / 1e9:.0f} Gflop/s),",
            f"and {counted['bytes'] * speed / count / 1e9:.0f} GB/s a core between registers and",
            f"caches: {counted['bytes'] / 4 / counted['flops']:.2f} loads and stores",
            "for each operation. So neither main memory nor launches bound it, but a core's own",
            "instructions: the arithmetic, and loads and stores between kernels.",
        ]
    if found.get("planar_over_native"):
        text += [
            "",
            "The limit for SIMD on the same equations: the bench prints JAX's own trace of",
            "`planar.step` as straight-line C in vectors of 16 lanes "
            f"({counted['native_operations']} operations),",
            "compiled by `cc -O3 -march=native -ffast-math`: no kernels, so none of their traffic.",
            f"The batch runs at **{100 * found['planar_over_native']:.0f} %** of it.",
        ]
    return text


def draw(found: dict[str, Any], file: Path) -> None:
    """The rate against the number of cars."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    growth = {int(n): v / 1e6 for n, v in found["planar_steps_per_s_by_cars"].items()}
    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    axes.plot(list(growth), list(growth.values()), "o-", color="#0069a8", label="planar batch")
    for name, label, colour in (
        ("native_steps_per_s", "the same equations as C", "#00694f"),
        ("planar_plain_vmap_steps_per_s", "vmap alone, 2,048 cars", "#8a6d1a"),
        ("mujoco_steps_per_s", "MuJoCo", "#a3210f"),
    ):
        if found.get(name):
            axes.axhline(found[name] / 1e6, color=colour, linestyle="--", linewidth=1, label=label)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(list(growth), [f"{n:,}" for n in growth])
    axes.set(xlabel="cars", ylabel="million steps per second")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right", bbox_to_anchor=(1.0, 0.12))
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def write_page(found: dict[str, Any], file: Path) -> None:
    """The page, and its picture beside it."""
    picture = file.with_suffix(".png")
    draw(found, picture)
    file.write_text(page(found, picture.name))
