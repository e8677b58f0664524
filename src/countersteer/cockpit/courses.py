"""Courses by name: those of the library, and those that were drawn on the page."""

import itertools
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.cockpit import messages as m
from countersteer.errors import InputError
from countersteer.text import toml_of
from countersteer.writing import alone, write_whole

if TYPE_CHECKING:
    from countersteer.course.course import Course

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _-]{0,58}")


class CourseShelf:
    """The library, and the TOML files of a folder."""

    def __init__(self, folder: Path) -> None:
        """The folder is made when a course is saved."""
        self.folder = folder

    def names(self) -> list[str]:
        """All names, those of the folder first."""
        from countersteer.course.files import library  # with it comes JAX

        own = sorted(path.stem for path in self.folder.glob("*.toml") if NAME.fullmatch(path.stem))
        return [*own, *(name for name in library() if name not in own)]

    def load(self, name: str) -> "Course":
        """A course by its name. Raises `InputError` for one that is not in `names`."""
        from countersteer.course.files import load_course

        if name not in self.names():
            raise InputError(f"course: there is no {name[:60]}")
        file = self.folder / f"{name}.toml"
        return load_course(str(file) if file.is_file() else name)

    def save(self, drawn: m.DrawCourse) -> str:
        """Write a drawn course, and return its name. What is there stays: names are numbered."""
        if not NAME.fullmatch(drawn.name):
            raise InputError("course: give it a name of letters, digits, spaces, - and _")
        from countersteer.course.files import library

        course_of(drawn)
        text = toml_of(tables_of(drawn))
        self.folder.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            name = drawn.name if number == 1 else f"{drawn.name}-{number}"
            file = self.folder / f"{name}.toml"
            if name in library():
                continue
            with alone(file):
                if file.exists() and file.read_text(encoding="utf-8") != text:
                    continue
                write_whole(file, text)
                return name
        raise AssertionError("numbers have no end")

    def sketch(self, drawn: m.DrawCourse) -> m.Sketch:
        """What a drawn course looks like. Raises `InputError` where it is none."""
        return sketch_of(drawn)


def course_of(drawn: m.DrawCourse) -> "Course":
    """The course that was drawn. Raises `InputError` where it is none."""
    from countersteer.course.files import course_from_tables

    if bool(drawn.segments) == bool(drawn.walls):
        raise InputError("course: draw segments or free walls")
    return course_from_tables(tables_of(drawn), "course")


def sketch_of(drawn: m.DrawCourse) -> m.Sketch:
    """What a drawn course looks like."""
    course = course_of(drawn)
    x, y, heading = course.start
    length = course.length if len(course.line) else math.nan
    return m.Sketch(
        walls_m=course.walls.tolist(),
        line_m=course.line.tolist(),
        start={"x_m": x, "y_m": y, "heading_rad": heading},
        length_m=float(length),
    )


def tables_of(drawn: m.DrawCourse) -> dict[str, Any]:
    """A drawn course as the tables of its file."""
    if drawn.walls:
        start = {"x_m": drawn.start_x_m, "y_m": drawn.start_y_m}
        return {
            "name": drawn.name or "sketch",
            "walls_m": [[[*map(_rounded, p)] for p in line.points_m] for line in drawn.walls],
            "start": start | {"heading_deg": drawn.start_heading_deg},
        }
    tables: dict[str, Any] = {
        "name": drawn.name or "sketch",
        "width_m": drawn.width_m,
        "closed": drawn.closed,
        "segments": [_segment(segment) for segment in drawn.segments],
        "start": {
            "distance_m": drawn.start_distance_m,
            "offset_m": drawn.start_offset_m,
            "heading_deg": drawn.start_heading_deg,
        },
    }
    if drawn.crosses:
        tables["crosses"] = True
    if drawn.goal_distance_m is not None:
        tables["goal"] = {"distance_m": drawn.goal_distance_m}
    return tables


def _rounded(value: float) -> float:
    return round(value, 4)


def _segment(segment: m.Segment) -> dict[str, float]:
    fields = m.plain(segment)
    if bool(segment.straight_m) == bool(segment.turn_deg):
        raise InputError("course: a segment is a straight or a turn")
    return {key: value for key, value in fields.items() if value}
