"""Turns on open floor: the time and the angle that a car still turns after it is stopped.

A turn is stopped by its kill, the end of its throttle. Yaw rate and speed are measured at the kill,
then time and angle until the yaw rate is nearly 0. The measurement is the same for simulated turns
(`trial`) and for logs of a real car (`of_run`).
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.batch.open_drives import drives, repeated
from countersteer.batch.population import Population, draw
from countersteer.car.car import Car
from countersteer.drivers.open_turn import open_turn
from countersteer.drivers.turning import Turning
from countersteer.errors import InputError
from countersteer.reading.content import reading
from countersteer.runs.files import Table, csv_text, read_table
from countersteer.runs.run import Run, drawn_car, read_run
from countersteer.task.turns import sideslip
from countersteer.tuning.windows import find_references, read_measured
from countersteer.viewing.style import styled
from countersteer.writing import whole, write_whole

ON, OFF = 0.05, 0.02  # throttle that drives (above), and throttle that does not (up to)
FAST = 1.0  # rad/s; above it, a car turns
BEGIN = 0.3  # rad/s at the start of a turn
STILL = 0.1  # rad/s at its end
LONGEST = 2.0  # s, longest stop
SLOWEST = 0.3  # m/s; slower turns say nothing about a drift
SAMPLE = 0.005  # s between samples of a log

RUN_TIME = 3.2  # s of a simulated trial: run-up, turn, stop
KILL = (1.0, 1.5)  # range of the kill yaw rate: rad/s, and factor of the held yaw rate
SPIN = (0.25, 0.75)  # s, range of the longest time until the kill, at any yaw rate

COLUMNS = (
    "hand",
    "entry_speed_mps",
    "kill_speed_mps",
    "kill_yaw_rate_degps",
    "time_to_stop_s",
    "angle_to_stop_deg",
    "peak_sideslip_deg",
    "battery_charge",
    "seed",
    "kill_time_s",
    "run",
)
WORDS = ("hand", "run")


class Series(NamedTuple):
    """A drive as samples; NaN where unknown. SI units, rad."""

    time: np.ndarray
    throttle: np.ndarray
    steering: np.ndarray
    vx: np.ndarray
    vy: np.ndarray  # NaN if wheels and gyroscope are the only sources
    yaw_rate: np.ndarray


class Stop(NamedTuple):
    """A turn that was stopped. SI units, rad."""

    hand: int  # 1 left, -1 right
    time: float  # of the kill
    entry_speed: float
    vx: float  # at the kill, as an encoder measures it
    yaw_rate: float  # at the kill, positive in the turn's direction
    duration: float
    angle: float
    peak_sideslip: float  # NaN: unknown


def stops(series: Series, undisturbed: bool = True) -> list[Stop]:
    """The turns with a kill and then a stop; if `undisturbed`, without throttle in between."""
    time, rate = series.time, series.yaw_rate
    drives = series.throttle > ON
    held = np.abs(series.throttle) <= OFF
    found = []
    for kill in np.nonzero(drives[:-1] & held[1:])[0] + 1:
        if not abs(rate[kill]) > FAST or not series.vx[kill] > SLOWEST:
            continue
        hand = int(np.sign(rate[kill]))
        again = np.nonzero(~held[kill:])[0] if undisturbed else np.zeros(0, int)
        last = min(
            kill + (int(again[0]) if len(again) else len(time)),
            int(np.searchsorted(time, time[kill] + LONGEST)),
        )
        ahead = hand * rate[kill:last]
        if not np.any(ahead <= STILL):
            continue
        end = int(np.argmax(ahead <= STILL))
        if not np.all(np.isfinite(ahead[: end + 1])):
            continue
        part = (ahead[end - 1] - STILL) / (ahead[end - 1] - ahead[end])
        stopped = time[kill + end - 1] + part * (time[kill + end] - time[kill + end - 1])
        steps = np.append(time[kill : kill + end], stopped)
        angle = float(np.trapezoid(np.append(ahead[:end], STILL), steps))
        slow = np.nonzero(~(hand * rate[:kill] >= BEGIN))[0]
        begin = int(slow[-1]) + 1 if len(slow) else 0
        during = slice(begin, kill + end + 1)
        slip = np.abs(sideslip(series.vx, series.vy))[during]
        known = bool(np.any(np.isfinite(series.vy[during])))
        found.append(
            Stop(
                hand,
                float(time[kill]),
                float(np.hypot(series.vx[begin], np.nan_to_num(series.vy[begin]))),
                float(series.vx[kill]),
                float(hand * rate[kill]),
                float(stopped - time[kill]),
                angle,
                float(np.max(slip)) if known else math.nan,
            )
        )
    return found


def row(stop: Stop, charge: float = math.nan, seed: float = math.nan, run: str = "") -> list[Any]:
    """A stop as a row of the table, in the order of `COLUMNS`."""
    return [
        "left" if stop.hand > 0 else "right",
        stop.entry_speed,
        stop.vx,
        math.degrees(stop.yaw_rate),
        stop.duration,
        math.degrees(stop.angle),
        math.degrees(stop.peak_sideslip),
        charge,
        seed,
        stop.time,
        run,
    ]


def trial(
    car: Car,
    turning: Turning,
    population: Population | None,
    seeds: Sequence[int],
    speeds: tuple[float, float],
    charge: tuple[float, float] | None,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int = 128,
) -> list[list[Any]]:
    """Simulate one turn for each seed, as rows. Turns that do not stop in time are left out.

    The seed draws the hand, entry speed, yaw rate and latest time of the kill, and the charge. With
    a population, it also draws the car. The driver knows the nominal car.
    """
    count = len(seeds)
    cars, charges, floor = repeated(car, count), np.ones(count), None
    drawn = np.array([np.random.default_rng([seed, 1]).uniform(size=5) for seed in seeds])
    if population is not None:
        varied = draw(population, car, None, seeds, np.float32)
        cars, charges, floor = varied.cars, varied.charge, varied.floor
    if charge is not None:
        charges = charge[0] + (charge[1] - charge[0]) * drawn[:, 0]
    entry = speeds[0] + (speeds[1] - speeds[0]) * drawn[:, 1]
    hand = np.where(drawn[:, 2] < 0.5, 1, -1)
    held = np.interp(entry, turning.speeds, turning.rate)
    kill = KILL[0] + (KILL[1] * held - KILL[0]) * drawn[:, 3]
    longest = SPIN[0] + (SPIN[1] - SPIN[0]) * drawn[:, 4]
    drivers = [
        open_turn(car, turning, float(v), int(h), float(k), float(t))
        for v, h, k, t in zip(entry, hand, kill, longest, strict=True)
    ]
    velocity = np.stack([entry, np.zeros(count), np.zeros(count)], axis=1)
    sampled = drives(
        cars,
        charges.astype(np.float32),
        drivers,
        velocity,
        RUN_TIME,
        floor=floor,
        report=report,
        lanes=lanes,
    )
    rows = []
    for i, seed in enumerate(seeds):
        m, c = sampled.motion, sampled.command
        series = (c.throttle[i], c.steering[i], m.vx[i], m.vy[i], m.yaw_rate[i])
        for stop in stops(Series(sampled.time, *series))[:1]:
            rows.append(row(stop, float(charges[i]), int(seed)))
    return rows


def series_of(run: Run) -> Series:
    """The series of a run: motion capture or the simulated truth, else gyroscope and wheel speed.

    The lag of sensors is removed. Raises `InputError` if the run has neither.
    """
    found = find_references(read_measured(run, drawn_car(run.about)))
    forward = found.get("vx_mps") or found.get("wheel_speed_mps")
    turning = found.get("yaw_rate_radps")
    if forward is None or turning is None:
        raise InputError(
            f"{run.path}: tells no speed and yaw rate: give truth.csv, or wheel_speed_mps and "
            "gyro_radps in telemetry.csv"
        )
    commands = run.commands["time_s"]
    time = np.arange(commands[0], commands[-1] + SAMPLE / 2, SAMPLE)
    last = np.maximum(np.searchsorted(commands, time + 1e-6, side="right") - 1, 0)
    sideways = found["vy_mps"].undone(time) if "vy_mps" in found else np.full(len(time), math.nan)
    return Series(
        time,
        run.commands["throttle"][last],
        run.commands["steering"][last],
        forward.undone(time),
        sideways,
        turning.undone(time),
    )


def of_run(path: Path) -> list[list[Any]]:
    """The stopped turns of a run's folder, as rows."""
    run = read_run(path)
    charge = float(run.about.get("battery_charge", math.nan))
    return [row(stop, charge, run=path.name) for stop in stops(series_of(run))]


