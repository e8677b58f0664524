"""Tables in CSV files: columns as arrays, read strictly and written so that they round-trip."""

import csv
import io
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.content import read_text, reading
from countersteer.reading.values import short, shown
from countersteer.writing import naming, write_whole

log = logging.getLogger(__name__)

COMMANDS = ("time_s", "throttle", "direction", "steering_deg")
COVARIANCE = ("xx_m2", "xy_m2", "yy_m2")  # of the place; zeros: unknown
# What the pilot takes for its motion, in the axes of the ground truth.
ESTIMATE = (
    "time_s", "x_m", "y_m", "heading_rad", "vx_mps", "vy_mps", "yaw_rate_radps", *COVARIANCE,
)  # fmt: skip
# Places on each path that a planner looked at, one path after the other; 0 is its plan.
ROLLOUTS = ("time_s", "rollout", "cost", "x_m", "y_m")
LARGEST_STEERING = 90.0  # degrees
LATEST = 1e6  # s, of a time; a clock of Unix time is beyond
LONGEST = 3600.0  # s, of what is simulated on the commands of a log
LARGEST = 1e20  # of a finite cell of a run; sums of squares of larger ones leave the floats
MOST_COLUMNS = 10_000


class Table(dict[str, np.ndarray]):
    """Columns by name, all of one length; `time_s` never falls."""

    def __len__(self) -> int:
        """The number of rows."""
        return len(next(iter(self.values()))) if self.keys() else 0


def read_table(
    path: Path, required: Iterable[str], text: Sequence[str] = (), recorded: bool = False
) -> Table:
    """Read a CSV file with a header as columns of numbers; empty cells are NaN.

    Columns named in `text` stay text. A last line that was cut off, by a killed process, is left
    out with a logged warning: one with too few cells, or, if `TableWriter` `recorded` the file, one
    that does not end. Raises `InputError` if a column is missing or appears twice; and, with the
    line, for a wrong number of cells, a cell that is no number, or a falling time.
    """
    with reading(path):
        return _read_table(path, required, text, recorded)


def _read_table(path: Path, required: Iterable[str], text: Sequence[str], recorded: bool) -> Table:
    content = read_text(path)
    lines = content.splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    whole = content.endswith("\n") or len(lines) < 2
    if not whole and (recorded or lines[-1].count(",") < lines[0].count(",")):
        log.warning("%s: its last line, cut off in the middle, is passed over", path)
        lines = lines[:-1]
    rows = _cells(path, lines)
    header = next(rows, [])
    missing = [name for name in required if name not in header]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing")
    if len(set(header)) != len(header):
        raise InputError(f"{path}: a column is there twice")
    if len(header) > MOST_COLUMNS:
        raise InputError(f"{path}: {len(header)} columns, over {MOST_COLUMNS}")
    columns: list[list[float]] = [[] for _ in header]
    words: list[list[str]] = [[] for _ in header]
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise InputError(f"{path}, line {number}: {len(row)} cells, not {len(header)}")
        for i, (name, cell) in enumerate(zip(header, row, strict=True)):
            if name in text:
                words[i].append(cell)
                continue
            try:
                columns[i].append(float(cell) if cell else math.nan)
            except ValueError:
                raise InputError(
                    f"{path}, line {number}: {short(name)} must be a number, not {shown(cell)}"
                ) from None
    table = Table(
        {name: np.array(words[i] if name in text else columns[i]) for i, name in enumerate(header)}
    )
    if "time_s" in table:
        time = table["time_s"]
        if not np.all(np.isfinite(time)):
            raise InputError(f"{path}, line {_first(~np.isfinite(time))}: time_s is not a number")
        if np.any(np.abs(time) > LATEST):
            line, first = _first(np.abs(time) > LATEST), time[np.argmax(np.abs(time) > LATEST)]
            raise InputError(
                f"{path}, line {line}: time_s must be within {LATEST:g} s of 0, not {first:.10g}: "
                "if it is Unix time, subtract the time at which the log begins from all its tables"
            )
        if np.any(np.diff(time) < 0):
            line = _first(np.diff(time) < 0) + 1
            raise InputError(f"{path}, line {line}: time_s goes backwards")
    return table


def _cells(path: Path, lines: list[str]) -> Iterator[list[str]]:
    """The rows of a CSV file. Raises `InputError` if it is none."""
    try:
        yield from csv.reader(lines)
    except csv.Error as error:
        raise InputError(f"{path}: it is no CSV file: {short(str(error))}") from None


