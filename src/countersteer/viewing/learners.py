"""How learners went: metres that they come, over what they drove and over CPU time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from countersteer.viewing.style import (
    INK,
    LABEL,
    MEASURED,
    SIMULATED,
    SOFT,
    STEERED,
    dress,
    new_figure,
)
from countersteer.writing import naming

COLOURS = {"exploring": STEERED, "greedy": SIMULATED}
NAMES = {"exploring": "online, with random actions", "greedy": "online, without"}


class Learners(NamedTuple):
    """How learners of one kind went: arrays (learners, tests)."""

    driven: np.ndarray  # s, (tests,)
    metres: np.ndarray  # that a test came, without random actions
    cpu: np.ndarray  # s of CPU a learner, (tests,)


def draw_learners(
    found: Mapping[str, Learners], sweeps: Sequence[tuple[float, float]], title: str, file: Path
) -> None:
    """Draw each learner thin, the median thick; `sweeps` are (CPU seconds, metres) of the table."""
    figure, canvas = new_figure(12.0, 4.6)
    driven, spent = figure.subplots(
        1, 2, sharey=True,
        gridspec_kw={"left": 0.06, "right": 0.98, "bottom": 0.13, "top": 0.84, "wspace": 0.06},
    )  # fmt: skip
    for name, curves in found.items():
        for axes, time in ((driven, curves.driven), (spent, curves.cpu)):
            axes.plot(time, curves.metres.T, color=COLOURS[name], linewidth=0.6, alpha=0.5)
            middle = np.median(curves.metres, axis=0)
            axes.plot(time, middle, color=COLOURS[name], linewidth=2.2, label=NAMES[name])
    spent.step(*zip(*sweeps, strict=True), where="post", color=INK, marker="o", markersize=3,
               linewidth=1.4, label="dynamic programming, a mark a sweep")  # fmt: skip
    spent.set_xscale("log")
    for axes, label in (
        (driven, "driven, s"),
        (spent, "CPU time of a learner, s (compiling counts)"),
    ):
        dress(axes)
        axes.set_xlabel(label, fontsize=LABEL, color=SOFT)
        axes.axhline(0, color=MEASURED, linewidth=0.8)
    driven.set_ylabel("metres in 10 s from rest, up to a touch", fontsize=LABEL, color=SOFT)
    spent.legend(frameon=False, fontsize=LABEL, labelcolor=INK)
    figure.text(0.02, 0.92, title, fontsize=14, color=INK, weight="semibold")
    with naming(file):
        canvas.print_png(str(file))
