"""One drive at a glance, as a picture."""

import gc
import io
import json
import math
import os
import pathlib
import subprocess
import sys
import threading
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from countersteer.viewing.look import (
    BODY,
    REAR_WINDOW,
    SKID_DARKEST,
    SKID_FROM_MPS,
    SKID_FULL_MPS,
    WINDSCREEN,
)
from countersteer.viewing.style import DPI, INK, LINE, PAPER, SLIP_COLOURS, SOFT, light, new_figure
from countersteer.writing import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]  # left, bottom, width, height; parts of the figure

_SIZE_IN = (14.0, 9.0)
FLOOR, WALL, GLASS = light("floor"), light("wall"), light("glass")
_TURN, SPEED, SIDESLIP = light("turn"), light("velocity"), light("slip-mid")
_GOOD, _BAD = light("good"), light("bad")

_SKID_FAINTEST = 0.12
_MOST_SKID_SAMPLES = 2000

_GHOST_EVERY_S, _GHOST_EVERY_IN_TURN_S, _MOST_GHOSTS = 0.25, 0.15, 160
# Ghosts that hide each other show nothing. These are the least distances, in car lengths, from a
# ghost of the same pass and from one of an earlier lap.
_STEP_LENGTHS, _CLEARANCE_LENGTHS = 0.4, 0.6
_SAME_PASS_S, _TURNED_RAD = 1.0, math.radians(20)

_MOST_TURN_NUMBERS = 16
_TITLE, _LEAST_TITLE = 58, 10.0  # characters that fit at 18 points; points of the smallest
_DASHES = (3.0, 2.0)


class _Layout(NamedTuple):
    """The places of the picture's parts."""

    floor: Rectangle
    strips: Rectangle


# Most courses are about as wide as they are tall; a long one gets the whole width.
_BESIDE = _Layout(floor=(0.022, 0.085, 0.55, 0.79), strips=(0.615, 0.07, 0.363, 0.805))
_BELOW = _Layout(floor=(0.022, 0.5, 0.956, 0.375), strips=(0.05, 0.06, 0.928, 0.37))
_LONG = 2.0


def draw_picture(view: dict[str, Any], path: pathlib.Path) -> None:
    """Write the PNG of `picture_png` to `path`. An existing file is replaced."""
    write_whole(path, picture_png(view))


def picture_png(view: dict[str, Any]) -> bytes:
    """The drive `view` (one sample or more) as PNG, from above and over time.

    The car stands on its path at regular intervals, denser in turns, coloured by its sideslip.
    """
    from matplotlib.colors import LinearSegmentedColormap

    figure, canvas = new_figure(*_SIZE_IN)
    low, high = _bounds(view)
    layout = _BELOW if high[0] - low[0] > _LONG * (high[1] - low[1]) else _BESIDE
    colours = LinearSegmentedColormap.from_list("sideslip", SLIP_COLOURS)
    largest = float(np.max(np.abs(_sideslip(view)), initial=0.0))
    colours_end = max(20, 5 * math.ceil(largest / 5))

    _write_headline(figure, view, largest)
    metres_per_width = _draw_floor(figure, layout.floor, view, colours, colours_end)
    _draw_keys(figure, layout.floor, colours, colours_end, metres_per_width)
    _draw_strips(figure, layout.strips, view)
    png = io.BytesIO()
    canvas.print_png(png, pil_kwargs={"compress_level": 1})
    return png.getvalue()


def _sideslip(view: dict[str, Any]) -> Array:
    """The sideslip (°), and 0 where it is unknown."""
    return np.nan_to_num(np.array(view.get("sideslip_deg", np.zeros(len(view["time_s"])))))


def _steering(view: dict[str, Any]) -> Array:
    """The angle of the front wheels (°): as simulated, or else as asked for."""
    return np.array(view.get("steering_deg", view["steering_command_deg"]))


def _bounds(view: dict[str, Any]) -> tuple[Array, Array]:
    """Return the lowest and highest x and y of the scene, with a margin."""
    length = view["car"]["length_m"]
    places = np.column_stack([view["x_m"], view["y_m"]])
    corners = np.array(view["walls_m"], dtype=float).reshape(-1, 2)
    low = np.vstack([places - 0.6 * length, corners]).min(axis=0)
    high = np.vstack([places + 0.6 * length, corners]).max(axis=0)
    return low - 0.25 * length, high + 0.25 * length


