"""How far a point is from the nearest wall: a grid, which a thousand cars look up at once."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from countersteer.course.course import Course
from countersteer.course.way import Way
from countersteer.signals import Array, Scalar

CELL = 0.02  # m
MARGIN = 0.5  # m, of the grid around the walls
MOST_CELLS = 4_000_000


class Clearance(NamedTuple):
    """A grid of distances."""

    away: Array  # (rows, columns) m from the nearest wall, negative beyond it
    corner_x: Scalar  # of the first cell's middle, m
    corner_y: Scalar
    cell: Scalar  # m

    def clear(self, x: Scalar, y: Scalar) -> Scalar:
        """Distance of a point to the nearest wall (m), in steps of a cell; negative beyond it."""
        rows, columns = self.away.shape
        column = jnp.round((x - self.corner_x) / self.cell).astype(jnp.int32)
        row = jnp.round((y - self.corner_y) / self.cell).astype(jnp.int32)
        return self.away[jnp.clip(row, 0, rows - 1), jnp.clip(column, 0, columns - 1)]


def clearance_of(course: Course, way: Way) -> Clearance:
    """The grid of a course, in 32 bits."""
    rows = slice(0, int(way.last) + 1)
    points = np.stack([way.x[rows], way.y[rows]], axis=1)
    ends = course.walls.reshape(-1, 2)
    low, high = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
    cell = max(CELL, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    across, up = np.ceil((high - low) / cell).astype(int) + 1
    solid = np.zeros((up, across), bool)
    for ax, ay, bx, by in course.walls:
        steps = max(2, math.ceil(2 * math.hypot(bx - ax, by - ay) / cell))
        xs, ys = np.linspace(ax, bx, steps), np.linspace(ay, by, steps)
        index = np.round((np.stack([ys, xs], axis=1) - low[::-1]) / cell).astype(int)
        solid[index[:, 0], index[:, 1]] = True
    regions, _ = ndimage.label(~solid)
    index = np.round((points[:, ::-1] - low[::-1]) / cell).astype(int)
    inside = np.all((index >= 0) & (index < [up, across]), axis=1)
    driven = np.unique(regions[index[inside, 0], index[inside, 1]])
    free = np.isin(regions, driven[driven > 0])
    away = np.asarray(ndimage.distance_transform_edt(~solid)) * cell
    signed = np.where(free, away, -away).astype(np.float32)
    parts: list[Any] = [signed, *map(np.float32, (*low, cell))]
    return Clearance(*parts)