def write_rows(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    """Write the rows as `turns.csv`. An unknown value is an empty cell."""
    write_whole(path, csv_text(COLUMNS, rows))


def as_table(rows: Sequence[Sequence[Any]]) -> Table:
    """Rows as columns by name."""
    columns = list(zip(*rows, strict=True)) if rows else [()] * len(COLUMNS)
    return Table(
        {
            name: np.array(column, dtype=str if name in WORDS else float)
            for name, column in zip(COLUMNS, columns, strict=True)
        }
    )


def read_turns(path: Path) -> Table:
    """Read turns from a `turns.csv`, a folder that holds one, or a run's folder.

    Raises `InputError` if a number is missing or impossible for a stop.
    """
    with reading(path):
        is_folder = path.is_dir()
        file = path / "turns.csv" if is_folder else path
        is_run = is_folder and (path / "run.toml").exists()
        if not is_run and not file.exists():
            raise InputError(f"{path}: no such table of turns, nor a run's folder")
    if is_run:
        return as_table(of_run(path))
    table = read_table(file, COLUMNS[:6], text=WORDS)
    other = ~np.isin(table["hand"], ("left", "right"))
    if np.any(other):
        raise InputError(f"{file}, line {int(np.argmax(other)) + 2}: hand must be left or right")
    for name in COLUMNS[1:6]:
        low = 0.0 if name != "angle_to_stop_deg" else -360.0
        wrong = ~(table[name] >= low) | ~(table[name] <= 1e4)
        if np.any(wrong):
            line = int(np.argmax(wrong)) + 2
            raise InputError(f"{file}, line {line}: {name} must be a number in [{low:g}, 10000]")
    return table


@styled()
def draw_turns(table: Table, path: Path, title: str) -> None:
    """Draw time and angle to the stop over the yaw rate at the kill, coloured by speed."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    speeds = table["kill_speed_mps"]
    slowest, fastest = (float(np.min(speeds)), float(np.max(speeds))) if len(speeds) else (0.0, 1.0)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharex=True)
    for ax, name, label in (
        (axes[0], "time_to_stop_s", "time to stop, s"),
        (axes[1], "angle_to_stop_deg", "angle turned until stopped, °"),
    ):
        for hand, marker in (("left", "<"), ("right", ">")):
            mine = table["hand"] == hand
            dots = ax.scatter(
                table["kill_yaw_rate_degps"][mine],
                table[name][mine],
                c=table["kill_speed_mps"][mine],
                vmin=slowest,
                vmax=fastest,
                s=14,
                marker=marker,
                linewidths=0,
                label=f"{hand} ({int(mine.sum())})",
            )
        ax.set_xlabel("yaw rate at the kill, °/s")
        ax.set_ylabel(label)
    axes[0].legend(frameon=False, fontsize=8)
    figure.colorbar(dots, ax=axes, label="forward speed at the kill, m/s")
    figure.suptitle(title)
    with whole(path) as part:
        figure.savefig(part, format="png", dpi=110)
    plt.close(figure)


def summary(table: Table, tried: int | None) -> dict[str, Any]:
    """Statistics of the table; names and units are those of the JSON."""
    count = len(table["hand"])
    result: dict[str, Any] = {"turns": count}
    if tried is not None:
        result = {"trials": tried, **result, "never_stopped": tried - count}
    result["left"], result["right"] = (int(np.sum(table["hand"] == h)) for h in ("left", "right"))
    for name in COLUMNS[1:7]:
        values = table[name][np.isfinite(table[name])]
        result[name] = (
            {
                "low": float(values.min()),
                "median": float(np.median(values)),
                "high": float(values.max()),
            }
            if len(values)
            else None
        )
    return result
