"""One drive at a glance, as a picture."""

import math
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

Points = NDArray[np.float64]  # shape (n, 2), metres unless said otherwise

_SIZE_IN = (14.0, 9.0)
_DPI = 100
_PAPER, _FLOOR, _INK, _SOFT, _LINE = "#fffefb", "#fbfaf6", "#1b2229", "#5a6570", "#e4e0d6"
_WALL, _GLASS, _TURN, _SPEED = "#39434c", "#dde5ea", "#f1ecdf", "#0069a8"
_GOOD, _BAD = "#00694f", "#a3210f"
# From calm to wild, and readable without telling red from green: the lightness falls as well.
_SLIP_COLOURS = ("#93a7b7", "#e0901f", "#a3210f")

_SKID_FROM_MPS, _SKID_FULL_MPS, _SKID_ALPHA = 0.3, 2.0, (0.10, 0.42)

# Outlines in halves of the car's length and width, from the centre of the outline.
_BODY = np.array(
    [(-1.0, 0.0), (-0.99, 0.62), (-0.93, 0.92), (-0.8, 1.0), (-0.5, 0.96), (-0.2, 0.93)]
    + [(0.2, 0.93), (0.62, 0.96), (0.82, 0.88), (0.94, 0.66), (1.0, 0.3)]
    + [(1.0, -0.3), (0.94, -0.66), (0.82, -0.88), (0.62, -0.96), (0.2, -0.93)]
    + [(-0.2, -0.93), (-0.5, -0.96), (-0.8, -1.0), (-0.93, -0.92), (-0.99, -0.62)]
)
_WINDSCREEN = np.array(
    [(0.3, 0.6), (0.36, 0.0), (0.3, -0.6), (0.06, -0.5), (0.09, 0.0), (0.06, 0.5)]
)
_REAR_WINDOW = np.array([(-0.6, 0.56), (-0.62, 0.0), (-0.6, -0.56), (-0.42, -0.46), (-0.42, 0.46)])
_WING = np.array([(-1.0, 0.86), (-0.86, 0.86), (-0.86, -0.86), (-1.0, -0.86)])

_GHOST_EVERY_S, _GHOST_EVERY_IN_TURN_S, _MOST_GHOSTS = 0.25, 0.125, 160
# Ghosts of different laps would hide each other: nearer than this part of a length, one is left
# out, unless it follows the other directly.
_CLEARANCE, _FOLLOWS_S = 0.55, 1.0


def draw_picture(view: dict[str, Any], path: pathlib.Path) -> None:
    """Write to `path`, as PNG, the drive `view` from above and over time.

    The car stands on its path at regular intervals, coloured by its sideslip, denser in turns.
    An existing file is replaced.
    """
    # Matplotlib takes longer to import than all the rest; who draws nothing does not wait for it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor=_PAPER)
    canvas = FigureCanvasAgg(figure)
    colours = LinearSegmentedColormap.from_list("sideslip", _SLIP_COLOURS)
    largest = max((abs(angle) for angle in view["sideslip_deg"]), default=0.0)
    scale_end = max(10, 5 * math.ceil(largest / 5))

    _write_headline(figure, view, largest)
    _draw_floor(figure, view, colours, scale_end)
    _draw_strips(figure, view, colours)
    canvas.print_png(path)


def _write_headline(figure: "Figure", view: dict[str, Any], largest_sideslip: float) -> None:
    """Write what was driven and how it ended across the top."""
    summary = view["summary"]
    figure.text(0.022, 0.953, str(view["title"]), color=_INK, size=18, weight="bold", va="center")
    status = str(summary["status"])
    figure.text(
        0.022,
        0.916,
        status[:1].upper() + status[1:],
        color=_GOOD if summary["completed"] else _BAD,
        size=12.5,
        weight="bold",
        va="center",
    )
    lap_time = summary.get("lap_time_s")
    times = view["time_s"]
    facts = [
        ("drive time", f"{times[-1] - times[0]:.2f} s")
        if lap_time is None
        else ("lap time", f"{lap_time:.2f} s"),
        ("wall contacts", str(summary["wall_contacts"])),
        ("largest sideslip", f"{largest_sideslip:.0f}°"),
    ]
    for right, (name, value) in zip((0.715, 0.845, 0.978), facts, strict=True):
        figure.text(right, 0.953, value, color=_INK, size=16, weight="bold", va="center", ha="right")
        figure.text(right, 0.918, name, color=_SOFT, size=10.5, va="center", ha="right")


def _draw_floor(
    figure: "Figure", view: dict[str, Any], colours: "Colormap", scale_end: float
) -> None:
    """Draw the drive from above, on the left."""
    from matplotlib.collections import LineCollection

    position = Points_of(view)
    axes = figure.add_axes((0.022, 0.035, 0.535, 0.85), facecolor=_FLOOR)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color(_LINE)
