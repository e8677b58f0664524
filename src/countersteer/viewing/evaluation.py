"""The results of an evaluation, as a picture."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from countersteer.task.judge import DRIFT, Outcome, Score
from countersteer.viewing.style import MOST_RUNS, styled
from countersteer.writing import whole

LINES = ("-", "--", ":")


def draw_evaluation(scores: Mapping[str, Score], title: str, path: Path) -> None:
    """Draw heading errors, peak sideslip and lap times of the successful trials, by driver.

    A value beyond the axes, such as that of a turn that ended in a spin, counts in the outermost
    bin.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with styled(), whole(path) as part:
        figure, (errors, slips, laps) = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
        for i, (name, score) in enumerate(scores.items()):
            won, turns = score.outcome == Outcome.REACHED.code, score.turns
            if not np.any(won):
                continue
            counted = won[:, None] & np.isfinite(turns.begin)
            dashes = LINES[i // MOST_RUNS % len(LINES)]  # the colours begin again
            drawn = {"histtype": "step", "linewidth": 1.5, "label": name, "linestyle": dashes}
            for axes, values, bins in (
                (errors, np.degrees(turns.error[counted]), np.linspace(-10, 10, 41)),
                (slips, np.degrees(turns.peak_sideslip[counted]), np.linspace(0, 70, 36)),
            ):
                axes.hist(np.clip(values, bins[0], bins[-1]), bins=bins, **drawn)
            laps.hist(score.goal_time[won], bins=40, **drawn)
        drift = math.degrees(DRIFT)
        slips.axvline(drift, color="grey", linewidth=0.8, label=f"a drift: over {drift:.0f}°")
        slips.legend(handles=slips.lines, fontsize=8)
        for axes, name in (
            (errors, "heading error at a turn's end, ° (ends: and beyond)"),
            (slips, "peak sideslip of a turn, ° (end: and beyond)"),
            (laps, "time to the goal, s"),
        ):
            axes.set_xlabel(name)
        errors.set_ylabel("turns of successes")
        laps.set_ylabel("successes")
        if errors.get_legend_handles_labels()[0]:
            errors.legend(frameon=False, fontsize=8)
        figure.suptitle(title)
        figure.savefig(part, format="png", dpi=110)
    plt.close(figure)
