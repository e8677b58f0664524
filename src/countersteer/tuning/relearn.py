"""Decide whether to learn a driver again, from a car's errors on new and on old runs.

Learning with a model is a loop: drive, judge the model on the new runs, fit it again, learn the
driver again. The last step is worth its cost only if the model no longer agrees with the car. The
error of the car's prediction in a window of a log is

    e = log sqrt(mean over known samples of ((predicted - measured) / scale)² + FAINT²)

The excess is the mean of e over the new windows, less the mean of e over old windows of the same
kind (straight, steered, sliding). It is given as a factor exp(). Two effects separate any new run
from the runs of the fit. Both are estimated from the old runs, cut into `PIECES` pieces of time:

- Optimism: a car predicts the data of its fit better. Cars are fitted to each half of the pieces.
  The optimism is the mean of e outside the fit, less the mean of e inside it.
- Chance: runs differ. s is the standard deviation of the mean e of the pieces. If the new runs are
  as long as k pieces, the excess has the standard deviation s sqrt(1/k + 1/PIECES). Student's t
  with PIECES - 1 degrees of freedom gives the limit that chance exceeds once in a hundred.

The driver is learned again if the excess exceeds the product of both factors, and `LEAST`.

Source of the loop: P. Abbeel, A. Coates, M. Quigley, A. Y. Ng, An application of reinforcement
learning to aerobatic helicopter flight, NIPS 2006.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.stats import t as student

from countersteer.car.car import Car
from countersteer.errors import InputError
from countersteer.tuning import fit
from countersteer.tuning.shooting import Shots
from countersteer.tuning.tune import Logs

FAINT = 0.2  # normalised error that counts as none: a fifth of a good fit's error
PIECES = 8  # of the old runs, in order of time
CHANCE = 0.01  # probability of a false alarm: a new driver although nothing has changed
LEAST = 1.1  # factor of the error; a smaller one does not justify a new driver
PASSES = 12  # largest number of steps in the fit to a half
KINDS = (fit.straight, fit.steered, fit.slides)  # if several hold, the last counts


def window_errors(cars: Mapping[str, Car], shots: Shots) -> np.ndarray:
    """The error e, as defined above, of each window: (windows,)."""
    problem = fit.Problem(dict(cars), shots, ())
    found = problem.predictions()
    off = np.where(problem.known, (found - shots.measured) / fit.SCALES[:, None], 0.0)
    # A prediction of NaN counts as a large error, not as an unknown one.
    squares = np.sum(np.nan_to_num(off, nan=1e2) ** 2, axis=(1, 2))
    known = np.sum(problem.known, axis=(1, 2))
    return np.log(np.sqrt(squares / np.maximum(known, 1) + FAINT**2))


def kinds(shots: Shots) -> np.ndarray:
    """The kind of each window, as an index of `KINDS`: (windows,)."""
    kind = np.zeros(len(shots.surface), int)
    for number, chooses in enumerate(KINDS):
        kind[chooses(shots)] = number
    return kind


def pieces_of_time(run_of: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Cut windows by run and time into `PIECES` equal pieces: their indices (windows,)."""
    rank = np.argsort(np.lexsort((start, run_of)))
    return rank * PIECES // len(rank)


def optimism(cars: dict[str, Car], shots: Shots, piece: np.ndarray, free: tuple[str, ...]) -> float:
    """Mean e with the car fitted to the other half of the pieces, less that with its own; >= 0.

    Raises `InputError` if a half has no window.
    """
    if len(np.unique(piece % 2)) < 2:
        raise InputError("--new: too few windows of the old runs tell of what is fitted")
    cars_of = []
    for half in (0, 1):
        problem = fit.Problem(cars, fit.select(shots, piece % 2 == half), free)
        cars_of.append(problem.cars_at(problem.solve(problem.start, PASSES).x))
    errors = np.stack([window_errors(found, shots) for found in cars_of])
    own = np.arange(len(piece)), piece % 2
    other = np.arange(len(piece)), 1 - piece % 2
    return max(0.0, float(np.mean(errors.T[other] - errors.T[own])))


