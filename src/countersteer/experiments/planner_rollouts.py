"""What the planner sees: some of its sequences at a few instants of a lap of `box`, as driven."""

from typing import Any

import jax
import numpy as np

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.course.files import load_course
from countersteer.drivers.driver import Observation
from countersteer.experiments.result import Report, Result, silent
from countersteer.pilot import Pilot
from countersteer.planning.mppi import KNOT, KNOTS, Memory, Mppi, Rollouts
from countersteer.signals import Command
from countersteer.simulator import Simulator

COURSE = "box"
FIRST, BETWEEN, INSTANTS = 0.6, 0.8, 6  # s, s, count
SHOWN = 150  # sequences of an instant
PENALTY = 4.0  # cost over the least, from which a sequence is drawn in the palest colour


class Watched(Mppi):
    """The planner, whose sequences are kept at some instants."""

    def __init__(self, course: Course, car: Car, times: np.ndarray) -> None:
        """`times` (s) are whole knots."""
        super().__init__(course, car)
        self.times = {round(time / KNOT) for time in times}
        self.seen: dict[float, Rollouts] = {}

    def act(self, memory: Memory, observation: Observation) -> tuple[Command, Memory]:
        """The planner's decision."""
        knot = round(float(observation.time) / KNOT)
        if knot in self.times:
            self.seen[knot * KNOT] = self.rollouts(memory, observation, SHOWN)
        return super().act(memory, observation)


def simulate(car: Car, name: str, report: Report = silent) -> Result:
    """A lap with the nominal car, on ground truth."""
    course, times = load_course(COURSE), FIRST + BETWEEN * np.arange(INSTANTS)
    driver, tracks = Watched(course, car, times), []
    longest = float(times[-1]) + KNOT * KNOTS
    for record in Simulator.of(course, car).run(Pilot.of(driver, course, car, "truth"), longest):
        tracks.append(np.stack([record.motion.x, record.motion.y]))
        report(round(record.tick[-1] / 100), round(longest * 10))
    track = np.concatenate(tracks, axis=1)
    table: dict[str, list[Any]] = {
        key: []
        for key in ("decision_s", "sequence", "cost", "weight", "time_s", "x_m", "y_m", "vx_mps")
    }
    for time, seen in driver.seen.items():
        for k in range(SHOWN):
            line = jax.tree.map(lambda leaf, k=k: leaf[k], seen.motion)
            columns = (
                np.full(KNOTS, time),
                np.full(KNOTS, k),
                np.full(KNOTS, seen.cost[k]),
                np.full(KNOTS, seen.weight[k]),
                time + KNOT * np.arange(1, KNOTS + 1),
                line.x,
                line.y,
                line.vx,
            )
            for key, column in zip(table, columns, strict=True):
                table[key].extend(column.tolist())
    missed = {time: float(_missed(time, seen, track)) for time, seen in driver.seen.items()}
    figures = {"car": name, "course": COURSE, "plan_end_off_the_drive_m": list(missed.values())}
    text = (
        f"The planner's lap of {COURSE} with {name}: {SHOWN} of its 1,000 sequences at "
        f"{INSTANTS} instants. After 0.8 s the car was {np.median(list(missed.values())):.2f} m "
        "(median) from where the plan of then ended, since each decision plans anew."
    )

    def paint(figure: Any) -> None:
        for ax, (time, seen) in zip(figure.subplots(2, 3).flat, driver.seen.items(), strict=True):
            for ax_, ay, bx, by in course.walls:
                ax.plot([ax_, bx], [ay, by], "k", lw=1)
            over = np.clip((seen.cost - np.nanmin(seen.cost)) / PENALTY, 0, 1)
            for k in np.argsort(-over):
                shade = {"color": (0.85 * over[k], 0.45 + 0.4 * over[k], 0.85), "alpha": 0.5}
                ax.plot(seen.motion.x[k], seen.motion.y[k], lw=0.5, **shade)
            ax.plot(seen.plan.x, seen.plan.y, color="tab:red", lw=1.8, label="plan")
            ax.plot(*track, color="k", lw=0.7, ls="--", label="driven")
            at = round(time * 1000)
            ax.plot(*track[:, at], "ko", ms=4, label="car")
            ax.set_xlim(track[0, at] - 1.7, track[0, at] + 1.7)
            ax.set_ylim(track[1, at] - 1.7, track[1, at] + 1.7)
            ax.set_aspect("equal")
            ax.set_title(f"{time:.1f} s, least cost {np.nanmin(seen.cost):.1f}", fontsize=9)
        figure.axes[0].legend(fontsize=8)
        figure.suptitle(f"{SHOWN} of 1,000 sequences; the paler, the dearer")

    return Result(table, figures, text, paint, (11.0, 7.5))


def _missed(time: float, seen: Rollouts, track: np.ndarray) -> float:
    """Distance of the car from where the plan ended, when it should have been there (m)."""
    end = min(round((time + KNOT * KNOTS) * 1000), track.shape[1] - 1)
    away = np.hypot(track[0, end] - seen.plan.x[-1], track[1, end] - seen.plan.y[-1])
    return float(away)
