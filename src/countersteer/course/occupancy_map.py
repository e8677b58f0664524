"""Courses from occupancy maps: the YAML files of ROS's map_server, each beside its image."""

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any, NamedTuple

import contourpy
import numpy as np
import shapely
from scipy import ndimage

from countersteer.course import free_space
from countersteer.course.course import Course, from_track, from_walls, walls_around
from countersteer.course.files import place_of
from countersteer.errors import InputError
from countersteer.reading.content import read_text
from countersteer.reading.documents import LARGEST_YAML, yaml_mapping
from countersteer.reading.images import read_pixels
from countersteer.reading.values import number, shown
from countersteer.reading.values import path as checked_path

TOLERANCE = 0.02  # m, largest distance of walls from the edge between pixels, ...
PIXELS = 1.0  # ... or so many pixels, if that is more: a slanted edge is a staircase
SPECK = 4  # pixels: a smaller patch within free space is noise, not a wall
FREE_THRESH = 0.25  # default, that of ROS 2
UNKNOWN = 205  # brightness that map savers write for unknown in trinary mode
AROUND = np.ones((3, 3))  # pixels of walls connect at corners too, free pixels at edges only

log = logging.getLogger(__name__)


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


class Ends(NamedTuple):
    """Where a drive starts and ends, by the file's own keys."""

    start: tuple[float, float]  # the origin by default
    given: bool  # whether the file has a start
    heading: float | None
    goal: tuple[float, float] | None


def read_map(path: Path) -> Course:
    """The course in a map's free space.

    Free space is the free pixels connected with the start, or with the free pixel nearest to the
    origin (0, 0) without a start. Unknown pixels are not free. Walls are the edge of free space.
    Where free space reaches the picture's edge, that is a wall too, and a warning says so.

    A ring is a closed course. Its centre line is equally far from the walls outside and inside, and
    obstacles are walls (`free_space.ring_walls`). It starts nearest to the start, and goes the way
    of `heading_deg`, or else in the direction in which x rises, or in the other one with
    `reverse: true` in the file. Any other free space is open. With a goal it has a line from the
    start to the goal (`free_space.way_between`), else free walls. Raises `InputError` naming file
    and key.
    """
    about = _about(path)
    grid, ends = _grid(about, path), _ends(about, path)
    image = path.parent / checked_path(about["image"], f"{path}: image")
    free = _free(about, path, image)
    if not np.any(free):
        raise InputError(f"{path}: {image.name} has no free pixel")
    begin = grid.pixel(*ends.start)
    rows, columns = np.nonzero(free)
    nearest = int(np.argmin((columns - begin[0]) ** 2 + (rows - begin[1]) ** 2))
    at_start = np.max(np.abs([columns[nearest], rows[nearest]] - begin)) <= 0.5
    if ends.given and not at_start:
        raise InputError(f"{path}: start: ({ends.start[0]:g}, {ends.start[1]:g}) is not free")
    labels, _ = ndimage.label(free)
    region = labels == labels[rows[nearest], columns[nearest]]
    if any(np.any(edge) for edge in (region[0], region[-1], region[:, 0], region[:, -1])):
        log.warning(
            "%s: the free space at the %s reaches the picture's edge, which is taken for a wall; "
            "if it is not the track, put start: {x_m: …, y_m: …} on the track",
            path, "start" if ends.given else "origin",
        )  # fmt: skip
    # Crop to the region, with a margin of one pixel that is not free.
    rows, columns = (np.nonzero(np.any(region, axis=axis))[0] for axis in (1, 0))
    low = np.array([columns[0], rows[0]]) - 1
    region = np.pad(region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 1)
    solid, count = ndimage.label(~region, structure=AROUND)  # 1 is the outside
    sizes = np.bincount(solid.ravel(), minlength=count + 1)
    region |= (sizes < SPECK)[solid]
    solid = np.where(region, 0, solid)
    tolerance = max(TOLERANCE, PIXELS * grid.resolution)
    area: Any = _outline(region, grid, low).simplify(tolerance)
    walls = walls_around(area, str(path))
    ring = free_space.ring_walls(solid)
    if ring is not None:
        line, sides = free_space.lap_between(*ring)
        line, sides = _start(grid.place(line + low), sides * grid.resolution, ends, about, path)
        return _lap(from_track(path.stem, line, sides, walls), ends)
    if not at_start:
        raise InputError(f"{path}: the origin (0, 0), where the car starts, is not free")
    start = (*ends.start, ends.heading or 0.0)
    if ends.goal is None:
        return from_walls(path.stem, walls, start)
    end = grid.pixel(*ends.goal)
    way = free_space.way_between(region, begin - low, end - low)
    if way is None:
        raise InputError(f"{path}: goal: no free way leads from the start to it")
    line, sides = grid.place(way[0] + low), way[1] * grid.resolution
    course = from_track(path.stem, line, sides, walls, closed=False)
    return course if ends.heading is None else dataclasses.replace(course, start=start)


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