def _write_headline(figure: "Figure", view: dict[str, Any], largest_sideslip: float) -> None:
    """Write the title, the outcome and the main figures across the top."""
    summary = view["summary"]
    status = str(summary.get("verdict", summary["outcome"]))
    title = str(view["title"])
    size = max(_LEAST_TITLE, min(18.0, 18.0 * _TITLE / max(len(title), 1)))
    if len(title) * size > 18 * _TITLE:
        title = title[: int(18 * _TITLE / size) - 1] + "…"
    figure.text(0.022, 0.955, title, color=INK, size=size, weight="bold", va="center")
    verdict = status[:1].upper() + status[1:]
    mood = _GOOD if summary.get("success", summary["completed"]) else _BAD
    turns = len(summary["turns"])
    if summary["outcome"] == "not judged" or (
        mood == _GOOD and summary.get("drifts", turns) < turns
    ):
        mood = INK
    figure.text(0.022, 0.914, verdict, color=mood, size=13, weight="bold", va="center")
    lap_time, times = summary.get("lap_time_s"), view["time_s"]
    contacts = summary["wall_contacts"]
    facts = [("largest sideslip", f"{largest_sideslip:.0f}°")]
    if contacts is not None:
        facts.append(("wall contacts", f"{contacts}"))
    driven = ("drive time", f"{times[-1] - times[0]:.2f} s")
    facts.append(driven if lap_time is None else ("lap time", f"{lap_time:.2f} s"))
    for right, (name, value) in zip((0.978, 0.845, 0.718), facts, strict=False):
        bold = figure.text(right, 0.955, value, color=INK, size=17, va="center", ha="right")
        bold.set_fontweight("bold")
        figure.text(right, 0.916, name, color=SOFT, size=10.5, va="center", ha="right")


# -------------------------------------------------------------------------------------------------
# The drive from above
# -------------------------------------------------------------------------------------------------


def _draw_floor(
    figure: "Figure",
    place: Rectangle,
    view: dict[str, Any],
    colours: "Colormap",
    colours_end: float,
) -> float:
    """Draw the drive from above, and return the width of the whole figure in its metres."""
    from matplotlib.collections import LineCollection

    axes = figure.add_axes(place, facecolor=FLOOR, xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_color(LINE)
    # One scale for both axes: the limits are widened to the shape of the place.
    low, high = _bounds(view)
    inches = np.array([place[2] * _SIZE_IN[0], place[3] * _SIZE_IN[1]])
    metres_per_inch = float(np.max((high - low) / inches))
    middle, half = (low + high) / 2, inches * metres_per_inch / 2
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])

    _draw_skid_marks(axes, view, 72 / metres_per_inch)
    axes.plot(view["x_m"], view["y_m"], color=SOFT, linewidth=0.8, alpha=0.6, zorder=2)
    _draw_ghosts(axes, view, colours, colours_end)
    walls = np.array(view["walls_m"], dtype=float).reshape(-1, 2, 2)
    axes.add_collection(
        LineCollection(list(walls), colors=WALL, linewidths=3.5, capstyle="round", zorder=4),
        autolim=False,
    )
    _number_turns(axes, view)
    return metres_per_inch * _SIZE_IN[0]


def _draw_skid_marks(axes: "Axes", view: dict[str, Any], points_per_metre: float) -> None:
    """Draw the marks of slipping wheels, darker for faster slip."""
    from matplotlib.collections import LineCollection

    stride = math.ceil(len(view["time_s"]) / _MOST_SKID_SAMPLES)
    poses = _poses(view)[::stride]
    for wheel, series in zip(view["car"]["wheels"], view["wheels"], strict=False):
        track = placed(np.array([(wheel["x_m"], wheel["y_m"])]), poses)[:, 0]
        slip = np.array(series["slip_mps"][::stride])[:-1]
        marks = slip > SKID_FROM_MPS
        share = np.clip((slip[marks] - SKID_FROM_MPS) / (SKID_FULL_MPS - SKID_FROM_MPS), 0, 1)
        shades = np.zeros((len(share), 4))
        shades[:, 3] = _SKID_FAINTEST + (SKID_DARKEST - _SKID_FAINTEST) * share
        axes.add_collection(
            LineCollection(
                list(np.stack([track[:-1], track[1:]], axis=1)[marks]),
                colors=shades,
                linewidths=max(0.8, 0.9 * wheel["width_m"] * points_per_metre),
                capstyle="butt",
                zorder=1,
            ),
            autolim=False,
        )


