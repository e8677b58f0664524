"""The look of pictures: colours, figures, and parts that several pictures share."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

Numbers = NDArray[np.float64]

# The one palette of pages and pictures: each colour in light, and in dark. Pictures are light.
PALETTE = {
    "paper": ("#f5f4f0", "#0f1317"),  # around the cards of a page
    "card": ("#fffefb", "#171c21"),
    "floor": ("#fbfaf6", "#13181c"),
    "ink": ("#1b2229", "#e9edf0"),
    "soft": ("#5a6570", "#9ba8b3"),
    "line": ("#dfdcd3", "#2a323a"),
    "grid": ("#efece4", "#1c2329"),
    "track": ("#e6e2d8", "#2a323a"),  # of a bar
    "good": ("#00694f", "#4fd3a8"),
    "bad": ("#a3210f", "#ff8f6b"),
    "warn": ("#8a5a00", "#e5b04c"),
    "wall": ("#39434c", "#b4c0ca"),
    "rubber": ("#14181c", "#e6ebef"),
    "skid": ("#14181c", "#aeb8c0"),
    "body": ("#ffffff", "#27313a"),
    "glass": ("#303a43", "#51606c"),
    "velocity": ("#0069a8", "#62b8f2"),
    "force": ("#00785a", "#3ccb9f"),
    "sonar": ("#7a5ba8", "#b79be6"),
    "turn": ("#f1ecdf", "#222a31"),  # behind the time of a turn
    # Sideslip, from calm to wild. In each theme the contrast always rises, so that the order is
    # clear without red and green.
    "slip-low": ("#93a7b7", "#5a7084"),
    "slip-mid": ("#e0901f", "#e08c2e"),
    "slip-high": ("#a3210f", "#ffdf9e"),
    "measured": ("#8796a3", "#7b8995"),
    "simulated": ("#c4400f", "#f08a4b"),
    "held-out": ("#7a5ba8", "#b79be6"),
    "steered": ("#0069a8", "#62b8f2"),
    # Runs side by side.
    "run-1": ("#0069a8", "#62b8f2"),
    "run-2": ("#c4400f", "#f08a4b"),
    "run-3": ("#00785a", "#3ccb9f"),
    "run-4": ("#7a5ba8", "#b79be6"),
    "run-5": ("#8a5a00", "#e5b04c"),
    "run-6": ("#a2336b", "#f28bb8"),
}
MOST_RUNS = 6  # side by side, for each has a colour of its own


def light(name: str) -> str:
    """A colour of the palette, as pictures have it."""
    return PALETTE[name][0]


def palette_css() -> str:
    """The palette as custom properties of a page, for light and dark."""

    def block(theme: int, indent: str) -> str:
        return "\n".join(f"{indent}--{name}: {pair[theme]};" for name, pair in PALETTE.items())

    return (
        f":root {{\n{block(0, '  ')}\n}}\n"
        f"@media (prefers-color-scheme: dark) {{\n  :root {{\n{block(1, '    ')}\n  }}\n}}"
    )


PAPER, INK, SOFT, LINE = light("card"), light("ink"), light("soft"), light("line")
MEASURED, SIMULATED, STEERED = light("measured"), light("simulated"), light("steered")
SLIP_COLOURS = tuple(light(f"slip-{end}") for end in ("low", "mid", "high"))

LABEL, DPI = 9.5, 100  # points; pixels per inch


def new_figure(width: float, height: float, dpi: int = DPI) -> tuple["Figure", "FigureCanvasAgg"]:
    """A figure of this size (inches), and the canvas that prints it as PNG."""
    # Importing Matplotlib takes longer than drawing. Commands that draw nothing do not import it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, facecolor=PAPER)
    return figure, FigureCanvasAgg(figure)


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Figures that are made and drawn inside have the colours of the palette, and a light grid."""
    import matplotlib
    from cycler import cycler

    runs = [light(f"run-{k + 1}") for k in range(MOST_RUNS)]
    settings: dict[Any, Any] = {
        "figure.facecolor": PAPER,
        "savefig.facecolor": PAPER,
        "axes.facecolor": PAPER,
        "axes.edgecolor": LINE,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": LINE,
        "grid.linewidth": 0.8,
        "text.color": INK,
        "axes.titlecolor": INK,
        "axes.labelcolor": SOFT,
        "axes.labelsize": LABEL,
        "axes.titlesize": 10.5,
        "xtick.color": LINE,
        "ytick.color": LINE,
        "xtick.labelcolor": SOFT,
        "ytick.labelcolor": SOFT,
        "xtick.labelsize": LABEL,
        "ytick.labelsize": LABEL,
        "axes.prop_cycle": cycler(color=runs),
        "legend.frameon": False,
        "legend.labelcolor": INK,
        "figure.titleweight": "bold",
        "figure.titlesize": 12.0,
    }
    with matplotlib.rc_context(settings):
        yield


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
