"""The planner's decisions: how long they take, and how far its step is off (docs/planning.md).

The nominal car drives one lap, compiled as `drive` does it. Every fifth plan is then driven once
more, with the planner's step and with the world's of 1 ms, both in 64 bits. The error is how far
apart they end.

    python -m studies.planner_decisions COURSE
"""

import functools
import sys
import time
from typing import Any

import jax
import numpy as np

from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.drivers.driver import Observation
from countersteer.pilot import Pilot
from countersteer.planning import mppi
from countersteer.signals import Command
from countersteer.simulator import Simulator
from countersteer.task.judge import Outcome, Task, samples

FIRST, EACH = 20, 5  # of the plans that are driven again: after the start, and every so many
LONGEST = 60.0  # s
WORLD = 0.001  # s


class Watched(mppi.Mppi):
    """The planner, with the time of each decision, and what each began with."""

    def __init__(self, *about: Any) -> None:
        super().__init__(*about)
        self.times: list[float] = []
        self.plans: list[tuple[mppi.Memory, list[float]]] = []

    def act(self, memory: mppi.Memory, observation: Observation) -> tuple[Command, mppi.Memory]:
        """As the planner does."""
        begun = time.perf_counter()
        decided = super().act(memory, observation)
        self.times.append(1000 * (time.perf_counter() - begun))
        self.plans.append((memory, [getattr(observation.estimate, name) for name in mppi.SEEN]))
        return decided


def in_64_bits(tree: Any) -> Any:
    """The tree with all its numbers in 64 bits."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def main(name: str) -> int:
    """Print both."""
    configure_jax(batches=False, cores=2)
    course, car = load_course(name), load_car("rx7")
    planner = Watched(course, car)
    task = Task.of(course, 1, walls_end=True)
    simulator, score = Simulator.of(course, car), task.init()
    for record in simulator.run(Pilot.of(planner, course, car, "truth"), LONGEST):
        rows = np.nonzero(record.tick % 5 == 0)[0]
        score, _ = task.follow(score, samples(record, rows, simulator.dt))
        if score.outcome != Outcome.DRIVING.code:
            break
    times = planner.times[3:]  # the first compile
    print(
        f"{len(times)} decisions: {np.median(times):.1f} ms at the median, "
        f"90th percentile {np.percentile(times, 90):.1f} ms"
    )
    errors, ways = [], []
    with jax.enable_x64(True):
        problem = in_64_bits(mppi.problem_of(course, car, 1, mppi.Costs(), mppi.Search())[0])
        own, fine = (
            jax.jit(functools.partial(mppi.drive, problem, step=step))
            for step in (mppi.STEP, WORLD)
        )
        for plan in planner.plans[FIRST::EACH]:
            memory, seen = in_64_bits((plan[0]._replace(key=0), np.array(plan[1])))
            begun = mppi.now(problem, memory.motion, seen)
            a, b = (drive(begun, memory.given, memory.commands) for drive in (own, fine))
            errors.append(1000 * float(np.hypot(a.x[-1] - b.x[-1], a.y[-1] - b.y[-1])))
            ways.append(float(np.hypot(b.x[-1] - begun.x, b.y[-1] - begun.y)))
    print(
        f"{len(errors)} plans of {np.median(ways):.1f} m: a step of {1000 * mppi.STEP:.0f} ms "
        f"is off by {np.median(errors):.1f} mm at the median, 95th percentile "
        f"{np.percentile(errors, 95):.0f} mm"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
