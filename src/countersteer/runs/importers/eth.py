"""Logs of the RC car of ETH Zürich's Learning and Adaptive Systems group, as run folders.

A file holds one recording. `obs` (N, 12) has x, y (m), heading (rad), velocity in the world's axes
(m/s), yaw rate (rad/s), and a buffer of the last three pairs of steering and throttle, oldest
first. `action` (N, 2) has the pair commanded on that row's observation. So a command belongs to the
time of its row and holds until the next row. The newest pair in the buffer is that of the row
before. Axes and signs need no change (ISO 8855). The point is published as the centre of mass.

Source: https://github.com/lasgroup/simulation_transfer, MIT licence.
"""

from pathlib import Path
from typing import Any

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.arrays import read_arrays
from countersteer.runs.files import require
from countersteer.runs.importers.imported import Imported, write_run

FULL_LOCK = 36.0  # degrees, nominal angle of the front wheels at a steering of 1

# s between two rows. The loop asks for 30 Hz, but distance over logged speed gives 33.4 (on
# straights) to 33.7 ms. In one row of a hundred, a frame came 10 ms late. This is not corrected.
PERIOD = 0.0336
# s, lag of velocities and yaw rate behind the poses. They belong to the middle of the frames that
# they were computed from. The lag is by least squares against differences of poses. It is written
# to run.toml, and not corrected.
VELOCITY_LAG = 0.015

FASTEST_YAW = 12.0  # rad/s; a higher yaw rate was computed across a wrap of the heading
MOST_ROWS = 1_000_000  # nine hours
LARGEST = 1e6  # of a number, in its unit
OBSERVED, ASKED = 12, 2  # columns


def import_eth(log: Path, out: Path) -> dict[str, Any]:
    """Write an ETH log as the run folder `out`/<name of the log>. Returns a report for JSON.

    - `commands.csv`: a row for each row of the log. The throttle is as logged; its sign is the
      direction. The steering is scaled by a nominal lock of 36 degrees.
    - `truth.csv`: velocity in the body's axes, heading unwrapped. A row is left out if the next one
      repeats its state. False yaw rates are empty.
    - `run.toml` and `run.mcap`.

    Raises `InputError` if the file is not an ETH log or is damaged.
    """
    observed, asked = _read(log)
    time = np.round(PERIOD * np.arange(len(observed)), 6)
    x, y, yaw, east, north, yaw_rate = observed[:, :6].T
    cosine, sine = np.cos(yaw), np.sin(yaw)
    # The row after a wrap is still computed partly across it, but stays below `FASTEST_YAW`.
    wrapped = np.abs(yaw_rate) > FASTEST_YAW
    wrapped[1:] |= wrapped[:-1].copy()
    # Of two rows with one state, the first is a period early: the distance to the row before is
    # that of two periods, and the distance to the row after is that of one.
    repeated = np.zeros(len(time), bool)
    repeated[:-1] = np.all(np.diff(observed[:, :6], axis=0) == 0, axis=1)
    truth = {
        "time_s": time,
        "x_m": x,
        "y_m": y,
        "heading_rad": np.unwrap(yaw),
        "vx_mps": cosine * east + sine * north,
        "vy_mps": cosine * north - sine * east,
        "yaw_rate_radps": np.where(wrapped, np.nan, yaw_rate),
    }
    steering, throttle = asked.T
    newest = observed[1:, -1] - throttle[:-1]  # the buffer's throttle is not scaled
    about: dict[str, Any] = {
        "log_format": "eth",
        "car_name": "eth",
        "kind": "motion capture with commands",
        "full_lock_deg": FULL_LOCK,
        "period_s": PERIOD,
        "velocity_lag_s": VELOCITY_LAG,
        "capture_point": "at the centre of mass, as published",
        "repairs": {
            "frames_repeated": int(np.sum(repeated)),
            "yaw_rates_false": int(np.sum(wrapped & ~repeated)),
            "heading_unwrapped": int(np.sum(np.abs(np.diff(yaw)) > np.pi)),
            "commands_not_in_buffer": int(np.sum(np.abs(newest) > 1e-6)),
        },
    }
    truth = {name: column[~repeated] for name, column in truth.items()}
    angle = np.radians(FULL_LOCK * steering)
    return write_run(log, out, Imported(about, len(time), time, throttle, angle, truth=truth))


def _read(log: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read observations and actions. Nothing in the file is executed: arrays of numbers only.

    Raises `InputError` if they are not as in the module's description.
    """
    found = read_arrays(log, ("obs", "action"), "an ETH log")
    observed, asked = found["obs"], found["action"]

    def place(row: int) -> str:
        return f"{log}, row {row} ({row * PERIOD:.2f} s)"

    for name, array, width, most in (
        ("obs", observed, OBSERVED, LARGEST),
        ("action", asked, ASKED, 1.0),
    ):
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
            raise InputError(f"{log}: not an ETH log: '{name}' must be numbers (N, {width})")
        require(place, np.all(np.isfinite(array), axis=1), f"{name} is not a number")
        within = np.all(np.abs(array) <= most, axis=1)
        require(place, within, f"{name} must be in [-{most:g}, {most:g}]")
    if len(observed) != len(asked) or len(observed) < 2:
        raise InputError(
            f"{log}: 'obs' and 'action' must be as long as each other, two rows or more"
        )
    if len(observed) > MOST_ROWS:
        raise InputError(f"{log}: {len(observed)} rows, over {MOST_ROWS}")
    return observed, asked
