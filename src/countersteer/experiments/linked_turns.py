"""Four turns of 90° linked without straightening, with and without carrying errors over.

On open floor, on the sensors of cars drawn around the nominal one: each turn begins as soon as the
one before is stopped. Carried over, a turn's error is part of the next one's target; else each
turn counts from the heading at which it begins. There are no walls to look at, so the gyroscope's
drift and the heading at the start are in both.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.batch.population import draw, load_population
from countersteer.batch.trials import Instant, run_trials
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course, Turn
from countersteer.drivers.drift_turn import drift_turn
from countersteer.experiments.result import Report, Result, silent
from countersteer.pilot import Pilot
from countersteer.signals import Scalar
from countersteer.task.turns import ROUNDING, STRAIGHT_FOR, goes_straight

TRIALS = 1000
TURNS, ANGLE = 4, -math.pi / 2
SPEED = 2.0  # m/s
LONGEST = 12.0  # s
FAR = 1e4  # m


class Kept(NamedTuple):
    """Of a trial: how its last turn goes."""

    stirred: Scalar  # 1 once the car has not gone straight in it
    calm_since: Scalar  # s
    heading: Scalar  # rad, once the car has gone straight for 50 ms behind it; NaN before


@pytree
class LastTurn:
    """Looks at the heading behind the driver's last turn: no corridor tells where it ends."""

    def begin(self, now: Instant) -> Kept:
        """Nothing yet."""
        zero = jnp.zeros_like(now.simulator.world.motion(now.loop.state).x)
        return Kept(zero, zero, zero + jnp.nan)

    def look(self, now: Instant, kept: Kept) -> Kept:
        """One instant more."""
        motion = now.simulator.world.motion(now.loop.state)
        time = now.simulator.dt * now.loop.tick.astype(motion.x.dtype)
        turns, calm = now.pilot.status(now.memory).turn >= TURNS, goes_straight(motion)
        stirred = jnp.where(turns & ~calm, 1.0, kept.stirred)
        since = jnp.where(calm, kept.calm_since, time)
        ends = (stirred > 0) & calm & (time - since >= STRAIGHT_FOR - ROUNDING)
        heading = jnp.where(ends & jnp.isnan(kept.heading), motion.heading, kept.heading)
        return Kept(stirred, since, heading)

    def end(self, kept: Kept) -> Kept:
        """All of it."""
        return kept


def open_floor(angle: float = ANGLE) -> Course:
    """A line without walls, and turns that nothing but the driver brings about."""
    line = np.array([[0.0, 0.0], [FAR, 0.0]])
    turns = tuple(Turn(float(n), angle) for n in range(1, TURNS + 1))
    none = np.zeros((0, 4))
    return Course("open floor", 1.4, False, line, none, turns, (0.0, 0.0, 0.0), 0.0, FAR)


def simulate(car: Car, name: str, report: Report = silent, trials: int = TRIALS) -> Result:
    """Over random cars; the heading's error is that at the end of the last turn."""
    course, seeds = open_floor(), range(trials)
    drawn = draw(load_population("around"), car, course, seeds, np.float32)
    errors = {}
    for i, (label, carry) in enumerate((("carried over", 1.0), ("each by itself", 0.0))):
        driver = dataclasses.replace(drift_turn(course, car, SPEED), linked=1.0, carry=carry)
        _, kept = run_trials(
            course,
            Pilot.of(driver, course, car),
            drawn,
            [driver] * trials,
            seeds,
            1,
            LONGEST,
            LastTurn(),
            lambda done, of, i=i: report(i * of + done, 2 * of),  # type: ignore[misc]  # one type
        )
        off = kept.heading - TURNS * ANGLE
        errors[label] = np.degrees(np.arctan2(np.sin(off), np.cos(off)))
    figures = {label: _figures(values) for label, values in errors.items()}
    said = "; ".join(
        f"{label}: {f['rms_deg']:.1f}° RMS, {100 * f['within_10_deg']:.0f} % within 10°, "
        f"{f['ended']} turns ended"
        for label, f in figures.items()
    )
    text = (
        f"{TURNS} turns of 90° with {name}, linked without straightening, at {SPEED:g} m/s, "
        f"{trials} random cars; heading at the end, less that of {TURNS} turns. {said}."
    )

    def paint(figure: Any) -> None:
        axes = figure.add_subplot()
        bins = np.linspace(-180, 180, 73)
        for label, values in errors.items():
            axes.hist(values, bins, histtype="step", linewidth=1.5, label=label)
        axes.set_xlabel(f"heading error after {TURNS} linked turns, °")
        axes.set_ylabel("trials")
        axes.legend(frameon=False)

    table: dict[str, Any] = {"seed": list(seeds)}
    for label, values in errors.items():
        table[f"heading_error_{label.replace(' ', '_')}_deg"] = values
    return Result(table, figures, text, paint, (7.0, 4.0))


def _figures(errors: np.ndarray) -> dict[str, float]:
    """Of the trials whose last turn ended."""
    values = errors[np.isfinite(errors)]
    return {
        "ended": len(values),
        "rms_deg": float(np.sqrt(np.mean(values**2))),
        "mean_deg": float(np.mean(values)),
        "median_abs_deg": float(np.median(np.abs(values))),
        "within_10_deg": float(np.mean(np.abs(values) < 10)),
    }
