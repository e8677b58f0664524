"""Stopped turns: lines through time and angle over the yaw rate, in regions of speed.

This is the paper's local linear regression. Beyond some sideslip, countersteer no longer stops a
car, and it spins on until it stands. No line fits such turns. They are recognised by their angle
and left out.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.drivers.stop_angle import StopAngle
from countersteer.errors import InputError
from countersteer.experiments.local_regression import (
    LEAST,
    Line,
    Local,
    bounds_of,
    fit,
    paint_stops,
    regress,
)
from countersteer.runs.files import Table
from countersteer.text import counted
from countersteer.viewing.style import styled
from countersteer.writing import whole

MOST = math.radians(30)  # largest angle to the stop for which the lines are straight


class Stops(NamedTuple):
    """The regression and its data. SI units, rad."""

    angle: Local
    time: tuple[Line, ...]  # in the regions of the angle
    speed: np.ndarray
    rate: np.ndarray
    angles: np.ndarray
    times: np.ndarray
    most: float  # largest angle of the turns used
    ran_on: int  # number of turns left out
    ran_on_from: float  # least yaw rate of a turn left out

    @property
    def stop_angle(self) -> StopAngle:
        """The regression in the form that the driver uses."""
        column = lambda name: np.array([getattr(line, name) for line in self.angle.lines])  # noqa: E731  # used four times
        return StopAngle(
            speeds=column("middle"),
            offset=column("offset"),
            slope=column("slope"),
            deviation=column("deviation"),
        )


def regress_stops(table: Table, most: float = MOST) -> Stops:
    """Fit regions and lines to a table of turns. Raises `InputError` if it has too few for a line.

    `most` (rad) is the largest angle to the stop of a turn that is used.
    """
    angle = np.radians(table["angle_to_stop_deg"])
    rate = np.radians(table["kill_yaw_rate_degps"])
    stopped = angle <= most
    speed, times = table["kill_speed_mps"][stopped], table["time_to_stop_s"][stopped]
    if np.sum(stopped) < LEAST or np.ptp(rate[stopped]) < 0.1:
        raise InputError(
            f"{int(np.sum(stopped))} turns that stopped within {math.degrees(most):g}°: a line "
            f"needs {LEAST} or more, at different yaw rates"
        )
    local = fit(speed, rate[stopped], angle[stopped])
    return Stops(
        local,
        regress(speed, rate[stopped], times, bounds_of(local)),
        speed,
        rate[stopped],
        angle[stopped],
        times,
        most,
        int(np.sum(~stopped)),
        float(np.min(rate[~stopped], initial=math.inf)),
    )


def about(found: Stops) -> dict[str, Any]:
    """The figures of the regression; names and units are those of the JSON."""
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
        for angle, time in zip(found.angle.lines, found.time, strict=True)
    ]
    return {
        "turns": len(found.rate),
        "ran_on": found.ran_on,
        "ran_on_from_degps": math.degrees(found.ran_on_from) if found.ran_on else None,
        "yaw_rate_degps": [math.degrees(f(found.rate)) for f in (np.min, np.max)],
        "chosen_by": "10-fold cross-validation, one standard error",
        "cross_validated_rms_deg": {
            str(count): math.degrees(error) for count, error in found.angle.error.items()
        },
        "regions": regions,
    }


def lines(told: dict[str, Any]) -> list[str]:
    """The figures of `about` as lines for a person."""
    errors = told["cross_validated_rms_deg"]
    text = [
        f"{counted(told['turns'], 'turn')}, {counted(len(told['regions']), 'region')} by "
        f"{told['chosen_by']} (rms "
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


def paint(found: Stops, figure: Any) -> None:
    """Draw the turns and their lines, by region."""
    paint_stops(
        figure,
        found.time,
        found.angle.lines,
        found.speed,
        found.rate,
        found.times,
        found.angles,
    )


def draw(found: Stops, path: Path, title: str) -> None:
    """Write the picture of `paint` to `path`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with styled(), whole(path) as part:
        figure = plt.figure(figsize=(10, 4), layout="constrained")
        paint(found, figure)
        figure.suptitle(title)
        figure.savefig(part, format="png", dpi=110)
    plt.close(figure)
