"""The best drive of a car that is wholly known: the planner's, and the open-loop optimum."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from countersteer.car.car import Car
from countersteer.course.course import Course, place
from countersteer.drivers.replay import Replay
from countersteer.pilot import Pilot
from countersteer.planning import optimum
from countersteer.planning.mppi import KNOT, Costs, Mppi, Search, at_rest, problem_of
from countersteer.planning.optimum import Optimum
from countersteer.signals import Command, Motion, Wheels
from countersteer.simulator import Simulator
from countersteer.task.judge import PERIOD, Outcome, Task, samples, summary

BEYOND = 0.4  # s that commands go on behind the goal of the planner's drive
LONGEST = 60.0  # s of that drive


class Flying(NamedTuple):
    """A start in motion, in the middle of the course."""

    distance: float  # along the centre line, m
    speed: float  # m/s


def start_motion(course: Course, car: Car, flying: Flying | None) -> Motion:
    """The motion at the start: at rest, or rolling."""
    if flying is None:
        return at_rest(course.start)
    radii = [float(t.radius) for t in (car.tires.front, car.tires.rear)]
    wheels = Wheels(*(flying.speed / r for r in np.repeat(radii, 2)))
    return at_rest(place(course, flying.distance))._replace(vx=flying.speed, wheels=wheels)


def _simulator(course: Course, car: Car, motion: Motion) -> Simulator:
    return Simulator.of(
        course,
        car,
        start=(float(motion.x), float(motion.y), float(motion.heading)),
        velocity=(float(motion.vx), 0.0, 0.0),
    )


def planned(
    course: Course,
    car: Car,
    laps: int = 1,
    flying: Flying | None = None,
    seconds: float | None = None,
    costs: Costs = Costs(),  # noqa: B008  # it is immutable
) -> Command:
    """The planner's commands on ground truth, a value every `KNOT`.

    They last `seconds`, by default until `BEYOND` after the goal, and at most `LONGEST`.
    """
    simulator = _simulator(course, car, start_motion(course, car, flying))
    pilot = Pilot.of(Mppi(course, car, laps, costs=costs), course, car, "truth")
    task = Task.of(course, laps)
    score, lines, ends = task.init(), [], LONGEST if seconds is None else seconds
    for record in simulator.run(pilot, LONGEST):
        given = record.tick % round(KNOT / simulator.dt) == 0
        lines.append(Command(record.command.throttle[given], record.command.steering[given]))
        if seconds is None:
            look = np.nonzero(record.tick % round(PERIOD / simulator.dt) == 0)[0]
            score, _ = task.follow(score, samples(record, look, simulator.dt))
            ends = min(ends, float(score.goal_time) + BEYOND)
        if record.tick[-1] * simulator.dt >= ends:
            break
    throttle, steering = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    knots = math.ceil(ends / KNOT)
    return Command(throttle[:knots], steering[:knots])


def best(
    course: Course,
    car: Car,
    begin: Command,
    rounds: int,
    laps: int = 1,
    flying: Flying | None = None,
    seed: int = 0,
    costs: Costs = Costs(),  # noqa: B008  # it is immutable
    report: Callable[[int, float], None] = lambda *_: None,
) -> Optimum:
    """The best commands that `rounds` of search find, from those of `begin` on."""
    problem, at = problem_of(course, car, laps, costs, Search())
    ahead = 0.0 if flying is None else flying.distance - course.start_distance
    motion = start_motion(course, car, flying)
    return optimum.search(problem, at + ahead, motion, begin, rounds, seed=seed, report=report)


def replay(commands: Command) -> Replay:
    """A driver that gives the commands open loop."""
    times = KNOT * np.arange(len(commands.throttle))
    return Replay(times=times, commands=commands)


def judged(
    course: Course, car: Car, commands: Command, laps: int = 1, flying: Flying | None = None
) -> dict[str, Any]:
    """The judge's summary of the commands, driven open loop by the nominal car in the world."""
    simulator = _simulator(course, car, start_motion(course, car, flying))
    task = Task.of(course, laps)
    score: Any = task.init()
    pilot = Pilot.of(replay(commands), course, car)
    for record in simulator.run(pilot, KNOT * len(commands.throttle)):
        look = np.nonzero(record.tick % round(PERIOD / simulator.dt) == 0)[0]
        score, _ = task.follow(score, samples(record, look, simulator.dt))
        if score.outcome != Outcome.DRIVING.code:
            break
    return summary(score, Outcome.of(score.outcome))
