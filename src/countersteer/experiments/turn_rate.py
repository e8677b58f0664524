"""Yaw rate over the wheels' angle without slip.

Simulated: wheels held at an angle, at speeds within grip; the last half second counts. From a log:
half seconds with a constant commanded angle, a constant yaw rate, and a rear slip angle below 3°,
where it is known. Without slip the yaw rate is v tan(angle) / L. The line through yaw rate / v over
tan(angle) gives L, the effective wheelbase. It is longer than the wheelbase if the front wheels
slip more than the rear ones, or turn less than commanded.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from countersteer.batch.engine import LANES
from countersteer.batch.open_drives import commands, drives, repeated
from countersteer.car.car import Car
from countersteer.drivers.straighten import holding_throttle
from countersteer.errors import InputError
from countersteer.experiments.open_turns import series_of
from countersteer.experiments.result import Report, Result, silent
from countersteer.runs.run import Run, drawn_car

SPEEDS = (0.5, 0.8, 1.1)  # m/s
STEP = math.radians(2)
DRIVE, COUNTS = 2.5, 0.5  # s, length of a drive, and of its end that counts
GRIPS = math.radians(3)  # rear slip angle; below it, the car does not slip
STILL = math.radians(0.5)  # largest change of a constant angle
EVEN = 0.15  # rad/s, largest standard deviation of a constant yaw rate
GENTLE = 1.5  # m/s², largest lateral acceleration without slip, if the slip angle is unknown


def simulate(car: Car, name: str, report: Report = silent, lanes: int = LANES) -> Result:
    """Simulate every second degree of lock at three speeds."""
    left, right = float(car.servo.limit_left), float(car.servo.limit_right)
    angles = STEP * np.arange(-math.floor(right / STEP + 1e-6), math.floor(left / STEP + 1e-6) + 1)
    speeds, asked = (grid.ravel() for grid in np.meshgrid(SPEEDS, angles, indexing="ij"))
    dead_zone = float(car.motor.dead_zone)
    drivers = [
        commands((0.0, holding_throttle(car, v) + dead_zone, angle))
        for v, angle in zip(speeds, asked, strict=True)
    ]
    still = np.zeros(len(asked))
    velocity = np.stack([speeds, still, still], axis=1)
    charge = np.ones(len(asked), np.float32)
    sampled = drives(
        repeated(car, len(asked)), charge, drivers, velocity, DRIVE, report=report, lanes=lanes
    )
    end, m = sampled.time >= DRIVE - COUNTS, sampled.motion
    vx, vy, rate = (np.mean(v[:, end], axis=1) for v in (m.vx, m.vy, m.yaw_rate))
    return _found(car, f"{name}, simulated", asked, vx, vy, rate)


def measure(runs: Sequence[Run]) -> Result:
    """Find such half seconds in logs."""
    rows: list[tuple[float, ...]] = []
    for run in runs:
        series = series_of(run)
        count = round(COUNTS / (series.time[1] - series.time[0]))
        for begin in range(0, len(series.time) - 2 * count + 1, count):
            # The servo and the car need a moment before the angle shows.
            held = series.steering[begin : begin + 2 * count]
            own = slice(begin + count, begin + 2 * count)
            vx, rate = series.vx[own], series.yaw_rate[own]
            if np.ptp(held) < STILL and np.std(rate) < EVEN and np.mean(vx) > 0.3:
                rows.append((held[0], float(vx.mean()), float(series.vy[own].mean()), rate.mean()))
    if len(rows) < 3:
        raise InputError("--from: less than three stretches of half a second at a standing angle")
    asked, vx, vy, rate = np.array(rows).T
    car = drawn_car(runs[0].about)
    return _found(car, f"{len(runs)} runs", asked, vx, vy, rate)


def _found(
    car: Car, name: str, asked: np.ndarray, vx: np.ndarray, vy: np.ndarray, rate: np.ndarray
) -> Result:
    rear = float(car.body.wheelbase - car.body.front_axle)
    slip = np.arctan2(vy - rear * rate, np.maximum(vx, 1e-3))
    grips = np.where(np.isfinite(slip), np.abs(slip) < GRIPS, np.abs(vx * rate) < GENTLE)
    if np.sum(grips) < 3:
        raise InputError("turn-rate: less than three angles are held without slip")
    x, y = np.tan(asked[grips]), (rate / vx)[grips]
    slope, offset = np.polyfit(x, y, 1)
    left = y - offset - slope * x
    deviation = math.sqrt(float(np.sum(left**2)) / max(len(x) - 2, 1))
    error = deviation / math.sqrt(max(float(np.sum((x - x.mean()) ** 2)), 1e-12))
    length, length_error = 1 / slope, error / slope**2
    trim = -math.degrees(math.atan(offset / slope))
    explained = 1 - float(np.sum(left**2) / max(np.sum((y - y.mean()) ** 2), 1e-12))
    figures = {
        "car": name,
        "points": len(asked),
        "without_slip": int(grips.sum()),
        "wheelbase_m": float(car.body.wheelbase),
        "felt_wheelbase_m": float(length),
        "felt_wheelbase_error_m": float(length_error),
        "straight_at_deg": trim,
        "r_squared": explained,
    }
    text = (
        f"Yaw rate over the wheels' angle ({name}): {int(grips.sum())} of {len(asked)} points "
        f"without slip, wheels at {math.degrees(asked[grips].min()):.0f} to "
        f"{math.degrees(asked[grips].max()):.0f}°, {vx[grips].min():.2f} to "
        f"{vx[grips].max():.2f} m/s. Yaw rate = v tan(angle) / {length:.3f} m (± "
        f"{length_error:.3f}; the wheelbase is {float(car.body.wheelbase):.3f} m), straight ahead "
        f"at {trim:+.1f}°, R² {explained:.3f}."
    )
    table = {
        "wheel_angle_deg": np.degrees(asked),
        "speed_mps": vx,
        "yaw_rate_degps": np.degrees(rate),
        "rear_slip_deg": np.degrees(slip),
        "without_slip": grips.astype(float),
    }

    def paint(figure: Any) -> None:
        ax, flat = figure.subplots(1, 2)
        dots = ax.scatter(np.degrees(asked[grips]), np.degrees(rate[grips]), c=vx[grips], s=14)
        ax.plot(
            np.degrees(asked[~grips]), np.degrees(rate[~grips]), "x", color="grey", ms=4,
            label="slips",
        )  # fmt: skip
        figure.colorbar(dots, ax=ax, label="speed, m/s")
        ax.set_xlabel("wheel angle asked for, °")
        ax.set_ylabel("yaw rate, °/s")
        if np.any(~grips):
            ax.legend(frameon=False, fontsize=8)
        flat.scatter(x, y, c=vx[grips], s=14)
        ends = np.array([x.min(), x.max()])
        flat.plot(ends, offset + slope * ends, color="k", lw=1, label=f"1 / {length:.3f} m")
        flat.set_xlabel("tan of the wheel angle")
        flat.set_ylabel("yaw rate / speed, 1/m")
        flat.legend(frameon=False)
        figure.suptitle(f"turn-rate: {name}")

    return Result(table, figures, text, paint)
