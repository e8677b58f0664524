"""Throttle steps: commands for a series of drives, the same for the simulator and a real car."""

from pathlib import Path
from typing import Any

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.files import COMMANDS, command_rows, csv_text
from countersteer.writing import write_whole

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # throttle: the paper's ten
DURATION = 1.0  # s, the paper's
REST = 1.0  # s without throttle after a step: the car rolls out and shows its drag
RATE = 100.0  # Hz


def read_levels(text: str) -> tuple[float, ...]:
    """Levels of throttle from `0.1,0.2,…`. Raises `InputError` if one is invalid or there twice."""
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--levels {text}: write numbers, such as 0.1,0.2,0.3") from None
    if not all(-1 <= level <= 1 and level != 0 for level in levels):
        raise InputError(f"--levels {text}: each must be in [-1, 1] and not 0")
    names = [step_name(level) for level in levels]
    if len(set(names)) != len(names):
        raise InputError(f"--levels {text}: a level is there twice")
    return levels


def step_name(level: float) -> str:
    """The name of a level's file, without its ending."""
    return f"throttle-{'reverse-' if level < 0 else ''}{abs(level):.3f}".rstrip("0").rstrip(".")


def throttle_steps(
    out: Path, levels: tuple[float, ...] = LEVELS, duration: float = DURATION, rate: float = RATE
) -> dict[str, Any]:
    """Write a `commands.csv` for each level: that throttle from rest, then none; wheels straight.

    A row comes every 1/`rate` seconds: for `duration` seconds (rounded to whole rows) at the level,
    then for `REST` seconds at 0. Returns the files in the order of the runs. `README.txt` holds
    the same for a person.
    """
    on, off = round(duration * rate), round(REST * rate)
    if on < 1:
        raise InputError(f"--duration-s {duration:g}: is shorter than a row at {rate:g} Hz")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from None
    time = np.round(np.arange(on + off + 1) / rate, 9)
    runs = []
    for level in levels:
        file = out / f"{step_name(level)}.csv"
        throttle = np.where(np.arange(len(time)) < on, level, 0.0)
        rows = command_rows(time, throttle, np.zeros(len(time)))
        write_whole(file, csv_text(COMMANDS, rows))
        runs.append({"throttle": level, "commands": str(file)})
    write_whole(out / "README.txt", _instructions(runs, on / rate))
    return {"duration_s": on / rate, "rest_s": off / rate, "rate_hz": rate, "runs": runs}


def _instructions(runs: list[dict[str, Any]], duration: float) -> str:
    """Instructions for the files."""
    names = "\n".join(f"  {Path(run['commands']).name}" for run in runs)
    return f"""Throttle steps: {len(runs)} runs from rest, straight, {duration:g} s at a throttle.

In the simulator:   countersteer replay FILE --car CAR --out RUN
On a real car:      run each file's rows at their times; log what the car reports beside them in
                    a run's folder: commands.csv, telemetry.csv, run.toml.
                    The simulator says how much room the fastest needs (x_m in truth.csv).

{names}
"""
