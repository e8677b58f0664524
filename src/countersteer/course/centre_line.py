"""Closed courses from centre lines with widths: the CSV files of F1TENTH and its relatives."""

import contextlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from countersteer.course.course import Course, from_track, walls_around
from countersteer.errors import InputError
from countersteer.reading.content import read_text
from countersteer.reading.values import number, short

COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")  # in this order without a header
EDGES = ("x_right_m", "y_right_m", "x_left_m", "y_left_m")  # instead: points of both walls
# Other names for them: `x_ref_m`, `width_right_m`, `d_right_iqp` … A unit is metres, or not named.
NAMES = {
    "x_m": r"x(_ref|_cent(er|re))?(_m)?",
    "y_m": r"y(_ref|_cent(er|re))?(_m)?",
    "w_tr_right_m": r"(w|w_tr|width|d)_right(_iqp)?(_m)?",
    "w_tr_left_m": r"(w|w_tr|width|d)_left(_iqp)?(_m)?",
} | {name: name.removesuffix("_m") + "(_m)?" for name in EDGES}
SAME = 1e-3  # m within which two points count as one
TOLERANCE = 0.01  # of the mean width: largest distance of walls from the corridor's true edge
MOST_POINTS = 20_000
LARGEST = 10  # MB
NARROWEST, WIDEST, FARTHEST = 0.05, 1e3, 1e5  # m
OPEN = 5.0  # so many times as far as between any two other points: the ends of an open line
FEW = 8  # points, below which no column is told to be a heading or a distance by chance
ALIKE = 0.95  # of the line's length, that its steps sum up to once they are turned back