def _draw_ghosts(
    axes: "Axes", view: dict[str, Any], colours: "Colormap", colours_end: float
) -> None:
    """Draw the car at intervals along its path, later ones over earlier ones."""
    from matplotlib.collections import PolyCollection

    car = view["car"]
    chosen = _ghosts(view)
    poses = _poses(view)[chosen]
    half = np.array([car["length_m"] / 2, car["width_m"] / 2])
    centre = np.array([car["center_x_m"], 0.0])
    paints = colours(np.abs(_sideslip(view)[chosen]) / colours_end)
    body, windscreen, rear_window = (
        placed(shape * half + centre, poses) for shape in (BODY, WINDSCREEN, REAR_WINDOW)
    )
    wheels = [_placed_wheel(view, k, chosen, poses) for k in range(len(car["wheels"]))]
    shapes: list[Array] = []
    faces: list[Any] = []
    # All in one collection, so that the parts of one car lie together in depth.
    for k, paint in enumerate(paints):
        shapes += [body[k], windscreen[k], rear_window[k], *(wheel[k] for wheel in wheels)]
        faces += [paint, GLASS, GLASS, *(INK for _ in wheels)]
    edges = [PAPER, "none", "none", *("none" for _ in wheels)] * len(paints)
    axes.add_collection(
        PolyCollection(
            shapes, facecolors=faces, edgecolors=edges, linewidths=1.1, zorder=3, joinstyle="round"
        ),
        autolim=False,
    )


def _ghosts(view: dict[str, Any]) -> NDArray[np.intp]:
    """Return the samples at which the car is drawn."""
    time, poses = np.array(view["time_s"]), _poses(view)
    turns = view["summary"]["turns"]
    length = view["car"]["length_m"]
    turning = sum(turn["end_s"] - turn["begin_s"] for turn in turns)
    straight = time[-1] - time[0] - turning
    planned = turning / _GHOST_EVERY_IN_TURN_S + straight / _GHOST_EVERY_S
    stretch = max(1.0, planned / _MOST_GHOSTS)
    chosen: list[int] = []
    moment = time[0]
    while moment <= time[-1]:
        sample = int(np.searchsorted(time, moment))
        earlier = poses[chosen]
        distance = np.hypot(*(earlier[:, :2] - poses[sample, :2]).T) / length
        same_pass = time[sample] - time[chosen] < _SAME_PASS_S * stretch
        turned = np.abs(np.sin((earlier[:, 2] - poses[sample, 2]) / 2)) > math.sin(_TURNED_RAD / 2)
        least = np.where(same_pass, np.where(turned, 0, _STEP_LENGTHS), _CLEARANCE_LENGTHS)
        if np.all(distance >= least):
            chosen.append(sample)
        in_turn = any(turn["begin_s"] <= moment < turn["end_s"] for turn in turns)
        moment += stretch * (_GHOST_EVERY_IN_TURN_S if in_turn else _GHOST_EVERY_S)
    return np.array(chosen, dtype=np.intp)


def _number_turns(axes: "Axes", view: dict[str, Any]) -> None:
    """Write each turn's number on the inside of its middle, unless there are too many turns."""
    from matplotlib.patheffects import withStroke

    turns = view["summary"]["turns"]
    if len(turns) > _MOST_TURN_NUMBERS:
        return
    time = np.array(view["time_s"])
    for number, turn in enumerate(turns, start=1):
        begin, middle, end = np.clip(
            np.searchsorted(
                time, [turn["begin_s"], (turn["begin_s"] + turn["end_s"]) / 2, turn["end_s"]]
            ),
            0,
            len(time) - 1,
        )
        points = _poses(view)[[begin, middle, end], :2]
        inward = (points[0] + points[2]) / 2 - points[1]
        norm = float(np.hypot(*inward))
        if norm == 0:
            continue
        x, y = points[1] + inward / norm * 1.1 * view["car"]["length_m"]
        text = axes.text(x, y, str(number), color=SOFT, size=15, ha="center", va="center")
        text.set(weight="bold", zorder=5)
        text.set_path_effects([withStroke(linewidth=4, foreground=FLOOR)])


def _poses(view: dict[str, Any]) -> Array:
    """Return x, y and heading of the car at each sample, a row each."""
    return np.column_stack([view["x_m"], view["y_m"], view["heading_rad"]])


def placed(points: Array, poses: Array) -> Array:
    """Return the places of `points` of the car on the floor: (poses, points, 2)."""
    cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = points[:, 0], points[:, 1]
    return np.stack([poses[:, :1] + cos * x - sin * y, poses[:, 1:2] + sin * x + cos * y], axis=-1)


