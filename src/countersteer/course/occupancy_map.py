"""Courses from occupancy maps: the YAML files of ROS's map_server, each beside its image."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import contourpy
import numpy as np
import shapely
from scipy import ndimage

from countersteer.course.course import Course, from_track, from_walls, walls_around
from countersteer.errors import InputError
from countersteer.reading.content import read_text
from countersteer.reading.documents import LARGEST_YAML, yaml_mapping
from countersteer.reading.images import read_pixels
from countersteer.reading.values import number, shown
from countersteer.reading.values import path as checked_path

TOLERANCE = 0.02  # m, largest distance of walls from the edge between pixels, ...
PIXELS = 1.0  # ... or so many pixels, if that is more: a slanted edge is a staircase
SPECK = 4  # pixels: a smaller patch within free space is noise, not a wall
SMOOTH = 4.0  # pixels: standard deviation of the filter along a centre line
FREE_THRESH = 0.25  # default, that of ROS 2
AROUND = np.ones((3, 3))  # pixels of walls connect at corners too, free pixels at edges only


class Grid(NamedTuple):
    """The place of an image's pixels in the plane."""

    resolution: float  # m
    x: float  # of the lower left corner
    y: float
    yaw: float

    def place(self, pixels: np.ndarray) -> np.ndarray:
        """Points (n, 2) of column and row (n, 2), counted from the lower left pixel's middle."""
        along = (pixels + 0.5) * self.resolution
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return along @ np.array([[cosine, sine], [-sine, cosine]]) + [self.x, self.y]

    def pixel(self, x: float, y: float) -> np.ndarray:
        """The inverse of `place`, for one point."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        x, y = x - self.x, y - self.y
        local = np.array([cosine * x + sine * y, cosine * y - sine * x])
        return np.asarray(local / self.resolution - 0.5)


def read_map(path: Path) -> Course:
    """The course in a map's free space.

    Free space is the free pixels connected with the origin (0, 0), or with the free pixel nearest
    to it. Unknown pixels are not free. Walls are the edge of free space.

    Between one outer and one inner edge there is a closed course. Its centre line is equally far
    from both. It starts nearest to the origin, in the direction in which x rises, or in the other
    one with `reverse: true` in the file. Any other free space has free walls, and the car starts at
    the origin, heading 0. Raises `InputError` naming file and key.
    """
    about = _about(path)
    grid, image = _grid(about, path), path.parent / checked_path(about["image"], f"{path}: image")
    free = _free(about, path, image)
    if not np.any(free):
        raise InputError(f"{path}: {image.name} has no free pixel")
    begin = grid.pixel(0.0, 0.0)
    rows, columns = np.nonzero(free)
    nearest = int(np.argmin((columns - begin[0]) ** 2 + (rows - begin[1]) ** 2))
    at_origin = np.max(np.abs([columns[nearest], rows[nearest]] - begin)) <= 0.5
    labels, _ = ndimage.label(free)
    region = labels == labels[rows[nearest], columns[nearest]]
    # Crop to the region, with a margin of one pixel that is not free.
    rows, columns = (np.nonzero(np.any(region, axis=axis))[0] for axis in (1, 0))
    low = np.array([columns[0], rows[0]])
    region = np.pad(region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 1)
    solid, count = ndimage.label(~region, structure=AROUND)  # 1 is the outside
    sizes = np.bincount(solid.ravel(), minlength=count + 1)
    region |= (sizes < SPECK)[solid]
    solid = np.where(region, 0, solid)
    tolerance = max(TOLERANCE, PIXELS * grid.resolution)
    area: Any = _outline(region, grid, low - 1).simplify(tolerance)
    walls = walls_around(area, str(path))
    if len(area.interiors) == 1:
        line, sides = _middle(solid == 1, solid > 1)
        line, sides = _start(grid.place(line + low - 1), sides * grid.resolution, about, path)
        return from_track(path.stem, line, sides, walls)
    if not at_origin:
        raise InputError(f"{path}: the origin (0, 0), where the car starts, is not free")
    return from_walls(path.stem, walls)


def _about(path: Path) -> dict[str, Any]:
    about = yaml_mapping(read_text(path, LARGEST_YAML), str(path))
    for key in ("image", "resolution", "origin"):
        if key not in about:
            raise InputError(f"{path}: {key} is missing")
    return about


def _grid(about: dict[str, Any], path: Path) -> Grid:
    origin = about["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError(f"{path}: origin must be [x, y, yaw] in metres and radians")
    x, y, yaw = (number(value, f"{path}: origin", -1e5, 1e5) for value in origin)
    return Grid(number(about["resolution"], f"{path}: resolution", 1e-4, 10), x, y, yaw)


def _flag(about: dict[str, Any], key: str, path: Path) -> bool:
    value = about.get(key, False)
    if value not in (0, 1):
        raise InputError(f"{path}: {key} must be true or false, not {shown(value)}")
    return bool(value)


def _free(about: dict[str, Any], path: Path, image: Path) -> np.ndarray:
    """Mask of free pixels, lowest row first: their occupancy is below `free_thresh`."""
    mode = about.get("mode", "trinary")
    if mode not in ("trinary", "scale", "raw"):
        raise InputError(f"{path}: mode must be trinary, scale or raw, not {shown(mode)}")
    threshold = number(about.get("free_thresh", FREE_THRESH), f"{path}: free_thresh", 0, 1)
    try:
        shade, opaque = read_pixels(image)
    except InputError as error:
        raise InputError(f"{path}: image {error}") from None
    if mode == "raw":
        occupied = shade / 100  # per cent; from 101 on unknown
    else:
        occupied = shade / 255 if _flag(about, "negate", path) else (255 - shade) / 255
    return np.asarray(((occupied < threshold) & opaque)[::-1])


def _outline(region: np.ndarray, grid: Grid, low: np.ndarray) -> shapely.Polygon:
    """The polygon of a region, along the edges of its pixels."""
    # A little over one half: walls connect where only corners meet, as in the labels.
    contours = contourpy.contour_generator(z=region.astype(float), fill_type="OuterOffset")
    filled: Any = contours.filled(0.501, 2.0)
    (points,), (offsets,) = filled
    rings = [grid.place(ring + low) for ring in np.split(points, offsets[1:-1])]
    return shapely.Polygon(rings[0], rings[1:])


def _middle(outer: np.ndarray, inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closed line equally far from `outer` and `inner`, and its room to both, in pixels.

    It runs counter-clockwise, its points 2 pixels apart. There is only one such line: a point
    nearer to `outer` stays nearer on its way to `outer`.
    """
    away = [np.asarray(ndimage.distance_transform_edt(~solid)) for solid in (outer, inner)]
    lines: Any = contourpy.contour_generator(z=away[0] - away[1]).lines(0.0)
    line = max(lines, key=len)
    if not shapely.LinearRing(line).is_ccw:
        line = line[::-1]
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    even = np.linspace(0.0, marks[-1], max(8, round(marks[-1] / 2)), endpoint=False)
    even_line = np.stack([np.interp(even, marks, line[:, i]) for i in (0, 1)], axis=1)
    spacing = marks[-1] / len(even)
    line = ndimage.gaussian_filter1d(even_line, SMOOTH / spacing, axis=0, mode="wrap")
    # The edge of a pixel is half a pixel before its middle. The inner wall is to the left.
    room = [ndimage.map_coordinates(a, line.T[::-1], order=1, mode="nearest") - 0.5 for a in away]
    return line, np.maximum(np.stack(room, axis=1), 0.0)


def _start(
    line: np.ndarray, sides: np.ndarray, about: dict[str, Any], path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Line and sides from the point nearest to the origin on, in the driving direction."""
    first = int(np.argmin(np.hypot(*line.T)))
    ahead = line[(first + 1) % len(line)] - line[first - 1]
    if (ahead[0] < 0) != _flag(about, "reverse", path):
        line, sides, first = line[::-1], sides[::-1, ::-1], len(line) - 1 - first
    return np.roll(line, -first, axis=0), np.roll(sides, -first, axis=0)
