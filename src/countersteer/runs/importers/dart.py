"""Logs of DART, TU Delft's JetRacer Pro, as run folders.

Two kinds of file are read. The recordings hold what the car reported (held between its updates at
10 Hz) and, most of them, motion capture beside it at 100 Hz. The processed files hold motion
capture at 20 Hz with velocities computed from it, and no sensor of the car.

Axes and signs are ours already (ISO 8855: yaw, yaw rate and steering positive to the left).

Source: https://github.com/Lorenzo-Lyons/DART, MIT licence.
"""

import csv
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.defects import SLACK, SLACK_YAW
from countersteer.runs.files import (
    COMMANDS,
    Table,
    read_table,
    require,
)
from countersteer.runs.recorder import Recorder, new_folder

FULL_LOCK = 25.0  # degrees of the front wheels that a steering of 1 nominally asks for

# The captured point from the centre of mass, m, and the captured yaw's error, rad. 0.0220 is the
# published 0.115 m from the rear axle less the 0.0930 m that the axle loads give. The point is to
# the right: so the authors' code has it, and so do the logs. In steady circles the encoder reads
# 0.997 of the point's speed to the left (at 0.89 of yaw rate over speed) and 1.039 to the right
# (at 1.85), which a point 8 mm to the right explains and one to the left does not.
POINT_X, POINT_Y = 0.0220, -0.01
YAW_ERROR = 0.0077  # added to the captured yaw; the sideslip of slow circles then is 0 on average

FASTEST, FASTEST_YAW = 10.0, 60.0  # m/s, rad/s; a frame that would need more is a false one
DIGITS = 6  # of a second that times keep