def _placed_wheel(
    view: dict[str, Any], which: int, chosen: NDArray[np.intp], poses: Array
) -> Array:
    """Return the outline on the floor of wheel `which` at the `chosen` samples."""
    wheel = view["car"]["wheels"][which]
    if view["wheels"]:
        angle = np.array(view["wheels"][which]["angle_rad"])[chosen]
    elif which < 2:
        angle = np.radians(_steering(view)[chosen])
    else:
        angle = np.zeros(len(chosen))
    hub = placed(np.array([(wheel["x_m"], wheel["y_m"])]), poses)[:, 0]
    radius, half_width = wheel["radius_m"], wheel["width_m"] / 2
    tread = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (radius, half_width)
    return placed(tread, np.column_stack([hub, poses[:, 2] + angle]))


def _draw_keys(
    figure: "Figure",
    floor: Rectangle,
    colours: "Colormap",
    colours_end: float,
    metres_per_width: float,
) -> None:
    """Draw the key of the colours and the scale bar under the floor."""
    left, bottom, width, _ = floor
    y, right = bottom - 0.027, left + width
    figure.text(left, y, "sideslip  0°", color=SOFT, size=10.5, va="center")
    _paint_ramp(figure, colours, (left + 0.068, y - 0.006, 0.1, 0.012))
    figure.text(left + 0.174, y, f"{colours_end}°", color=SOFT, size=10.5, va="center")
    metres = nice_step(0.05 * metres_per_width)
    start = right - metres / metres_per_width
    _draw_line(
        figure,
        [(start, y + 0.007), (start, y - 0.007), (right, y - 0.007), (right, y + 0.007)],
        colour=SOFT,
        width=1.4,
    )
    label = figure.text(start - 0.008, y, f"{metres:g} m", color=SOFT, size=10.5, va="center")
    label.set_horizontalalignment("right")


def _paint_ramp(figure: "Figure", colours: "Colormap", place: Rectangle) -> None:
    """Paint all of `colours`, from left to right, into `place`."""
    across, up = (int(inches * DPI) for inches in _SIZE_IN)
    left, bottom, width, height = place
    shades = colours(np.linspace(0, 1, int(width * across)))
    pixels = np.broadcast_to(shades, (int(height * up), *shades.shape))
    figure.figimage(pixels, int(left * across), int(bottom * up))


def _draw_line(
    figure: "Figure",
    points: list[tuple[float, float]],
    colour: str,
    width: float,
    dashes: tuple[float, float] | None = None,
) -> None:
    """Draw a line through `points`, which are in parts of the figure."""
    from matplotlib.lines import Line2D

    x, y = zip(*points, strict=True)
    line = Line2D(x, y, color=colour, linewidth=width, transform=figure.transFigure)
    if dashes is not None:
        line.set_dashes(dashes)
    figure.add_artist(line)


# -------------------------------------------------------------------------------------------------
# The drive over time
# -------------------------------------------------------------------------------------------------


class _Strip(NamedTuple):
    """One quantity over time."""

    name: str
    unit: str
    values: Array
    colour: str
    command: Array | None


def _draw_strips(figure: "Figure", place: Rectangle, view: dict[str, Any]) -> None:
    """Draw the quantities over time, one strip under the other."""
    asked, throttle = view["steering_command_deg"], view.get("throttle")
    strips = [
        _Strip(name, unit, values, colour, command)
        for name, unit, values, colour, command in (
            ("Speed", "m/s", view.get("speed_mps"), SPEED, None),
            ("Sideslip", "°", view.get("sideslip_deg"), SIDESLIP, None),
            ("Yaw rate", "°/s", view.get("yaw_rate_degps"), SOFT, None),
            ("Steering", "°", view.get("steering_deg"), SOFT, asked),
            ("Steering asked for", "°", None if "steering_deg" in view else asked, SOFT, None),
            ("Throttle", "%", None if throttle is None else 100 * np.array(throttle), SOFT, None),
            ("Commanded speed", "m/s", view.get("commanded_speed_mps"), SOFT, None),
        )
        if values is not None
    ]
    left, bottom, width, height = place
    pitch = height / len(strips)
    caption = 0.026
    for k, strip in enumerate(strips):
        strip_bottom = bottom + height - (k + 1) * pitch
        axes = figure.add_axes((left, strip_bottom, width, pitch - caption - 0.004))
        _draw_strip(axes, strip, view, is_last=k == len(strips) - 1)
        _write_caption(figure, (left, strip_bottom + pitch - caption / 2 - 0.002), width, strip)


