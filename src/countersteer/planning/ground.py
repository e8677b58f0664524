"""A course as a planner needs it: tables in which a thousand cars at once look up their place."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.signals import Array, Scalar

SPACING = 0.02  # m between two points of the line
ROUNDING = 0.3  # corridor widths: standard deviation by which the line's corners are rounded
AHEAD = 0.5  # corridor widths: so far ahead a corner's outgoing direction is looked for
STRAIGHT_ON = 4.0  # m, by which an open course goes on before its start and behind its end
CELL = 0.02  # m, of the grid of clearances
MARGIN = 0.5  # m, of the grid around the walls
MOST_CELLS = 4_000_000
TABLE = 1024  # rows, or a multiple: courses share programs
STRAIGHT = 0.2  # 1/m, curvature from which a place is in a corner


class Ground(NamedTuple):
    """The line of a course, rounded, with a point every `SPACING`; and a grid of clearances."""

    x: Array  # (n,) m
    y: Array
    along_x: Array  # (n,) direction
    along_y: Array
    bend: Array  # (n,) 1 in a corner to the left, -1 to the right, 0 on a straight
    out_x: Array  # (n,) direction in which the corner is left
    out_y: Array
    last: Scalar  # index of the last point
    whole: Scalar  # points of a lap, or 0 where the course is open
    clearance: Array  # (rows, columns) m from the nearest wall, negative beyond it
    corner_x: Scalar  # of the grid's first cell's middle, m
    corner_y: Scalar
    cell: Scalar  # m

    def row(self, place: Scalar) -> Scalar:
        """The row of a place (m along the line from its first point)."""
        index = jnp.round(place / SPACING).astype(jnp.int32)
        wrapped = jnp.where(self.whole > 0, index % jnp.maximum(self.whole, 1), index)
        return jnp.clip(wrapped, 0, self.last)

    def follow(self, x: Scalar, y: Scalar, place: Scalar) -> Scalar:
        """The place of a point, near a place of before: two steps of projection on the line."""
        for _ in range(2):
            row = self.row(place)
            ahead = (x - self.x[row]) * self.along_x[row] + (y - self.y[row]) * self.along_y[row]
            place = place + jnp.clip(ahead, -0.5, 0.5)
        return place

    def clear(self, x: Scalar, y: Scalar) -> Scalar:
        """Distance of a point to the nearest wall (m), in steps of a cell; negative beyond it."""
        rows, columns = self.clearance.shape
        column = jnp.round((x - self.corner_x) / self.cell).astype(jnp.int32)
        row = jnp.round((y - self.corner_y) / self.cell).astype(jnp.int32)
        return self.clearance[jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)]


def ground_of(course: Course) -> Ground:
    """The tables of a course with a centre line, in 32 bits. Raises `InputError` for free walls."""
    if not len(course.line):
        raise InputError(f"{course.name}: free walls have no centre line for a planner to follow")
    width = course.width or 1.0
    points = _even(course)
    sigma = ROUNDING * width / SPACING
    if course.closed:
        points = ndimage.gaussian_filter1d(points, sigma, axis=0, mode="wrap")
        steps = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    else:
        points = ndimage.gaussian_filter1d(points, sigma, axis=0, mode="nearest")
        steps = np.gradient(points, axis=0)
    bearing = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    lap = round((bearing[-1] - bearing[0]) / (2 * math.pi)) * 2 * math.pi if course.closed else 0.0
    curve = np.gradient(np.append(bearing, bearing[0] + lap))[:-1] / SPACING
    bend = np.where(np.abs(curve) > STRAIGHT, np.sign(curve), 0.0)
    ahead = np.arange(len(points)) + round(AHEAD * width / SPACING)
    if course.closed:
        out = bearing[ahead % len(points)] + lap * (ahead // len(points))
    else:
        out = bearing[np.minimum(ahead, len(points) - 1)]
    clearance, corner, cell = _clearances(course, points)
    columns = (*points.T, np.cos(bearing), np.sin(bearing), bend, np.cos(out), np.sin(out))
    rows = math.ceil(len(points) / TABLE) * TABLE
    tables = [np.append(c, np.full(rows - len(c), c[-1])).astype(np.float32) for c in columns]
    whole = np.int32(len(points) if course.closed else 0)
    grid = clearance.astype(np.float32), *map(np.float32, (*corner, cell))
    parts: list[Any] = [*tables, np.int32(len(points) - 1), whole, *grid]
    return Ground(*parts)


def start_of(course: Course, ground: Ground) -> float:
    """The place of a course's start (m)."""
    x, y, _ = course.start
    away = np.hypot(ground.x[: ground.last + 1] - x, ground.y[: ground.last + 1] - y)
    return SPACING * int(np.argmin(away))


def _even(course: Course) -> np.ndarray:
    """The centre line, a point every `SPACING` or a little less; an open one goes straight on."""
    line = course.line
    if not course.closed:
        ends = [(line[0], line[0] - line[1]), (line[-1], line[-1] - line[-2])]
        before, behind = (end + STRAIGHT_ON * way / np.hypot(*way) for end, way in ends)
        line = np.vstack([before, line, behind])
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    count = math.ceil(marks[-1] / SPACING)
    at = np.linspace(0.0, marks[-1], count, endpoint=not course.closed)
    return np.stack([np.interp(at, marks, line[:, i]) for i in (0, 1)], axis=1)


def _clearances(course: Course, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Clearances on a grid around the walls, its first cell's place, and the size of a cell."""
    ends = course.walls.reshape(-1, 2)
    low, high = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
    cell = max(CELL, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    columns, rows = np.ceil((high - low) / cell).astype(int) + 1
    solid = np.zeros((rows, columns), bool)
    for ax, ay, bx, by in course.walls:
        steps = max(2, math.ceil(2 * math.hypot(bx - ax, by - ay) / cell))
        xs, ys = np.linspace(ax, bx, steps), np.linspace(ay, by, steps)
        index = np.round((np.stack([ys, xs], axis=1) - low[::-1]) / cell).astype(int)
        solid[index[:, 0], index[:, 1]] = True
    regions, _ = ndimage.label(~solid)
    index = np.round((points[:, ::-1] - low[::-1]) / cell).astype(int)
    inside = np.all((index >= 0) & (index < [rows, columns]), axis=1)
    driven = np.unique(regions[index[inside, 0], index[inside, 1]])
    free = np.isin(regions, driven[driven > 0])
    away = np.asarray(ndimage.distance_transform_edt(~solid)) * cell
    return np.where(free, away, -away), low, cell
