"""Courses in files: TOML here, others by `centre_line` and `occupancy_map`."""

import dataclasses
import importlib.resources
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.car.parameter import unknown_key
from countersteer.course.course import (
    MOST_WALLS,
    Course,
    Segment,
    Turn,
    from_segments,
    from_walls,
)
from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.content import reading
from countersteer.reading.values import flag, number, short
from countersteer.text import read_toml

LIBRARY = importlib.resources.files("countersteer.course") / "library"

KEYS = ("name", "width_m", "closed", "crosses", "segments", "walls_m", "start", "goal")
MOST_SEGMENTS = 500
MOST_DEG, MOST_MITRED_DEG = 350, 179  # of a turn with a radius, and without
PLACES = {
    "start": ("distance_m", "offset_m", "heading_deg"),
    "goal": ("distance_m",),
    "start of walls": ("x_m", "y_m", "heading_deg"),
}


def library() -> list[str]:
    """Names of the courses that come with the package."""
    return sorted(p.name.removesuffix(".toml") for p in LIBRARY.iterdir())


def load_course(name: str) -> Course:
    """A course from the library or a file. Raises `InputError` naming file and key.

    A `.csv` is a centre line with widths (F1TENTH), a `.yaml` an occupancy map (ROS).
    """
    with reading(short(name)):
        return _load(name)


def _load(name: str) -> Course:
    path = Path(name)
    # Imported here, as libraries for geometry and images load slowly.
    if path.suffix == ".csv":
        from countersteer.course.centre_line import read_centre_line

        return read_centre_line(path)
    if path.suffix in (".yaml", ".yml"):
        from countersteer.course.occupancy_map import read_map

        return read_map(path)
    tables, where = read_toml(name, LIBRARY, "course", ".toml, .csv or .yaml")
    return course_from_tables(tables, where)


def course_from_tables(tables: dict[str, Any], where: str) -> Course:
    """The course that the tables of a file describe. Raises `InputError` naming `where`."""
    for key in tables:
        if key not in KEYS:
            raise unknown_key(where, key, dict.fromkeys(KEYS))
    title = values.name(tables["name"], f"{where}: name") if "name" in tables else where
    if ("segments" in tables) == ("walls_m" in tables):
        raise InputError(f"{where}: give either segments or walls_m")
    if "walls_m" in tables:
        start = place_of(tables, "start", where, PLACES["start of walls"])
        return from_walls(title, _walls(tables["walls_m"], where), (start[0], start[1], start[2]))
    closed = flag(tables.get("closed", False), f"{where}: closed")
    start = place_of(tables, "start", where, PLACES["start"])
    goal = place_of(tables, "goal", where, PLACES["goal"])[0] if "goal" in tables else None
    width = number(tables.get("width_m"), f"{where}: width_m", 0.05, 100)
    segments = tables["segments"]
    if not isinstance(segments, list) or not all(isinstance(s, dict) for s in segments):
        raise InputError(f"{where}: segments must be a list of {{straight_m}} and {{turn_deg}}")
    if len(segments) > MOST_SEGMENTS:
        raise InputError(f"{where}: {len(segments)} segments, over {MOST_SEGMENTS}")
    read = [_segment(s, f"{where}: segments[{i}]") for i, s in enumerate(segments)]
    crosses = flag(tables.get("crosses", False), f"{where}: crosses")
    begin = (start[0], start[1], start[2])
    course = from_segments(where, width, closed, read, begin, goal, crosses)
    return dataclasses.replace(course, name=title)  # errors before this line name the file


