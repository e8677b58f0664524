"""A table's values and actions as slices over the course, with the path that its car drove."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from countersteer.viewing.style import INK, LABEL, SLIP_COLOURS, SOFT, light, new_figure
from countersteer.writing import naming

VALUES = (light("ink"), light("velocity"), light("slip-mid"), light("card"))  # from little to much
SIDES = (light("steered"), light("track"), light("simulated"))  # steering right, straight, left
THROTTLES = (light("track"), *SLIP_COLOURS[1:])
WALL = light("wall")
HEAD = 0.85  # inches, above the slices


class Slice(NamedTuple):
    """Values and best actions over the course, for one motion along it: arrays (rows, columns)."""

    name: str
    x: np.ndarray  # m
    y: np.ndarray
    value: np.ndarray  # NaN where the car touches
    throttle: np.ndarray
    steering_deg: np.ndarray


def draw_slices(
    slices: Sequence[Slice], walls: np.ndarray, path: np.ndarray, title: str, file: Path
) -> None:
    """Draw a row for each slice: value, steering, throttle. `path` (n, 6) begins with x, y."""
    from matplotlib.colors import LinearSegmentedColormap

    height = HEAD + 4.1 * len(slices)
    figure, canvas = new_figure(13.0, height)
    places = {"left": 0.02, "right": 0.98, "bottom": 0.03, "top": 1 - HEAD / height}
    axes = figure.subplots(
        len(slices), 3, squeeze=False, gridspec_kw={**places, "wspace": 0.04, "hspace": 0.14}
    )
    looks = (
        ("value", VALUES, "value"),
        ("steering_deg", SIDES, "steering, ° (left is positive)"),
        ("throttle", THROTTLES, "throttle"),
    )
    for row, one in zip(axes, slices, strict=True):
        for ax, (name, colours, label) in zip(row, looks, strict=True):
            ramp = LinearSegmentedColormap.from_list(name, colours)
            low, high = _ends(name, [getattr(each, name) for each in slices])
            drawn = ax.pcolormesh(
                _edges(one.x),
                _edges(one.y),
                np.ma.masked_invalid(getattr(one, name)),
                cmap=ramp,
                vmin=low,
                vmax=high,
            )
            bar = figure.colorbar(drawn, ax=ax, fraction=0.04, pad=0.02)
            bar.outline.set_visible(False)
            bar.ax.tick_params(length=0, labelsize=LABEL - 1.5, labelcolor=SOFT)
            for ax_, ay, bx, by in walls:
                ax.plot([ax_, bx], [ay, by], color=WALL, linewidth=2.0, solid_capstyle="round")
            ax.plot(path[:, 0], path[:, 1], color=INK, linewidth=1.4)
            ax.plot(path[:1, 0], path[:1, 1], "o", color=INK, markersize=4)
            ax.set_aspect("equal")
            ax.set_axis_off()
            ax.set_title(f"{label}, at {one.name}", fontsize=LABEL, color=SOFT, loc="left")
    figure.text(0.02, 1 - 0.34 / height, title, fontsize=14, color=INK, weight="semibold")
    figure.text(0.02, 1 - 0.56 / height, "the line is the drive of the nominal car, from rest",
                fontsize=LABEL, color=SOFT)  # fmt: skip
    with naming(file):
        canvas.print_png(str(file))


def _ends(name: str, tables: Sequence[np.ndarray]) -> tuple[float, float]:
    """The range of colours that all slices share. Few poses are as bad as a failure."""
    known = np.concatenate([table[np.isfinite(table)] for table in tables])
    if not known.size:
        return 0.0, 1.0
    if name == "steering_deg":
        most = float(np.max(np.abs(known)))
        return -most, most
    low, high = np.percentile(known, 5 if name == "value" else 0), np.max(known)
    return float(low), float(high)


def _edges(points: np.ndarray) -> np.ndarray:
    """The corners (n + 1, m + 1) of the cells around points (n, m)."""
    for axis in (0, 1):
        table = np.moveaxis(points, axis, 0)
        outer = [2 * table[:1] - table[1:2], table, 2 * table[-1:] - table[-2:-1]]
        wide = np.concatenate(outer)
        points = np.moveaxis((wide[:-1] + wide[1:]) / 2, 0, axis)
    return points
