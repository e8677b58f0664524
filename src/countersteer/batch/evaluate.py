"""Evaluation of drivers over random cars: success with its interval, errors and times."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from scipy.stats import binomtest

from countersteer.batch.population import Drawn, Population, draw
from countersteer.batch.separation import separation_line
from countersteer.batch.trace import Trace, path_of
from countersteer.batch.trials import Watch, run_trials
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver
from countersteer.errors import InputError
from countersteer.link.link import ONBOARD, Link
from countersteer.pilot import Pilot
from countersteer.sensing.faults import SensorFault
from countersteer.task.judge import DRIFT, Outcome, Score

CONFIDENCE = 0.95


SLOWEST = 0.5  # m/s; the time limit of a trial is 3 s, and that of its course at this speed


@dataclasses.dataclass(frozen=True)
class Trials:
    """The settings that all drivers of an evaluation share."""

    course: Course
    car: Car  # around which cars are drawn
    nominal: Car  # known to drivers and filters
    population: Population
    seeds: Sequence[int]
    speeds: tuple[float, float] | None  # m/s, range asked of the driver; None: its own speed
    laps: int
    link: Link
    estimate: str
    dt: float

    def __post_init__(self) -> None:
        """Raises `InputError` if no drive of the course can succeed."""
        self.course.check_laps(self.laps)
        if self.course.goal_distance is None:
            raise InputError(f"{self.course.name}: has no goal, so nothing tells a success")

    @functools.cached_property
    def drawn(self) -> Drawn:
        """What is drawn for each trial, in 32 bits."""
        return draw(self.population, self.car, self.course, self.seeds, np.float32, self.speeds)

    def run(
        self,
        make: Callable[[float | None], Driver],
        report: Callable[[int, int], None] = lambda *_: None,
    ) -> Score:
        """The scores of one driver in all trials, in 32 bits. `make` makes it for a speed."""
        return self.run_watched(make, None, report)[0]

    def run_watched(
        self,
        make: Callable[[float | None], Driver],
        watch: Watch | None,
        report: Callable[[int, int], None] = lambda *_: None,
        faults: tuple[SensorFault, ...] = (),
        lanes: int | None = None,
    ) -> tuple[Score, Any]:
        """The scores, as `run`, and the result of `watch`. `faults` holds times for each trial."""
        drawn = self.drawn
        if drawn.speed is None:
            drivers = [make(None)] * len(self.seeds)
        else:
            made = {speed: make(speed) for speed in set(drawn.speed.tolist())}
            drivers = [made[speed] for speed in drawn.speed.tolist()]
        pilot = Pilot.of(drivers[0], self.course, self.nominal, self.estimate, self.link, self.dt)
        longest = 3.0 + (self.course.lap_end(self.laps) or 0.0) / SLOWEST
        return run_trials(
            self.course,
            pilot,
            drawn,
            drivers,
            self.seeds,
            self.laps,
            longest,
            watch,
            report,
            lanes,
            faults,
            self.link,
        )

    def about(self) -> dict[str, Any]:
        """The settings of the trials for a record, by the names of the JSON."""
        return {
            "course": self.course.name,
            "cars": self.population.name,
            "first_seed": int(self.seeds[0]),
            "speed_mps": None if self.speeds is None else list(self.speeds),
            "laps": self.laps,
            "link": self.link.name,
            "estimate": self.estimate,
            "dt_s": self.dt,
        }


def interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's interval of a success rate."""
    found = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def results(
    score: Score, seeds: Sequence[int], margins: np.ndarray | None = None
) -> dict[str, Any]:
    """Statistics of a driver's trials; names and units are those of the JSON.

    `margins` (m) are the least distances to a wall (`batch.margin`).
    """
    won, turns = score.outcome == Outcome.REACHED.code, score.turns
    count, trials = int(np.sum(won)), len(seeds)
    begun = np.isfinite(turns.begin)  # a corner may be passed without a turn of its own
    drifts = np.all((turns.peak_sideslip > DRIFT) | ~begun, axis=1)
    counted = begun & won[:, None]
    errors = np.degrees(turns.error[counted])
    numbers = np.asarray(seeds)

    def median(values: np.ndarray) -> float | None:
        return float(np.median(values)) if values.size else None

    return {
        "trials": trials,
        "successes": count,
        "success_rate": count / trials,
        "success_interval": list(interval(count, trials)),
        "drift_share": float(np.mean(drifts[won])) if count else None,
        "heading_error_rms_deg": float(np.sqrt(np.mean(errors**2))) if errors.size else None,
        "peak_sideslip_deg_median": median(np.degrees(turns.peak_sideslip[counted])),
        **overshoot(np.degrees(turns.overshoot[counted])),
        "entry_speed_mps_median": median(turns.entry_speed[counted]),
        "lap_time_s_median": median(score.goal_time[won]),
        **({} if margins is None else {"wall_margin_m_median": median(margins[won])}),
        "failed_seeds": [int(seed) for seed in numbers[~won]],
        "failures": {
            Outcome.of(code).value: [int(seed) for seed in numbers[score.outcome == code]]
            for code in np.unique(score.outcome[~won])
        },
    }


