"""`bench`: the speed of the simulator beside that of MuJoCo, measured in one run.

Each side is a process of its own, because compiler flags hold for a whole process. All sides are
prepared first. Then they take turns, round after round, so that other load affects all equally.
"""

import contextlib
import datetime
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

DT = 1e-3  # s
Figures = dict[str, float]


class Size(NamedTuple):
    """The amount of measurement."""

    rounds: int = 7
    least: float = 0.3  # s, shortest measurement
    cars: int = 32768
    ticks: int = 100
    warms: int = 3  # drives in a process of their own, after one with an empty cache


FULL = Size()
QUICK = Size(rounds=3, least=0.1, warms=1)


def cores() -> int:
    """The number of cores that the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def rate(work: float, run: Callable[[], Any], least: float) -> float:
    """Work per second, with calls repeated for at least `least` (s)."""
    begin, calls = time.perf_counter(), 0
    while (spent := time.perf_counter() - begin) < least or calls == 0:
        run()
        calls += 1
    return calls * work / spent


# Sides. Each prepares, yields its facts once, and then the figures of one round each time.


def planar_side(size: Size) -> Iterator[dict[str, Any]]:
    """The planar world in 32 bits, rx7 on box with walls and all stages."""
    from countersteer.batch.engine import in_one_program
    from countersteer.bench.fleet import Fleet, advance

    fleet = Fleet(size.cars, cores())
    program = fleet.compiled(in_one_program(partial(advance, dt=DT, ticks=size.ticks)))
    run, work = fleet.call(program), float(fleet.cars * size.ticks)
    yield {}
    while True:
        yield {"planar_batch_steps_per_s": rate(work, run, size.least)}


def mujoco_side(size: Size) -> Iterator[dict[str, Any]]:
    """A similar car in MuJoCo, on all cores and on one."""
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
    """A driver's compiled `act`, with a memory and an observation for it."""
    import jax
    import jax.numpy as jnp

    with jax.enable_x64(True):
        loop, memory = simulator.init(), pilot.init(simulator.root)
        _, seen = jax.jit(type(pilot).observe)(pilot, memory, simulator.readings(loop), loop.tick)
        seen = seen._replace(time=jnp.asarray(1.0))
        act = jax.jit(pilot.driver.act).lower(memory.driver, seen).compile()
        return act, *jax.tree.map(jnp.asarray, (memory.driver, seen))


SIDES: dict[str, Callable[[Size], Iterator[dict[str, Any]]]] = {
    "planar": planar_side,
    "mujoco": mujoco_side,
    "drive": drive_side,
}


def serve(module: str, side: str, size: Size) -> None:
    """The process of a side: print a line of JSON when ready, and one for each line of input.

    `module` has the side in its `SIDES`.
    """
    from countersteer.compiling import configure_jax

    if side == "planar":
        from countersteer.batch.engine import flags

        os.environ["XLA_FLAGS"] = flags(cores())
    configure_jax(batches=side != "drive")
    rounds = importlib.import_module(module).SIDES[side](size)
    print(json.dumps(next(rounds)), flush=True)
    for _ in sys.stdin:
        print(json.dumps(next(rounds)), flush=True)


class Side:
    """A side's process, seen from the bench: the other end of `serve`."""

    def __init__(self, module: str, name: str, size: Size):
        """Start the process."""
        self.name = name
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # as long as the process
        order = f"from countersteer.bench.bench import *; serve({module!r}, {name!r}, {size!r})"
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
        """Its next line. Raises `RuntimeError` with its last line of error if it ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._errors.seek(0)
            words = self._errors.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"bench: {self.name}: {words[-1] if words else 'ended'}")
        found: dict[str, Any] = json.loads(line)
        return found

    def round(self) -> Figures:
        """The figures of one more round."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
        self._errors.close()


def missing_sides() -> dict[str, str]:
    """The sides that cannot run here, with the reason."""
    if importlib.util.find_spec("mujoco") is None:
        return {"mujoco": "MuJoCo is not installed: pip install mujoco"}
    return {}


class Measured(NamedTuple):
    """A bench's result: samples, facts, skipped sides with reasons, load, and duration (s)."""

    samples: dict[str, list[float]]
    facts: dict[str, Any]
    skipped: dict[str, str]
    load: tuple[float, float]
    duration: float


def measure(
    size: Size,
    show: Callable[[float, float], None],
    module: str,
    sides: Sequence[str],
    skipped: dict[str, str],
) -> Measured:
    """Measure the sides of `module`, except those skipped. `show` receives the progress."""
    skipped = dict(skipped)
    begin, load = time.time(), os.getloadavg()[0]
    steps = float(len(sides) + size.rounds + size.warms + 3)
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
        for name in sides:
            if name not in skipped:
                processes.append(Side(module, name, size))
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
    return Measured(samples, facts, skipped, (load, os.getloadavg()[0]), time.time() - begin)


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


def bench(size: Size, show: Callable[[float, float], None]) -> dict[str, Any]:
    """The JSON of `bench`."""
    return result(measure(size, show, __name__, list(SIDES), missing_sides()))


def result(measured: Measured) -> dict[str, Any]:
    """Medians under the figures' names, all samples under `samples`."""
    found: dict[str, Any] = {
        "planar_batch_steps_per_s": None,
        "mujoco_steps_per_s": None,
        "drive_realtime_factor": None,
        "drive_warm_s": None,
        "drive_cold_s": None,
    }
    found |= {name: statistics.median(values) for name, values in measured.samples.items()}
    found["planar_step_s"] = DT
    if found["mujoco_steps_per_s"]:
        found["planar_over_mujoco"] = (
            found["planar_batch_steps_per_s"] / found["mujoco_steps_per_s"]
        )
    return found | {
        "skipped": measured.skipped,
        "machine": machine(measured.load),
        "duration_s": measured.duration,
        "samples": measured.samples,
    }


def machine(load: tuple[float, float]) -> dict[str, Any]:
    """The machine of the measurement, with its load and versions."""
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
    """The lines that `bench` prints for a person."""

    def millions(name: str) -> str:
        return f"{found[name] / 1e6:.2f} M" if found.get(name) else "-"

    out = [
        f"planar batch     {millions('planar_batch_steps_per_s'):>9} steps/s",
        f"MuJoCo           {millions('mujoco_steps_per_s'):>9} steps/s",
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
