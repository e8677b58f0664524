"""How learning went: its figures as a table, and drawn."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from countersteer.runs.files import csv_text
from countersteer.viewing.style import new_figure, styled
from countersteer.writing import whole, write_whole

Curves = Sequence[dict[str, float]]


def save(
    curves: Curves, policy: Path, title: str, along: str, unit: tuple[str, float], panels: Any
) -> None:
    """Write `.csv` and `.png` beside a policy.

    `curves` are rows of figures by name. `along` names the one to draw along, `unit` its label and
    size. `panels` are four lists of names, drawn in one panel each.
    """
    columns = list(curves[0])
    rows = [[told[name] for name in columns] for told in curves]
    write_whole(policy.with_suffix(".csv"), csv_text(columns, rows))
    label, size = unit
    done = [told[along] / size for told in curves]
    with styled(), whole(policy.with_suffix(".png")) as part:
        figure, canvas = new_figure(9.0, 6.0)
        figure.set_layout_engine("constrained")
        for ax, names in zip(figure.subplots(2, 2).flat, panels, strict=True):
            for name in names:
                ax.plot(done, [told[name] for told in curves], label=name)
            ax.set_xlabel(label)
            ax.legend(fontsize=7)
        figure.suptitle(title)
        canvas.print_png(str(part))