def _ends(about: dict[str, Any], path: Path) -> Ends:
    start = place_of(about, "start", str(path), ("x_m", "y_m", "heading_deg"))
    goal = place_of(about, "goal", str(path), ("x_m", "y_m"))
    heading = start[2] if "heading_deg" in about.get("start", {}) else None
    if heading is not None and "reverse" in about:
        raise InputError(f"{path}: give either reverse or start.heading_deg")
    return Ends(
        (start[0], start[1]), "start" in about, heading,
        (goal[0], goal[1]) if "goal" in about else None,
    )  # fmt: skip


def _flag(about: dict[str, Any], key: str, path: Path) -> bool:
    value = about.get(key, False)
    if value not in (0, 1):
        raise InputError(f"{path}: {key} must be true or false, not {shown(value)}")
    return bool(value)


def _free(about: dict[str, Any], path: Path, image: Path) -> np.ndarray:
    """Mask of free pixels, lowest row first: their occupancy is below `free_thresh`.

    In trinary mode, pixels of the brightness `UNKNOWN` are not free, whatever the threshold says.
    """
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
        shade = 255 - shade if _flag(about, "negate", path) else shade
        occupied = (255 - shade) / 255
    known = opaque if mode != "trinary" else opaque & (np.abs(shade - UNKNOWN) > 0.5)
    return np.asarray(((occupied < threshold) & known)[::-1])


def _outline(region: np.ndarray, grid: Grid, low: np.ndarray) -> shapely.Polygon:
    """The polygon of a region, along the edges of its pixels."""
    # A little over one half: walls connect where only corners meet, as in the labels.
    contours = contourpy.contour_generator(z=region.astype(float), fill_type="OuterOffset")
    filled: Any = contours.filled(0.501, 2.0)
    (points,), (offsets,) = filled
    rings = [grid.place(ring + low) for ring in np.split(points, offsets[1:-1])]
    return shapely.Polygon(rings[0], rings[1:])


def _start(
    line: np.ndarray, sides: np.ndarray, ends: Ends, about: dict[str, Any], path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Line and sides from the point nearest to the start on, in the driving direction."""
    first = int(np.argmin(np.hypot(*(line - ends.start).T)))
    ahead = line[(first + 1) % len(line)] - line[first - 1]
    if ends.heading is None:
        back = (ahead[0] < 0) != _flag(about, "reverse", path)
    else:
        back = ahead @ [math.cos(ends.heading), math.sin(ends.heading)] < 0
    if back:
        line, sides, first = line[::-1], sides[::-1, ::-1], len(line) - 1 - first
    return np.roll(line, -first, axis=0), np.roll(sides, -first, axis=0)


def _lap(course: Course, ends: Ends) -> Course:
    """A closed course with the start and the goal of the file."""
    if ends.given:
        heading = course.start[2] if ends.heading is None else ends.heading
        course = dataclasses.replace(course, start=(*ends.start, heading))
    if ends.goal is not None:
        nearest = int(np.argmin(np.hypot(*(course.line[1:] - ends.goal).T))) + 1
        course = dataclasses.replace(course, goal_distance=float(course.marks[nearest]))
    return course