# Lags of the car's sensors, from the instant to the row in which a reading first appears, measured
# against motion capture on the four recordings that have it. The gyroscope's is sharp (rms 0.07
# rad/s at 0.05 s, 0.16 to 0.41 at 0.09 s). The encoder's is that of straight driving in grip (rms
# 0.024 m/s at 0.055 s, 0.08 at 0.13 s), about half of the 0.1 s over which it counts. Others report
# 0.09 s and 0.11 to 0.15 s: those are of the columns as they stand in the file, which hold each
# reading for 0.1 s and so are 0.05 s later on average.
SENSORS = {
    "encoder": {"lag_s": 0.06, "over_s": 0.1, "step_mps": 0.0413},
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
PROCESSED = {"vx body": "vx_mps", "vy body": "vy_mps", "w": "yaw_rate_radps"}
YAW = "unwrapped yaw"


class Log(NamedTuple):
    """What a log says, in our units; times from its first row on."""

    kind: str
    updates: Table  # safety_value, throttle, steering, and what the car reported, with time_s
    telemetry: dict[str, np.ndarray]  # columns of telemetry.csv, besides time and armed
    truth: dict[str, np.ndarray] | None
    repairs: dict[str, int]


# The library's car by folder of the published logs; `jetracer`, on the rubber floor, where none is
# given. The throttle ramps are told to be of the taped tyres too, but they are not: they corner at
# 6.0 m/s² where the circles with tape end at 3.6, in the same hours.
CARS = {
    "circles_tape_and_tiles": "jetracer-tape",
    "drift_tape_and_tiles": "jetracer-tape",
    "slippery_floor_racing": "jetracer-tape",
    "throttle_ramps": "jetracer-tiles",
}


def import_dart(log: Path, out: Path) -> dict[str, Any]:
    """Write a DART log as the run folder `out`/<name of the log> and say what was done.

    The files are `commands.csv` (a row per update of the car; the throttle that the motor got,
    which is 0 while the dead-man switch is released; steering times a nominal lock of 25 degrees),
    `telemetry.csv` (with `armed`, 1 while the switch is closed), `truth.csv` where there is motion
    capture (moved to the centre of mass, heading unwrapped), and `run.toml`.

    Raises `InputError` with one line where the file is not a DART log or is damaged.
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
        "source": log.name,
        "kind": found.kind,
        "full_lock_deg": FULL_LOCK,
        "sensors": SENSORS,
        "columns": list(table),
        "rows": {
            "log": len(table),
            "commands": len(updates),
            "telemetry": len(updates),
            "truth": 0 if found.truth is None else len(found.truth["time_s"]),
        },
        "repairs": repairs,
    }
    if found.truth is not None:
        about["capture_point"] = (
            {"x_m": POINT_X, "y_m": POINT_Y, "heading_rad": YAW_ERROR}
            if CLOCK in table
            else "at the centre of mass in the file itself"
        )
    folder = new_folder(out / log.stem, log.stem)
    steering = np.radians(FULL_LOCK * updates["steering"])
    headers = {"commands": COMMANDS, "telemetry": tuple(telemetry)}
    tables = {
        "commands": (updates["time_s"], throttle, steering),
        "telemetry": tuple(telemetry.values()),
    }
    if found.truth is not None:
        headers["truth"] = tuple(found.truth)
        tables["truth"] = tuple(found.truth.values())
    with Recorder(folder, about, headers) as recorder:
        recorder.write(tables)
    return {"run": str(folder), "duration_s": float(updates["time_s"][-1]), **about}


def _read(log: Path) -> Table:
    """Read the columns of a log. Raises `InputError` where there is no row."""
    try:
        table = read_table(log, ())
    except csv.Error:
        raise InputError(f"{log}: not a DART log: it is no CSV file") from None
    if not table.keys():
        raise InputError(f"{log}: is empty")
    if not len(table):
        raise InputError(f"{log}: holds no rows")
    return table


def _recording(log: Path, table: Table) -> Log:
    """Read a recording: the car's updates, and motion capture where its columns are there.

    The rows come at the rate of motion capture and hold the car's last update. So an update's time
    is that of the row in which it first appears. It is 0 in the rows before the first one.
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
    """Motion capture at the centre of mass, and how many frames were dropped for what."""
    time = np.round(table["vicon time"] - table["vicon time"][0], DIGITS)
    x, y, yaw = (table[name] for name in CAPTURE[1:])
    pose = np.stack([x, y, yaw])
    repeated = np.zeros(len(time), bool)
    repeated[1:] = np.all(np.diff(pose) == 0, axis=0) | (np.diff(time) == 0)
    possible = _possible(time, x, y, yaw, ~repeated)
    heading = np.unwrap(yaw[possible])
    cosine, sine = np.cos(heading + YAW_ERROR), np.sin(heading + YAW_ERROR)
    truth = {
        "time_s": time[possible],
        "x_m": x[possible] - cosine * POINT_X + sine * POINT_Y,
        "y_m": y[possible] - sine * POINT_X - cosine * POINT_Y,
        "heading_rad": heading + YAW_ERROR,
    }
    wraps = np.sum(np.abs(np.diff(yaw[possible])) > math.pi)
    return truth, {
        "frames_repeated": int(np.sum(repeated)),
        "frames_impossible": int(np.sum(~possible & ~repeated)),
        "heading_unwrapped": int(wraps),
    }


def _possible(
    time: np.ndarray, x: np.ndarray, y: np.ndarray, yaw: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """Those candidates that the car could have reached from the one kept before.

    What is allowed grows with the time since then, so that a false start heals.
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
    The point is the centre of mass (slow and in grip, lateral velocity is 0.097 m times the yaw
    rate, as at 0.093 m ahead of the rear axle), and `unwrapped yaw` has its error taken out.
    """
    _check(log, table, ("vicon time", "vicon x", "vicon y", YAW, *ASKED, *PROCESSED))
    _rises(log, table, "vicon time")
    new = np.diff(table["vicon time"], prepend=-math.inf) > 0
    updates = _rows(table, new, table["vicon time"])
    velocity = {ours: updates[theirs] for theirs, ours in PROCESSED.items()}
    # Where no difference could be taken, the authors' code writes zeros, and nothing else is one.
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
    """Take the chosen rows, with their time since the log's first row."""
    columns = {name: column[chosen] for name, column in table.items()}
    return Table(columns | {"time_s": np.round(time[chosen] - time[0], DIGITS)})


def _check(log: Path, table: Table, columns: tuple[str, ...]) -> None:
    """Raise `InputError` where a column is missing, holds no number, or a command is too large."""
    line = _line(log)
    for name in columns:
        if name not in table:
            raise InputError(f"{log}: not a DART log: column '{name}' is missing")
        require(line, np.isfinite(table[name]), f"{name} is not a number")
    for name in ("throttle", "steering"):
        require(line, np.abs(table[name]) <= 1, f"{name} must be in [-1, 1]")


def _rises(log: Path, table: Table, clock: str) -> None:
    """Raise `InputError` where a clock goes backwards."""
    require(_line(log), np.diff(table[clock], prepend=-math.inf) >= 0, f"{clock} goes backwards")


def _line(log: Path) -> Callable[[int], str]:
    """Says where a row is: the header is line 1."""
    return lambda row: f"{log}, line {row + 2}"
