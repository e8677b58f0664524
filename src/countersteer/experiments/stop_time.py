"""Time and angle from the kill of a turn to its stop, over the yaw rate, with the regression."""

import math
from collections.abc import Sequence
from typing import Any

from countersteer.batch.engine import LANES
from countersteer.car.car import Car
from countersteer.drivers.policy import library
from countersteer.experiments import stop_regression
from countersteer.experiments.open_turns import as_table, of_run, trial
from countersteer.experiments.result import Report, Result, silent
from countersteer.runs.files import Table
from countersteer.runs.run import Run
from countersteer.text import counted

TRIALS, SPEEDS, CHARGE = 1000, (1.0, 3.0), (0.3, 1.0)


def simulate(
    car: Car, name: str, report: Report = silent, trials: int = TRIALS, lanes: int = LANES
) -> Result:
    """Simulate turns on open floor with the laws of the library's policy, as `trials turns`."""
    rows = trial(
        car, library().turning, None, range(trials), SPEEDS, CHARGE, report=report, lanes=lanes
    )
    return _found(as_table(rows), f"{name}, simulated")


def measure(runs: Sequence[Run]) -> Result:
    """The stopped turns of logs."""
    rows = [row for run in runs for row in of_run(run.path)]
    return _found(as_table(rows), f"{len(runs)} runs")


def _found(table: Table, name: str) -> Result:
    found = stop_regression.regress_stops(table)
    told = stop_regression.about(found)
    times = "; ".join(map(_region, told["regions"]))
    ran_on = (
        f" {told['ran_on']} more ran on, from {told['ran_on_from_degps']:.0f} °/s: no line holds "
        "for those."
        if told["ran_on"]
        else ""
    )
    text = (
        f"Stopping time over the yaw rate at the kill ({name}): "
        f"{counted(told['turns'], 'turn')} that stopped, in "
        f"{counted(len(told['regions']), 'region')} of forward speed (chosen by "
        f"{told['chosen_by']}): {times}.{ran_on}"
    )
    columns: dict[str, Any] = {key: table[key] for key in table if key not in ("hand", "run")}
    columns["stopped"] = (table["angle_to_stop_deg"] <= math.degrees(found.most)).astype(float)

    def paint(figure: Any) -> None:
        stop_regression.paint(found, figure)
        figure.suptitle(f"stop-time: {name}")

    return Result(columns, {"car": name, **told}, text, paint)


def _region(told: dict[str, Any]) -> str:
    """A region's lines in words."""
    (low, high), time, angle = told["speed_mps"], told["time"], told["angle"]
    return (
        f"{low:.2f} to {high:.2f} m/s: {time['offset_s']:.3f} s + "
        f"{time['slope_s_per_100degps']:.3f} s per 100 °/s (± "
        f"{time['slope_error_s_per_100degps']:.3f}, R² {time['r_squared']:.2f}), angle to ± "
        f"{angle['deviation_deg']:.1f}°"
    )
