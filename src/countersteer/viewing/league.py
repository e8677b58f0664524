"""The page of an evaluation: a league of drivers, each row with the command that makes it again."""

import base64
import math
from collections.abc import Mapping
from html import escape
from typing import Any

from countersteer.viewing.page import filled

HEADS = (
    ("driver", ""),
    ("knows", ""),
    ("success", "%"),
    ("lap", "s"),
    ("drifts", "% of successes"),
    ("sideslip", "° at a turn's peak"),
    ("overshoot", "° beyond the corridor, median, 95 %"),
    ("heading error", "° at a turn's end, RMS"),
    ("wall margin", "cm at the nearest"),
    ("learned from", "samples, CPU time"),
)
KNOWS = {
    "truth": "ground truth",
    "pose": "sensors: pose",
    "filter": "sensors: velocities",
    "reckoning": "sensors: reckoning",
}


def league_page(result: Mapping[str, Any], picture: bytes) -> str:
    """The page of `countersteer evaluate`'s JSON and picture. It loads no other file."""
    found = list(result["drivers"].values())
    most = max(one["trials"] for one in found)
    fields = {
        "title": escape(f"{result['course']}: who drives it best"),
        "about": escape(
            f"{most:,} random cars ({result['cars']}) around {result['car']}, from seed "
            f"{result['first_seed']} on; the same for all"
        ),
        "heads": "".join(
            f"<th>{escape(name)}<small>{escape(unit)}</small></th>" for name, unit in HEADS
        ),
        "rows": "".join(_row(one, most) for one in found),
        "commands": "\n".join(escape(one["command"]) for one in found),
        "picture": base64.b64encode(picture).decode(),
    }
    return filled("league_template.html", fields)


def _row(one: Mapping[str, Any], most: int) -> str:
    """A driver with what it knows."""
    low, high = (100 * part for part in one["success_interval"])
    few = f", {one['trials']} trials" if one["trials"] < most else ""
    over = [one[f"heading_overshoot_deg_{name}"] for name in ("median", "p95")]
    margin = one["wall_margin_m_median"]
    cells = (
        f"<b>{escape(one['driver'])}</b><small>steers by {escape(one['steers_by'])}</small>",
        escape(KNOWS[one["estimate"]]),
        f"<b>{100 * one['success_rate']:.1f}</b>{_bar(low, high)}"
        f"<small>{low:.1f} to {high:.1f}{few}</small>",
        _number(one["lap_time_s_median"], 2),
        _number(one["drift_share"], 1, 100),
        _number(one["peak_sideslip_deg_median"], 0),
        ", ".join(_number(value, 0) for value in over),
        _number(one["heading_error_rms_deg"], 1),
        _number(margin, 1, 100),
        _cost(one["learned_at"]),
    )
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _bar(low: float, high: float) -> str:
    """The interval of a success rate, on a line from 0 to 100 %."""
    width = max(high - low, 1.0)
    return f'<span class="bar"><i style="left:{low:.1f}%;width:{width:.1f}%"></i></span>'


def _number(value: Any, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"


def _cost(cost: Mapping[str, float]) -> str:
    """What a driver cost to learn; nothing where its file says nothing."""
    if not cost:
        return "<small>no record</small>"
    samples = _short(cost["samples"]) if "samples" in cost else "–"
    seconds = f"{cost['cpu_s']:,.0f} s" if "cpu_s" in cost else "CPU not recorded"
    return f"{samples}<small>{seconds}</small>"


def _short(count: float) -> str:
    """A count in three digits or so."""
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= size:
            digits = max(0, 2 - int(math.log10(count / size)))
            return f"{count / size:.{digits}f}{letter}"
    return f"{count:.0f}"