def read_centre_line(path: Path) -> Course:
    """The closed course along a centre line, starting at its first point.

    A row is a point with the room to its right and to its left, split by commas, semicolons or
    blanks. A header, also in a comment, names the columns: `COLUMNS` in any order, among others, or
    by another of their `NAMES`. `EDGES` may stand for them. Without a header there are four
    columns. The corridor is the area that its cross-sections sweep, each from wall to wall. So no
    wall stands in it, even if a bend is tighter inside than the room there. The walls are within
    `TOLERANCE` of its true edge.

    Raises `InputError` naming file and line. Way points and race lines, which have no widths, are
    refused, also if they have no header and four columns.
    """
    rows, places, by_edges = _rows(path)
    if by_edges:
        right, left = rows[:, :2], rows[:, 2:]
        points = (right + left) / 2
        sides = np.repeat(np.hypot(*(right - left).T)[:, None] / 2, 2, axis=1)
    else:
        points, sides = rows[:, :2], rows[:, 2:]
    _check_widths(sides, places)
    fresh = np.hypot(*(points - np.roll(points, -1, axis=0)).T) > SAME
    points, sides = points[fresh], sides[fresh]
    if not 3 <= len(points) <= MOST_POINTS:
        raise InputError(f"{path}: {len(points)} points that differ, not 3 to {MOST_POINTS}")
    steps = np.roll(points, -1, axis=0) - points
    gap, longest = np.hypot(*steps[-1]), np.max(np.hypot(*steps[:-1].T))
    if gap > OPEN * longest:
        raise InputError(
            f"{path}: no lap: the last point is {gap:.3g} m from the first one, and other points "
            f"at most {longest:.3g} m from the next"
        )
    if not shapely.LinearRing(points).is_simple:
        raise InputError(f"{path}: the centre line crosses itself")
    if by_edges:
        right, left = right[fresh], left[fresh]
    else:
        along = steps + np.roll(steps, 1, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        right, left = points - sides[:, :1] * normal, points + sides[:, 1:] * normal
    following = [np.roll(side, -1, axis=0) for side in (left, right)]
    swept = shapely.convex_hull(shapely.linestrings(np.stack([right, left, *following], axis=1)))
    tolerance = TOLERANCE * float(np.mean(np.sum(sides, axis=1)))
    # Slivers between pieces that nearly touch are not walls.
    corridor: Any = shapely.union_all(swept)
    holes = [h for h in corridor.interiors if not shapely.Polygon(h).buffer(-tolerance).is_empty]
    if not holes:
        raise InputError(f"{path}: the widths leave no wall inside the lap")
    area: Any = shapely.Polygon(corridor.exterior, holes).simplify(tolerance)
    return from_track(path.stem, points, sides, walls_around(area, str(path)))


def _rows(path: Path) -> tuple[np.ndarray, list[str], bool]:
    """The numbers of the file (n, 4), where each row stands, and whether they are of `EDGES`."""
    lines = read_text(path, LARGEST).splitlines()
    begin = next((i for i, line in enumerate(lines) if _is_data(line)), len(lines))
    first = lines[begin] if begin < len(lines) else ""
    headers = [names for line in lines[:begin] if (names := _header(line, first))]
    names = _known(path, headers[-1]) if headers else list(COLUMNS)
    by_edges = set(EDGES) <= set(names)
    wanted = EDGES if by_edges else COLUMNS
    places, rows = [], []
    for at, line in enumerate(lines[begin:], start=begin + 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells, where = _cells(line), f"{path}, line {at}"
        if len(cells) != len(names):
            hint = "" if headers else f" ({', '.join(COLUMNS)}): name others in a header"
            raise InputError(f"{where}: {len(cells)} cells, not {len(names)}{hint}")
        rows.append([_number(cells[names.index(name)], name, where) for name in wanted])
        places.append(where)
        if len(rows) > MOST_POINTS:
            raise InputError(f"{where}: over {MOST_POINTS} points")
    table = np.array(rows).reshape(-1, len(COLUMNS))
    if not headers:
        _refuse_way_points(path, table)
    return table, places, by_edges


def _check_widths(sides: np.ndarray, places: list[str]) -> None:
    """Raises `InputError` if the room to the right and left (n, 2) is out of range in a line."""
    for room, where in zip(sides.tolist(), places, strict=True):
        for name, width in zip(COLUMNS[2:], room, strict=True):
            number(width, f"{where}: {name}", 0.0, WIDEST)
        if sum(room) < NARROWEST:
            raise InputError(f"{where}: less than {NARROWEST} m wide")


def _is_data(line: str) -> bool:
    """Whether a line is a row of numbers, or is meant to be one."""
    words = line.strip()
    return bool(words) and words[0] != "#" and any(map(_is_number, _cells(words)))


def _is_number(cell: str) -> bool:
    with contextlib.suppress(ValueError):
        float(cell)
        return True
    return False


def _header(line: str, first: str) -> list[str] | None:
    """The names that a line before the `first` row gives to the columns; None for other comments.

    A comment is a header if it has one of the `NAMES`, or as many cells as the first row, split by
    the same comma or semicolon.
    """
    words = line.strip().lstrip("#").strip()
    cells = _cells(words)
    if not words or any(map(_is_number, cells)):
        return None
    alike = len(cells) == len(_cells(first)) and any(m in words and m in first for m in ";,")
    comment = line.lstrip().startswith("#")
    return cells if not comment or alike or any(map(_column, cells)) else None


def _column(name: str) -> str | None:
    """The column that a name stands for, if any."""
    plain = name.strip(" \"'").lower()
    return next((column for column, known in NAMES.items() if re.fullmatch(known, plain)), None)


def _known(path: Path, names: list[str]) -> list[str]:
    """The columns that a header's names stand for, and other names as they are.

    Raises `InputError` if some of those that are needed are not there, or twice.
    """
    columns = [_column(name) or name for name in names]
    for column in (*COLUMNS, *EDGES):
        twice = [name for name, known in zip(names, columns, strict=True) if known == column]
        if len(twice) > 1:
            raise InputError(f"{path}: columns {', '.join(map(short, twice))} both say {column}")
    if set(EDGES) <= set(columns):
        return columns
    missing = [column for column in COLUMNS if column not in columns]
    if missing == list(COLUMNS[2:]):
        raise InputError(
            f"{path}: columns {' and '.join(missing)} are missing: a race line and way points say "
            "nothing about walls; give a centre line with the room to its right and left"
        )
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing")
    return columns


def _refuse_way_points(path: Path, table: np.ndarray) -> None:
    """Raises `InputError` if a column of widths is the line's heading, a time or a distance.

    The heading may be in rad or degrees, from any axis and to either hand. Then the steps of the
    line, turned back by it, all point one way. Turned back by a width they nearly cancel, as those
    of a closed line do.
    """
    if len(table) < FEW:
        return
    x, y = table[:, :2].T
    steps = np.roll(x, -1) - x + 1j * (np.roll(y, -1) - y)
    for column, name in ((2, COLUMNS[2]), (3, COLUMNS[3])):
        values, what = table[:, column], None
        if np.all(np.diff(values) > 0):
            what = "rises from row to row, as a time or a distance does"
        back = [np.exp(hand * 1j * v) for v in (values, np.radians(values)) for hand in (1, -1)]
        if max(abs(np.sum(steps * turn)) for turn in back) > ALIKE * np.sum(np.abs(steps)):
            what = "is the heading of the line"
        if what:
            raise InputError(
                f"{path}: column {column + 1} {what}, and is no {name}: way points say nothing "
                "about walls; give a centre line with the room to its right and left"
            )


def _cells(line: str) -> list[str]:
    """The cells of a line; a separator may stand at its end."""
    split = next((mark for mark in ";," if mark in line), r"\s+")
    return [cell.strip() for cell in re.split(split, line.strip().removesuffix(split))]


def _number(cell: str, column: str, where: str) -> float:
    value: Any = cell
    with contextlib.suppress(ValueError):
        value = float(cell)
    return number(value, f"{where}: {column}", -FARTHEST, FARTHEST)
