"""Write docs/speed.md: the bench with more sides, and the limits of the planar batch.

python -m benchmarks.speed docs/speed.md
"""

import shutil
import statistics
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import accuracy
from benchmarks.accuracy import DURATION, MANOEUVRES
from benchmarks.native import Native
from benchmarks.profile import profile
from countersteer.batch.engine import CACHED_LANES, in_one_program
from countersteer.bench import bench
from countersteer.bench.bench import DT, Size, cores, drive_side, mujoco_side, rate
from countersteer.bench.fleet import Fleet, advance
from countersteer.car.files import load_car
from countersteer.progress import Progress
from countersteer.signals import Command
from countersteer.world import planar
from countersteer.writing import whole, write_whole

LARGE_DT = 5e-3  # s, largest step of docs/accuracy.md with a usable error
GROWTH = (1, 8, 64, 512, 2048, 8192, 32768)  # cars


def planar_side(size: Size) -> Iterator[dict[str, Any]]:
    """The planar world in 32 bits, rx7 on box with walls and all stages."""
    count = cores()
    runs: dict[str, tuple[float, Callable[[], Any]]] = {}
    problem = Fleet(size.cars, count)
    program = problem.compiled(whole := in_one_program(partial(advance, dt=DT, ticks=size.ticks)))
    work = float(problem.cars * size.ticks)
    runs["planar_batch_steps_per_s"] = (work, problem.call(program))
    facts: dict[str, Any] = {"profile": profile(program.as_text(), CACHED_LANES)}
    facts |= {"ends": manoeuvres(problem, program, size.ticks)}
    varied = Fleet(size.cars, count, varied=True)
    runs["planar_varied_steps_per_s"] = (work, varied.call(varied.compiled(whole)))
    large = Fleet(size.cars, count, dt=LARGE_DT)
    at_large = large.compiled(in_one_program(partial(advance, dt=LARGE_DT, ticks=size.ticks)))
    runs["planar_large_step_steps_per_s"] = (work, large.call(at_large))
    facts |= {"ends_large": manoeuvres(large, at_large, size.ticks)}
    alone = Fleet(size.cars, 1)
    one_core = alone.compiled(in_one_program(partial(advance, dt=DT, ticks=size.ticks), cores=1))
    runs["planar_one_core_steps_per_s"] = (
        float(alone.cars * size.ticks),
        alone.call(one_core),
    )
    for lanes in GROWTH:
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


def manoeuvres(fleet: Fleet, program: Any, ticks: int) -> list[list[float]]:
    """Positions x, y (m) at the end of each manoeuvre of docs/accuracy.md."""
    begins = [planar.initial_state(fleet.car, fleet.dt, velocity=m.velocity) for m in MANOEUVRES]
    lanes = np.arange(fleet.cars) % len(begins)
    states = jax.tree.map(lambda *leaves: np.stack(leaves)[lanes].astype(np.float32), *begins)
    asked = np.array([m.command for m in MANOEUVRES], np.float32)[lanes].T
    walls = np.full_like(fleet.walls, np.nan)
    for first in range(0, round(DURATION / fleet.dt), ticks):
        states = program(*fleet.inputs_of(states, Command(*asked), walls, first))
    motion = states.motion
    return [[float(motion.x[i]), float(motion.y[i])] for i in range(len(begins))]


def plain_side(size: Size) -> Iterator[dict[str, Any]]:
    """The same batch by `vmap` alone, and the converged manoeuvres in 64 bits."""
    fleet = Fleet(min(size.cars, 2048), 1)
    ticks = min(size.ticks, 20)
    program = fleet.compiled(jax.jit(partial(advance, dt=DT, ticks=ticks)))
    yield {"converged": accuracy.positions(load_car("rx7"), accuracy.FINEST)[:, :2].tolist()}
    while True:
        work = float(fleet.cars * ticks)
        yield {"planar_plain_vmap_steps_per_s": rate(work, fleet.call(program), size.least)}


def native_side(size: Size) -> Iterator[dict[str, Any]]:
    """The same equations as C, compiled for this machine's vectors, and the machine's peak."""
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


def missing_sides() -> dict[str, str]:
    """The sides that cannot run here, with the reason."""
    return bench.missing_sides() | (
        {"native": "no C compiler (cc)"} if shutil.which("cc") is None else {}
    )


def measure(size: Size, show: Callable[[float, float], None]) -> dict[str, Any]:
    """The result of `bench`, with further figures."""
    measured = bench.measure(size, show, "benchmarks.speed", list(SIDES), missing_sides())
    found, facts = bench.result(measured), measured.facts
    growth = {n: found.pop(f"lanes_{n}", found["planar_batch_steps_per_s"]) for n in GROWTH}
    found["planar_error_mm"] = error_mm(facts["ends"], facts["converged"])
    found["planar_large_step_s"] = LARGE_DT
    found["planar_large_step_error_mm"] = error_mm(facts["ends_large"], facts["converged"])
    if found.get("native_steps_per_s"):
        found["planar_over_native"] = (
            found["planar_batch_steps_per_s"] / found["native_steps_per_s"]
        )
    return found | {
        "planar_steps_per_s_by_cars": {str(n): value for n, value in growth.items()},
        "profile": facts["profile"] | {"native_operations": facts.get("operations")},
    }


def error_mm(ends: list[list[float]], converged: list[list[float]]) -> float:
    """The largest distance between the ends of manoeuvres and their converged ends (mm)."""
    return 1e3 * float(np.max(np.hypot(*(np.array(ends) - np.array(converged)).T)))


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
    """The text of docs/speed.md."""
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
    """Draw the rate over the number of cars."""
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
    with whole(file) as part:
        figure.savefig(part, format="png", dpi=110)
    pyplot.close(figure)


def write_page(found: dict[str, Any], file: Path) -> None:
    """Write the page, and its picture beside it."""
    picture = file.with_suffix(".png")
    draw(found, picture)
    write_whole(file, page(found, picture.name))


if __name__ == "__main__":
    with Progress() as progress:
        write_page(measure(bench.FULL, progress.show), Path(sys.argv[1]))
