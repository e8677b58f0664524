"""One corner of 90° by four kinds of commands, open loop, with many random cars each.

The paper asks what better control actions are worth. The commands are the optimum's; the planner's;
the optimum's as a keyboard would give them (each control full to a side, or none), on time; and the
same from a novice, whose every change of a key comes late by a random time. Nobody corrects
anything. So the differences are those of the commands, and the spread is that of the cars.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from countersteer.batch.open_drives import drives
from countersteer.batch.population import draw, load_population
from countersteer.car.car import Car
from countersteer.course.course import Course, from_segments
from countersteer.drivers.replay import Replay
from countersteer.experiments.best_drive import Flying, best, planned
from countersteer.experiments.result import Report, Result, silent
from countersteer.planning.mppi import KNOT, Costs
from countersteer.signals import Command
from countersteer.task.judge import DRIFT

CARS = 1000
SEED = 40_000  # of the first car
BEFORE, SPEED = 1.6, 2.2  # m before the corner, and m/s, at which all begin
SECONDS = 1.6  # of commands; then they are held, and the heading is read
ROUNDS = 300  # of the search for the optimum
WIDTH = 1.4  # m, of the corridor
COSTS = Costs(margin=0.25)  # commands that nobody corrects need room
GATE = 1.2  # m behind the corner; who passes it without a touch is through
LINED_UP = math.radians(30)
LATE, SCATTER = 0.12, 0.05  # s, mean and standard deviation of a novice's delay
KEY = 1 / 3  # part of the full command from which a key is pressed
KINDS = ("optimum", "planner", "keys", "novice")
COLOURS = ("tab:green", "tab:blue", "tab:orange", "tab:red")


class Spread(NamedTuple):
    """The results of a kind of commands: an entry a car."""

    through: np.ndarray  # no wall touched, lined up at the gate
    touched: np.ndarray
    heading: np.ndarray  # rad, at the gate, over the corridor's; NaN where it was not reached
    offset: np.ndarray  # m from the corridor's middle there
    peak_sideslip: np.ndarray  # rad, up to the gate
    tracks: tuple[np.ndarray, np.ndarray]  # x and y (cars, samples), m


def corner() -> Course:
    """A corner to the left, 3 m from the start."""
    turn = [("straight", 3.0, 0.0), ("turn", math.pi / 2, 0.0), ("straight", 4.0, 0.0)]
    return from_segments("corner", WIDTH, False, turn)


def as_keys(commands: Command, lock: float) -> Command:
    """Each control full to the nearer side, or none."""

    def pressed(part: np.ndarray) -> np.ndarray:
        return np.where(np.abs(part) > KEY, np.sign(part), 0.0)

    return Command(pressed(commands.throttle), lock * pressed(commands.steering / lock))


def late(line: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A control whose every change comes late; a change overtakes none before it."""
    found, at = np.full(len(line), line[0]), 0
    for knot in np.nonzero(np.diff(line))[0] + 1:
        delay = round(float(rng.normal(LATE, SCATTER)) / KNOT)
        at = max(at, int(knot) + max(0, delay))
        found[at:] = line[knot]
    return found


def spread(course: Course, car: Car, commands: list[Command], first: int = SEED) -> Spread:
    """Drive each list of commands with a random car of its own."""
    count = len(commands)
    population = load_population("around")
    drawn = draw(population, car, course, range(first, first + count), np.float32)
    along = 3.0 - BEFORE - course.start_distance
    pose = drawn.pose + np.array([along, 0.0, 0.0], np.float32)
    still = np.zeros(count)
    times = KNOT * np.arange(len(commands[0].throttle))
    drivers = [Replay(times=times, commands=one) for one in commands]
    velocity = np.stack([SPEED + still, still, still], axis=1)
    sampled = drives(
        drawn.cars, drawn.charge, drivers, velocity, SECONDS + 1.0, pose, course.walls, drawn.floor
    )
    m = sampled.motion
    passed = (m.y >= GATE) & (np.abs(m.x - 3.0) < WIDTH / 2)
    reached, at = np.any(passed, axis=1), np.argmax(passed, axis=1)
    last, rows = np.where(reached, at, passed.shape[1] - 1), np.arange(count)
    on_way = np.arange(passed.shape[1])[None] <= last[:, None]
    slip = np.where(np.hypot(m.vx, m.vy) > 0.5, np.abs(np.arctan2(m.vy, m.vx)), 0.0)
    touched = sampled.wall_contacts[rows, last] > 0
    heading = np.where(reached, m.heading[rows, last] - math.pi / 2, math.nan)
    return Spread(
        reached & ~touched & (np.abs(heading) < LINED_UP),
        touched,
        heading,
        np.where(reached, m.x[rows, last] - 3.0, math.nan),
        np.max(np.where(on_way, slip, 0.0), axis=1),
        (np.where(on_way, m.x, math.nan), np.where(on_way, m.y, math.nan)),
    )


