"""When not to believe a comparison or a fit: one plain line for each reason.

A line is a reason to distrust a car on a log, or a log for a car. No line is no proof: what a log
does not hold, it cannot contradict.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from countersteer.text import counted
from countersteer.tuning import fit
from countersteer.tuning.windows import QUANTITIES

WORDS = {  # of `QUANTITIES`
    "vx_mps": ("forward velocity", "m/s"),
    "vy_mps": ("lateral velocity", "m/s"),
    "yaw_rate_radps": ("yaw rate", "rad/s"),
    "wheel_speed_mps": ("wheel speed", "m/s"),
}
NEGLIGIBLE = dict(zip(QUANTITIES, fit.SCALES.tolist(), strict=True))  # errors of a good fit
ABOVE = 1.1  # error over persistence; figures that look alike are no reason
FEWEST = 5  # windows that a line is based on
GRIPS, SPINS = math.radians(20), math.radians(60)  # sideslip of a log that grips, and of a spin
CRAWLS = 0.5  # m/s; sideslip below this speed is not counted
YAW_FACTOR, YAW_MARGIN = 1.5, 1.5  # 1, rad/s; a spin turns faster than this times, plus this
SPUN = 0.03  # part of the gripping windows that may spin
NEARLY = 0.02  # charge; so near to its bound, a search ends at it
TURNS = 0.5  # rad/s; a window that turns
ONE_HAND = 0.95  # part of the turning windows
FAR = 2.0  # error outside the fit over the error inside it

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]  # vx, vy, yaw rate at the samples of a window


class Errors(NamedTuple):
    """Median absolute errors at the ends of windows, by quantity."""

    windows: int
    simulated: Mapping[str, float]
    unchanged: Mapping[str, float]  # of persistence

    @classmethod
    def of(cls, scored: Mapping[str, Any]) -> "Errors":
        """From an object of the JSON of `replay --compare`, or of `tune`."""

        def medians(part: Mapping[str, Any]) -> dict[str, float]:
            if "median_abs_error" in part:
                return dict(part["median_abs_error"])
            return {name: one["median_abs_error"] for name, one in part.items()}

        simulated = scored if "median_abs_error" in scored else scored.get("errors", {})
        return cls(scored["windows"], medians(simulated), medians(scored.get("persistence", {})))


# -------------------------------------------------------------------------------------------------
# Reasons
# -------------------------------------------------------------------------------------------------


def above_persistence(scored: Mapping[str, Any], horizon: float, what: str) -> list[str]:
    """A line for each quantity that is predicted worse than by no change, steady and transient.

    An error as small as a good fit's is no reason. `what` is the log or the floor.
    """
    lines = []
    for kind in ("steady", "transient"):
        errors = Errors.of(scored[kind])
        if errors.windows < FEWEST:
            continue
        for name, error in errors.simulated.items():
            still = errors.unchanged.get(name, math.nan)
            if error > max(ABOVE * still, NEGLIGIBLE[name]) or not math.isfinite(error):
                words, unit = WORDS[name]
                lines.append(
                    f"The error of the {words} after {horizon:g} s in {kind} windows, {error:.2g} "
                    f"{unit}, is larger than if nothing changed ({still:.2g}): do not trust this "
                    f"car on {what}."
                )
    return lines


def spin_count(windows: Iterable[tuple[Motion, Motion]]) -> dict[str, int]:
    """How many of the windows (measured, simulated) grip in the log, and how many of those spin.

    A window grips if its sideslip stays below `GRIPS`. It spins if its sideslip exceeds `SPINS`, or
    if it turns faster than `YAW_FACTOR` times the log's fastest yaw rate and `YAW_MARGIN`.
    """
    gripping = spinning = 0
    for measured, simulated in windows:
        if not all(np.isfinite(one).any() for one in measured):
            continue
        ahead = float(np.sign(np.nanmean(measured[0])))
        if sideslip(measured, ahead) >= GRIPS:
            continue
        gripping += 1
        limit = YAW_FACTOR * np.nanmax(np.abs(measured[2])) + YAW_MARGIN
        turns = np.max(np.abs(simulated[2]))
        spinning += not (sideslip(simulated, ahead) <= SPINS and turns <= limit)
    return {"windows": spinning, "of": gripping}


def sideslip(motion: Motion, ahead: float) -> float:
    """The largest sideslip of a window (rad) above `CRAWLS`; `ahead` is -1 for a car in reverse."""
    vx, vy, _ = motion
    angle = np.where(np.hypot(vx, vy) > CRAWLS, np.arctan2(np.abs(vy), ahead * vx), 0.0)
    return float(np.nanmax(angle))


def spins(found: Mapping[str, int], what: str) -> list[str]:
    """A line if the simulation spins where the log grips; `found` is what `spin_count` returns."""
    spun, gripping = found["windows"], found["of"]
    if gripping < FEWEST or spun <= SPUN * gripping:
        return []
    return [
        f"The simulation spins in {spun} of {counted(gripping, 'window')} in which the log grips: "
        f"do not trust this car on {what}."
    ]


def empty_battery(charge: float, found_by_fit: bool, log: str) -> list[str]:
    """A line if errors are only as small as they are with a battery that nobody drives."""
    if not found_by_fit or charge > fit.EMPTY + NEARLY:
        return []
    return [
        f"The battery's charge that agrees best with {log} is {charge:.2f}: no one drives with "
        "such a pack. The car's motor is too strong there, or its drag too weak: do not trust "
        "the errors."
    ]


def one_hand(yaw_rates: np.ndarray, what: str) -> list[str]:
    """A line if all windows that turn, turn to one side; `yaw_rates` (rad/s) are by window."""
    turning = yaw_rates[np.abs(yaw_rates) > TURNS]
    if len(turning) < FEWEST:
        return []
    left = float(np.mean(turning > 0))
    if max(left, 1 - left) < ONE_HAND:
        return []
    side, other = ("left", "right") if left > 0.5 else ("right", "left")
    return [f"All turns of {what} are to the {side}: nothing is known of turns to the {other}."]


def not_carried_over(totals: Mapping[str, Any], surface: str) -> list[str]:
    """A line for each kind of data outside the fit with errors far above those inside it."""
    lines = []
    inside = Errors.of(totals["fitted"].get(surface, {"windows": 0}))
    for kind, where in (("held out", "blocks held out"), ("validation", "the logs of --validate")):
        outside = Errors.of(totals.get(kind, {}).get(surface, {"windows": 0}))
        if min(inside.windows, outside.windows) < FEWEST:
            continue
        worse = []
        for name, error in outside.simulated.items():
            fitted = inside.simulated.get(name, math.nan)
            if error > max(FAR * fitted, NEGLIGIBLE[name]):
                words, unit = WORDS[name]
                worse.append(f"{words} {error:.2g} and {fitted:.2g} {unit}")
        if worse:
            lines.append(
                f"On {surface}, errors in {where} are far above those of what was fitted "
                f"({', '.join(worse)}): the fit does not carry over."
            )
    return lines


def at_bounds(parameters: Iterable[Mapping[str, Any]]) -> list[str]:
    """A line for each fitted parameter at an end of its range."""
    lines = []
    for one in parameters:
        if one["at_bound"] and one["path"] != fit.CHARGE:  # packs are often full
            where = one["surface"] or one["run"]
            name = one["path"] + (f" ({where})" if where else "")
            unit = f" {one['unit']}" if one["unit"] else ""
            lines.append(
                f"{name} is at an end of its range, {one['value']:.3g}{unit}: it makes up for "
                "something that the model lacks, or the range is too narrow."
            )
    return lines


# -------------------------------------------------------------------------------------------------
# Comparisons and fits
# -------------------------------------------------------------------------------------------------


def of_comparison(result: Mapping[str, Any], yaw_rates: np.ndarray) -> list[str]:
    """The lines of a comparison's JSON; `yaw_rates` (rad/s) as measured, one a window."""
    return [
        *above_persistence(result, result["horizon_s"], "this log"),
        *spins(result["spins"], "this log"),
        *empty_battery(result["battery_charge"], result["battery_from"] == "fit", "the log"),
        *one_hand(yaw_rates, "this log"),
    ]


