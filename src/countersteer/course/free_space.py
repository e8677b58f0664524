"""Lines through the free space of a grid: a lap round its island, or a way between two places.

All lengths are in pixels, and places are columns and rows.
"""

import math
from typing import Any

import contourpy
import numpy as np
import shapely
from scipy import ndimage, sparse
from scipy.sparse import csgraph

SMOOTH = 4.0  # standard deviation of the filter along a line
SPACING = 2.0  # between two points of a line
OBSTACLE = 0.5  # of the island's area: a larger patch is no obstacle
MOST_CELLS = 500_000  # of the grid on which a way is searched


def ring_walls(solid: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Masks of the walls outside and inside a lap; None if the free space is no ring.

    `solid` is 0 in free space, 1 outside of it, and another number in each patch within it. A lap
    goes round the largest patch, the island. The others are obstacles, if each has at most
    `OBSTACLE` of the island's area and is thinner than the way is wide. An obstacle counts to the
    wall that is nearer to it, so a lap passes on its wider side.
    """
    patches = np.unique(solid[solid > 1])
    if not len(patches):
        return None
    areas = ndimage.sum_labels(solid > 0, solid, patches)
    island = patches[np.argmax(areas)]
    outer, inner = solid == 1, solid == island
    others = patches != island
    if not np.any(others):
        return outer, inner
    obstacles = patches[others]
    width = float(np.median(np.sum(lap_between(outer, inner)[1], axis=1)))
    thickness = 2 * ndimage.maximum(_away(solid > 0), solid, obstacles) - 1
    if np.max(areas[others]) > OBSTACLE * np.max(areas) or np.max(thickness) >= width:
        return None
    to_outer, to_inner = (ndimage.minimum(_away(~w), solid, obstacles) for w in (outer, inner))
    nearer = to_outer < to_inner
    return (
        outer | np.isin(solid, obstacles[nearer]),
        inner | np.isin(solid, obstacles[~nearer]),
    )


def lap_between(outer: np.ndarray, inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closed line (n, 2) equally far from two walls, and its room (n, 2) to both.

    It runs counter-clockwise, with the outer wall to its right. Where walls are in one piece each,
    there is only one such line: a point nearer to `outer` stays nearer on its way to `outer`.
    """
    away = [_away(~wall) for wall in (outer, inner)]
    lines: Any = contourpy.contour_generator(z=away[0] - away[1]).lines(0.0)
    line = max(lines, key=len)
    if not shapely.LinearRing(line).is_ccw:
        line = line[::-1]
    line, spacing = _even(line, closed=True)
    line = ndimage.gaussian_filter1d(line, SMOOTH / spacing, axis=0, mode="wrap")
    return line, np.stack([_room(a, line) for a in away], axis=1)


def way_between(
    region: np.ndarray, begin: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """A line (n, 2) from one free place to another, and its room (n, 2) to both sides.

    It is None if there is no way, if the end is not free, and if it is the beginning.

    Of all ways on the grid it is the one of the least sum of length over distance from the nearest
    wall. So it keeps to the middle, and to wide passages. A step may not be longer than what is
    free around its ends; on a coarse grid that closes passages of less than half its spacing.
    """
    away = _away(region)
    stride = math.ceil(math.sqrt(region.size / MOST_CELLS))
    free = away[::stride, ::stride] - 0.5  # the edge of a pixel is half a pixel before its middle
    number = np.arange(free.size).reshape(free.shape)
    height, width = free.shape
    ends, costs = [], []
    for up, right in ((0, 1), (1, 0), (1, 1), (1, -1)):  # the other four are these backwards
        a = np.s_[: height - up, max(-right, 0) : width - max(right, 0)]
        b = np.s_[up:, max(right, 0) : width - max(-right, 0)]
        length = stride * math.hypot(up, right)
        clear = (free[a] > 0) & (free[b] > 0) & (free[a] + free[b] >= length)
        ends.append(np.stack([number[a][clear], number[b][clear]]))
        costs.append(length * (1 / free[a][clear] + 1 / free[b][clear]) / 2)
    first, last = np.concatenate(ends, axis=1)
    graph = sparse.coo_array((np.concatenate(costs), (first, last)), shape=(free.size,) * 2)
    column, row = np.round(end).astype(int)
    if not (0 <= row < region.shape[0] and 0 <= column < region.shape[1] and region[row, column]):
        return None
    source, target = (_nearest(free > 0, place / stride) for place in (begin, end))
    _, (before,) = csgraph.dijkstra(
        graph.tocsr(), directed=False, indices=np.array([source]), return_predecessors=True
    )
    cells = [target]
    while before[cells[-1]] >= 0:
        cells.append(before[cells[-1]])
    if cells[-1] != source or source == target:
        return None
    rows_of, columns_of = np.unravel_index(cells[-2:0:-1], free.shape)
    inner = stride * np.stack([columns_of, rows_of], axis=1).astype(float)
    line, spacing = _even(np.vstack([begin, inner, end]), closed=False)
    middle = ndimage.gaussian_filter1d(line, SMOOTH / spacing, axis=0, mode="nearest")
    line = np.vstack([line[:1], middle[1:-1], line[-1:]])
    return line, np.repeat(_room(away, line)[:, None], 2, axis=1)


def _away(free: np.ndarray) -> np.ndarray:
    """The distance of each pixel from the nearest one that is not `free`."""
    return np.asarray(ndimage.distance_transform_edt(free))


def _room(away: np.ndarray, line: np.ndarray) -> np.ndarray:
    """The distance of each point of a line from the edge of a wall that is `away`."""
    # The edge of a pixel is half a pixel before its middle.
    room = ndimage.map_coordinates(away, line.T[::-1], order=1, mode="nearest") - 0.5
    return np.asarray(np.maximum(room, 0.0))


def _even(line: np.ndarray, closed: bool) -> tuple[np.ndarray, float]:
    """The line with points some `SPACING` apart, and that distance. A closed one ends before it."""
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    count = max(8, round(marks[-1] / SPACING))
    at = np.linspace(0.0, marks[-1], count, endpoint=not closed)
    even = np.stack([np.interp(at, marks, line[:, i]) for i in (0, 1)], axis=1)
    return even, float(at[1])


def _nearest(free: np.ndarray, place: np.ndarray) -> int:
    """The number of the free cell nearest to a place."""
    rows, columns = np.nonzero(free)
    best = int(np.argmin((columns - place[0]) ** 2 + (rows - place[1]) ** 2))
    return int(np.ravel_multi_index((rows[best], columns[best]), free.shape))
