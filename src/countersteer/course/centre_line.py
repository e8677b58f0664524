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
from countersteer.reading.values import number

COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")  # in this order without a header
ALIASES = {"d_right": "w_tr_right_m", "d_left": "w_tr_left_m"}
SAME = 1e-3  # m within which two points count as one
TOLERANCE = 0.01  # of the mean width: largest distance of walls from the corridor's true edge
MOST_POINTS = 20_000
LARGEST = 10  # MB
NARROWEST, WIDEST, FARTHEST = 0.05, 1e3, 1e5  # m


def read_centre_line(path: Path) -> Course:
    """The closed course along a centre line, starting at its first point.

    A row is a point with the room to its right and to its left, split by commas, semicolons or
    blanks. A header, also in a comment, names the columns: `COLUMNS` in any order, among others.
    The corridor is the area that its cross-sections sweep, each from wall to wall. So no wall
    stands in it, even if a bend is tighter inside than the room there. The walls are within
    `TOLERANCE` of its true edge. Raises `InputError` naming file and line.
    """
    table = _rows(path)
    points, sides = table[:, :2], table[:, 2:]
    fresh = np.hypot(*(points - np.roll(points, -1, axis=0)).T) > SAME
    points, sides = points[fresh], sides[fresh]
    if not 3 <= len(points) <= MOST_POINTS:
        raise InputError(f"{path}: {len(points)} points that differ, not 3 to {MOST_POINTS}")
    if not shapely.LinearRing(points).is_simple:
        raise InputError(f"{path}: the centre line crosses itself")
    along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
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


def _rows(path: Path) -> np.ndarray:
    """The numbers of the file (n, 4), in the order of `COLUMNS`."""
    lines = read_text(path, LARGEST).splitlines()
    names: list[str] = list(COLUMNS)
    rows: list[list[float]] = []
    for at, line in enumerate(lines, start=1):
        cells = _cells(line.lstrip("# \t"))
        if "x_m" in cells:
            names = [ALIASES.get(cell, cell) for cell in cells]
            for column in COLUMNS:
                if column not in names:
                    raise InputError(f"{path}: column {column} is missing")
        elif line.strip() and not line.lstrip().startswith("#"):
            if len(cells) < len(names):
                raise InputError(f"{path}, line {at}: {len(cells)} cells, not {len(names)}")
            rows.append([_number(cells[names.index(c)], c, f"{path}, line {at}") for c in COLUMNS])
            if len(rows) > MOST_POINTS:
                raise InputError(f"{path}, line {at}: over {MOST_POINTS} points")
            if not sum(rows[-1][2:]) >= NARROWEST:
                raise InputError(f"{path}, line {at}: less than {NARROWEST} m wide")
    return np.array(rows).reshape(-1, len(COLUMNS))


def _cells(line: str) -> list[str]:
    split = next((mark for mark in ";," if mark in line), r"\s+")
    return [cell.strip() for cell in re.split(split, line.strip())]


def _number(cell: str, column: str, where: str) -> float:
    low, high = (0.0, WIDEST) if column.startswith("w_") else (-FARTHEST, FARTHEST)
    value: Any = cell
    with contextlib.suppress(ValueError):
        value = float(cell)
    return number(value, f"{where}: {column}", low, high)
