"""Logs of DART, TU Delft's JetRacer Pro, as run folders.

Two kinds of file are read. Recordings hold the car's reports, held between its updates at 10 Hz.
Most of them also hold motion capture at 100 Hz. Processed files hold motion capture at 20 Hz, and
velocities computed from it, but no sensor of the car.

Axes and signs need no change (ISO 8855: yaw, yaw rate and steering positive to the left).

Source: https://github.com/Lorenzo-Lyons/DART, MIT licence.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.declared import moved_to_centre
from countersteer.runs.defects import SLACK, SLACK_YAW
from countersteer.runs.files import LATEST, Table, read_table, require
from countersteer.runs.importers.imported import Imported, write_run

FULL_LOCK = 25.0  # degrees, nominal angle of the front wheels at a steering of 1

# The captured point from the centre of mass (m), and the error of the captured yaw (rad). 0.0220 is
# the published 0.115 m from the rear axle, less 0.0930 m from the axle loads. The point is on the
# right, by the authors' code and by the logs. In steady circles to the left (yaw rate over speed
# 0.89), the encoder reads 0.997 of the point's speed; to the right (1.85), it reads 1.039. A point
# 8 mm to the right explains this. A point to the left does not.
POINT_X, POINT_Y = 0.0220, -0.01
YAW_ERROR = 0.0077  # added to the captured yaw; then the mean sideslip of slow circles is 0

FASTEST, FASTEST_YAW = 10.0, 60.0  # m/s, rad/s; a frame that needs more is false
DIGITS = 6  # decimals of times (s)

# Lags of the car's sensors, from the instant to the first row with the reading. They were measured
# against motion capture, on the four recordings that have it. The gyroscope's optimum is sharp: rms
# 0.07 rad/s at 0.05 s, 0.16 to 0.41 at 0.09 s. The encoder's is from straight driving within grip:
# rms 0.024 m/s at 0.055 s, 0.08 at 0.13 s. It is about half of the 0.1 s over which it counts.
# Others report 0.09 s, and 0.11 to 0.15 s, for the columns as they are in the file. These hold each
# reading for 0.1 s, so they are 0.05 s later on average.
# Each log tells its encoder's step: 0.0413 m/s in August and September 2024, 0.0516 in January.
SENSORS = {
    "encoder": {"lag_s": 0.06, "over_s": 0.1},
    "gyroscope": {"lag_s": 0.05},
}

ONBOARD = {
    "acc x (IMU)": "accel_x_mps2",
    "acc y (IMU)": "accel_y_mps2",
    "W (IMU)": "gyro_radps",
    "vel encoder": "wheel_speed_mps",
}
ASKED = ("safety_value", "throttle", "steering")
CAPTURE = ("vicon time", "vicon x", "vicon y", "vicon yaw")
CLOCK = "elapsed time sensors"
CLOCKS = (CLOCK, "vicon time")
LARGEST, LATEST_CLOCK = 1e6, 1e12  # of a cell, and of a clock: it may be Unix time in ms
PROCESSED = {"vx body": "vx_mps", "vy body": "vy_mps", "w": "yaw_rate_radps"}
YAW = "unwrapped yaw"


class Log(NamedTuple):
    """The content of a log; times start at its first row."""

    kind: str
    updates: Table  # safety_value, throttle, steering and the car's reports, with time_s
    telemetry: dict[str, np.ndarray]  # columns of telemetry.csv, besides time and armed
    truth: dict[str, np.ndarray] | None
    repairs: dict[str, int]


# The library's car by folder of the published logs. Other folders have `jetracer`, on the rubber
# floor. The throttle ramps are published as driven on taped tyres too, but they were not: they
# corner at 6.0 m/s². Circles with tape, recorded in the same hours, end at 3.6.
CARS = {
    "circles_tape_and_tiles": "jetracer-tape",
    "drift_tape_and_tiles": "jetracer-tape",
    "slippery_floor_racing": "jetracer-slippery",
    "slippery_floor_racing_no_tape": "jetracer-slippery",
    "steering_sines": "jetracer-january",
    "steering_steps": "jetracer-january",
    "throttle_ramps": "jetracer-tiles",
    "circles_27_sept_2024_fast_ramp": "jetracer-tiles",  # by its grip: docs/tuning.md
}


def import_dart(log: Path, out: Path) -> dict[str, Any]:
    """Write a DART log as the run folder `out`/<name of the log>. Returns a report for JSON.

    - `commands.csv`: a row for each update of the car. The throttle is the motor's: 0 while the
      dead-man switch is released. The steering is scaled by a nominal lock of 25 degrees.
    - `telemetry.csv`: the sensors, and `armed`, which is 1 while the switch is closed.
    - `truth.csv`, with motion capture only: moved to the centre of mass, heading unwrapped.
    - `run.toml` and `run.mcap`.

    Raises `InputError` if the file is not a DART log or is damaged.
    """
    table = _read(log)
    if CLOCK in table:
        found = _recording(log, table)
    elif "vx body" in table:
        found = _processed(log, table)
    else:
        raise InputError(f"{log}: not a DART log: it has neither column '{CLOCK}' nor 'vx body'")
    updates = found.updates
    armed = updates["safety_value"] > 0.5
    throttle = np.where(armed, updates["throttle"], 0.0)
    telemetry = {"time_s": updates["time_s"], **found.telemetry, "armed": armed.astype(float)}
    repairs = found.repairs | {
        "throttle_masked": int(np.sum(~armed & (updates["throttle"] != 0))),
    }
    about: dict[str, Any] = {
        "log_format": "dart",
        "car_name": CARS.get(log.resolve().parent.name, "jetracer"),
        "kind": found.kind,
        "full_lock_deg": FULL_LOCK,
        "sensors": SENSORS,
        "columns": list(table),
        "repairs": repairs,
    }
    if found.truth is not None:
        about["capture_point"] = (
            {"x_m": POINT_X, "y_m": POINT_Y, "heading_rad": YAW_ERROR}
            if CLOCK in table
            else "at the centre of mass in the file itself"
        )
    steering = np.radians(FULL_LOCK * updates["steering"])
    imported = Imported(
        about, len(table), updates["time_s"], throttle, steering, telemetry, found.truth
    )
    return write_run(log, out, imported)


def _read(log: Path) -> Table:
    """Read the columns of a log. Raises `InputError` if it has no rows or is no CSV file."""
    table = read_table(log, ())
    if not table.keys():
        raise InputError(f"{log}: is empty")
    if not len(table):
        raise InputError(f"{log}: holds no rows")
    return table


def _recording(log: Path, table: Table) -> Log:
    """Read a recording: the car's updates, and motion capture if it has the columns.

    The rows come at the rate of motion capture and hold the car's last update. So an update's time
    is that of its first row. In the rows before the first update, the car's clock is 0.
    """
    captured = "vicon time" in table
    _check(log, table, (CLOCK, *ONBOARD, *ASKED, *(CAPTURE if captured else ())))
    clock = table[CLOCK]
    _rises(log, table, CLOCK)
    new = np.diff(clock, prepend=math.nan) != 0
    if captured:
        new &= clock != 0
    if not np.any(new):
        raise InputError(f"{log}: '{CLOCK}' never changes: the car reported nothing")
    first = int(np.argmax(new))
    repairs = {"rows_before_first_update": first, "rows_held": int(np.sum(~new)) - first}
    time, truth = clock, None
    if captured:
        _rises(log, table, "vicon time")
        time = table["vicon time"]
        truth, dropped = _captured(table)
        repairs |= dropped
    updates = _rows(table, new, time)
    telemetry = {ours: updates[theirs] for theirs, ours in ONBOARD.items()}
    kind = "recording with motion capture" if captured else "recording"
    return Log(kind, updates, telemetry, truth, repairs)


def _captured(table: Table) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Motion capture at the centre of mass, and the numbers of dropped frames and heading wraps."""
    time = np.round(table["vicon time"] - table["vicon time"][0], DIGITS)
    x, y, yaw = (table[name] for name in CAPTURE[1:])
    pose = np.stack([x, y, yaw])
    repeated = np.zeros(len(time), bool)
    repeated[1:] = np.all(np.diff(pose) == 0, axis=0) | (np.diff(time) == 0)
    possible = _possible(time, x, y, yaw, ~repeated)
    heading = np.unwrap(yaw[possible])
    seen = Table(time_s=time[possible], x_m=x[possible], y_m=y[possible], heading_rad=heading)
    truth = dict(moved_to_centre(seen, POINT_X, POINT_Y, -YAW_ERROR))
    wraps = np.sum(np.abs(np.diff(yaw[possible])) > math.pi)
    return truth, {
        "frames_repeated": int(np.sum(repeated)),
        "frames_impossible": int(np.sum(~possible & ~repeated)),
        "heading_unwrapped": int(wraps),
    }


