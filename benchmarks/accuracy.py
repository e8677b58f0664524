"""Error of the position over the time step: `python -m benchmarks.accuracy PAGE`."""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.signals import Command
from countersteer.world import planar
from countersteer.writing import write_whole

DURATION = 1.0  # s
FINEST = 2e-5  # s, step of the converged solution
STEPS = (1e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
SLOTS = 32768  # of the delay lines; enough for every step, so that all steps share one program


class Manoeuvre(NamedTuple):
    """A constant command from a given motion."""

    name: str
    velocity: tuple[float, float, float]  # vx, vy (m/s), yaw rate (rad/s)
    command: tuple[float, float]  # throttle, steering (rad)


MANOEUVRES = (
    Manoeuvre("launch at full throttle", (0.0, 0.0, 0.0), (1.0, 0.0)),
    Manoeuvre("full-lock turn at the limit", (2.0, 0.0, 0.0), (0.45, 0.5)),
    Manoeuvre("sustained drift", (1.2, -0.8, 3.5), (1.0, 0.3)),
    Manoeuvre("braking slide", (3.0, 0.8, 2.0), (-0.6, 0.1)),
)


def positions(car: Car, dt: float) -> np.ndarray:
    """x, y (m) and heading (rad) at the end of each manoeuvre: (n, 3)."""
    ends = []
    with jax.enable_x64(True):
        for manoeuvre in MANOEUVRES:
            start = planar.initial_state(car, dt, velocity=manoeuvre.velocity, slots=SLOTS)
            ticks = round(DURATION / dt)
            motion = _drive(car, start, Command(*manoeuvre.command), ticks, dt)
            ends.append([float(v) for v in (motion.x, motion.y, motion.heading)])
    return np.array(ends)


@jax.jit
def _drive(car: Car, start: planar.State, command: Command, ticks: int, dt: float) -> planar.Motion:
    nowhere = jnp.full((1, 4), jnp.nan, jnp.result_type(car.body.mass))
    return jax.lax.fori_loop(
        0, ticks, lambda i, s: planar.step(car, nowhere, s, command, i, dt), start
    ).motion


def table(names: tuple[str, ...]) -> str:
    """The text of the docs page."""
    lines = [
        "# Error of the position against the step",
        "",
        "Made by `make accuracy`. Position after one second of open loop, against the same physics",
        f"at {1e6 * FINEST:g} µs, in millimetres; 64 bits. The default step is 1 ms. Errors of the",
        "model are not in here: they show when a log is replayed (`replay RUN --compare`).",
        "",
    ]
    for name in names:
        car = load_car(name)
        converged = positions(car, FINEST)
        lines += [
            f"## {name}",
            "",
            "| step | " + " | ".join(m.name for m in MANOEUVRES) + " |",
            "| --- |" + " ---: |" * len(MANOEUVRES),
        ]
        for dt in STEPS:
            off = np.hypot(*(positions(car, dt) - converged)[:, :2].T)
            cells = " | ".join(f"{1e3 * error:.3f}" for error in off)
            lines.append(f"| {1e3 * dt:g} ms | {cells} |")
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    configure_jax()
    write_whole(Path(sys.argv[1]), table(("rx7", "jetracer", "jetracer-tape")))
