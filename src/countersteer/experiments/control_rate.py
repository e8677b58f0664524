"""10 Hz over a lossy radio or 1000 Hz on board, open or closed loop, two batteries.

This is the paper's own argument. Cars drawn around the nominal one drive a corner of 90°. The
battery is full and new, or worn and nearly empty. The open loop plays back the commands of a turn
that the closed loop gave with the nominal car and the first battery. Playback begins where the
driver hands over. Before and after it, the closed loop drives.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer.batch.engine import LANES
from countersteer.batch.evaluate import interval
from countersteer.batch.population import draw, load_population
from countersteer.batch.trials import run_trials
from countersteer.car.car import Car
from countersteer.car.parameter import changed
from countersteer.course.course import Course, from_segments
from countersteer.drivers.drift_turn import DriftTurn, drift_turn
from countersteer.drivers.played_turn import STEP, PlayedTurn
from countersteer.experiments.result import Report, Result, silent
from countersteer.link.link import LINKS
from countersteer.pilot import Pilot
from countersteer.simulator import Simulator
from countersteer.task.judge import Outcome, Score

TRIALS = 256
SPEED = 2.0  # m/s
AFTER = 0.2  # s of recorded commands after the car goes straight
LONGEST = 8.0  # s of a trial
BATTERIES = {"first": (1.0, 0.0), "last": (0.3, 1.0)}  # charge, wear


def corner(width: float = 1.4, name: str = "corner") -> Course:
    """A right turn of 90° between two straights."""
    segments = [("straight", 3.5, 0.0), ("turn", -math.pi / 2, 0.0), ("straight", 3.5, 0.0)]
    return from_segments(name, width, False, segments, (0.5, 0.0, 0.0), 6.2)


def record(course: Course, car: Car, driver: DriftTurn) -> tuple[np.ndarray, np.ndarray]:
    """Throttle and steering of the turn, by the nominal car with the first battery."""
    simulator = Simulator.of(course, jax.tree.map(np.float32, car))
    drive = simulator.record(Pilot.of(driver, course, car), LONGEST)
    turning = np.nonzero(drive.status.turn > 0)[0]
    calm = (np.abs(drive.motion.yaw_rate) < math.radians(30)) & (
        np.abs(np.arctan2(drive.motion.vy, drive.motion.vx)) < math.radians(10)
    )
    begin = int(turning[0])
    stirred = begin + int(np.argmax(~calm[begin:]))
    held = np.convolve(calm[stirred:].astype(int), np.ones(50, int), "valid")
    end = stirred + int(np.argmax(held == 50)) + 50 + round(AFTER / simulator.dt)
    every = slice(begin, end, round(STEP / simulator.dt))
    return drive.command.throttle[every], drive.command.steering[every]


def simulate(
    car: Car, name: str, report: Report = silent, trials: int = TRIALS, lanes: int = LANES
) -> Result:
    """Simulate eight cells of trials: rate, loop, battery."""
    course = corner()
    closed = drift_turn(course, car, SPEED)
    throttle, steering = record(course, car, closed)
    drivers = {
        "closed": closed,
        "open": PlayedTurn(inner=closed, throttle=throttle, steering=steering),
    }
    rows: dict[str, list[Any]] = {}
    errors: dict[Cell, np.ndarray] = {}
    cells = [Cell(*one) for one in itertools.product(LINKS, ("open", "closed"), BATTERIES)]
    for number, cell in enumerate(cells):
        score = run_cell(course, car, drivers[cell.loop], cell, trials, lanes)
        ended = np.isfinite(score.turns.end[:, 0])
        errors[cell] = np.degrees(score.turns.error[ended, 0])
        for key, value in row(cell, score).items():
            rows.setdefault(key, []).append(value)
        report(number + 1, len(cells))
    figures = {
        "car": name,
        "speed_mps": SPEED,
        "cells": [dict(zip(rows, cell, strict=True)) for cell in zip(*rows.values(), strict=True)],
    }
    text = _text(name, trials, rows, cells)
    return Result(rows, figures, text, partial(_paint, name, trials, rows, errors), (11.0, 4.6))


class Cell(NamedTuple):
    """The conditions of one set of trials."""

    link: str
    loop: str  # open or closed
    battery: str  # first or last


def run_cell(course: Course, car: Car, driver: Any, cell: Cell, trials: int, lanes: int) -> Score:
    """Run the trials of a cell."""
    charge, wear = BATTERIES[cell.battery]
    population = dataclasses.replace(load_population("around"), charge=(charge, charge))
    drawn = draw(population, car, course, range(trials), np.float32)
    cars = changed(drawn.cars, "battery.wear", np.full(trials, wear, np.float32))
    link = LINKS[cell.link]
    return run_trials(
        course,
        Pilot.of(driver, course, car, link=link),
        drawn._replace(cars=cars),
        [driver] * trials,
        range(trials),
        1,
        LONGEST,
        lanes=lanes,
        link=link,
    )[0]


def row(cell: Cell, score: Score) -> dict[str, Any]:
    """The results of a cell, as a row of the table."""
    won = score.outcome == Outcome.REACHED.code
    ended = np.isfinite(score.turns.end[:, 0])
    error = np.degrees(score.turns.error[ended, 0])
    low, high = interval(int(won.sum()), len(won))
    charge, wear = BATTERIES[cell.battery]
    mean = rms = slip = math.nan
    if len(error):
        mean, rms = float(error.mean()), float(np.sqrt(np.mean(error**2)))
        slip = float(np.degrees(np.median(score.turns.peak_sideslip[ended, 0])))
    return {
        "control_hz": 1 / LINKS[cell.link].control_period,
        **cell._asdict(),
        "battery_charge": charge,
        "battery_wear": wear,
        "trials": len(won),
        "success_rate": float(won.mean()),
        "success_low": low,
        "success_high": high,
        "turns_ended": int(ended.sum()),
        "heading_error_mean_deg": mean,
        "heading_error_rms_deg": rms,
        "peak_sideslip_median_deg": slip,
    }


def _text(name: str, trials: int, rows: dict[str, list[Any]], cells: Sequence[Cell]) -> str:
    """The figures in words."""

    def cell(link: str, loop: str, battery: str) -> str:
        i = cells.index(Cell(link, loop, battery))
        rate, error = rows["success_rate"][i], rows["heading_error_rms_deg"][i]
        return f"{100 * rate:.0f} % pass ({error:.0f}° rms of heading)"

    def pair(link: str, loop: str) -> str:
        return f"{cell(link, loop, 'first')} with the first, {cell(link, loop, 'last')} the last"

    return (
        f"A 90° corner, 1.4 m wide, at {SPEED:g} m/s, {trials} cars drawn around {name}, with the "
        f"first battery (full, new) and the last (30 %, worn). On board at 1000 Hz, closed loop: "
        f"{pair('onboard', 'closed')}; open loop: {pair('onboard', 'open')}. Over the radio at "
        f"10 Hz, closed loop: {pair('radio', 'closed')}; open loop: {pair('radio', 'open')}."
    )


def _paint(
    name: str,
    trials: int,
    rows: dict[str, list[Any]],
    errors: dict[Cell, np.ndarray],
    figure: Any,
) -> None:
    """Draw corners passed, and heading errors, by cell."""
    left, right = figure.subplots(1, 2)
    rates = {"onboard": "1000 Hz on board", "radio": "10 Hz by radio"}
    labels = [f"{rates[c.link]}\n{c.loop} loop, {c.battery} battery" for c in errors]
    colours = ["tab:blue" if c.loop == "closed" else "tab:orange" for c in errors]
    place = np.arange(len(errors))[::-1]
    rate = np.array(rows["success_rate"])
    ends = np.abs(np.array([rows["success_low"], rows["success_high"]]) - rate)
    left.barh(place, 100 * rate, xerr=100 * ends, color=colours, height=0.7)
    left.set_yticks(place, labels, fontsize=8)
    left.set_xlabel("corners passed, % (95 % interval)")
    left.set_xlim(0, 100)
    shown = [error if len(error) else np.array([math.nan]) for error in errors.values()]
    right.boxplot(shown, positions=place, orientation="horizontal", widths=0.6, sym=".")
    right.set_yticks(place, [""] * len(errors))
    right.axvline(0, color="grey", linewidth=0.8)
    right.set_xlabel("heading error of turns that ended, ° (box: half of them, dots: outliers)")
    figure.suptitle(f"control-rate: {name}, {trials} trials each")
