"""The planner with cars that differ from the one it knows: the table of docs/planning.md.

Where the car's sideslip in a turn, as the judge finds it, stays under 25°, it goes round by grip. A
race track has no corners for the judge; there a bend is told instead, a stretch of the rounded
centre line with a radius under 5 m.

It plans with the nominal model; each car is a random one of the set `around`. It knows where it is
(the estimator `truth`). Drives are computed one after another, in as many processes as cores.

    python -m studies.planner COURSE [CARS] [FIRST_SEED]
"""

import concurrent.futures
import itertools
import multiprocessing
import os
import sys
from typing import Any

import jax
import numpy as np
from scipy.spatial import KDTree

from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.course import Course
from countersteer.course.files import load_course
from countersteer.course.way import SPACING, way_of
from countersteer.pilot import Pilot
from countersteer.planning.mppi import Mppi
from countersteer.simulator import Simulator
from countersteer.task.judge import Outcome, Task, samples
from countersteer.task.turns import sideslip

CARS, FIRST = 100, 7_000_000
LONGEST = 60.0  # s
DRIFT = 25.0  # degrees of sideslip, from which a turn is a drift


def bends_of(course: Course) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """The points of the rounded line (n, 2), and the first and last row of each bend.

    There are none where the judge finds turns.
    """
    way = way_of(course)
    rows = int(way.last) + 1
    edges = np.flatnonzero(np.diff(way.bend[:rows], prepend=0.0, append=0.0))
    pairs = [] if course.turns else itertools.pairwise(edges)
    bends = [(int(a), int(b)) for a, b in pairs if way.bend[a] != 0]
    return np.stack([way.x, way.y], axis=1)[:rows], bends


def drives(name: str, seeds: range) -> list[dict[str, Any]]:
    """The results of the cars with these seeds, on one core."""
    configure_jax(blocks=True, cores=1)
    course, car = load_course(name), load_car("rx7")
    drawn = draw(load_population("around"), car, course, seeds, np.float64)
    pilot = Pilot.of(Mppi(course, car), course, car, "truth")
    task = Task.of(course, 1, walls_end=True)
    points, bends = bends_of(course)
    line = KDTree(points)
    found = []
    for i, seed in enumerate(seeds):
        alone, floor = jax.tree.map(lambda leaf, at=i: leaf[at], (drawn.cars, drawn.floor))
        x, y, heading = map(float, drawn.pose[i])
        simulator = Simulator.of(
            course,
            alone,
            seed=seed,
            charge=float(drawn.charge[i]),
            start=(x, y, heading),
            floor=floor,
        )
        score, slips = task.init(), np.zeros(len(bends))
        for record in simulator.run(pilot, LONGEST):
            rows = np.nonzero(record.tick % 5 == 0)[0]
            score, _ = task.follow(score, samples(record, rows, simulator.dt))
            motion = jax.tree.map(lambda leaf, at=rows: leaf[at], record.motion)
            near = line.query(np.stack([motion.x, motion.y], axis=1))[1]
            slip = np.abs(np.degrees(sideslip(motion.vx, motion.vy)))
            for k, (first, last) in enumerate(bends):
                within = slip[(near >= first) & (near < last)]
                slips[k] = max(slips[k], *within, 0.0)
            if score.outcome != Outcome.DRIVING.code:
                break
        found.append(
            {
                "seed": seed,
                "outcome": Outcome.of(score.outcome).value,
                "furthest": float(score.furthest),
                "lap": float(score.goal_time),
                "sideslip": slips if bends else np.degrees(score.turns.peak_sideslip),
                "overshoot": np.degrees(score.turns.overshoot),
            }
        )
        print(found[-1]["seed"], found[-1]["outcome"], file=sys.stderr, flush=True)
    return found


def main(name: str, cars: int = CARS, first: int = FIRST) -> int:
    """Print a row of the table, and the turns of those that got round."""
    cores, context = os.cpu_count() or 1, multiprocessing.get_context("spawn")
    shares = [range(first + k, first + cars, cores) for k in range(cores)]
    with concurrent.futures.ProcessPoolExecutor(cores, context) as pool:
        found = [one for share in pool.map(drives, [name] * cores, shares) for one in share]
    round_ = [one for one in found if one["outcome"] == Outcome.REACHED.value]
    print(f"{name}: {len(round_)} of {cars} get round")
    for outcome in sorted({one["outcome"] for one in found} - {Outcome.REACHED.value}):
        failed = [one for one in found if one["outcome"] == outcome]
        at = ", ".join(f"{one['furthest']:.1f}" for one in failed)
        print(f"  {len(failed)} {outcome}, after {at} m")
    if not round_:
        return 0
    lap = np.percentile([one["lap"] for one in round_], (5, 50, 95))
    print("  lap {:.2f} s, {:.2f} to {:.2f}".format(*lap[[1, 0, 2]]))
    over = np.concatenate([one["overshoot"] for one in round_])
    if len(over):
        print(f"  overshoot {np.median(over):.0f}°, 95th percentile {np.percentile(over, 95):.0f}°")
    course = load_course(name)
    places = [f"turn at {turn.distance:.1f} m" for turn in course.turns_ahead(1)]
    places += [f"bend of {SPACING * a:.1f} to {SPACING * b:.1f} m" for a, b in bends_of(course)[1]]
    slips = np.array([one["sideslip"] for one in round_])
    for place, slip in zip(places, slips.T, strict=True):
        print(
            f"  {place}: sideslip {np.median(slip):.0f}°, "
            f"drifts {100 * np.mean(slip > DRIFT):.0f} %"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], *map(int, sys.argv[2:])))
