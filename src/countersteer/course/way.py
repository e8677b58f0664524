"""The way along a course: its centre line with rounded corners, as tables.

Planners and policies follow it. A thousand cars look up their place at once.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.signals import Array, Scalar

SPACING = 0.02  # m between two points of the line
ROUNDING = 0.3  # corridor widths: standard deviation by which the line's corners are rounded
AHEAD = 0.5  # corridor widths: so far ahead a corner's outgoing direction is looked for
STRAIGHT_ON = 4.0  # m, by which an open course goes on before its start and behind its end
TABLE = 1024  # rows, or a multiple: courses share programs
STRAIGHT = 0.2  # 1/m, curvature from which a place is in a corner


class Way(NamedTuple):
    """The line of a course, rounded, with a point every `SPACING`."""

    x: Array  # (n,) m
    y: Array
    along_x: Array  # (n,) direction
    along_y: Array
    bend: Array  # (n,) 1 in a corner to the left, -1 to the right, 0 on a straight
    out_x: Array  # (n,) direction in which the corner is left
    out_y: Array
    last: Scalar  # index of the last point
    whole: Scalar  # points of a lap, or 0 where the course is open

    def row(self, place: Scalar) -> Scalar:
        """The row of a place (m along the line from its first point)."""
        index = jnp.round(place / SPACING)
        # Vector units cannot divide integers. Floating-point numbers of this size are as exact.
        whole = jnp.asarray(self.whole, index.dtype)
        laps = jnp.where(whole > 0, jnp.floor(index / jnp.maximum(whole, 1)), 0)
        return jnp.clip(index - laps * whole, 0, self.last).astype(jnp.int32)

    def point(self, place: Scalar) -> tuple[Scalar, Scalar]:
        """The point at a place (m): that of its row, moved on along the line."""
        row = self.row(place)
        # Of a closed line, the place counts from the row on, whatever the lap.
        on = place - SPACING * jnp.round(place / SPACING)
        return self.x[row] + on * self.along_x[row], self.y[row] + on * self.along_y[row]

    def follow(self, x: Scalar, y: Scalar, place: Scalar) -> Scalar:
        """The place of a point, near a place of before: two steps of projection on the line."""
        for _ in range(2):
            row = self.row(place)
            ahead = (x - self.x[row]) * self.along_x[row] + (y - self.y[row]) * self.along_y[row]
            place = place + jnp.clip(ahead, -0.5, 0.5)
        return place


def way_of(course: Course, rounding: float = ROUNDING) -> Way:
    """The tables of a course with a centre line, in 32 bits. Raises `InputError` for free walls.

    `rounding` is in corridor widths, as `ROUNDING`.
    """
    from scipy import ndimage  # a tenth of a second, which a drive without a way need not wait for

    if not len(course.line):
        raise InputError(f"{course.name}: free walls have no centre line to follow")
    width = course.width or 1.0
    points = _even(course)
    sigma = rounding * width / SPACING
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
    columns = (*points.T, np.cos(bearing), np.sin(bearing), bend, np.cos(out), np.sin(out))
    rows = math.ceil(len(points) / TABLE) * TABLE
    tables = [np.append(c, np.full(rows - len(c), c[-1])).astype(np.float32) for c in columns]
    whole = np.int32(len(points) if course.closed else 0)
    parts: list[Any] = [*tables, np.int32(len(points) - 1), whole]
    return Way(*parts)


def start_of(course: Course, way: Way) -> float:
    """The place of a course's start (m)."""
    x, y, _ = course.start
    away = np.hypot(way.x[: way.last + 1] - x, way.y[: way.last + 1] - y)
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
