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
SPEED_COMMANDS = ("time_s", "speed_mps", "steering_deg")  # of a car with a speed controller
COVARIANCE = ("xx_m2", "xy_m2", "yy_m2")  # of the place; zeros: unknown
# What the pilot takes for its motion, in the axes of the ground truth.
ESTIMATE = (
    "time_s", "x_m", "y_m", "heading_rad", "vx_mps", "vy_mps", "yaw_rate_radps", *COVARIANCE,
)  # fmt: skip
# Places on each path that a planner looked at, one path after the other; 0 is its plan.
ROLLOUTS = ("time_s", "rollout", "cost", "x_m", "y_m")
LARGEST_STEERING = 90.0  # degrees
FASTEST = 100.0  # m/s, of a commanded speed
LATEST = 1e6  # s, of a time; a clock of Unix time is beyond
CLOCKS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
SLOWEST_CLOCK = 0.5  # s between rows; nothing that a car logs is so slow
UNIX = (4e8, 4e9)  # s; a clock in this range counts from 1970
LONGEST = 3600.0  # s, of what is simulated on the commands of a log
LARGEST = 1e20  # of a finite cell of a run; sums of squares of larger ones leave the floats
MOST_COLUMNS = 10_000


class Table(dict[str, np.ndarray]):
    """Columns by name, all of one length; `time_s` never falls."""

    def __len__(self) -> int:
        """The number of rows."""
        return len(next(iter(self.values()))) if self.keys() else 0


def read_table(
    path: Path,
    required: Iterable[str],
    text: Sequence[str] = (),
    recorded: bool = False,
    any_clock: bool = False,
) -> Table:
    """Read a CSV file with a header as columns of numbers; empty cells are NaN.

    Columns named in `text` stay text. With `any_clock`, times may be far from 0.

    A last line that was cut off, by a killed process, is left out with a logged warning: one with
    too few cells, or, if `TableWriter` `recorded` the file, one that does not end. Raises
    `InputError` if a column is missing or appears twice; and, with the line, for a wrong number of
    cells, a cell that is no number, or a falling time.
    """
    with reading(path):
        return _read_table(path, required, text, recorded, any_clock)


def _read_table(
    path: Path, required: Iterable[str], text: Sequence[str], recorded: bool, any_clock: bool
) -> Table:
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
        latest = LARGEST if any_clock else LATEST
        if np.any(np.abs(time) > latest):
            line, first = _first(np.abs(time) > latest), time[np.argmax(np.abs(time) > latest)]
            raise InputError(
                f"{path}, line {line}: time_s must be within {latest:g} s of 0, not {first:.10g}: "
                f"{clock_mistake(time)}"
            )
        if np.any(np.diff(time) < 0):
            line = _first(np.diff(time) < 0) + 1
            raise InputError(f"{path}, line {line}: time_s goes backwards")
    return table


def clock_mistake(time: np.ndarray) -> str:
    """What a clock seems to count, if not seconds from 0, and what to do about it."""
    begins = "'countersteer import run' moves the clock of all its tables to 0"
    first = abs(float(time[0]))
    for unit, factor in CLOCKS.items():
        if UNIX[0] <= first / factor <= UNIX[1]:
            convert = "" if factor == 1 else f", in {unit}: convert it to seconds, and"
            return f"it seems to be Unix time{convert or ':'} {begins}"
    steps = np.diff(time)
    step = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for unit, factor in CLOCKS.items():
        if step / factor < SLOWEST_CLOCK:
            return begins if factor == 1 else f"is it in {unit}? Convert it to seconds"
    return begins


def merged_rows(table: Table) -> Table:
    """The table with rows of one time merged, where they fill different columns or agree.

    A log that is written topic by topic has such rows. Rows that contradict each other stay.
    """
    time = table["time_s"]
    if not np.any(np.diff(time) == 0):
        return table
    group = np.cumsum(np.diff(time, prepend=time[:1]) > 0)
    count = int(group[-1]) + 1
    conflict = np.zeros(count, bool)
    filled = {}
    for name, values in table.items():
        there = np.flatnonzero(~np.isnan(values))
        groups, first = np.unique(group[there], return_index=True)
        whole = np.full(count, math.nan)
        whole[groups] = values[there[first]]
        conflict[group[there[values[there] != whole[group[there]]]]] = True
        filled[name] = whole[group]
    kept = conflict[group] | (np.diff(group, prepend=-1) > 0)
    return Table(
        {
            name: np.where(conflict[group], values, filled[name])[kept]
            for name, values in table.items()
        }
    )


