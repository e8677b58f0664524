"""How far a car still turns once it is stopped, learned from turns that were stopped.

The paper's local linear regression: time and angle until stopped over the yaw rate at the kill, in
regions of the forward speed there. Beyond some sideslip the wheels turned back no longer stop a
car, and it spins on until it stands: no line holds there, and such turns are left out by the angle
that they took.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.drivers.stop_angle import StopAngle
from countersteer.errors import InputError
from countersteer.evaluation.local_regression import (
    LEAST,
    Line,
    Local,
    bounds_of,
    draw_stops,
    fit,
    regress,
)
from countersteer.evaluation.open_turns import read_turns
from countersteer.runs.files import Table

MOST = math.radians(30)  # that a turn may go on for


class Learned(NamedTuple):
    """The regression and what it was made from. SI units, rad."""

    angle: Local
    time: tuple[Line, ...]  # in the regions of the angle
    speed: np.ndarray
    rate: np.ndarray
    angles: np.ndarray
    times: np.ndarray
    ran_on: int  # turns left out
    ran_on_from: float  # least yaw rate at which one ran on

    @property
    def stop_angle(self) -> StopAngle:
        """What the driver asks."""
        column = lambda name: np.array([getattr(line, name) for line in self.angle.lines])  # noqa: E731  # used four times
        return StopAngle(
            speeds=column("middle"),
            offset=column("offset"),
            slope=column("slope"),
            deviation=column("deviation"),
        )


def read_all(paths: Sequence[Path]) -> Table:
    """The turns of several tables or runs, one below the other."""
    tables = [read_turns(path) for path in paths]
    names = ("kill_speed_mps", "kill_yaw_rate_degps", "time_to_stop_s", "angle_to_stop_deg")
    return Table({name: np.concatenate([table[name] for table in tables]) for name in names})


def learn_stop_angle(table: Table, most: float = MOST) -> Learned:
    """Regions and lines from a table of turns. Raises `InputError` where they carry no line."""
    angle = np.radians(table["angle_to_stop_deg"])
    rate = np.radians(table["kill_yaw_rate_degps"])
    stopped = angle <= most
    speed, times = table["kill_speed_mps"][stopped], table["time_to_stop_s"][stopped]
    if np.sum(stopped) < LEAST or np.ptp(rate[stopped]) < 0.1:
        raise InputError(
            f"{int(np.sum(stopped))} turns that stopped within {math.degrees(most):g}°: a line "
            f"needs {LEAST} or more, at different yaw rates"
        )
    found = fit(speed, rate[stopped], angle[stopped])
    return Learned(
        found,
        regress(speed, rate[stopped], times, bounds_of(found)),
        speed,
        rate[stopped],
        angle[stopped],
        times,
        int(np.sum(~stopped)),
        float(np.min(rate[~stopped], initial=math.inf)),
    )


def about(learned: Learned) -> dict[str, Any]:
    """The regression in figures; names and units are those of the JSON."""
    regions = [
        {
            "speed_mps": [angle.low, angle.high],
            "middle_mps": angle.middle,
            "turns": angle.points,
            "angle": {
                "offset_deg": math.degrees(angle.offset),
                "offset_error_deg": math.degrees(angle.offset_error),
                "slope_s": angle.slope,
                "slope_error_s": angle.slope_error,
                "deviation_deg": math.degrees(angle.deviation),
                "r_squared": angle.explained,
            },
            "time": {
                "offset_s": time.offset,
                "offset_error_s": time.offset_error,
                "slope_s_per_100degps": math.radians(100) * time.slope,
                "slope_error_s_per_100degps": math.radians(100) * time.slope_error,
                "deviation_s": time.deviation,
                "r_squared": time.explained,
            },
        }
        for angle, time in zip(learned.angle.lines, learned.time, strict=True)
    ]
    return {
        "turns": len(learned.rate),
        "ran_on": learned.ran_on,
        "ran_on_from_degps": math.degrees(learned.ran_on_from) if learned.ran_on else None,
        "yaw_rate_degps": [math.degrees(f(learned.rate)) for f in (np.min, np.max)],
        "chosen_by": "10-fold cross-validation, one standard error",
        "cross_validated_rms_deg": {
            str(count): math.degrees(error) for count, error in learned.angle.error.items()
        },
        "regions": regions,
    }


def lines(told: dict[str, Any]) -> list[str]:
    """The same for a person."""
    errors = told["cross_validated_rms_deg"]
    text = [
        f"{told['turns']} turns, {len(told['regions'])} regions by {told['chosen_by']} (rms "
        + ", ".join(f"{count}: {error:.2f}°" for count, error in errors.items())
        + ")"
    ]
    if told["ran_on"]:
        text.append(
            f"left out: {told['ran_on']} that ran on, from {told['ran_on_from_degps']:.0f} °/s"
        )
    for region in told["regions"]:
        low, high = region["speed_mps"]
        angle, time = region["angle"], region["time"]
        text.append(
            f"  {low:.2f} to {high:.2f} m/s ({region['turns']}): angle "
            f"{angle['offset_deg']:+.1f}° ± {angle['offset_error_deg']:.1f} + "
            f"{angle['slope_s']:.3f} s ± {angle['slope_error_s']:.3f} · yaw rate, to "
            f"{angle['deviation_deg']:.1f}°; time {time['offset_s']:.3f} s + "
            f"{time['slope_s_per_100degps']:.3f} s per 100 °/s, to {time['deviation_s']:.3f} s"
        )
    return text


def source(learned: Learned, names: Sequence[str]) -> dict[str, str]:
    """What the policy says of where its numbers are from."""
    told = about(learned)
    errors = "; ".join(
        f"{r['middle_mps']:.2f} m/s: offset ± {r['angle']['offset_error_deg']:.2g}°, slope ± "
        f"{r['angle']['slope_error_s']:.2g} s, {r['turns']} turns"
        for r in told["regions"]
    )
    low, high = told["yaw_rate_degps"]
    return {
        "stop_angle": f"learned from {told['turns']} turns of {', '.join(names)}",
        "standard_errors": errors,
        "valid": f"yaw rates of {low:.0f} to {high:.0f} °/s at the kill",
        "left_out": f"{told['ran_on']} turns that ran on",
    }


def draw(learned: Learned, path: Path, title: str) -> None:
    """Picture: the turns with the lines through them, by region."""
    draw_stops(
        learned.time,
        learned.angle.lines,
        learned.speed,
        learned.rate,
        learned.times,
        learned.angles,
        path,
        title,
    )
