"""Whether a driver should be learned again: a car judged on new runs beside those that it knows.

The loop of learning with a model is drive, judge the model on what was driven, fit it again, learn
the driver again. The last is worth its while only where the model had come apart from the car.
So, of each window of a log, the error of the car's prediction is

    e = log sqrt(mean over what is known of it of ((predicted - measured) / scale)² + FAINT²)

and the excess is the mean over the new windows of e less that of old windows of their kind
(straight, steered, sliding), as a factor exp(). It must be beyond two things that separate any runs
from those that a car was fitted to, both taken from the old runs alone. These are cut into
`PIECES` pieces of time:

- what was fitted is met better. Cars are fitted to either half of the pieces; the mean of e where
  a window was not fitted less that where it was is the optimism.
- runs differ. With s the standard deviation between pieces of their mean e, and the new runs as
  long as k pieces, the excess has the standard deviation s sqrt(1/k + 1/PIECES); Student's t with
  PIECES - 1 degrees of freedom gives how many of these chance reaches once in a hundred.

And it must be worth while: beyond `LEAST` at any rate.

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

FAINT = 0.2  # normalised error that counts as none: a fifth of what a good fit is off by
PIECES = 8  # of the old runs, in the order of their time
CHANCE = 0.01  # of calling for a driver where nothing has changed
LEAST = 1.1  # factor of the error up to which no one learns a driver again
PASSES = 12  # steps of the fit to a half, at most
KINDS = (fit.straight, fit.steered, fit.slides)  # a later one takes precedence


def window_errors(cars: Mapping[str, Car], shots: Shots) -> np.ndarray:
    """Give e, as above, of each window."""
    problem = fit.Problem(dict(cars), shots, ())
    found = problem.predictions()
    off = np.where(problem.known, (found - shots.measured) / fit.SCALES[:, None], 0.0)
    # A prediction that came to nothing is a bad one, not an absent one.
    squares = np.sum(np.nan_to_num(off, nan=1e2) ** 2, axis=(1, 2))
    known = np.sum(problem.known, axis=(1, 2))
    return np.log(np.sqrt(squares / np.maximum(known, 1) + FAINT**2))


def kinds(shots: Shots) -> np.ndarray:
    """What each window tells of, as an index of `KINDS`."""
    kind = np.zeros(len(shots.surface), int)
    for number, chooses in enumerate(KINDS):
        kind[chooses(shots)] = number
    return kind


def pieces_of_time(run_of: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The piece, 0 to `PIECES` - 1, of each window: as many windows each, in order of time."""
    rank = np.argsort(np.lexsort((start, run_of)))
    return rank * PIECES // len(rank)


def optimism(cars: dict[str, Car], shots: Shots, piece: np.ndarray, free: tuple[str, ...]) -> float:
    """Mean e of windows by cars fitted to the other half of the pieces, less that by their own."""
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
    """What `tune --new` says: `after` is the refit with both.

    Errors are exp of the mean e: 1 is what a good fit is off by. `learn_again` is whether
    `excess`, the factor by which the new runs' exceeds the old ones', is beyond `threshold`;
    `gain` is the part of the new runs' error that the refit took away in those of their windows
    held out of it (`hold_out`, as in `tune.tune`), or else in all. A battery that a log does not
    tell of is as full as agrees best with the car before: that it ran down is no fault of the car.
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
