"""A log's tables in SI units and at the centre of mass, by `[sensors]` of its `run.toml`.

A log's columns may hold another unit, or the poses of a marker beside the centre of mass. Both are
corrected once, where the run is read. Lags, steps and the encoder's wheel are used where readings
are compared (`tuning/log_sensors.py`).
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from countersteer.runs.files import Table
from countersteer.runs.keys import GYRO_UNITS, VOLT_UNITS


def sensor_tables(about: Mapping[str, Any], sensor: str) -> dict[str, Any]:
    """What a run's `[sensors.<sensor>]` declares, if anything."""
    return dict(about.get("sensors", {}).get(sensor, {}))


def telemetry_in_si(about: Mapping[str, Any], table: Table) -> Table:
    """The telemetry in SI units: `gyro_radps` by its unit, `battery_v` by its unit and cells.

    With `cells`, a reading is of one cell of that many in series.
    """
    volts = sensor_tables(about, "voltmeter")
    factors = {
        "gyro_radps": GYRO_UNITS[sensor_tables(about, "gyroscope").get("unit", "rad/s")],
        "battery_v": VOLT_UNITS[volts.get("unit", "V")] * volts.get("cells", 1),
    }
    return Table({n: v * factors[n] if factors.get(n, 1.0) != 1.0 else v for n, v in table.items()})


def truth_at_centre(about: Mapping[str, Any], table: Table) -> Table:
    """Poses and velocities of the centre of mass, from those of the captured point.

    `[sensors.capture]`: `x_m` forward and `y_m` left of the centre of mass, and `yaw_offset_deg`,
    the captured heading less the car's.
    """
    declared = sensor_tables(about, "capture")
    return moved_to_centre(
        table,
        declared.get("x_m", 0.0),
        declared.get("y_m", 0.0),
        math.radians(declared.get("yaw_offset_deg", 0.0)),
    )


def moved_to_centre(table: Table, x: float, y: float, yaw_offset: float) -> Table:
    """The table, captured at (x, y) in the car's axes (m) with this error of the heading (rad)."""
    if x == y == yaw_offset == 0:
        return table
    heading = table["heading_rad"] - yaw_offset
    cosine, sine = np.cos(heading), np.sin(heading)
    moved = Table(
        table
        | {
            "x_m": table["x_m"] - cosine * x + sine * y,
            "y_m": table["y_m"] - sine * x - cosine * y,
            "heading_rad": heading,
        }
    )
    if {"vx_mps", "vy_mps", "yaw_rate_radps"} <= table.keys():
        vx, vy, rate = (table[n] for n in ("vx_mps", "vy_mps", "yaw_rate_radps"))
        ahead, aside = math.cos(yaw_offset), math.sin(yaw_offset)
        moved["vx_mps"] = ahead * vx - aside * vy + rate * y
        moved["vy_mps"] = aside * vx + ahead * vy - rate * x
    return moved