def _draw_strip(axes: "Axes", strip: _Strip, view: dict[str, Any], is_last: bool) -> None:
    """Draw the curves of one strip. Only the last strip has labels on its time axis."""
    time = view["time_s"]
    lines = [strip.values] if strip.command is None else [strip.values, strip.command]
    shown = np.nan_to_num(np.concatenate([[0.0], *lines]))
    low, high = float(shown.min()), float(shown.max())
    # A quantity that never changes still needs a height.
    span = max(high - low, 1e-3)
    for turn in view["summary"]["turns"]:
        axes.axvspan(turn["begin_s"], turn["end_s"], color=_TURN, linewidth=0, zorder=0)
    axes.fill_between(time, strip.values, color=strip.colour, alpha=0.12, linewidth=0, zorder=2)
    axes.plot(time, strip.values, color=strip.colour, linewidth=1.5, zorder=3)
    if strip.command is not None:
        axes.plot(time, strip.command, color=INK, linewidth=0.8, dashes=_DASHES, zorder=3)
    axes.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
    axes.set_ylim(low - 0.06 * span, high + 0.06 * span)
    axes.set_yticks(_ticks(low, high, span / 2.6))
    axes.set_xticks(_ticks(time[0], time[-1], (time[-1] - time[0]) / 8 or 1))
    axes.grid(axis="y", color=LINE, linewidth=0.8, zorder=1)
    axes.set_axisbelow(True)
    axes.set_frame_on(False)
    axes.tick_params(
        length=0, labelsize=9.5, labelcolor=SOFT, pad=5, labelbottom=is_last, bottom=is_last
    )
    if is_last:
        shaded = "shaded: turns      " if view["summary"]["turns"] else ""
        axes.set_xlabel(f"{shaded}time, s", color=SOFT, size=9.5, labelpad=3, loc="right")


def _write_caption(
    figure: "Figure", start: tuple[float, float], width: float, strip: _Strip
) -> None:
    """Write the strip's name at `start` and, where it has two curves, the key at the other end."""
    x, y = start
    name = figure.text(x, y, f"{strip.name}, {strip.unit}", color=INK, size=10.5, va="center")
    name.set_fontweight("bold")
    if strip.command is None:
        return
    right = x + width
    _draw_line(figure, [(right - 0.145, y), (right - 0.13, y)], strip.colour, 1.8)
    figure.text(right - 0.125, y, "actual", color=SOFT, size=9.5, va="center")
    _draw_line(figure, [(right - 0.075, y), (right - 0.057, y)], INK, 0.9, _DASHES)
    figure.text(right, y, "command", color=SOFT, size=9.5, va="center", ha="right")


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is at least `least` (> 0)."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.9999 * least)


def _ticks(low: float, high: float, least_step: float) -> list[float]:
    """Return the round numbers from `low` to `high`, at least `least_step` apart."""
    step = nice_step(least_step)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [step * k for k in range(first, last + 1)]


class Painter:
    """A process that prepares to draw while the drive is still computed.

    Importing Matplotlib takes as long as a short drive. The process writes no file: if this program
    ends early, nothing is left that could write to a run's folder.
    """

    def __init__(self) -> None:
        """Start the process."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "countersteer.viewing.picture"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C stops the drive only
        )

    def draw(self, view: dict[str, Any]) -> None:
        """Begins `picture_png`, over there."""
        self._view = json.dumps(view, default=np.ndarray.tolist).encode()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        self._png, self._errors = self._process.communicate(self._view)

    def cancel(self) -> None:
        """Nothing is drawn."""
        self._process.communicate(b"")

    def finish(self, path: pathlib.Path) -> None:
        """Waits until it is drawn, and writes it. Raises `OSError` with the reason if it failed."""
        self._thread.join()
        if self._process.returncode:
            words = self._errors.decode(errors="replace").strip().splitlines() or ["it was ended"]
            raise OSError(f"the picture was not drawn: {words[-1]}")
        write_whole(path, self._png)


if __name__ == "__main__":
    # While the view is waited for: imports, fonts and the rest of a first drawing.
    figure, canvas = new_figure(1, 1)
    figure.add_axes((0.3, 0.3, 0.6, 0.6)).set_title("first", weight="bold")
    canvas.print_png(io.BytesIO())
    gc.freeze()
    gc.disable()  # a tenth of a drawing would go into looking for garbage
    text = sys.stdin.buffer.read()
    if text:
        sys.stdout.buffer.write(picture_png(json.loads(text)))
        sys.stdout.flush()
    os._exit(0)  # as `cli.entry`
