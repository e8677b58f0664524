"""The look of pictures: colours, figures, and parts that several pictures share."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

Numbers = NDArray[np.float64]

PAPER, INK, SOFT, LINE = "#fffefb", "#1b2229", "#5a6570", "#e2ded3"
MEASURED, SIMULATED, STEERED = "#8796a3", "#c4400f", "#0069a8"
LABEL, DPI = 9.5, 100  # points; pixels per inch


def new_figure(width: float, height: float, dpi: int = DPI) -> tuple["Figure", "FigureCanvasAgg"]:
    """A figure of this size (inches), and the canvas that prints it as PNG."""
    # Importing Matplotlib takes longer than drawing. Commands that draw nothing do not import it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=PAPER)
    return figure, FigureCanvasAgg(figure)


def dress(axes: "Axes", size: float = LABEL) -> None:
    """Give the axes a light grid and no frame."""
    axes.grid(color=LINE, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_frame_on(False)
    axes.tick_params(length=0, labelsize=size, labelcolor=SOFT)


class Prediction(NamedTuple):
    """A window's simulated quantity over time (s), from its start."""

    time: Numbers
    simulated: Numbers
    colour: str = SIMULATED


def draw_windows(
    axes: "Axes", time: Numbers, measured: Numbers, windows: Iterable[Prediction]
) -> None:
    """Draw a measured quantity, and each window's prediction of it with a dot at its start.

    The axes' height covers the predictions, and the measured values within the axes' limits. A
    prediction may go beyond the measured values by their own span. It is cut there, so that it does
    not flatten the rest.
    """
    axes.plot(time, measured, color=MEASURED, linewidth=2.3, zorder=2)
    begin, end = axes.get_xlim()
    seen = measured[(time >= begin) & (time <= end)]
    seen = seen[np.isfinite(seen)]
    shown = [seen]
    for window in windows:
        (line,) = axes.plot(
            window.time, window.simulated, color=window.colour, linewidth=1.5, zorder=3
        )
        line.set(marker="o", markersize=3.3, markevery=[0])
        predicted = window.simulated[np.isfinite(window.simulated)]
        if len(seen):
            reach = max(float(np.ptp(seen)), 0.1)
            predicted = np.clip(predicted, seen.min() - reach, seen.max() + reach)
        shown.append(predicted)
    every = np.concatenate(shown)
    if not len(every):
        axes.text(
            0.5, 0.5, "not measured", transform=axes.transAxes, color=SOFT, ha="center", size=LABEL
        )
        return
    margin = 0.06 * max(float(np.ptp(every)), 0.1)
    axes.set_ylim(every.min() - margin, every.max() + margin)


def draw_commands(
    axes: "Axes", commands: Mapping[str, Numbers], steering: Numbers, size: float = LABEL
) -> None:
    """Draw the columns of `read_commands`: the drive on the left scale, steering (°) on the right.

    The drive is a throttle, as %, or a speed.
    """
    time, drive, least, label = commands["time_s"], commands.get("speed"), 1.0, "speed, m/s"
    if drive is None:
        drive, least, label = 100 * commands["throttle"], 100.0, "throttle, %"
    axes.step(time, drive, where="post", color=INK, linewidth=1.3)
    most = max(least, float(np.nanmax(np.abs(drive), initial=0.0)))
    axes.set_ylim((-1.06 if np.any(drive < 0) else -0.06) * most, 1.06 * most)
    axes.set_ylabel(label, color=INK, size=size)
    right = axes.twinx()
    right.step(time, steering, where="post", color=STEERED, linewidth=1.3)
    most = max(10.0, float(np.nanmax(np.abs(steering), initial=0.0)))
    right.set_ylim(-1.08 * most, 1.08 * most)
    right.set_ylabel("steering asked for, °", color=STEERED, size=size)
    right.set_frame_on(False)
    right.tick_params(length=0, labelsize=size, labelcolor=STEERED)
    right.locator_params(axis="y", nbins=5)
