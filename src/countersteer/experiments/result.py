"""The result of an experiment, and its files."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.runs.files import csv_text
from countersteer.viewing.style import styled
from countersteer.writing import whole, write_whole

Report = Callable[[int, int], None]


def silent(done: int, of: int) -> None:
    """Ignore progress."""


class Result(NamedTuple):
    """A table (columns by name, with units), figures for JSON, a paragraph and a picture."""

    table: Mapping[str, Sequence[Any] | np.ndarray]
    figures: dict[str, Any]
    text: str
    draw: Callable[[Any], None]  # draws on a matplotlib figure
    size: tuple[float, float] = (10.0, 4.0)  # inches


def write(found: Result, folder: Path, name: str) -> dict[str, Any]:
    """Write NAME.csv, NAME.png and summary.json. Returns the content of summary.json."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    result = {"experiment": name, **found.figures, "text": found.text}
    rows = zip(*found.table.values(), strict=True)
    with (
        styled(),
        whole(folder / "summary.json") as summary,
        whole(folder / f"{name}.png") as picture,
    ):
        figure = plt.figure(figsize=found.size, layout="constrained")
        found.draw(figure)
        write_whole(folder / f"{name}.csv", csv_text(list(found.table), rows))
        figure.savefig(picture, format="png", dpi=110)
        text = json.dumps(result, indent=1, ensure_ascii=False) + "\n"
        write_whole(summary, text)
    plt.close(figure)
    return result
