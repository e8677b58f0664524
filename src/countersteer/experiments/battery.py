"""The effect of the battery: the same commands at four charges and three wears.

The commands are a second straight ahead at a throttle, a left turn with throttle, and countersteer
without throttle; or else those of a run.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from countersteer.batch.engine import LANES
from countersteer.batch.open_drives import commands, drives, repeated
from countersteer.car.car import Car
from countersteer.car.parameter import changed
from countersteer.drivers.registry import replay
from countersteer.drivers.replay import Replay
from countersteer.experiments.result import Report, Result, silent
from countersteer.runs.run import Run, drawn_car
from countersteer.task.turns import sideslip

CHARGES, WEARS = (1.0, 0.75, 0.5, 0.25), (0.0, 0.5, 1.0)
# Time (s), throttle, part of full lock
STEPS = ((0.0, 0.9, 0.0), (1.0, 0.8, 0.8), (1.35, 0.0, -0.8), (1.65, 0.0, 0.0))
DRIVE = 2.2  # s
LONGEST = 10.0  # s of a run's commands


def simulate(car: Car, name: str, report: Report = silent, lanes: int = LANES) -> Result:
    """Simulate the commands from rest, on open floor."""
    lock = min(float(car.servo.limit_left), float(car.servo.limit_right))
    driver = commands(*((t, u, lock * part) for t, u, part in STEPS))
    return _found(car, name, driver, DRIVE, STEPS[1][0], report, lanes)


def measure(runs: Sequence[Run]) -> Result:
    """Simulate the commands of the first run with its car, for at most `LONGEST`."""
    told, car = runs[0].commands, drawn_car(runs[0].about)
    driver = replay(told)
    longest = min(float(told["time_s"][-1]), LONGEST)
    return _found(car, runs[0].path.name, driver, longest, longest, silent, LANES)


def _found(
    car: Car, name: str, driver: Replay, longest: float, mark: float, report: Report, lanes: int
) -> Result:
    charge, wear = (grid.ravel() for grid in np.meshgrid(CHARGES, WEARS, indexing="ij"))
    count = len(charge)
    cars = changed(repeated(car, count), "battery.wear", wear.astype(np.float32))
    sampled = drives(
        cars, charge.astype(np.float32), [driver] * count, np.zeros((count, 3)), longest,
        report=report, lanes=lanes,
    )  # fmt: skip
    m = sampled.motion
    at = min(round(mark / (sampled.time[1] - sampled.time[0])), len(sampled.time) - 1)
    speed = np.hypot(m.vx[:, at], m.vy[:, at])
    turned = np.degrees(m.heading[:, -1])
    away = np.hypot(m.x[:, -1] - m.x[0, -1], m.y[:, -1] - m.y[0, -1])
    table = {
        "battery_charge": charge,
        "battery_wear": wear,
        "speed_mps": speed,
        "turned_deg": turned,
        "peak_yaw_rate_degps": np.degrees(np.max(np.abs(m.yaw_rate), axis=1)),
        "peak_sideslip_deg": np.degrees(np.max(np.abs(sideslip(m.vx, m.vy)), axis=1)),
        "end_x_m": m.x[:, -1],
        "end_y_m": m.y[:, -1],
        "from_first_m": away,
    }
    last = count - 1
    figures = {
        "car": name,
        "commands_s": longest,
        "speed_mps": {"first": float(speed[0]), "last": float(speed[last])},
        "turned_deg": {
            "first": float(turned[0]), "last": float(turned[last]),
            "least": float(turned.min()), "most": float(turned.max()),
        },
        "farthest_from_first_m": float(away.max()),
    }  # fmt: skip
    text = (
        f"The same {longest:.1f} s of commands ({name}) at charges of {CHARGES[0]:g} to "
        f"{CHARGES[-1]:g} and wears of {WEARS[0]:g} to {WEARS[-1]:g}: after {mark:.1f} s the first "
        f"battery brings {speed[0]:.2f} m/s, the last {speed[last]:.2f}; at the end the car has "
        f"turned by {turned[0]:.0f}° with the first, {turned[last]:.0f}° with the last (of all "
        f"twelve {turned.min():.0f} to {turned.max():.0f}°), and is up to {away.max():.2f} m from "
        "where the first battery brings it."
    )

    def paint(figure: Any) -> None:
        import matplotlib.pyplot as plt

        path, angle = figure.subplots(1, 2)
        colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(CHARGES)))
        for i in range(count):
            colour = colours[CHARGES.index(charge[i])]
            style = ("-", "--", ":")[WEARS.index(wear[i])]
            path.plot(m.x[i], m.y[i], style, color=colour, lw=1.2)
            label = f"charge {charge[i]:g}" if wear[i] == 0 else None
            angle.plot(sampled.time, np.degrees(m.heading[i]), style, color=colour, label=label)
        path.set_aspect("equal", adjustable="datalim")
        path.set_xlabel("x, m")
        path.set_ylabel("y, m")
        angle.set_xlabel("time, s")
        angle.set_ylabel("heading, °")
        angle.legend(
            frameon=False,
            fontsize=8,
            title="solid new, dashed half worn, dotted worn",
            title_fontsize=7,
        )
        figure.suptitle(f"battery: {name}")

    return Result(table, figures, text, paint)
