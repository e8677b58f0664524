"""Corners of 60 to 180°, to both hands, driven by drift-turn: `python -m studies.corners`.

Prints a table. Each course is two straights with one corner between them, in a corridor of 1.4 m.
Corners of 150° and more are arcs, as a mitred corner would be too sharp a spike.
"""

import math
import os
from typing import Any

from countersteer.batch.evaluate import Trials, results
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.course import Course, from_segments
from countersteer.drivers.drift_turn import drift_turn
from countersteer.link.link import ONBOARD

ANGLES = (60, 75, 90, 105, 120, 135, 150, 180)  # degrees
ARC, RADIUS = 150, 0.7  # degrees from which a corner is an arc; m
WIDTH, STRAIGHT = 1.4, 4.0  # m
CARS, FIRST = 500, 5_000_000  # for each corner; first seed
SPEEDS = (1.5, 3.0)  # m/s
COLUMNS = (
    ("success_rate", 100, 1, " %"),
    ("drift_share", 100, 1, " %"),
    ("heading_error_rms_deg", 1, 1, "°"),
    ("heading_overshoot_deg_median", 1, 0, "°"),
    ("peak_sideslip_deg_median", 1, 0, "°"),
)


def corner(angle: float, hand: int) -> Course:
    """One corner (degrees), to the left (1) or right (-1)."""
    arc = angle >= ARC
    straight = ("length" if arc else "straight", STRAIGHT, 0.0)
    turn = ("turn", hand * math.radians(angle), RADIUS if arc else 0.0)
    name = f"{angle:g}° {'left' if hand > 0 else 'right'}"
    length = 2 * STRAIGHT + (math.radians(angle) * RADIUS if arc else 0.0)
    start, goal = (0.5, 0.0, 0.0), length - 0.5
    return from_segments(name, WIDTH, False, [straight, turn, straight], start, goal)


def row(angle: float, hand: int) -> dict[str, Any]:
    """The figures of a corner."""
    course, car = corner(angle, hand), load_car("rx7")
    seeds = range(FIRST, FIRST + CARS)
    around = load_population("around")
    trials = Trials(course, car, car, around, seeds, SPEEDS, 1, ONBOARD, "filter", 0.001)
    score = trials.run(lambda speed: drift_turn(course, car, speed))
    return results(score, seeds)


def main() -> int:
    """Print the table."""
    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    print("| corner | success | drifts | heading error, RMS | too far | sideslip |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for angle in ANGLES:
        for hand in (1, -1):
            found = row(angle, hand)
            cells = [
                "-" if found[key] is None else f"{factor * found[key]:.{digits}f}{unit}"
                for key, factor, digits, unit in COLUMNS
            ]
            side = "left" if hand > 0 else "right"
            print(f"| {angle}° {side} | {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
