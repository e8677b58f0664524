"""One drift turn in all its signals: simulated, or from a log.

Simulated: the drift-turn driver, on its sensors, in a right corner of 90°. From a log: the first
turn that was stopped, from a second before its kill (the end of its throttle).
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from countersteer.car.car import Car
from countersteer.drivers.drift_turn import drift_turn
from countersteer.errors import InputError
from countersteer.experiments.control_rate import LONGEST, SPEED, corner
from countersteer.experiments.open_turns import Series, series_of, stops
from countersteer.experiments.result import Report, Result, silent
from countersteer.pilot import Pilot
from countersteer.runs.run import Run
from countersteer.simulator import Simulator
from countersteer.task.turns import sideslip

BEFORE, BEHIND = 1.0, 0.8  # s shown before the kill, and after the stop


def simulate(car: Car, name: str, report: Report = silent) -> Result:
    """Simulate the nominal car with a full battery, at 2 m/s."""
    course = corner()
    simulator = Simulator.of(course, jax.tree.map(np.float32, car))
    drive = simulator.record(Pilot.of(drift_turn(course, car, SPEED), course, car), LONGEST)
    report(1, 1)
    m, every = drive.motion, slice(0, None, 5)
    series = Series(
        simulator.dt * drive.tick[every],
        drive.command.throttle[every],
        drive.command.steering[every],
        m.vx[every],
        m.vy[every],
        m.yaw_rate[every],
    )
    wheels = np.stack(m.wheels)[:, every]
    radii = (float(car.tires.front.radius), float(car.tires.rear.radius))
    more = {
        "steering_deg": np.degrees(m.steering[every]),
        "front_wheels_mps": radii[0] * wheels[:2].mean(axis=0),
        "rear_wheels_mps": radii[1] * wheels[2:].mean(axis=0),
        "battery_v": drive.voltage[every],
        "gyro_degps": np.degrees(drive.readings.gyroscope.value[every]),
        "wheel_speed_mps": drive.readings.wheel_speed.value[every],
    }
    return _found(f"{name}, simulated", series, more)


def measure(runs: Sequence[Run]) -> Result:
    """The first turn in these runs that was stopped. Raises `InputError` if there is none."""
    for run in runs:
        series = series_of(run)
        if stops(series, undisturbed=False):
            return _found(run.path.name, series, {})
    raise InputError("--from: no turn was stopped in these runs")


def _found(name: str, series: Series, more: dict[str, np.ndarray]) -> Result:
    turns = stops(series, undisturbed=False)
    if not turns:
        raise InputError(f"drift-turn: {name} holds no turn that was stopped")
    stop = turns[0]
    own = (series.time >= stop.time - BEFORE) & (series.time <= stop.time + stop.duration + BEHIND)
    time = series.time[own] - stop.time
    rate, vx, vy = series.yaw_rate[own], series.vx[own], series.vy[own]
    known = np.where(np.isfinite(rate), rate, 0.0)
    steps = (known[1:] + known[:-1]) / 2 * np.diff(time)
    heading = np.concatenate([[0.0], np.cumsum(steps)])
    slip = np.where(np.isfinite(vy), sideslip(vx, vy), math.nan)
    table = {
        "time_to_kill_s": time,
        "throttle": series.throttle[own],
        "steering_asked_deg": np.degrees(series.steering[own]),
        "vx_mps": vx,
        "vy_mps": vy,
        "yaw_rate_degps": np.degrees(rate),
        "turned_deg": np.degrees(heading),
        "sideslip_deg": np.degrees(slip),
        **{key: values[own] for key, values in more.items()},
    }
    figures = {
        "car": name,
        "hand": "left" if stop.hand > 0 else "right",
        "entry_speed_mps": stop.entry_speed,
        "kill_speed_mps": stop.vx,
        "kill_yaw_rate_degps": math.degrees(stop.yaw_rate),
        "time_to_stop_s": stop.duration,
        "angle_to_stop_deg": math.degrees(stop.angle),
        "turned_deg": math.degrees(float(heading[-1])),
        "peak_sideslip_deg": None
        if math.isnan(stop.peak_sideslip)
        else math.degrees(stop.peak_sideslip),
        "peak_yaw_rate_degps": math.degrees(float(np.nanmax(np.abs(rate)))),
    }
    slips = (
        "" if figures["peak_sideslip_deg"] is None
        else f", sideslip up to {figures['peak_sideslip_deg']:.0f}°"
    )  # fmt: skip
    text = (
        f"A turn to the {figures['hand']} ({name}): in at {stop.entry_speed:.2f} m/s, yaw rate up "
        f"to {figures['peak_yaw_rate_degps']:.0f} °/s{slips}; killed at "
        f"{figures['kill_yaw_rate_degps']:.0f} °/s and {stop.vx:.2f} m/s, it stopped in "
        f"{stop.duration:.3f} s and {figures['angle_to_stop_deg']:.0f}° more; turned by "
        f"{figures['turned_deg']:.0f}° in what is shown."
    )

    def paint(figure: Any) -> None:
        rows = figure.subplots(4, 1, sharex=True)
        panels: list[tuple[str, tuple[str, ...]]] = [
            ("throttle", ("throttle",)),
            ("wheels, °", ("steering_asked_deg", "steering_deg")),
            ("°/s and °", ("yaw_rate_degps", "gyro_degps", "turned_deg", "sideslip_deg")),
            ("m/s", ("vx_mps", "vy_mps", "wheel_speed_mps", "front_wheels_mps", "rear_wheels_mps")),
        ]
        for ax, (label, names) in zip(rows, panels, strict=True):
            for key in names:
                if key in table and np.any(np.isfinite(table[key])):
                    thin = 0.7 if key in ("gyro_degps", "wheel_speed_mps") else 1.4
                    ax.plot(time, table[key], lw=thin, label=key.rsplit("_", 1)[0])
            ax.axvline(0, color="grey", lw=0.8)
            ax.axvline(stop.duration, color="grey", lw=0.8, ls=":")
            ax.set_ylabel(label)
            ax.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
        rows[-1].set_xlabel("time from the kill, s (grey: the kill, dotted: stopped)")
        figure.suptitle(f"drift-turn: {name}")

    return Result(table, figures, text, paint, (9.0, 8.0))