def _cells(path: Path, lines: list[str]) -> Iterator[list[str]]:
    """The rows of a CSV file. Raises `InputError` if it is none."""
    try:
        yield from csv.reader(lines)
    except csv.Error as error:
        raise InputError(f"{path}: it is no CSV file: {short(str(error))}") from None


def _first(where: np.ndarray) -> int:
    """The line in the file of the first row for which `where` is true."""
    return int(np.argmax(where)) + 2


def read_measurements(
    path: Path, required: Iterable[str], recorded: bool = False, any_clock: bool = False
) -> Table:
    """Read a table of a run, with `merged_rows`.

    Raises `InputError` for a finite number beyond `LARGEST` too. `recorded` and `any_clock` are as
    in `read_table`.
    """
    table = read_table(path, required, (), recorded, any_clock)
    for name, column in table.items():
        beyond = np.isfinite(column) & (np.abs(column) > LARGEST)
        if np.any(beyond):
            raise InputError(
                f"{path}, line {_first(beyond)}: {short(name)} must be in "
                f"[-{LARGEST:g}, {LARGEST:g}], not {column[np.argmax(beyond)]:g}"
            )
    return merged_rows(table)


def read_commands(path: Path, recorded: bool = False, any_clock: bool = False) -> Table:
    """Read a `commands.csv` as `time_s`, `throttle` (negative in reverse) and `steering` (rad).

    If it commands speeds, `speed` (m/s, negative in reverse) stands in place of `throttle`. A
    direction is optional there. `recorded` and `any_clock` are as in `read_table`.
    """
    table = read_table(path, ("time_s", "steering_deg"), ("direction",), recorded, any_clock)
    by_speed = "speed_mps" in table
    known = {*SPEED_COMMANDS, "direction"} if by_speed else COMMANDS
    for name in table:
        if by_speed and name == "throttle":
            raise InputError(f"{path}: columns throttle and speed_mps: give one of the two")
        if name not in known:
            words = ", ".join((*COMMANDS, "speed_mps"))
            raise InputError(f"{path}: unknown column {short(name)}; known: {words}")
    for name in SPEED_COMMANDS if by_speed else COMMANDS:
        if name not in table:
            raise InputError(f"{path}: column {name} is missing")
    if not len(table):
        raise InputError(f"{path}: holds no command")
    asked, steering = table["speed_mps" if by_speed else "throttle"], table["steering_deg"]
    direction = table.get("direction", np.full(len(table), "forward"))
    reverse = direction == "reverse"
    for wrong, message in (
        (~np.isin(direction, ("forward", "reverse")), "direction must be forward or reverse"),
        (
            ~((asked >= 0) & (asked <= 1)) & (not by_speed),
            "throttle must be in [0, 1]; a speed in m/s goes into a column speed_mps",
        ),
        (
            ~(np.abs(asked) <= FASTEST) & by_speed,
            f"speed_mps must be in [-{FASTEST:g}, {FASTEST:g}]",
        ),
        ((asked < 0) & reverse, "speed_mps is negative and direction is reverse: give one of them"),
        (
            ~(np.abs(steering) <= LARGEST_STEERING),
            f"steering_deg must be in [-{LARGEST_STEERING:g}, {LARGEST_STEERING:g}]",
        ),
        ((table["time_s"] < 0) & (not any_clock), "time_s must not be negative"),
    ):
        if np.any(wrong):
            raise InputError(f"{path}, line {_first(wrong)}: {message}")
    column = {drive_column(table): np.where(reverse, -1.0, 1.0) * asked}
    return Table(time_s=table["time_s"], **column, steering=np.radians(steering))


def drive_column(commands: Iterable[str]) -> str:
    """The column that commands the motor: `speed` of a car commanded in m/s, else `throttle`."""
    return "speed" if {"speed", "speed_mps"} & set(commands) else "throttle"


def speed_rows(time: np.ndarray, speed: np.ndarray, steering: np.ndarray) -> list[list[str]]:
    """Rows of a `commands.csv` with speeds (m/s); steering in rad."""
    return column_rows((time, speed, np.degrees(np.asarray(steering, float))))


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
