"""Judges a run's folder: simulated, imported or real."""

import dataclasses
from typing import Any

import numpy as np

from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.runs.run import Run, drawn_car
from countersteer.signals import Motion, Wheels
from countersteer.task.judge import PERIOD, Outcome, Sample, Score, Task, summary
from countersteer.tuning.windows import read_measured


def samples_of(run: Run) -> Sample:
    """The run's motion every `PERIOD`, without instants at which it is unknown.

    Velocities are those of `truth.csv`, or derived from its poses. Wall contacts are always 0, as a
    log does not record them. Raises `InputError` if the run has no poses.
    """
    if run.truth is None or not len(run.truth):
        raise InputError(f"{run.path}: has no truth.csv, so nothing tells where the car was")
    posed = np.isfinite(run.truth["x_m"] + run.truth["y_m"] + run.truth["heading_rad"])
    if not posed.any():
        raise InputError(f"{run.path}: truth.csv holds no pose")
    table = Table({name: column[posed] for name, column in run.truth.items()})
    table["heading_rad"] = np.unwrap(table["heading_rad"])
    measured = read_measured(dataclasses.replace(run, truth=table), drawn_car(run.about))
    assert measured.vx is not None
    assert measured.vy is not None
    assert measured.yaw_rate is not None
    begin = table["time_s"][0]
    steps = round((table["time_s"][-1] - begin) / PERIOD)
    time = begin + PERIOD * np.arange(steps + 1)
    poses = (table[name] for name in ("x_m", "y_m", "heading_rad"))
    places = [np.interp(time, table["time_s"], line) for line in poses]
    moves = [signal.at(time) for signal in (measured.vx, measured.vy, measured.yaw_rate)]
    known = np.all(np.isfinite([*places, *moves]), axis=0)
    parts: list[Any] = [part[known] for part in (*places, *moves)]
    zero = np.zeros(int(known.sum()))
    parts += [Wheels(zero, zero, zero, zero), *[zero] * 5]
    motion = Motion(*parts)
    return Sample(time[known], motion, zero, zero, zero)


def judge_run(run: Run, course: Course | None, laps: int = 1) -> tuple[Score, dict[str, Any]]:
    """The score of a run on a course, and its JSON as `drive` prints it."""
    task = dataclasses.replace(Task.of(course, laps), of_log=True)
    score, _ = task.follow(task.init(), samples_of(run))
    outcome = Outcome.of(score.outcome)
    if outcome == Outcome.DRIVING:
        # A log may end at its goal, before anything shows that the last turn has ended.
        reached = np.isfinite(score.goal_time)
        outcome = Outcome.REACHED if reached else Outcome.LATE
        outcome = Outcome.DONE if task.line is None else outcome
    return score, summary(score, outcome)
