"""Runs side by side: at the same time, or at the same place along the first one's path."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

STEP = 0.05  # m between two points of the path; less is noise of the measurement
# m of the path in which the next place is looked for, besides the distance moved
BACK, AHEAD = 0.3, 1.0
BEYOND = 2.0  # m by which the path goes on straight before its begin and after its end
QUANTITIES = ("speed_mps", "sideslip_deg", "yaw_rate_degps", "steering_deg")

View = Mapping[str, Any]


def with_places(views: Sequence[View]) -> list[dict[str, Any]]:
    """The views with `place_m`, the place along the first one's path; it never falls.

    A view without a path has none, and no view has one if the first has no path.
    """
    first = _points(views[0])
    if first is None:
        return [dict(view) for view in views]
    path, found = first[_apart(first)], []
    for view in views:
        points = _points(view)
        found.append(dict(view) | ({} if points is None else {"place_m": _along(path, points)}))
    return found


def _points(view: View) -> np.ndarray | None:
    return np.column_stack([view["x_m"], view["y_m"]]) if "x_m" in view else None


def _apart(points: np.ndarray) -> list[int]:
    """The indices of points that are at least `STEP` from the one chosen before."""
    chosen = [0]
    for i, (x, y) in enumerate(points.tolist()):
        last = points[chosen[-1]]
        if (x - last[0]) ** 2 + (y - last[1]) ** 2 >= STEP**2:
            chosen.append(i)
    return chosen


def _along(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The place of each point along a path: of the nearest point of it, looked for near the last.

    So a course that is driven again, or that crosses itself, has different places on each pass.
    """
    path = np.vstack([_beyond(path[0], path[1:2]), path, _beyond(path[-1], path[-2:-1])])
    mark = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))]) - BEYOND
    chosen, at, found = _apart(points), -BEYOND, []
    thinned = points[chosen]
    moved = np.hypot(*np.diff(thinned, axis=0, prepend=thinned[:1]).T).tolist()
    for i, point in enumerate(thinned):
        low, high = np.searchsorted(mark, [at - BACK, at + moved[i] + (AHEAD if i else BEYOND)])
        low = min(max(int(low) - 1, 0), len(path) - 2)
        near = path[low : int(high) + 2]
        along = np.diff(near, axis=0)
        square = np.maximum((along**2).sum(axis=1), 1e-12)
        part = ((point - near[:-1]) * along).sum(axis=1) / square
        part = np.minimum(np.maximum(part, 0.0), 1.0)
        away = ((near[:-1] + part[:, None] * along - point) ** 2).sum(axis=1)
        best = int(np.argmin(away))
        at = max(at, float(mark[low + best] + part[best] * np.sqrt(square[best])))
        found.append(at)
    return np.interp(np.arange(len(points)), chosen, found)


def _beyond(end: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """A point `BEYOND` an end of a path, straight on from the next point `inner` (one or none)."""
    way = end - inner[0] if len(inner) else np.array([1.0, 0.0])
    beyond: np.ndarray = end + BEYOND * way / np.hypot(*way)
    return beyond


def differences(views: Sequence[View], by: str) -> Iterator[dict[str, Any]]:
    """For each view but the first: root mean square and largest difference from the first.

    `by` is `time` or, of views `with_places`, `place`. Each is over what both have. `apart_m` is
    the distance of the cars. By place, `later_s` is how much later the other one is at the last
    common place.
    """
    axis, first = {"time": "time_s", "place": "place_m"}[by], views[0]
    for other in views[1:]:
        found: dict[str, Any] = {"run": other["name"], "by": by}
        if axis in first and axis in other:
            low, high = (f([first[axis][k], other[axis][k]]) for k, f in ((0, max), (-1, min)))
            grid = np.linspace(low, max(low, high), 2000)
            found |= {f"{axis}_from": float(low), f"{axis}_to": float(high)}
            at = {
                name: [np.interp(grid, one[axis], one[name]) for one in (first, other)]
                for name in (*QUANTITIES, "x_m", "y_m", "time_s")
                if name in first and name in other
            }
            for name in QUANTITIES:
                if name in at:
                    found[name] = _size(at[name][1] - at[name][0])
            if "x_m" in at:
                gap = np.hypot(at["x_m"][1] - at["x_m"][0], at["y_m"][1] - at["y_m"][0])
                found["apart_m"] = _size(gap)
            if by == "place":
                late = at["time_s"][1] - at["time_s"][0]
                found["later_s"] = float(late[-1] - late[0])
        yield found


def _size(difference: np.ndarray) -> dict[str, float | None]:
    known = np.abs(difference[np.isfinite(difference)])
    if not len(known):
        return {"rms": None, "largest": None}
    return {"rms": float(np.sqrt(np.mean(known**2))), "largest": float(known.max())}