def simulate(
    car: Car, name: str, report: Report = silent, cars: int = CARS, rounds: int = ROUNDS
) -> Result:
    """Find the commands for the nominal car, then drive them with random cars."""
    course, flying = corner(), Flying(3.0 - BEFORE, SPEED)
    steps = rounds + 4 * 20
    own = planned(course, car, flying=flying, seconds=SECONDS, costs=COSTS)
    found = best(
        course,
        car,
        own,
        rounds,
        flying=flying,
        costs=COSTS,
        report=lambda done, _: report(done, steps),
    )
    lock = min(float(car.servo.limit_left), float(car.servo.limit_right))
    keys = as_keys(found.commands, lock)
    rng = np.random.default_rng(SEED)
    novices = [Command(late(keys.throttle, rng), late(keys.steering, rng)) for _ in range(cars)]
    kinds = ([found.commands] * cars, [own] * cars, [keys] * cars, novices)
    results: dict[str, Spread] = {}
    for number, (kind, commands) in enumerate(zip(KINDS, kinds, strict=True), start=1):
        results[kind] = spread(course, car, commands)
        report(rounds + 20 * number, steps)
    rows = {kind: _figures(one) for kind, one in results.items()}
    table: dict[str, Any] = {"commands": list(rows)}
    table |= {key: [row[key] for row in rows.values()] for key in rows[KINDS[0]]}
    about = {"car": name, "cars": cars, "entry_speed_mps": SPEED, "first_seed": SEED}
    return Result(
        table, about | rows, _text(name, cars, rows), partial(_paint, name, results), (12.0, 4.2)
    )


def _figures(one: Spread) -> dict[str, float]:
    """The row of a kind of commands."""
    heading = np.degrees(one.heading[np.isfinite(one.heading)])
    offset = one.offset[np.isfinite(one.offset)]
    ends = np.percentile(heading, [5, 50, 95]) if len(heading) else np.full(3, math.nan)
    return {
        "through_share": float(np.mean(one.through)),
        "touched_share": float(np.mean(one.touched)),
        "drift_share": float(np.mean(one.peak_sideslip > DRIFT)),
        "peak_sideslip_deg_median": float(np.degrees(np.median(one.peak_sideslip))),
        "heading_deg_p5": float(ends[0]),
        "heading_deg_median": float(ends[1]),
        "heading_deg_p95": float(ends[2]),
        "offset_m_deviation": float(np.std(offset)) if len(offset) else math.nan,
    }


def _text(name: str, cars: int, rows: dict[str, dict[str, float]]) -> str:
    """The figures in words."""
    parts = [
        f"{kind}: {100 * row['through_share']:.1f} % get through without a touch, "
        f"{100 * row['drift_share']:.0f} % drift, heading at the gate {row['heading_deg_p5']:.0f}° "
        f"to {row['heading_deg_p95']:.0f}° (5th to 95th percentile)"
        for kind, row in rows.items()
    ]
    return (
        f"A corner of 90° at {SPEED:g} m/s, open loop, {cars} random cars around {name} for each "
        f"kind of commands. {'; '.join(parts)}."
    )


def _paint(name: str, results: dict[str, Spread], figure: Any) -> None:
    """Draw the tracks of each kind of commands."""
    walls = corner().walls
    for ax, kind, colour in zip(figure.subplots(1, 4), KINDS, COLOURS, strict=True):
        one = results[kind]
        for ax_, ay, bx, by in walls:
            ax.plot([ax_, bx], [ay, by], "k", lw=1)
        for x, y in zip(one.tracks[0][:150], one.tracks[1][:150], strict=True):
            ax.plot(x, y, color=colour, lw=0.4, alpha=0.4)
        ax.set_aspect("equal")
        ax.set_xlim(1.0, 4.0)
        ax.set_ylim(-0.9, 1.8)
        ax.set_title(f"{kind}: {100 * np.mean(one.through):.0f} % through")
        ax.set_xlabel("m")
    figure.suptitle(f"action-spread: {name}, 150 cars of each")
