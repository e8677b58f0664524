"""The result of an experiment, and its files."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

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

    lines = [",".join(found.table)]
    lines += [
        ",".join(_cell(value) for value in row) for row in zip(*found.table.values(), strict=True)
    ]
    (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    figure = plt.figure(figsize=found.size, layout="constrained")
    found.draw(figure)
    figure.savefig(folder / f"{name}.png", dpi=110)
    plt.close(figure)
    result = {"experiment": name, **found.figures, "text": found.text}
    (folder / "summary.json").write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    return result


def _cell(value: Any) -> str:
    """A number with six digits, an empty cell for NaN, or a word."""
    if isinstance(value, str):
        return value
    number = float(value)
    return "" if math.isnan(number) else f"{number:.6g}"