def _first(where: np.ndarray) -> int:
    """The line in the file of the first row for which `where` is true."""
    return int(np.argmax(where)) + 2


def read_measurements(path: Path, required: Iterable[str], recorded: bool = False) -> Table:
    """Read a table of a run. Raises `InputError` for a finite number beyond `LARGEST` too.

    `recorded` is as in `read_table`.
    """
    table = read_table(path, required, recorded=recorded)
    for name, column in table.items():
        beyond = np.isfinite(column) & (np.abs(column) > LARGEST)
        if np.any(beyond):
            raise InputError(
                f"{path}, line {_first(beyond)}: {short(name)} must be in "
                f"[-{LARGEST:g}, {LARGEST:g}], not {column[np.argmax(beyond)]:g}"
            )
    return table


def read_commands(path: Path, recorded: bool = False) -> Table:
    """Read a `commands.csv` as `time_s`, `throttle` (negative in reverse) and `steering` (rad).

    `recorded` is as in `read_table`.
    """
    table = read_table(path, COMMANDS, text=("direction",), recorded=recorded)
    for name in table:
        if name not in COMMANDS:
            raise InputError(f"{path}: unknown column {short(name)}; known: {', '.join(COMMANDS)}")
    if not len(table):
        raise InputError(f"{path}: holds no command")
    throttle, steering = table["throttle"], table["steering_deg"]
    for wrong, message in (
        (
            ~np.isin(table["direction"], ("forward", "reverse")),
            "direction must be forward or reverse",
        ),
        (~((throttle >= 0) & (throttle <= 1)), "throttle must be in [0, 1]"),
        (
            ~(np.abs(steering) <= LARGEST_STEERING),
            f"steering_deg must be in [-{LARGEST_STEERING:g}, {LARGEST_STEERING:g}]",
        ),
        (table["time_s"] < 0, "time_s must not be negative"),
    ):
        if np.any(wrong):
            raise InputError(f"{path}, line {_first(wrong)}: {message}")
    sign = np.where(table["direction"] == "reverse", -1.0, 1.0)
    return Table(time_s=table["time_s"], throttle=sign * throttle, steering=np.radians(steering))


def command_rows(time: np.ndarray, throttle: np.ndarray, steering: np.ndarray) -> list[list[str]]:
    """Rows of a `commands.csv`; throttle is negative in reverse, steering in rad."""
    degrees = np.degrees(np.asarray(steering, float))
    return [
        [_cell(t), _cell(abs(u)), "reverse" if u < 0 else "forward", _cell(d)]
        for t, u, d in zip(time.tolist(), throttle.tolist(), degrees.tolist(), strict=True)
    ]


def column_rows(columns: Iterable[np.ndarray]) -> list[list[str]]:
    """Rows of numbers; NaN is an empty cell, infinity is `inf`."""
    return [[_cell(v) for v in row] for row in zip(*(c.tolist() for c in columns), strict=True)]


def _cell(value: float) -> str:
    """The shortest text that reads back as the same number; empty for NaN."""
    return "" if value != value else repr(value).removesuffix(".0")


class TableWriter:
    """Writes a CSV file piece by piece. Flushed rows stay readable after a crash."""

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        """Create or overwrite the file, and write its header."""
        self._path = path
        self._file: TextIO = path.open("w", newline="")
        self._file.write(",".join(header) + "\n")
        self._file.flush()

    def write(self, rows: Iterable[Sequence[str]]) -> None:
        """Append rows and pass them to the operating system."""
        with naming(self._path):
            self._file.write("".join(",".join(row) + "\n" for row in rows))
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        with naming(self._path):
            self._file.close()


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write a whole table at once."""
    write_whole(path, csv_text(list(columns), column_rows(columns.values())))


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]], digits: int = 6) -> str:
    """The text of a CSV file. Words and whole numbers stay as they are, NaN is an empty cell."""

    def cell(value: Any) -> str:
        if isinstance(value, str):
            return value
        if isinstance(value, int | np.integer):
            return str(int(value))
        return "" if math.isnan(value) else f"{float(value):.{digits}g}"

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([cell(value) for value in row] for row in rows)
    return text.getvalue()


def require(place: Callable[[int], str], good: np.ndarray, message: str) -> None:
    """Raise `InputError` for the first row that is not good; `place` gives the row's place."""
    if not np.all(good):
        raise InputError(f"{place(int(np.argmin(good)))}: {message}")
