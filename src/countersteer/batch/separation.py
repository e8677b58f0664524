"""Which of the numbers drawn for each trial separate failures from successes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu

from countersteer.batch.population import Drawn, Population
from countersteer.car.parameter import EDGE
from countersteer.course.course import Course
from countersteer.task.judge import DRIFT, Outcome, Score

FEWEST = 5  # failures and successes, each, from which anything is said
SURE = 0.01  # probability of such a separation by chance, over all draws
MOST = 3  # draws that are named


def drawn_columns(population: Population, drawn: Drawn, course: Course) -> dict[str, np.ndarray]:
    """What was drawn, by column (trials,): one for each parameter, in the units of files."""
    columns = {}
    for entry in population.varied:
        for path, declared in zip(entry.paths, entry.declared, strict=True):
            value: Any = drawn.cars
            for name in path.split("."):
                value = getattr(value, name)
            suffix, factor = EDGE[declared.unit]
            columns[path + suffix] = np.asarray(value, float) / factor
    columns["battery_charge"] = np.asarray(drawn.charge, float)
    x, y, heading = course.start
    east, north, turned = (np.asarray(drawn.pose, float) - (x, y, heading)).T
    columns["start.along_m"] = np.cos(heading) * east + np.sin(heading) * north
    columns["start.offset_m"] = np.cos(heading) * north - np.sin(heading) * east
    columns["start.heading_deg"] = np.degrees(turned)
    if drawn.speed is not None:
        columns["speed_asked_mps"] = np.asarray(drawn.speed, float)
    return {name: column for name, column in columns.items() if np.ptp(column) > 1e-9}


def result_columns(score: Score) -> dict[str, Sequence[Any]]:
    """What came of each trial, by column. NaN is what did not happen."""
    turns, begun = score.turns, np.isfinite(score.turns.begin)

    def worst(values: np.ndarray) -> np.ndarray:
        return known(
            np.max(np.where(begun, np.abs(np.degrees(values)), -np.inf), axis=1, initial=-np.inf)
        )

    def known(values: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(values), values, np.nan)

    return {
        "outcome": [Outcome.of(code).value for code in score.outcome],
        "success": (score.outcome == Outcome.REACHED.code).astype(int),
        "lap_time_s": known(score.goal_time),
        "turns": begun.sum(axis=1),
        "drifts": (begun & (turns.peak_sideslip > DRIFT)).sum(axis=1),
        "peak_sideslip_deg": worst(turns.peak_sideslip),
        "heading_error_deg": worst(turns.error),
        "heading_overshoot_deg": worst(turns.overshoot),
    }


def separation(columns: Mapping[str, np.ndarray], won: np.ndarray) -> list[dict[str, Any]]:
    """The draws that best separate failures from successes, the best first.

    Of all pairs of a failure and a success, `pairs_told` is the part in which the draw alone says
    which is which (0.5: none; the area under the curve of Mann and Whitney). Named are at most
    `MOST` that no chance explains (Bonferroni over all draws).
    """
    found: list[dict[str, Any]] = []
    if min(np.sum(won), np.sum(~won)) < FEWEST:
        return []
    for name, column in columns.items():
        failed, passed = column[~won], column[won]
        test = mannwhitneyu(failed, passed)
        share = float(test.statistic) / (len(failed) * len(passed))
        if test.pvalue * len(columns) < SURE:
            found.append(
                {
                    "draw": name,
                    "failures_median": float(np.median(failed)),
                    "successes_median": float(np.median(passed)),
                    "pairs_told": max(share, 1 - share),
                }
            )
    return sorted(found, key=lambda one: float(one["pairs_told"]), reverse=True)[:MOST]


def separation_line(one: Mapping[str, Any]) -> str:
    """A draw that separates, in words."""
    failed, passed = one["failures_median"], one["successes_median"]
    than = "lower" if failed < passed else "higher"
    return (
        f"failures have a {than} {one['draw']}: median {failed:.3g}, successes {passed:.3g}; it "
        f"tells {100 * one['pairs_told']:.0f} % of pairs apart"
    )
