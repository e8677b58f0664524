"""Four turns of 90° linked without straightening, with and without carrying errors over.

Cars drawn around the nominal one drive on their sensors, on open floor. Each turn begins as soon as
the one before has stopped. With carrying, a turn's error is part of the next target. Without it,
each turn counts from the heading at its start. The sensors see no walls. So both results include
the gyroscope's drift and the heading at the start.
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
    """The progress of a trial's last turn."""

    stirred: Scalar  # 1 once the car has not gone straight in it
    calm_since: Scalar  # s
    heading: Scalar  # rad, once the car has gone straight for 50 ms after it; NaN before


@pytree
class LastTurn:
    """Records the heading after the driver's last turn. No corridor marks the turn's end."""

    def begin(self, now: Instant) -> Kept:
        """An empty record."""
        zero = jnp.zeros_like(now.simulator.world.motion(now.loop.state).x)
        return Kept(zero, zero, zero + jnp.nan)

    def look(self, now: Instant, kept: Kept) -> Kept:
        """The record with one more instant."""
        motion = now.simulator.world.motion(now.loop.state)
        time = now.simulator.dt * now.loop.tick.astype(motion.x.dtype)
        turns, calm = now.pilot.status(now.memory).turn >= TURNS, goes_straight(motion)
        stirred = jnp.where(turns & ~calm, 1.0, kept.stirred)
        since = jnp.where(calm, kept.calm_since, time)
        ends = (stirred > 0) & calm & (time - since >= STRAIGHT_FOR - ROUNDING)
        heading = jnp.where(ends & jnp.isnan(kept.heading), motion.heading, kept.heading)
        return Kept(stirred, since, heading)

    def end(self, kept: Kept) -> Kept:
        """The whole record."""
        return kept


def open_floor(angle: float = ANGLE) -> Course:
    """A line without walls, and turns that only the driver makes."""
    line = np.array([[0.0, 0.0], [FAR, 0.0]])
    turns = tuple(Turn(float(n), angle) for n in range(1, TURNS + 1))
    none = np.zeros((0, 4))
    return Course("open floor", 1.4, False, line, none, turns, (0.0, 0.0, 0.0), 0.0, FAR)


def simulate(car: Car, name: str, report: Report = silent, trials: int = TRIALS) -> Result:
    """Simulate random cars. The error is that of the heading at the end of the last turn."""
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
    """Statistics of the trials whose last turn ended."""
    values = errors[np.isfinite(errors)]
    return {
        "ended": len(values),
        "rms_deg": float(np.sqrt(np.mean(values**2))),
        "mean_deg": float(np.mean(values)),
        "median_abs_deg": float(np.median(np.abs(values))),
        "within_10_deg": float(np.mean(np.abs(values) < 10)),
    }
