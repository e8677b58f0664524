"""Drives as a self-contained HTML page that plays them, alone or side by side."""

import base64
import html
import json
from typing import Any

import numpy as np

from countersteer.viewing.page import filled
from countersteer.viewing.side_by_side import differences
from countersteer.viewing.viewer import FOLDER, bundle

# The steps to which series are rounded: what can be seen on the page. Finer ones make it larger.
_STEPS = {
    "time_s": 0.001,
    "x_m": 0.0005,
    "y_m": 0.0005,
    "place_m": 0.001,
    "heading_rad": 0.001,
    "angle_rad": 0.002,
    "ellipse_rad": 0.01,
    "longer_m": 0.001,
    "shorter_m": 0.001,
    "speed_mps": 0.005,
    "slip_mps": 0.02,
    "distance_m": 0.002,
    "sideslip_deg": 0.1,
    "yaw_rate_degps": 0.5,
    "steering_deg": 0.1,
    "steering_command_deg": 0.1,
    "throttle": 0.005,
    "commanded_speed_mps": 0.005,
    "battery_v": 0.005,
}
_DECIMALS = 4  # of single numbers
# Forces are drawn as parts of the friction limit, so their step follows its size: a newton for a
# toy car, thousands of newtons for a real one.
_FORCES = ("force_x_n", "force_y_n", "limit_n")
_STEPS_IN_LIMIT = 400


def report_html(*views: dict[str, Any]) -> str:
    """The page that plays these views of runs (`view.view_of`). It loads no other file.

    Several are side by side: at the same time or, `with_places`, at the same place along the first
    one's path. Texts of the views are shown as text, whatever they contain.
    """
    data = report_json(*views)
    title = " and ".join(str(run["title" if len(views) == 1 else "name"]) for run in views)
    fields = {
        "title": html.escape(title),
        # No "<" at all is left, so nothing in the data can end the script element around it.
        "view": data.replace("<", "\\u003c"),
        "viewer_style": (FOLDER / "viewer.css").read_text(encoding="utf-8").rstrip(),
        "viewer": bundle("report.js"),
    }
    return filled("report_template.html", fields)


def report_json(*views: dict[str, Any]) -> str:
    """The data of that page: the runs, and the differences of all from the first."""
    runs = [dict(view) for view in views]
    for run in runs:
        run["wheels"] = [_wheel(wheel) for wheel in run["wheels"]]
    compared = {by: list(differences(views, by)) for by in ("time", "place")}
    shown = {"runs": _plain("runs", runs), "differences": _plain("differences", compared)}
    return json.dumps(shown, separators=(",", ":"), allow_nan=False)


def _wheel(wheel: dict[str, Any]) -> dict[str, Any]:
    """One wheel, its forces packed in steps in proportion to its limit."""
    largest = float(np.max(wheel["limit_n"], initial=0.0))
    step = largest / _STEPS_IN_LIMIT or 1.0
    return {
        name: pack(np.asarray(value), step) if name in _FORCES else value
        for name, value in wheel.items()
    }


def _plain(name: str, value: Any) -> Any:
    """`value`, of the entry `name`, for JSON: series are packed and numbers are rounded."""
    if isinstance(value, dict):
        return {inner: _plain(inner, part) for inner, part in value.items()}
    if name in _STEPS and isinstance(value, np.ndarray | list):
        return pack(np.asarray(value, float), _STEPS[name])
    if isinstance(value, float):
        return round(value, _DECIMALS)
    if isinstance(value, list | tuple):
        return [_plain(name, part) for part in value]
    return value


def pack(values: np.ndarray, step: float) -> dict[str, Any]:
    """A series for the page: `values` in whole steps, each as its difference from the one before.

    A difference d is the number 2d + 1 if d >= 0, else -2d; an unknown or infinite value is 0 and
    passed over. Numbers have seven bits in each byte, lowest first, and the eighth bit says that
    more follow. The bytes are in base64. `drive.js` reads them.
    """
    known = np.isfinite(values)
    whole = np.round(values[known] / step).astype(np.int64)
    change = np.diff(whole, prepend=0)
    code = np.zeros(len(values), np.int64)
    code[known] = np.where(change >= 0, 2 * change + 1, -2 * change)
    longest = max(1, -(-int(np.max(code, initial=1)).bit_length() // 7))  # bytes of a number
    left = code[:, None] >> (7 * np.arange(longest + 1))  # what is left from each byte on
    more = left[:, 1:] > 0
    byte = (left[:, :-1] & 127) | (more << 7)
    used = np.hstack([np.ones((len(code), 1), bool), more[:, :-1]])
    packed = byte[used].astype(np.uint8)
    return {"packed": base64.b64encode(packed.tobytes()).decode(), "step": step}
