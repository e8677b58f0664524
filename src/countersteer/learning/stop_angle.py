"""The angle that a car still turns after the kill of a turn, learned from stopped turns."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from countersteer.drivers.policy import save_policy
from countersteer.errors import InputError
from countersteer.experiments.open_turns import read_turns
from countersteer.experiments.stop_regression import Stops, about, regress_stops
from countersteer.runs.files import Table
from countersteer.runs.marks import BAD, FILE, read_mark
from countersteer.text import counted


def learn(sources: Sequence[Path], most: float, out: Path) -> Stops:
    """Learn from tables of turns or runs, and write the policy. `most` is as in `regress_stops`.

    Runs that a person has marked bad are left out.
    """
    sources = without_bad(sources)
    found = regress_stops(read_all(sources), most)
    save_policy(out, source(found, [path.name for path in sources]), stop_angle=found.stop_angle)
    return found


def without_bad(sources: Sequence[Path]) -> list[Path]:
    """The sources without runs that are marked bad. Raises `InputError` if none is left."""
    left = [path for path in sources if not (path.is_dir() and read_mark(path) == BAD)]
    if sources and not left:
        raise InputError(f"{sources[0]}: is marked bad ({FILE}), as are all others that were given")
    return left


def read_all(paths: Sequence[Path]) -> Table:
    """The turns of several tables or runs in one table."""
    tables = [read_turns(path) for path in paths]
    names = ("kill_speed_mps", "kill_yaw_rate_degps", "time_to_stop_s", "angle_to_stop_deg")
    return Table({name: np.concatenate([table[name] for table in tables]) for name in names})


def source(found: Stops, names: Sequence[str]) -> dict[str, str]:
    """The source of the numbers, as the policy states it."""
    told = about(found)
    errors = "; ".join(
        f"{r['middle_mps']:.2f} m/s: offset ± {r['angle']['offset_error_deg']:.2g}°, slope ± "
        f"{r['angle']['slope_error_s']:.2g} s, {r['turns']} turns"
        for r in told["regions"]
    )
    low, high = told["yaw_rate_degps"]
    return {
        "stop_angle": f"learned from {counted(told['turns'], 'stopped turn')} ({', '.join(names)})",
        "standard_errors": errors,
        "valid": f"yaw rates of {low:.0f} to {high:.0f} °/s at the kill",
        "left_out": f"{told['ran_on']} turns that ran on",
    }