def of_fit(about: Mapping[str, Any], yaw_rates: Mapping[str, np.ndarray]) -> list[str]:
    """The lines of the JSON of `tune`; `yaw_rates` (rad/s) by surface, of the fitted windows."""
    lines = []
    if not any(run["kind"] == "validation" for run in about["runs"]):
        lines.append(
            "No other log judges this fit: give --validate RUN of another day, hand or throttle."
        )
    for run in about["runs"]:
        if run["kind"] != "fitted":
            lines += above_persistence(run, fit.HORIZON, run["run"])
        lines += spins(run["spins"], run["run"])
        lines += empty_battery(run["battery_charge"], run["battery_from"] == "fit", run["run"])
    for surface in about["surfaces"]:
        lines += not_carried_over(about["totals"], surface)
        turned = yaw_rates.get(surface, np.zeros(0))
        lines += one_hand(turned, f"the fitted logs on {surface}")
    return list(dict.fromkeys([*lines, *at_bounds(about["parameters"])]))


# -------------------------------------------------------------------------------------------------
# Several cars
# -------------------------------------------------------------------------------------------------

RULE = (
    "least median errors over those of a good fit (0.05 and 0.03 m/s forward and to the side, "
    "0.12 rad/s, 0.08 m/s of the wheels), averaged over quantities; steady and transient windows "
    "count alike"
)


def score(result: Mapping[str, Any]) -> float:
    """How well a comparison agrees, by `RULE`; 1 is a good fit."""
    kinds = [
        errors for kind in ("steady", "transient") if (errors := Errors.of(result[kind])).windows
    ]
    ratios = [
        [error / NEGLIGIBLE[name] for name, error in errors.simulated.items()] for errors in kinds
    ]
    return float(np.mean([np.mean(one) for one in ratios]))


def best(results: Mapping[str, Mapping[str, Any]]) -> str:
    """The name of the car whose comparison agrees best. A prediction of NaN never does."""
    scores = {name: score(result) for name, result in results.items()}
    return min(scores, key=lambda name: (math.isnan(scores[name]), scores[name]))