def _possible(
    time: np.ndarray, x: np.ndarray, y: np.ndarray, yaw: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """True for candidates that the car can have reached from the last one kept.

    The limit grows with the time since that one. So a false first frame does not exclude all later
    ones.
    """
    kept = np.zeros(len(time), bool)
    last = int(np.argmax(candidates))
    for i in np.nonzero(candidates)[0].tolist():
        since = time[i] - time[last]
        turned = abs(math.remainder(yaw[i] - yaw[last], 2 * math.pi))
        moved = math.hypot(x[i] - x[last], y[i] - y[last])
        if moved <= SLACK + FASTEST * since and turned <= SLACK_YAW + FASTEST_YAW * since:
            kept[i], last = True, i
    return kept


def _processed(log: Path, table: Table) -> Log:
    """Read a processed file: a row is both a command and a frame of motion capture.

    Checked on the four files: the velocities are central differences of `vicon x`, `vicon y` and
    `unwrapped yaw` over two rows, turned by `unwrapped yaw` into ISO 8855 axes, to the last digit.
    The point is the centre of mass, 0.093 m ahead of the rear axle: at low speed within grip, the
    lateral velocity is 0.097 m times the yaw rate. `unwrapped yaw` has no error left.
    """
    _check(log, table, ("vicon time", "vicon x", "vicon y", YAW, *ASKED, *PROCESSED))
    _rises(log, table, "vicon time")
    new = np.diff(table["vicon time"], prepend=-math.inf) > 0
    updates = _rows(table, new, table["vicon time"])
    velocity = {ours: updates[theirs] for theirs, ours in PROCESSED.items()}
    # The authors' code writes zeros where it has no difference. No other velocities are zero.
    unknown = np.all([column == 0 for column in velocity.values()], axis=0)
    truth = {
        "time_s": updates["time_s"],
        "x_m": updates["vicon x"],
        "y_m": updates["vicon y"],
        "heading_rad": updates[YAW],
        **{name: np.where(unknown, math.nan, column) for name, column in velocity.items()},
    }
    repairs = {"frames_repeated": int(np.sum(~new)), "velocities_unknown": int(np.sum(unknown))}
    return Log("processed motion capture", updates, {}, truth, repairs)


def _rows(table: Table, chosen: np.ndarray, time: np.ndarray) -> Table:
    """The chosen rows, with their time since the log's first row."""
    columns = {name: column[chosen] for name, column in table.items()}
    return Table(columns | {"time_s": np.round(time[chosen] - time[0], DIGITS)})


def _check(log: Path, table: Table, columns: tuple[str, ...]) -> None:
    """Raise `InputError` for a missing column, a cell that is no number, or too large a command."""
    line = _line(log)
    for name in columns:
        if name not in table:
            raise InputError(f"{log}: not a DART log: column '{name}' is missing")
        require(line, np.isfinite(table[name]), f"{name} is not a number")
        most = LATEST_CLOCK if name in CLOCKS else LARGEST
        require(line, np.abs(table[name]) <= most, f"{name} must be in [-{most:g}, {most:g}]")
    for name in ("throttle", "steering"):
        require(line, np.abs(table[name]) <= 1, f"{name} must be in [-1, 1]")


def _rises(log: Path, table: Table, clock: str) -> None:
    """Raise `InputError` if a clock goes backwards."""
    line, time = _line(log), table[clock]
    require(line, np.diff(time, prepend=-math.inf) >= 0, f"{clock} goes backwards")
    require(line, time - time[0] <= LATEST, f"{clock} is over {LATEST:g} s after the first row's")


def _line(log: Path) -> Callable[[int], str]:
    """A function that gives the place of a row. The header is line 1."""
    return lambda row: f"{log}, line {row + 2}"