def judge(
    before: dict[str, Car],
    after: dict[str, Car],
    old: Logs,
    new: Logs,
    what: str,
    hold_out: bool,
    report: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """The result of `tune --new`: `before` is the old car, `after` the refit to old and new runs.

    Errors are exp of the mean e; a good fit has 1. `learn_again` is true if `excess`, the error on
    the new runs over that on the old ones, exceeds `threshold`. `gain` is the part of the new
    runs' error that the refit removed. It is measured on their windows held out of the refit
    (`hold_out`, as in `tune.tune`), or else on all. A charge that a log does not state is fitted
    with the car before, since a discharged battery is no error of the car.
    """
    if len(old.start) < 2 * PIECES:
        raise InputError(
            f"--new: the old runs hold {len(old.start)} windows, of the {2 * PIECES} at least "
            "that tell what is usual"
        )
    old, new = (logs.with_charge(fit.estimated_charge(before, logs.shots)) for logs in (old, new))
    report(f"the car before, on {len(old.start)} old and {len(new.start)} new windows")
    on_old, on_new = (window_errors(before, logs.shots) for logs in (old, new))
    kind_old, kind_new = kinds(old.shots), kinds(new.shots)
    usual = np.array(
        [
            on_old[kind_old == k].mean() if np.any(kind_old == k) else on_old.mean()
            for k in range(len(KINDS))
        ]
    )
    beyond = float(np.mean(on_new - usual[kind_new]))
    piece = pieces_of_time(old.run, old.start)
    means = [np.mean((on_old - usual[kind_old])[piece == k]) for k in range(PIECES)]
    spread = float(np.std(means, ddof=1))
    as_many = len(new.start) * PIECES / len(old.start)
    chance = float(student.ppf(1 - CHANCE, PIECES - 1)) * spread
    chance *= math.sqrt(1 / as_many + 1 / PIECES)
    chosen = fit.STAGES[what].chooses(old.shots)
    report("cars of either half of the old runs, for what a car errs more on runs it has not seen")
    unseen = optimism(before, old.where(chosen).shots, piece[chosen], fit.STAGES[what].parameters)
    judged = fit.blocks(new.start, new.run) == 2 if hold_out else np.full(len(new.start), True)
    hold_out = hold_out and bool(judged.any())
    judged |= not hold_out
    refitted = window_errors(after, fit.select(new.shots, judged))
    usually = max(unseen + chance, math.log(LEAST))
    found: dict[str, Any] = {
        "learn_again": beyond > usually,
        "excess": math.exp(beyond),
        "threshold": math.exp(usually),
        "optimism": math.exp(unseen),
        "by_chance": math.exp(chance),
        "old": {"windows": len(on_old), "error": math.exp(on_old.mean())},
        "new": {
            "windows": len(on_new),
            "error": math.exp(on_new.mean()),
            "usual": math.exp(usual[kind_new].mean()),
        },
        "refit": {
            "windows": len(refitted),
            "held_out": hold_out,
            "error_before": math.exp(on_new[judged].mean()),
            "error": math.exp(refitted.mean()),
        },
        "gain": 1 - math.exp(refitted.mean() - on_new[judged].mean()),
    }
    return found | {"verdict": verdict(found)}


def verdict(found: Mapping[str, Any]) -> str:
    """The result of `judge` in one line."""
    answer = "yes" if found["learn_again"] else "no"
    return (
        f"learn the driver again: {answer}. The car before errs {found['excess']:.2f} times as "
        f"much on the new runs as on the old; up to {found['threshold']:.2f} is usual. Refitted, "
        f"its error on them is {100 * abs(found['gain']):.0f} % "
        f"{'smaller' if found['gain'] >= 0 else 'larger'}."
    )
