"""One drive as a self-contained HTML page that plays it."""

import html
import json
from typing import Any

import numpy as np

from countersteer.viewing.page import filled

# Decimals that are visible on the page. More would only make it larger.
_DECIMALS = {
    "time_s": 3,
    "x_m": 4,
    "y_m": 4,
    "heading_rad": 4,
    "angle_rad": 4,
    "speed_mps": 3,
    "slip_mps": 2,
    "distance_m": 3,
    "sideslip_deg": 2,
    "yaw_rate_degps": 1,
    "steering_deg": 2,
    "steering_command_deg": 2,
    "throttle": 3,
    "commanded_speed_mps": 3,
}
_DECIMALS_OF_OTHERS = 4
# Forces are drawn as parts of the friction limit, so their digits follow its size: a newton for a
# toy car, thousands of newtons for a real one.
_FORCES = ("force_x_n", "force_y_n", "limit_n")
_STEPS_IN_LIMIT = 1000


def report_html(view: dict[str, Any]) -> str:
    """Return the page that plays the drive `view` (one sample or more). It loads no other file.

    `view` holds JSON data and stays unchanged. Its text is shown as text, whatever it contains.
    Raises `ValueError` for NaN or infinity.
    """
    compact = {name: _rounded(name, value) for name, value in view.items()}
    compact["wheels"] = [_rounded_wheel(wheel) for wheel in view["wheels"]]
    data = json.dumps(compact, separators=(",", ":"), allow_nan=False)
    fields = {
        "title": html.escape(str(view["title"])),
        # No "<" at all is left, so nothing in the data can end the script element around it.
        "view": data.replace("<", "\\u003c"),
    }
    return filled("report_template.html", fields)


def _rounded_wheel(wheel: dict[str, Any]) -> dict[str, Any]:
    """Return the series of one wheel with its forces rounded in proportion to its limit."""
    largest = max(wheel["limit_n"], default=0.0)
    decimals = max(0, int(np.ceil(np.log10(_STEPS_IN_LIMIT / largest)))) if largest > 0 else 3
    return {
        name: _rounded_series(value, decimals) if name in _FORCES else _rounded(name, value)
        for name, value in wheel.items()
    }


def _rounded(name: str, value: Any) -> Any:
    """Return `value` with every number rounded to the decimals of its entry `name`."""
    if isinstance(value, dict):
        return {inner: _rounded(inner, part) for inner, part in value.items()}
    decimals = _DECIMALS.get(name, _DECIMALS_OF_OTHERS)
    if isinstance(value, float):
        return round(value, decimals)
    if not isinstance(value, list):
        return value
    if all(isinstance(part, float) for part in value):
        return _rounded_series(value, decimals)
    return [_rounded(name, part) for part in value]


def _rounded_series(values: list[float], decimals: int) -> list[float]:
    """Return `values` rounded. NumPy does it, since nearly all numbers are in series."""
    # Adding zero turns -0.0 into 0.0, which is shorter.
    rounded: list[float] = (np.round(values, decimals) + 0.0).tolist()
    return rounded
