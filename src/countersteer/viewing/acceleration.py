"""The speeds of throttle steps, measured and simulated, as a picture."""

import math
from pathlib import Path

from countersteer.tuning.acceleration import DURATION, Acceleration
from countersteer.viewing.style import INK, MEASURED, SIMULATED, SOFT, STEERED, dress, new_figure
from countersteer.writing import whole

_COLUMNS, _PANEL_IN = 5, (2.8, 2.75)


def draw_acceleration(found: Acceleration, path: Path) -> None:
    """Write each level's speed to `path` as PNG: measured, and simulated before and after the fit.

    Bars are the reader's standard deviation. An existing file is replaced.
    """
    rows = math.ceil(len(found.series) / _COLUMNS)
    size = (_COLUMNS * _PANEL_IN[0], rows * _PANEL_IN[1] + 0.9)
    figure, canvas = new_figure(*size)
    top = 1 - 0.8 / size[1]
    grid = figure.subplots(rows, _COLUMNS, squeeze=False, sharex=True, sharey="row")
    figure.subplots_adjust(0.045, 0.5 / size[1], 0.985, top - 0.15 / size[1], 0.08, 0.22)
    change = f"{found.before:.4g} → {found.after:.4g} ± {found.deviation:.2g} ohm"
    figure.text(
        0.045,
        1 - 0.3 / size[1],
        f"{found.parameter}  {change}",
        color=INK,
        size=15,
        weight="bold",
        va="center",
    )
    figure.text(
        0.045,
        1 - 0.62 / size[1],
        f"Speed by {found.source} in the first second of each throttle, m/s.   "
        f"RMS error {found.rms_before:.3f} → {found.rms_after:.3f} m/s",
        color=SOFT,
        size=10.5,
        va="center",
    )
    for axes, one in zip(grid.flat, found.series, strict=False):
        axes.errorbar(
            *(one.time, one.measured, one.deviation),
            fmt="o",
            color=MEASURED,
            markersize=3.5,
            elinewidth=1,
            label="measured",
        )
        axes.plot(
            one.time, one.before, color=STEERED, linewidth=1.3, linestyle="--", label="before"
        )
        axes.plot(one.time, one.after, color=SIMULATED, linewidth=1.8, label="after")
        axes.set_title(
            f"throttle {one.level:.3g}:  {one.rms_before:.2f} → {one.rms_after:.2f}",
            color=INK,
            size=10,
            loc="left",
        )
    for axes in grid.flat:
        dress(axes)
    for axes in list(grid.flat)[len(found.series) :]:
        axes.set_visible(False)
    for line in grid:
        line[0].set_ylim(bottom=0.0)
    for axes in grid[-1]:
        axes.set_xlim(0.0, DURATION)
        axes.set_xticks([0.0, 0.2, 0.4, 0.6, 0.8])
        axes.set_xlabel("time since the throttle came, s", color=SOFT, size=9.5)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="center right",
        bbox_to_anchor=(0.985, 1 - 0.55 / size[1]),
        ncols=3,
        frameon=False,
        fontsize=10.5,
        labelcolor=SOFT,
    )
    with whole(path) as part:
        canvas.print_png(str(part))
