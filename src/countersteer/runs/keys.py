"""The keys of `run.toml` and `summary.json` that are used, with their types and ranges.

A run's folder is data from elsewhere, so each key is checked when the run is read. Unknown keys are
passed over. A key may be absent, but a table that names `all_of` keys has to hold them.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.values import shown

Check = Callable[[Any, str], object]  # of a value, with its file and key; raises `InputError`

FARTHEST, FASTEST = 1e6, 1e4  # m (also rad); m/s and rad/s
LONGEST_TEXT = 1000  # characters
# `wheels` is the mean of all four, as of a log that has each of them, or does not say.
WHEELS = ("front-left", "front-right", "rear-left", "rear-right")
ENCODER_ON = ("shaft", *WHEELS, "wheels")
GYRO_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180}
VOLT_UNITS = {"V": 1.0, "mV": 1e-3}


def _number(low: float, high: float) -> Check:
    return lambda value, where: values.number(value, where, low, high)


def _whole(low: int, high: int) -> Check:
    return lambda value, where: values.whole(value, where, low, high)


def _one_of(*known: Any) -> Check:
    def check(value: Any, where: str) -> None:
        if isinstance(value, bool) or value not in known:
            raise InputError(f"{where} must be {' or '.join(map(str, known))}, not {shown(value)}")

    return check


def _text(value: Any, where: str) -> None:
    if not isinstance(value, str) or not value.isprintable() or len(value) > LONGEST_TEXT:
        raise InputError(f"{where} must be a printable text, not {shown(value)}")


def _any_table(value: Any, where: str) -> None:
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a table, not {shown(value)}")


def _or_none(check: Check) -> Check:
    return lambda value, where: None if value is None else check(value, where)


def _list(check: Check, length: int | None = None) -> Check:
    """A list of values, of a fixed `length` or of any."""

    def each(value: Any, where: str) -> None:
        if not isinstance(value, list) or len(value) != (len(value) if length is None else length):
            size = "" if length is None else f" of {length}"
            raise InputError(f"{where} must be a list{size}, not {shown(value)}")
        for i, one in enumerate(value):
            check(one, f"{where}[{i}]")

    return each


@dataclasses.dataclass(frozen=True)
class Keys:
    """The keys of a table."""

    known: Mapping[str, Check]
    all_of: tuple[str, ...] = ()

    def __call__(self, table: Any, where: str, dot: str = ".") -> None:
        """Check a table. `dot` goes between `where` and a key."""
        _any_table(table, where)
        for key in self.all_of:
            if key not in table:
                raise InputError(f"{where}{dot}{key} is missing")
        for key, check in self.known.items():
            if key in table:
                check(table[key], f"{where}{dot}{key}")


_PLACE = {key: _number(-FARTHEST, FARTHEST) for key in ("x_m", "y_m", "heading_rad")}
_POSE = Keys(_PLACE, tuple(_PLACE))
_DISTANCE, _LAG = _number(-FARTHEST, FARTHEST), _number(0, 10)
_ARM = _number(-5, 5)  # m, within a car
_POINT = _list(_DISTANCE, 2)
_WAVE = {key: _number(-FARTHEST, FARTHEST) for key in ("x_radpm", "y_radpm", "phase_rad")}
_PATCH = {
    "x_m": _number(-FARTHEST, FARTHEST), "y_m": _number(-FARTHEST, FARTHEST),
    "radius_m": _number(1e-3, FARTHEST), "friction": _number(0.01, 10),
}  # fmt: skip

_COURSE = Keys(
    {
        "name": _text,
        "width_m": _number(0, FARTHEST),
        "closed": values.flag,
        "line_m": _list(_POINT),
        "walls_m": _list(_list(_DISTANCE, 4)),
        "sides_m": _list(_POINT),
        "start": _POSE,
        "start_distance_m": _DISTANCE,
        "goal_distance_m": _DISTANCE,
        "turns": _list(
            Keys(
                {
                    "distance_m": _DISTANCE,
                    "turn_deg": _number(-360, 360),
                    "radius_m": _number(0, FARTHEST),
                },
                ("distance_m", "turn_deg"),
            )
        ),
    }
)

_FAULT = {
    "sensor": _text, "kind": _text, "start_s": _number(0, FARTHEST),
    "duration_s": _number(0, float("inf")),
}  # fmt: skip

ABOUT = Keys(
    {
        "car_name": _text,
        "driver": _text,
        "estimate": _text,
        "log_format": _text,
        "seed": _whole(0, 2**63 - 1),
        "laps": _whole(1, 1000),
        "precision_bits": _one_of(32, 64),
        "battery_charge": _number(0, 1),
        "battery_charge_end": _number(0, 1),
        "velocity_lag_s": _number(-10, 10),
        "line_spacing_m": _number(1e-6, FARTHEST),
        "start": _POSE,
        "initial": Keys(
            {key: _number(-1000, 1000) for key in ("vx_mps", "vy_mps", "yaw_rate_radps")}
        ),
        "sensors": Keys(
            {
                "encoder": Keys(
                    {
                        "on": _one_of(*ENCODER_ON),
                        "lag_s": _LAG,
                        "over_s": _LAG,
                        "step_mps": _number(0, FASTEST),
                        "regions": _number(1, 10_000),
                    }
                ),
                "gyroscope": Keys({"lag_s": _LAG, "unit": _one_of(*GYRO_UNITS)}),
                "capture": Keys({"x_m": _ARM, "y_m": _ARM, "yaw_offset_deg": _number(-180, 180)}),
                "voltmeter": Keys(
                    {
                        "lag_s": _LAG,
                        "noise_v": _number(0, 10),
                        "unit": _one_of(*VOLT_UNITS),
                        "cells": _whole(1, 100),
                    }
                ),
            }
        ),
        "link": Keys({"name": _text}),
        "rates": Keys({"dt_s": _number(1e-5, 0.02), "control_s": _number(1e-5, 10)}),
        "command": _text,
        "source": _text,
        "faults": _list(Keys(_FAULT, tuple(_FAULT))),
        "floor": Keys(
            {
                "amplitude": _number(-1, 1),
                "waves": _list(Keys(_WAVE, tuple(_WAVE))),
                "patches": _list(Keys(_PATCH, tuple(_PATCH))),
            },
            ("amplitude", "waves"),
        ),
        "course": _COURSE,
        "pilot": Keys(
            {
                "kind": _text,
                "file": _text,
                "speed_mps": _number(0, FASTEST),
                "numbers": _any_table,
            }
        ),
        "car": _any_table,
        "nominal": _any_table,
    }
)

_MEASURED = _or_none(_number(-1e9, 1e9))
_COUNT = _whole(0, 10**9)

_TIME = _number(-FARTHEST, FARTHEST)
_TURN = {"begin_s": _TIME, "end_s": _TIME}
_OF_TURN = (
    "entry_speed_mps", "peak_sideslip_deg", "peak_yaw_rate_degps", "heading_error_deg",
    "heading_overshoot_deg", "duration_s", "handover_s",
)  # fmt: skip

SUMMARY = Keys(
    {
        "outcome": _text,
        "verdict": _text,
        "completed": values.flag,
        "success": values.flag,
        "wall_contacts": _COUNT,
        "drifts": _COUNT,
        "lap_time_s": _MEASURED,
        "turns": _list(Keys(_TURN | dict.fromkeys(_OF_TURN, _MEASURED), tuple(_TURN))),
    }
)

check_about = partial(ABOUT, dot=": ")
check_summary = partial(SUMMARY, dot=": ")