def _segment(segment: dict[str, Any], where: str) -> Segment:
    for key, kind in (("straight_m", "straight"), ("length_m", "length")):
        if set(segment) == {key}:
            return Segment(kind, number(segment[key], f"{where}.{key}", 0.01, 1e4))
    if set(segment) in ({"turn_deg"}, {"turn_deg", "radius_m"}):
        radius = number(segment.get("radius_m", 0.0), f"{where}.radius_m", 0, 1e4)
        angle = number(segment["turn_deg"], f"{where}.turn_deg", -MOST_DEG, MOST_DEG)
        if radius == 0 and abs(angle) > MOST_MITRED_DEG:
            raise InputError(
                f"{where}: a turn of {angle:g}° needs an arc: write radius_m beside it, or at most "
                f"{MOST_MITRED_DEG}°"
            )
        return Segment("turn", math.radians(angle), radius)
    raise InputError(
        f"{where} must be {{straight_m = …}} (corner to corner), {{length_m = …}} (its own length) "
        "or {turn_deg = …, radius_m = …}"
    )


def place_of(tables: dict[str, Any], key: str, where: str, known: tuple[str, ...]) -> list[float]:
    """The numbers of a table `key`, in the order of its `known` keys; 0 for those left out."""
    table = tables.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"{where}: {key} must be a table")
    for name in table:
        if name not in known:
            raise unknown_key(where, f"{key}.{name}", {f"{key}.{k}": 0 for k in known})
    return [
        number(table.get(name, 0.0), f"{where}: {key}.{name}", -1e4, 1e4)
        * (math.pi / 180 if name.endswith("_deg") else 1.0)
        for name in known
    ]


def _walls(lines: Any, where: str) -> np.ndarray:
    """Wall segments (m, 4) of polylines."""
    if not isinstance(lines, list) or not lines:
        raise InputError(f"{where}: walls_m must be a list of lists of [x, y]")
    walls: list[list[float]] = []
    for i, line in enumerate(lines):
        at = f"{where}: walls_m[{i}]"
        if (
            not isinstance(line, list)
            or len(line) < 2
            or not all(isinstance(p, list) and len(p) == 2 for p in line)
        ):
            raise InputError(f"{at} must hold two or more points [x, y]")
        if len(walls) + len(line) > MOST_WALLS:
            raise InputError(f"{where}: walls_m has over {MOST_WALLS} pieces of wall")
        points = [[number(c, at, -1e5, 1e5) for c in p] for p in line]
        walls.extend([[*a, *b] for a, b in itertools.pairwise(points)])
    return np.array(walls)


def course_tables(course: Course) -> dict[str, Any]:
    """The tables of a course in `run.toml`: enough to draw it and to drive it again."""
    tables: dict[str, Any] = {
        "name": course.name,
        "closed": course.closed,
        "start": dict(zip(("x_m", "y_m", "heading_rad"), course.start, strict=True)),
        "start_distance_m": course.start_distance,
        "walls_m": course.walls.tolist(),
        "line_m": course.line.tolist(),
        "turns": [
            {
                "distance_m": t.distance,
                "turn_deg": math.degrees(t.angle),
                "radius_m": t.radius,
            }
            for t in course.turns
        ],
    }
    if course.width is not None:
        tables["width_m"] = course.width
    if course.goal_distance is not None:
        tables["goal_distance_m"] = course.goal_distance
    if course.sides is not None:
        tables["sides_m"] = course.sides.tolist()
    return tables


def course_of_run(about: dict[str, Any]) -> Course | None:
    """The course in a `run.toml`, as `course_tables` wrote it; None without one."""
    tables = about.get("course")
    if not isinstance(tables, dict) or not isinstance(tables.get("walls_m"), list):
        return None
    try:
        start = tables["start"]
        return Course(
            name=str(tables["name"]),
            width=tables.get("width_m"),
            closed=bool(tables["closed"]),
            line=np.array(tables["line_m"], float).reshape(-1, 2),
            walls=np.array(tables["walls_m"], float).reshape(-1, 4),
            turns=tuple(
                Turn(
                    float(t["distance_m"]), math.radians(t["turn_deg"]), float(t.get("radius_m", 0))
                )
                for t in tables["turns"]
            ),
            start=(float(start["x_m"]), float(start["y_m"]), float(start["heading_rad"])),
            start_distance=float(tables["start_distance_m"]),
            goal_distance=tables.get("goal_distance_m"),
            sides=np.array(tables["sides_m"], float) if "sides_m" in tables else None,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"run.toml: [course] is not as it was written: {error}") from None
