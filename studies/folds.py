"""Cross-validation: every window of some logs, predicted by a car that was not fitted to it.

`python -m studies.folds PAGE BASE RUN...` fits three times, from BASE (and the cars of other floors
beside it). Each fit leaves out another third: every third block of time of a longer log, and every
third file of the brief logs, which are one manoeuvre each. The errors of each log are pooled over
the three fits, so all of them are outside the fit. The battery charge is from a log's fitted
windows, or for a file left out, from its own windows.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.runs.run import read_run
from countersteer.tuning import fit, tune
from countersteer.tuning.compare import compare
from countersteer.tuning.windows import QUANTITIES
from countersteer.writing import write_whole

FOLDS = 3


class Judged(NamedTuple):
    """The windows left out of a log: absolute errors at their ends, (windows, quantities)."""

    simulated: np.ndarray
    unchanged: np.ndarray  # of persistence
    transient: np.ndarray  # mask (windows,)


def kinds(logs: tune.Logs, fold: int) -> np.ndarray:
    """The kinds of `fit.blocks`, with every third of the brief logs held out whole."""
    kind = fit.blocks(logs.start, logs.run, fold)
    short = fit.brief(logs.start, logs.run)
    if short.all():
        return kind
    turn = {run: i % FOLDS for i, run in enumerate(np.unique(logs.run[short]))}
    left = np.array([turn.get(run) == fold for run in logs.run])
    return np.where(short & left, 2, kind)


def judged(cars: dict[str, Car], held: tune.Logs) -> dict[int, Judged]:
    """Errors by log, over windows with a known charge."""
    shots = held.shots
    end = shots.measured[:, :, -1]
    start = np.stack([*shots.velocity, shots.wheel_speed], axis=1)
    off = np.abs(fit.Problem(cars, shots, ()).predictions()[:, :, -1] - end)
    still, lively = np.abs(start - end), tune.transient(shots)
    return {
        int(run): Judged(*(part[held.run == run] for part in (off, still, lively)))
        for run in np.unique(held.run)
    }


def cross_validate(
    logs: tune.Logs, cars: dict[str, Car], base: str, report: Callable[[str], None]
) -> tuple[dict[int, Judged], dict[int, float]]:
    """By log: its windows. By log that a fit left out: its RMS error of the wheel speed."""
    parts: dict[int, list[Judged]] = {}
    whole: dict[int, float] = {}
    for fold in range(FOLDS):
        kind = kinds(logs, fold)
        fitted, held = logs.where(kind == 1), logs.where(kind == 2)
        thin = fitted.where(tune.spread(fitted.run))
        report(f"fold {fold + 1} of {FOLDS}")
        found = fit.fit(cars, thin.shots, "all", report)
        charge = np.full(len(logs.runs), fit.FULL)
        for part in (held, thin):
            known = np.unique(part.run)
            charge[known] = fit.estimated_charge(found.cars, part.shots)[known]
        for run, errors in judged(found.cars, held.with_charge(charge)).items():
            parts.setdefault(run, []).append(errors)
        for run in np.setdiff1d(held.run, fitted.run):
            surface = tune.surface_of(logs.runs[run], found.cars, base)
            result, _ = compare(logs.runs[run], found.cars[surface], None, fit.STEP)
            whole[int(run)] = result["rmse"]["wheel_speed_mps"]
    pooled = {
        run: Judged(*(np.concatenate(one) for one in zip(*some, strict=True)))
        for run, some in sorted(parts.items())
    }
    return pooled, whole


def page(logs: tune.Logs, pooled: dict[int, Judged], whole: dict[int, float], base: str) -> str:
    """The text of the docs page."""
    names = ("forward, m/s", "lateral, m/s", "yaw rate, rad/s", "wheels, m/s")
    lines = [
        "# Logs predicted by cars that were not fitted to them",
        "",
        f"Made by `python -m studies.folds PAGE {base} RUN...`: three fits, each "
        "without another third of the blocks of time of a log, or of the files where a log is one "
        "brief manoeuvre. Median absolute errors after one second of open loop over the windows "
        "that were left out (if nothing changed); the last column is the RMS error of the wheel "
        "speed over the whole of a file that was left out.",
        "",
        "| log | windows | " + " | ".join(names) + " | whole run, m/s |",
        "| --- | ---: |" + " ---: |" * 5,
    ]
    for run, errors in pooled.items():
        name = logs.runs[run].path.name
        for title, chosen in (
            (name, np.full(len(errors.transient), True)),
            ("– where something changes", errors.transient),
        ):
            if not chosen.any() or (title != name and run in whole):
                continue
            cells = [
                _median(errors.simulated[chosen, i], errors.unchanged[chosen, i])
                for i in range(len(QUANTITIES))
            ]
            total = f"{whole[run]:.3f}" if run in whole else ""
            lines.append(f"| {title} | {int(chosen.sum())} | {' | '.join(cells)} | {total} |")
    return "\n".join([*lines, ""])


def _median(off: np.ndarray, still: np.ndarray) -> str:
    if not np.isfinite(off).any():
        return ""
    return f"{np.nanmedian(off):.3f} ({np.nanmedian(still):.3f})"


def read(base: str, paths: Sequence[Path]) -> tuple[tune.Logs, dict[str, Car]]:
    """Read the logs, and the cars of their floors."""
    runs = [read_run(path) for path in paths]
    name = Path(base).stem
    named = {str(run.about.get("car_name", name)) for run in runs} - {name}
    cars = tune.by_surface(name, load_car(base), tune.other_floors(base, named))
    return tune.read_logs(runs, cars, tune.EVERY, name), cars


def main(arguments: Sequence[str]) -> Any:
    """Run the command."""
    out, base, *paths = arguments
    configure_jax(blocks=True)
    with jax.enable_x64(True):
        logs, cars = read(base, [Path(path) for path in paths])
        found = cross_validate(logs, cars, Path(base).stem, lambda text: print(text, flush=True))
        write_whole(Path(out), page(logs, *found, base))


if __name__ == "__main__":
    main(sys.argv[1:])
