"""The least energy of a drift: straight ahead, then wheels over without throttle.

A drift is a sideslip of more than 25°. The kinetic energy is m v² / 2 when the wheels turn over.
In a log, this is a step of the commanded steering by at least 5°. The throttle is off from 0.1 s
before it to 0.5 s after it.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from countersteer.batch.engine import LANES
from countersteer.batch.open_drives import commands, drives, repeated
from countersteer.car.car import Car
from countersteer.errors import InputError
from countersteer.experiments.open_turns import OFF, series_of
from countersteer.experiments.result import Report, Result, silent
from countersteer.runs.run import Run, drawn_car
from countersteer.task.judge import DRIFT
from countersteer.task.turns import sideslip

SPEEDS = np.linspace(0.4, 4.0, 37)  # m/s
LOCKS = (0.4, 0.6, 0.8, 1.0)  # parts of the full one
DRIVE = 2.0  # s
OVER = math.radians(5)


def simulate(car: Car, name: str, report: Report = silent, lanes: int = LANES) -> Result:
    """Simulate four locks at 37 speeds, to the left."""
    full = float(car.servo.limit_left)
    lock, speed = (grid.ravel() for grid in np.meshgrid(LOCKS, SPEEDS, indexing="ij"))
    drivers = [commands((0.0, 0.0, 0.0), (0.1, 0.0, angle)) for angle in full * lock]
    still = np.zeros(len(lock))
    velocity = np.stack([speed, still, still], axis=1)
    charge = np.ones(len(lock), np.float32)
    sampled = drives(
        repeated(car, len(lock)), charge, drivers, velocity, DRIVE, report=report, lanes=lanes
    )
    m = sampled.motion
    at = round(0.1 / (sampled.time[1] - sampled.time[0]))
    entry = np.hypot(m.vx[:, at], m.vy[:, at])
    peak = np.max(np.abs(sideslip(m.vx, m.vy)), axis=1)
    return _found(car, f"{name}, simulated", full * lock, entry, peak)


def measure(runs: Sequence[Run]) -> Result:
    """Find such steps in logs. They need motion capture, since nothing else gives sideslip."""
    rows = []
    for run in runs:
        series = series_of(run)
        step = series.time[1] - series.time[0]
        before, behind = round(0.1 / step), round(0.5 / step)
        coasts = np.abs(series.throttle) <= OFF
        for i in range(before, len(series.time) - behind):
            turned = abs(series.steering[i] - series.steering[i - 1])
            during = slice(i - before, i + behind)
            known = np.all(np.isfinite(series.vx[during] + series.vy[during]))
            if turned < OVER or not known or not np.all(coasts[during]) or series.vx[i] < 0.3:
                continue
            slip = np.abs(sideslip(series.vx[during], series.vy[during]))
            rows.append((abs(series.steering[i]), float(series.vx[i]), float(slip.max())))
    if not rows:
        raise InputError("--from: in no run were the wheels turned over without throttle")
    lock, entry, peak = np.array(rows).T
    return _found(drawn_car(runs[0].about), f"{len(runs)} runs", lock, entry, peak)


def _found(car: Car, name: str, lock: np.ndarray, speed: np.ndarray, peak: np.ndarray) -> Result:
    energy = float(car.body.mass) * speed**2 / 2
    drifts = peak > DRIFT
    thresholds: list[dict[str, Any]] = []
    for angle in np.unique(lock):
        own = lock == angle
        order = np.argsort(energy[own])
        e, s = energy[own][order], peak[own][order]
        first = int(np.argmax(s > DRIFT)) if np.any(s > DRIFT) else None
        at = None
        if first is not None:
            pair = slice(max(first - 1, 0), first + 1)
            at = float(np.interp(DRIFT, s[pair], e[pair]))
        speed_there = None if at is None else math.sqrt(2 * at / float(car.body.mass))
        thresholds.append(
            {"lock_deg": math.degrees(angle), "energy_j": at, "speed_mps": speed_there}
        )
    figures = {
        "car": name,
        "moments": len(lock),
        "drifted": int(drifts.sum()),
        "drift_over_deg": math.degrees(DRIFT),
        "most_sideslip_deg": math.degrees(float(peak.max())),
        "thresholds": thresholds,
    }
    known = [t for t in thresholds if t["energy_j"] is not None]
    words = f"none; the most sideslip is {math.degrees(float(peak.max())):.0f}°"
    if known:
        words = f"the least with {min(t['energy_j'] for t in known):.1f} J"
    if known and len(thresholds) <= len(LOCKS):
        words = "; ".join(map(_threshold, thresholds))
    text = (
        f"Wheels over without throttle ({name}): {int(drifts.sum())} of {len(lock)} drift by more "
        f"than {math.degrees(DRIFT):.0f}°, over {energy.min():.1f} to {energy.max():.1f} J. By "
        f"angle of the wheels, {words}."
    )
    table = {
        "wheel_angle_deg": np.degrees(lock),
        "speed_mps": speed,
        "kinetic_energy_j": energy,
        "peak_sideslip_deg": np.degrees(peak),
        "drifts": drifts.astype(float),
    }

    def paint(figure: Any) -> None:
        ax = figure.subplots()
        dots = ax.scatter(energy, np.degrees(peak), c=np.degrees(lock), s=16)
        words = f"a drift: over {math.degrees(DRIFT):.0f}°"
        ax.axhline(math.degrees(DRIFT), color="grey", linewidth=0.8, label=words)
        ax.legend(fontsize=8)
        ax.set_xlabel("kinetic energy as the wheels turn over, J")
        ax.set_ylabel("peak sideslip, °")
        figure.colorbar(dots, ax=ax, label="wheel angle, °")
        figure.suptitle(f"drift-threshold: {name}")

    return Result(table, figures, text, paint, (7.0, 4.0))


def _threshold(of: dict[str, Any]) -> str:
    """A threshold in words."""
    if of["energy_j"] is None:
        return f"{of['lock_deg']:.0f}°: never"
    return f"{of['lock_deg']:.0f}°: from {of['energy_j']:.1f} J ({of['speed_mps']:.2f} m/s)"
