"""Known cars, recovered from their logs: `python -m studies.recovery PAGE`.

This study tests the deviations of a fit against a known ground truth. Each car differs from a base
at random, in every fitted parameter. It drives three short logs of random launches, curves and
slides. Noisy motion capture and the car's own sensors record them. `fit.fit` starts from the base.
A parameter that it calls determined should lie within one deviation of the truth in two of three
cases, and within three deviations in all but a few of a thousand.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.car.parameter import changed
from countersteer.compiling import configure_jax
from countersteer.drivers.replay import Replay
from countersteer.pilot import Pilot
from countersteer.recorded_drive import Drive, about_run, drive
from countersteer.runs.files import Table
from countersteer.runs.run import Run, read_run
from countersteer.signals import Command
from countersteer.simulator import Simulator
from countersteer.tuning import fit
from countersteer.tuning.tune import read_logs
from countersteer.writing import write_whole

BASE = "jetracer-tape"
CARS = 20
LOGS, DURATION, BLOCK = 3, 9.0, 1.5  # logs of each car; s of a log; s of a command
EVERY = 0.5  # s between the starts of windows
RANDOM = 0.15  # largest change, as a part of the value or of its prior deviation (`ABSOLUTE`)
CAPTURE_EVERY = 2  # samples of the record: 100 Hz
CAPTURE_NOISE = (0.0005, 0.0005, 0.002)  # m, m, rad: standard deviation of a pose


class Case(NamedTuple):
    """A parameter of a car, and its fit."""

    path: str
    true: float
    found: float
    deviation: float
    determined: bool

    @property
    def off(self) -> float:
        """Distance from the truth in deviations."""
        return abs(self.found - self.true) / self.deviation


def random_car(base: Car, free: Sequence[str], rng: np.random.Generator) -> Car:
    """The base with all parameters of `free` changed at random, within their ranges."""
    for path in free:
        value, declared = fit.value_of(base, path), fit.declaration(path)
        reach = RANDOM * fit.ABSOLUTE.get(path, abs(value))
        moved = np.clip(value + reach * rng.uniform(-1, 1), declared.low, declared.high)
        base = changed(base, path, np.float64(moved))
    return base


def log(car: Car, folder: Path, rng: np.random.Generator) -> Run:
    """A drive of the car by random commands, recorded by motion capture and its sensors."""
    times = np.concatenate([[0.0, 0.3], np.arange(BLOCK, DURATION, BLOCK)])
    throttle = np.append(0.0, rng.uniform(0.25, 0.9, len(times) - 1))
    steering = np.append(0.0, np.radians(rng.uniform(-25, 25, len(times) - 1)))
    seed = int(rng.integers(2**31))
    driver = Replay(times=times, commands=Command(throttle, steering))
    simulator, pilot = Simulator.of(None, car, seed=seed), Pilot.of(driver, None, car)
    about = about_run(simulator, pilot, None, "replay", BASE, 1, car, {"kind": "replay"})
    folder.mkdir()
    drive(Drive(simulator, pilot, None, about, DURATION), folder)
    return measured(read_run(folder), rng)


def measured(run: Run, rng: np.random.Generator) -> Run:
    """The run as a log of a real car: noisy poses instead of the state, the encoder as it is."""
    assert run.truth is not None
    assert run.telemetry is not None
    poses = {"time_s": run.truth["time_s"][::CAPTURE_EVERY]}
    for name, noise in zip(("x_m", "y_m", "heading_rad"), CAPTURE_NOISE, strict=True):
        true = run.truth[name][::CAPTURE_EVERY]
        poses[name] = true + noise * rng.normal(size=len(true))
    readings = {
        "time_s": run.telemetry["time_s"],
        "wheel_speed_mps": run.telemetry["wheel_speed_mps"],
    }
    return Run(run.path, run.about, run.commands, Table(readings), Table(poses))


def recovered(
    seed: int, what: str = "all", report: Callable[[str], None] = lambda _: None
) -> list[Case]:
    """The fit of the car with this seed. Values are in the units used inside."""
    rng = np.random.default_rng(seed)
    base = load_car(BASE)
    true = random_car(base, fit.STAGES[what].parameters, rng)
    with jax.enable_x64(True), tempfile.TemporaryDirectory() as folder:
        runs = [log(true, Path(folder) / f"log-{number}", rng) for number in range(LOGS)]
        logs = read_logs(runs, {BASE: base}, EVERY, BASE)
        result = fit.fit({BASE: base}, logs.shots, what, report)
    return [
        Case(one.path, fit.value_of(true, one.path), one.value, one.deviation, one.determined)
        for one in result.fitted
    ]


def page(cases: Sequence[Case], cars: int, what: str) -> str:
    """The text of the docs page."""
    determined = [case for case in cases if case.determined]
    within = [sum(case.off <= most for case in determined) for most in (1, 2, 3)]
    lines = [
        "# Known cars, found again",
        "",
        "Made by `make recovery`. "
        f"{cars} cars, each with every parameter {100 * RANDOM:g} % at the most from "
        f"`{BASE}`, or as much of what was likely beforehand; {LOGS} logs of {DURATION:g} s each: "
        f"poses at 100 Hz off by {1e3 * CAPTURE_NOISE[0]:g} mm and "
        f"{1e3 * CAPTURE_NOISE[2]:g} mrad, the encoder as it is. `--fit {what}` begins at the "
        "base. Of what it calls determined, so many lie within so many of their deviations:",
        "",
        "| | determined | within 1 | within 2 | within 3 | farthest | deviation of the value |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for path in dict.fromkeys(case.path for case in cases):
        some = [case for case in determined if case.path == path]
        counts = [sum(case.off <= most for case in some) for most in (1, 2, 3)]
        row = [path, f"{len(some)} of {cars}", *map(str, counts)]
        if some:
            relative = np.median([case.deviation / max(abs(case.found), 1e-12) for case in some])
            row += [f"{max(case.off for case in some):.1f}", f"{100 * relative:.1f} %"]
        else:
            row += ["", ""]
        lines.append("| " + " | ".join(row) + " |")
    total = [f"{len(determined)} of {len(cases)}", *map(str, within)]
    shares = ", ".join(f"{100 * count / max(len(determined), 1):.1f} %" for count in within)
    lines += [
        "| all | " + " | ".join(total) + f" | {max(case.off for case in determined):.1f} | |",
        "",
        f"That is {shares}; of a normal distribution it would be 68.3, 95.4 and 99.7 %.",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    configure_jax(blocks=True)
    count = int(sys.argv[2]) if len(sys.argv) > 2 else CARS
    what = sys.argv[3] if len(sys.argv) > 3 else "all"
    found: list[Case] = []
    for car in range(count):
        began = time.monotonic()
        found += recovered(car, what)
        far = [f"{c.path} {c.off:.1f}" for c in found if c.determined and c.off > 3]
        print(f"car {car}: {time.monotonic() - began:.0f} s; beyond three: {far}", flush=True)
        write_whole(Path(sys.argv[1]), page(found, car + 1, what))
