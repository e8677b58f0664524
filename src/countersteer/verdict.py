"""What the judge says of a run that is a folder: simulated, imported or real."""

from typing import Any

import numpy as np

from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.runs.run import Run, drawn_car
from countersteer.signals import Motion, Wheels
from countersteer.task.task import PERIOD, Outcome, Sample, Score, Task, summary
from countersteer.tuning.windows import read_measured


def samples_of(run: Run) -> Sample:
    """The run's motion every `PERIOD`, without instants of which nothing is known.

    Velocities are those of `truth.csv`, or derived from its poses. Of touches of walls a real log
    does not tell. Raises `InputError` where the run has no poses.
    """
    if run.truth is None or not len(run.truth):
        raise InputError(f"{run.path}: has no truth.csv, so nothing tells where the car was")
    measured = read_measured(run, drawn_car(run.about))
    assert measured.vx is not None
    assert measured.vy is not None
    assert measured.yaw_rate is not None
    table = run.truth
    begin = table["time_s"][0]
    steps = round((table["time_s"][-1] - begin) / PERIOD)
    time = begin + PERIOD * np.arange(steps + 1)
    heading = np.unwrap(table["heading_rad"])
    places = [
        np.interp(time, table["time_s"], line) for line in (table["x_m"], table["y_m"], heading)
    ]
    moves = [signal.at(time) for signal in (measured.vx, measured.vy, measured.yaw_rate)]
    known = np.all(np.isfinite([*places, *moves]), axis=0)
    parts: list[Any] = [part[known] for part in (*places, *moves)]
    zero = np.zeros(int(known.sum()))
    parts += [Wheels(zero, zero, zero, zero), *[zero] * 5]
    motion = Motion(*parts)
    return Sample(time[known], motion, zero, zero, zero)


def judge_run(run: Run, course: Course | None, laps: int = 1) -> tuple[Score, dict[str, Any]]:
    """The score of a run on a course, and the JSON of it as `drive` prints it."""
    task = Task.of(course, laps)
    score, _ = task.follow(task.init(), samples_of(run))
    outcome = Outcome.of(score.outcome)
    if outcome == Outcome.DRIVING:
        outcome = Outcome.DONE if task.line is None else Outcome.LATE
    return score, summary(score, outcome)
