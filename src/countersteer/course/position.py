"""Where along a course: poses on the centre line, in arithmetic that JAX can trace."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.course.course import Course, place
from countersteer.signals import Array, Scalar

FAR = 1e3  # m to the end of the last leg


class Place(NamedTuple):
    """A place seen from the centre line; distances of a closed course are not wrapped."""

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
    near: Scalar  # m along the line between two poses that follow each other, at most
    start: Scalar  # distance of the course's start

    def follow(self, x: Scalar, y: Scalar, last: Scalar) -> Place:
        """As `course.progress`: the nearest place of the line not far from the last distance."""
        return self._nearest(x, y, last, self.near)

    def find(self, x: Scalar, y: Scalar, last: Scalar) -> Place:
        """As `follow`; but where that is off the corridor, the nearest place of all.

        For a believed pose, which jumps when another is believed. Of a closed course's rounds it
        is in the one nearest to the last.
        """
        followed, any_place = (self._nearest(x, y, last, near) for near in (self.near, math.inf))
        strays = jnp.abs(followed.offset) > self.near / 2
        return Place(*(jnp.where(strays, a, f) for a, f in zip(any_place, followed, strict=True)))

    def _nearest(self, x: Scalar, y: Scalar, last: Scalar, near: Scalar) -> Place:
        """The nearest place at most `near` along the line from the last, or else the last."""
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
        """Where the line is at a distance (x, y); beyond the ends of an open course straight on."""
        wrapped = jnp.where(jnp.isinf(self.whole), distance, jnp.mod(distance, self.whole))
        piece = jnp.clip(jnp.searchsorted(jnp.asarray(self.mark), wrapped, side="right") - 1, 0)
        on = wrapped - jnp.asarray(self.mark)[piece]
        x, y = (
            jnp.asarray(self.begin)[piece, i] + on * jnp.asarray(self.along)[piece, i]
            for i in (0, 1)
        )
        return x, y


class Legs(NamedTuple):
    """The course as straights from corner point to corner point: one leg to each turn, one behind.

    A rounded corner has its point where the straights beside it would meet.
    """

    x: Array  # (turns + 1,) of the corner point that ends the leg, m; that of the last is far
    y: Array
    bearing: Array  # unwrapped from the start's, rad

    def seen(self, leg: Scalar, x: Scalar, y: Scalar, heading: Scalar) -> Place:
        """A pose from a leg: distance to its corner (m), offset, and how far it is turned (rad).

        For `bearing` the place has the car's angle to the leg, in ±pi, to the left.
        """
        bearing = jnp.asarray(self.bearing)[leg]
        cosine, sine = jnp.cos(bearing), jnp.sin(bearing)
        dx, dy = x - jnp.asarray(self.x)[leg], y - jnp.asarray(self.y)[leg]
        error = heading - bearing
        error = error - 2 * math.pi * jnp.round(error / (2 * math.pi))
        return Place(-(cosine * dx + sine * dy), cosine * dy - sine * dx, error)


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
        1.5 * (course.width or 1.0),
        course.start_distance,
    )
    return Line(*(np.asarray(value, dtype) for value in values))


def legs_of(course: Course, laps: int) -> Legs:
    """The legs between start and goal, in the order driven."""
    corners = []
    x, y, bearing = place(course, course.start_distance) if len(course.line) else course.start
    for turn in course.turns_ahead(laps):
        # From where the arc begins, on along the straight before it.
        x, y, _ = place(course, turn.distance - abs(turn.angle) * turn.radius / 2)
        ahead = turn.radius * math.tan(abs(turn.angle) / 2)
        x, y = x + ahead * math.cos(bearing), y + ahead * math.sin(bearing)
        corners.append((x, y, bearing))
        bearing += turn.angle
    corners.append((x + FAR * math.cos(bearing), y + FAR * math.sin(bearing), bearing))
    return Legs(*np.array(corners).T)
