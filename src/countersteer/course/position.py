"""Places along the centre line of a course, in arithmetic that JAX can trace."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.course.course import Course, follow_within, place
from countersteer.signals import Array, Scalar

FAR = 1e3  # m, length of the last leg
TABLE = 128  # rows, or a multiple: courses share programs, and long tables are read faster


class Place(NamedTuple):
    """A place relative to the centre line. Distances of a closed course are not wrapped."""

    distance: Scalar  # along the line, m
    offset: Scalar  # to the left of the line, m
    bearing: Scalar  # of the line there, in ±pi, rad


class Line(NamedTuple):
    """The centre line of a course: arrays of one row for each of its n straight pieces."""

    begin: Array  # (n, 2)
    along: Array  # (n, 2) direction
    length: Array  # (n,)
    mark: Array  # (n,) distance of the beginning
    whole: Scalar  # length of the line, or inf where it is open
    near: Scalar  # largest way along the line between consecutive poses, m
    start: Scalar  # distance of the course's start

    def follow(self, x: Scalar, y: Scalar, last: Scalar) -> Place:
        """The nearest place of the line within `near` of the last distance (`course.progress`)."""
        return self._nearest(x, y, last, self.near)

    def find(self, x: Scalar, y: Scalar, last: Scalar) -> Place:
        """As `follow`; but if that place is over `near` / 2 aside, the nearest one of all.

        It is for an estimated pose, which may jump. On a closed course the distance is in the round
        nearest to the last distance.
        """
        followed, any_place = (self._nearest(x, y, last, near) for near in (self.near, math.inf))
        strays = jnp.abs(followed.offset) > self.near / 2
        return Place(*(jnp.where(strays, a, f) for a, f in zip(any_place, followed, strict=True)))

    def _nearest(self, x: Scalar, y: Scalar, last: Scalar, near: Scalar) -> Place:
        """The nearest place at most `near` along the line from `last`. Without one, `last`."""
        dx, dy = x - self.begin[:, 0], y - self.begin[:, 1]
        on = jnp.clip(dx * self.along[:, 0] + dy * self.along[:, 1], 0.0, self.length)
        aside_x, aside_y = dx - on * self.along[:, 0], dy - on * self.along[:, 1]
        where = self.mark + on
        rounds = jnp.round((last - where) / self.whole)  # 0 of an open course
        where = where + jnp.where(jnp.isinf(self.whole), 0.0, rounds * self.whole)
        away = jnp.where(jnp.abs(where - last) <= near, aside_x**2 + aside_y**2, jnp.inf)
        best = jnp.argmin(away)
        ux, uy = jnp.asarray(self.along)[best, 0], jnp.asarray(self.along)[best, 1]
        left = ux * aside_y[best] - uy * aside_x[best]
        offset = jnp.where(left < 0, -1.0, 1.0) * jnp.sqrt(away[best])
        return Place(
            jnp.where(jnp.isinf(away[best]), last, where[best]), offset, jnp.arctan2(uy, ux)
        )

    def at(self, distance: Scalar) -> tuple[Scalar, Scalar]:
        """Point (x, y) of the line at a distance; straight on beyond the ends of an open course."""
        wrapped = jnp.where(jnp.isinf(self.whole), distance, jnp.mod(distance, self.whole))
        piece = jnp.clip(jnp.searchsorted(jnp.asarray(self.mark), wrapped, side="right") - 1, 0)
        on = wrapped - jnp.asarray(self.mark)[piece]
        x, y = (
            jnp.asarray(self.begin)[piece, i] + on * jnp.asarray(self.along)[piece, i]
            for i in (0, 1)
        )
        return x, y


class Legs(NamedTuple):
    """The course as straights between corner points: a leg to each turn, and one after the last.

    The point of a rounded corner is where the straights beside it would meet.
    """

    x: Array  # (legs,) of the corner point at a leg's end, m; the last one is far
    y: Array
    bearing: Array  # unwrapped from the start's, rad

    def seen(self, leg: Scalar, x: Scalar, y: Scalar, heading: Scalar) -> Place:
        """A pose relative to a leg: distance to its corner (m), offset (m) and angle (rad).

        `Place.bearing` holds the car's angle to the leg, in ±pi, positive to the left.
        """
        bearing = jnp.asarray(self.bearing)[leg]
        cosine, sine = jnp.cos(bearing), jnp.sin(bearing)
        dx, dy = x - jnp.asarray(self.x)[leg], y - jnp.asarray(self.y)[leg]
        error = heading - bearing
        error = error - 2 * math.pi * jnp.round(error / (2 * math.pi))
        return Place(-(cosine * dx + sine * dy), cosine * dy - sine * dx, error)


def beyond_corner(distance: Scalar, offset: Scalar, angle: Scalar) -> tuple[Scalar, Scalar]:
    """A place `distance` before a corner by `angle`, seen from the leg behind it.

    The result is the distance (m) along that leg to the corner, and the offset from that leg.
    """
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return distance * cosine - offset * sine, distance * sine + offset * cosine


def as_table(values: np.ndarray, filling: float) -> np.ndarray:
    """Values (n,), filled up to a whole number of `TABLE` rows."""
    rows = math.ceil(len(values) / TABLE) * TABLE
    return np.append(values, np.full(rows - len(values), filling))


def line_of(course: Course, dtype: Any = np.float64) -> Line:
    """The centre line of a course that has one."""
    steps = np.diff(course.line, axis=0)
    lengths = np.hypot(*steps.T)
    values = (
        course.line[:-1],
        steps / lengths[:, None],
        lengths,
        course.marks[:-1],
        course.length if course.closed else math.inf,
        follow_within(course),
        course.start_distance,
    )
    return Line(*(np.asarray(value, dtype) for value in values))


def legs_of(course: Course, laps: int) -> Legs:
    """The legs between start and goal, in the order driven."""
    corners = []
    x, y, bearing = place(course, course.start_distance) if len(course.line) else course.start
    for turn in course.turns_ahead(laps):
        # From the beginning of the arc, straight on to the corner point.
        x, y, _ = place(course, turn.distance - abs(turn.angle) * turn.radius / 2)
        ahead = turn.radius * math.tan(abs(turn.angle) / 2)
        x, y = x + ahead * math.cos(bearing), y + ahead * math.sin(bearing)
        corners.append((x, y, bearing))
        bearing += turn.angle
    corners.append((x + FAR * math.cos(bearing), y + FAR * math.sin(bearing), bearing))
    return Legs(*(as_table(column, column[-1]) for column in np.array(corners).T))
