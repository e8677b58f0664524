"""A log compared with its simulation, as a picture."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from countersteer.runs.defects import stretches
from countersteer.tuning.compare import Window
from countersteer.tuning.windows import EARLY, QUANTITIES
from countersteer.viewing.style import (
    INK,
    MEASURED,
    SIMULATED,
    SOFT,
    Prediction,
    draw_commands,
    draw_windows,
    dress,
    light,
    new_figure,
)
from countersteer.writing import whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE_IN = (14.0, 9.0)
_RELEASED = light("turn")
_DOUBT = light("bad")
_LONGEST_LINE = 150  # characters of a warning
_NAMES = {
    "vx_mps": ("Forward velocity", "m/s"),
    "vy_mps": ("Lateral velocity, left positive", "m/s"),
    "yaw_rate_radps": ("Yaw rate, left positive", "rad/s"),
    "wheel_speed_mps": ("Wheel speed", "m/s"),
}
_SHOWN_EVERY = 1.0  # s between drawn windows
_LEFT, _RIGHT, _TOP, _BOTTOM, _CAPTION = 0.055, 0.955, 0.885, 0.065, 0.033  # parts of the figure


def draw_comparison(series: Mapping[str, Any], path: Path) -> None:
    """Write the series of `compare` to `path` as PNG: measured against simulated.

    One window a second is drawn at most, with a dot at its start. An existing file is replaced.
    """
    figure, canvas = new_figure(*_SIZE_IN)
    result = series["result"]
    shown = _apart(series["starts_s"], max(_SHOWN_EVERY, result["horizon_s"]))
    _write_headline(figure, series["title"], result, len(shown))
    names = [name for name in QUANTITIES if name in series["measured"]]
    pitch = (_TOP - _BOTTOM) / (len(names) + 1)
    for k, name in enumerate([*names, "commands"]):
        bottom = _TOP - (k + 1) * pitch
        axes = figure.add_axes((_LEFT, bottom, _RIGHT - _LEFT, pitch - _CAPTION - 0.008))
        _dress(axes, series, is_last=name == "commands")
        if name == "commands":
            commands = series["commands"]
            steering = np.degrees(commands["steering"])
            draw_commands(axes, commands, steering)
            _write_caption(figure, bottom + pitch, "Commands", "")
            continue
        signal = series["measured"][name]
        draw_windows(axes, signal.time, signal.value, _predictions(series, name, shown))
        title, unit = _NAMES[name]
        _write_caption(figure, bottom + pitch, f"{title}, {unit}", _errors(result, name, unit))
    with whole(path) as part:
        canvas.print_png(str(part))


def _apart(starts: list[float], least: float) -> list[int]:
    """The indices of windows whose starts are at least `least` (s) apart."""
    chosen: list[int] = []
    for i, start in enumerate(starts):
        if not chosen or start >= starts[chosen[-1]] + least - EARLY:
            chosen.append(i)
    return chosen


def _errors(result: Mapping[str, Any], name: str, unit: str) -> str:
    """Both errors of a quantity as a text, with those of persistence in brackets."""
    if name not in result["rmse"]:
        return ""
    still, errors = result["persistence"], []
    for words, key in (("median at the end", "median_abs_error"), ("RMS", "rmse")):
        errors.append(f"{words} {result[key][name]:.2f}  ({still[key][name]:.2f})")
    return f"error, {unit}:   " + "     ".join(errors)


def _write_headline(figure: "Figure", title: str, result: Mapping[str, Any], shown: int) -> None:
    """Write the title, the number of windows and the key across the top."""
    from matplotlib.lines import Line2D

    figure.text(_LEFT, 0.962, title, color=INK, size=15, weight="bold", va="center")
    count, seconds = result["windows"], f"{result['horizon_s']:.3g} s"
    windows = f"One window of {seconds}."
    if count > 1:
        drawn = "" if shown == count else f", {shown} of them drawn"
        lively = result["transient"]["windows"]
        windows = f"{count} windows of {seconds}{drawn}; something changes in {lively}."
    figure.text(
        _LEFT,
        0.927,
        f"{windows}   In brackets: the errors of predicting that nothing changes.",
        color=SOFT,
        size=10.5,
        va="center",
    )
    warnings = result["warnings"]
    if warnings:
        more = f" (and {len(warnings) - 1} more)" if len(warnings) > 1 else ""
        line = "Warning: " + warnings[0]
        figure.text(
            _LEFT,
            0.9,
            (line[:_LONGEST_LINE] + "…" if len(line) > _LONGEST_LINE else line) + more,
            color=_DOUBT,
            size=9.5,
            va="center",
            parse_math=False,
        )
    for right, words, colour in (
        (0.845, "measured", MEASURED),
        (_RIGHT, "simulated", SIMULATED),
    ):
        figure.text(right, 0.927, words, color=colour, size=11, va="center", ha="right")
        figure.add_artist(
            Line2D(
                [right - 0.085, right - 0.063],
                [0.927] * 2,
                color=colour,
                linewidth=2.4,
                marker="o" if colour == SIMULATED else None,
                markersize=5,
                markevery=[0],
            )
        )


def _write_caption(figure: "Figure", top: float, left: str, right: str) -> None:
    """Write the quantity and its errors above a strip."""
    y = top - _CAPTION / 2 - 0.004
    figure.text(_LEFT, y, left, color=INK, size=10.5, weight="bold", va="center")
    figure.text(_RIGHT, y, right, color=SOFT, size=10, va="center", ha="right")


def _dress(axes: "Axes", series: Mapping[str, Any], is_last: bool) -> None:
    """Prepare a strip: the log's time axis, grey where the dead-man switch is released."""
    time = series["commands"]["time_s"]
    end = max(float(time[-1]), float(time[0]) + 1e-3)
    axes.set_xlim(float(time[0]), end)
    armed = series["armed"]
    if armed is not None:
        until = np.append(armed.time[1:], end)
        for first, last in stretches(armed.value < 0.5):
            span = (armed.time[first], until[last])
            axes.axvspan(*span, color=_RELEASED, linewidth=0, zorder=0)
    dress(axes)
    axes.tick_params(pad=5, labelbottom=is_last)
    axes.locator_params(axis="y", nbins=5)
    if is_last:
        axes.set_xlabel("time, s  (grey: dead-man switch released)", color=SOFT, size=9.5)


def _predictions(
    series: Mapping[str, Any], name: str, shown: Iterable[int]
) -> Iterator[Prediction]:
    """The drawn windows that have the quantity, each from its start."""
    for i in shown:
        window: Window = series["windows"][i]
        if name in window:
            one = window[name]
            yield Prediction(
                np.concatenate([[series["starts_s"][i]], one.time]),
                np.concatenate([one.unchanged[:1], one.simulated]),
            )