def verdict(
    course: Course, car: Car, population: Population, driver: Driver, first: int, count: int = 256
) -> dict[str, Any]:
    """The results of a driver on ground truth, in trials from the seed `first` on."""
    seeds = [(first + i) % 2**31 for i in range(count)]
    trials = Trials(course, car, car, population, seeds, None, 1, ONBOARD, "truth", 0.001)
    return results(trials.run(lambda _: driver), seeds)


def nominal_drive(course: Course, car: Car, driver: Driver) -> tuple[Score, np.ndarray]:
    """The score and the path (`batch.trace`) of the car itself, from rest, on ground truth."""
    alone = Population("nominal", (), (1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0))
    trials = Trials(course, car, car, alone, [0], None, 1, ONBOARD, "truth", 0.001)
    score, paths = trials.run_watched(lambda _: driver, Trace())
    first: Score = jax.tree.map(lambda leaf: leaf[0], score)
    return first, path_of(paths[0])


def overshoot(degrees: np.ndarray) -> dict[str, float | None]:
    """Median and 95th percentile of the heading's overshoot over the corridor behind a turn."""
    found = {"median": 50, "p95": 95}
    return {
        f"heading_overshoot_deg_{name}": float(np.percentile(degrees, part))
        if degrees.size
        else None
        for name, part in found.items()
    }


def table_lines(found: Mapping[str, dict[str, Any]]) -> list[str]:
    """The results of several drivers as a table for a terminal."""
    head = f"{'':24}{'success':>20}{'drifts':>8}{'heading':>9}{'sideslip':>10}{'lap':>8}"
    lines = [head]
    for name, one in found.items():
        low, high = one["success_interval"]
        rate = f"{100 * one['success_rate']:.1f} % ({100 * low:.1f}-{100 * high:.1f})"

        def text(key: str, form: str, factor: float = 1.0, one: dict[str, Any] = one) -> str:
            return "-" if one[key] is None else format(factor * one[key], form)

        lines.append(
            f"{name:24}{rate:>20}{text('drift_share', '.1f', 100):>7}%"
            f"{text('heading_error_rms_deg', '.2f'):>8}°"
            f"{text('peak_sideslip_deg_median', '.1f'):>9}°{text('lap_time_s_median', '.2f'):>7}s"
        )
        lines += [f"  {separation_line(draw)}" for draw in one.get("separated_by", ())]
        for reason, seeds in one["failures"].items():
            shown = " ".join(map(str, seeds[:12])) + (" …" if len(seeds) > 12 else "")
            lines.append(f"  {len(seeds)} {reason}: seeds {shown}")
    return lines
