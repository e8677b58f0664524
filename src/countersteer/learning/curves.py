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
        figure, canvas = new_figure(10.0, 6.0)
        figure.set_layout_engine("constrained")
        for ax, names in zip(figure.subplots(2, 2).flat, panels, strict=True):
            drawn: set[Any] = set()
            for name in names:
                (line,) = ax.plot(done, [told[name] for told in curves], label=name)
                # Colours that come round again are told apart by dashes.
                line.set_linestyle("--" if line.get_color() in drawn else "-")
                drawn.add(line.get_color())
            ax.set_xlabel(label)
            many = len(names) > 4  # they would hide the lines
            place = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)} if many else {}
            ax.legend(fontsize=7, **place)
        figure.suptitle(title)
        canvas.print_png(str(part))
