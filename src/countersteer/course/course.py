"""`Course`: a corridor of straights and turns, or free walls, with a start and a goal."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.errors import InputError

if TYPE_CHECKING:
    from shapely import Polygon

ARC_STEP = math.radians(5)  # largest angle of a chord of a rounded corner
MOST_WALLS = 8192


SHARPEST = math.radians(150)  # of a mitred corner, beyond which nobody cuts it whole


class Turn(NamedTuple):
    """A corner of the centre line."""

    distance: float  # of the corner point (or the middle of its arc) along the centre line, m
    angle: float  # positive to the left, rad
    radius: float = 0.0  # of its arc, m; 0: a mitred corner


@dataclasses.dataclass(frozen=True)
class Course:
    """An immutable course. Distances are along the centre line, in metres; angles in rad."""

    name: str
    width: float | None  # the smallest; None: there are only free walls
    closed: bool
    # (n, 2) corner points of the centre line, the first again at the end if closed
    line: np.ndarray
    walls: np.ndarray  # (m, 4) x, y of both ends
    turns: tuple[Turn, ...]
    start: tuple[float, float, float]  # x, y, heading
    start_distance: float
    goal_distance: float | None  # None: nothing to reach
    # (n, 2) room to the right and left of each point of the line; None: half the width each
    sides: np.ndarray | None = None

    @property
    def length(self) -> float:
        """Length of the centre line."""
        return float(self.marks[-1]) if len(self.line) else 0.0

    @property
    def marks(self) -> np.ndarray:
        """Distance of each point of the centre line."""
        steps = np.hypot(*np.diff(self.line, axis=0).T) if len(self.line) > 1 else np.zeros(0)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def lap_end(self, laps: int) -> float | None:
        """Unwrapped distance of the goal after so many laps; None without a goal."""
        if self.goal_distance is None:
            return None
        return self.goal_distance + (laps - 1) * self.length if self.closed else self.goal_distance

    def check_laps(self, laps: int) -> None:
        """Raise `InputError` if the course cannot be driven for so many laps."""
        if laps > 1 and not self.closed:
            raise InputError(f"--laps {laps}: {self.name} is open, and driven once")

    def turns_ahead(self, laps: int) -> list[Turn]:
        """The turns between start and goal, at unwrapped distances, in the order driven."""
        end = self.lap_end(laps)
        rounds = range(laps + 1) if self.closed else range(1)
        ahead = [
            t._replace(distance=t.distance + k * self.length) for k in rounds for t in self.turns
        ]
        return [t for t in ahead if self.start_distance < t.distance < (end or 0.0)]


class Segment(NamedTuple):
    """A piece of a corridor's centre line."""

    kind: str  # straight, from corner point to corner point; length, of its own; turn
    value: float  # m, or rad to the left
    radius: float = 0.0  # m


def from_segments(
    name: str,
    width: float,
    closed: bool,
    segments: Sequence[Segment | tuple[str, float, float]],
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    goal: float | None = None,
    crosses: bool = False,
) -> Course:
    """A corridor along a centre line of straights and turns.

    A "straight" runs between the corner points of the centre line, where the straights beside a
    turn would meet; a "length" is a straight's own length. A radius rounds a turn; a radius of 0
    mitres it. `start` is distance, offset to the left, heading relative to the line. `goal` is a
    distance: by default that of the end, or a lap after the start if closed. With `crosses` the
    line may cross itself, and no wall stands within the corridor there.
    Raises `InputError` if the segments do not make a corridor, and says what to write instead.
    """
    points, turns = _centre_line(name, [Segment(*s) for s in segments], closed)
    if crosses:
        walls = _opened(name, points, closed, width)
    else:
        walls = np.concatenate([_offset(points, closed, side * width / 2) for side in (1, -1)])
        _require_simple(name, points, closed)
    course = Course(name, width, closed, points, walls, turns, (0.0, 0.0, 0.0), start[0], None)
    length = course.length
    if not 0 <= start[0] <= length:
        raise InputError(f"{name}: start.distance_m must be in [0, {length:g}]")
    if goal is None:
        goal = start[0] + length if closed else length
    if goal <= start[0]:
        raise InputError(f"{name}: goal.distance_m must lie beyond start.distance_m")
    if not closed and goal > length + 1e-9:
        raise InputError(f"{name}: goal.distance_m must be at most {length:g}")
    if not abs(start[1]) < width / 2:
        raise InputError(f"{name}: start.offset_m must be within the corridor")
    x, y, along = place(course, start[0])
    x, y = x - math.sin(along) * start[1], y + math.cos(along) * start[1]
    return dataclasses.replace(course, start=(x, y, along + start[2]), goal_distance=goal)


def from_walls(
    name: str, walls: np.ndarray, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Course:
    """A course of free walls; `start` is x, y, heading."""
    return Course(name, None, False, np.zeros((0, 2)), walls, (), start, 0.0, None)


def from_track(
    name: str, line: np.ndarray, sides: np.ndarray, walls: np.ndarray, closed: bool = True
) -> Course:
    """A course along any line. It starts at the first point, and its goal is the line's end.

    `line` (n, 2) and `sides` (n, 2) of a `closed` one go round once, without the first point again.
    """
    if closed:
        line, sides = np.vstack([line, line[:1]]), np.vstack([sides, sides[:1]])
    width = float(np.min(np.sum(sides, axis=1)))
    course = Course(name, width, closed, line, walls, (), (0.0, 0.0, 0.0), 0.0, None, sides)
    return dataclasses.replace(course, start=place(course, 0.0), goal_distance=course.length)


def walls_around(area: "Polygon", where: str) -> np.ndarray:
    """The boundary of an area and of its holes as wall segments; `InputError` if too many."""
    rings = [np.asarray(ring.coords) for ring in (area.exterior, *area.interiors)]
    walls = np.concatenate([np.hstack([ring[:-1], ring[1:]]) for ring in rings])
    if len(walls) > MOST_WALLS:
        raise InputError(f"{where}: {len(walls)} pieces of wall, over {MOST_WALLS}")
    return walls


def _centre_line(
    where: str, segments: Sequence[Segment], closed: bool
) -> tuple[np.ndarray, tuple[Turn, ...]]:
    """The points of the centre line, the first again at the end if closed, and its turns."""
    if not segments or segments[0].kind == "turn":
        raise InputError(
            f"{where}: segments[0] must be a straight: write {{length_m = 1.0}} before the turn"
        )
    count = len(segments)
    trims = [0.0] * count  # from a turn's corner point to its arc, m; nan: it has no such point
    for i, (kind, angle, radius) in enumerate(segments):
        if kind != "turn":
            continue
        beside = [segments[i - 1], segments[(i + 1) % count] if closed or i + 1 < count else None]
        if radius == 0 and any(s is not None and s.kind == "turn" for s in beside):
            raise InputError(
                f"{where}: segments[{i}]: a turn beside another needs a radius_m over 0"
            )
        round_ = abs(angle) >= math.pi - 1e-9
        trims[i] = math.nan if round_ else radius * math.tan(abs(angle) / 2)
    own = [_own_length(where, segments, trims, i, closed) for i in range(count)]
    first = trims[-1] if closed and segments[-1].kind == "turn" else 0.0
    at, heading, walked = np.array([0.0 if math.isnan(first) else first, 0.0]), 0.0, 0.0
    points, turns = [at], []
    for i, (kind, value, radius) in enumerate(segments):
        if kind != "turn":
            at = at + own[i] * np.array([math.cos(heading), math.sin(heading)])
            points += [at] if own[i] > 1e-9 else []
            walked += own[i]
            continue
        points += list(arc := _arc(at, heading, value, radius))
        at, heading, bend = (arc[-1] if len(arc) else at), heading + value, abs(value) * radius
        if value:
            turns.append(Turn(walked + bend / 2, value, radius))
        walked += bend
    if closed:
        off, turned = at - points[0], math.degrees(math.remainder(heading, 2 * math.pi))
        if np.hypot(*off) > 1e-6 or abs(turned) > 1e-4:
            raise InputError(
                f"{where}: closed = true, but the segments end {off[0]:.3g} m ahead and "
                f"{off[1]:.3g} m left of the start, turned by {turned:.3g}°"
            )
        points[-1] = points[0]
    return np.array(points), tuple(turns)


def _own_length(
    where: str, segments: Sequence[Segment], trims: Sequence[float], i: int, closed: bool
) -> float:
    """The length (m) of the straight `i` between the arcs beside it; 0 for a turn."""
    kind, value, _ = segments[i]
    if kind == "turn":
        return 0.0
    if kind == "length":
        return value
    before = trims[i - 1] if i or closed else 0.0
    after = trims[(i + 1) % len(segments)] if i + 1 < len(segments) or closed else 0.0
    if math.isnan(before + after):
        raise InputError(
            f"{where}: segments[{i}]: straight_m runs to a corner point, and a turn of 180° or "
            "more has none: write length_m, the straight's own length"
        )
    if value < before + after - 1e-9:
        raise InputError(
            f"{where}: a radius_m is too large for the straights beside it: segments[{i}] needs a "
            f"straight_m of {before + after:.4g} or more"
        )
    return max(value - before - after, 0.0)


def _arc(entry: np.ndarray, heading: float, angle: float, radius: float) -> np.ndarray:
    """Points (n, 2) on an arc after its entry, in chords of at most `ARC_STEP`."""
    if radius == 0 or angle == 0:
        return np.zeros((0, 2))
    count = max(1, math.ceil(abs(angle) / ARC_STEP))
    bearings = heading + angle * (np.arange(count) + 0.5) / count
    chord = 2 * radius * math.sin(abs(angle) / count / 2)
    steps = chord * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    return entry + np.cumsum(steps, axis=0)


def _require_simple(where: str, points: np.ndarray, closed: bool) -> None:
    """Raises `InputError` where a centre line crosses itself."""
    from shapely import LinearRing, LineString

    line = LinearRing(points) if closed and len(points) > 3 else LineString(points)
    if not line.is_simple:
        raise InputError(
            f"{where}: the centre line crosses itself: write crosses = true if it should"
        )


def _opened(where: str, points: np.ndarray, closed: bool, width: float) -> np.ndarray:
    """Walls (m, 4) of a corridor that crosses itself: the outline of all of it."""
    from shapely import Polygon, unary_union

    sides = [_offset(points, closed, side * width / 2) for side in (1, -1)]
    pieces = [
        Polygon([(*left[:2],), (*left[2:],), (*right[2:],), (*right[:2],)])
        for left, right in zip(*sides, strict=True)
    ]
    area = unary_union([piece.buffer(1e-6) for piece in pieces]).simplify(1e-4)
    if not isinstance(area, Polygon):
        raise InputError(f"{where}: the corridor is not in one piece")
    walls = walls_around(area, where)
    if not closed:  # it is open at its ends
        middle = (walls[:, :2] + walls[:, 2:]) / 2
        ends = np.array([points[0], points[-1]])
        away = np.min(np.hypot(*(middle[:, None] - ends).T), axis=0)
        walls = walls[away > 1e-3]
    return walls


def _offset(points: np.ndarray, closed: bool, aside: float) -> np.ndarray:
    """Wall segments (m, 4) of the polyline moved to the left by `aside`, with mitred corners."""
    steps = np.diff(points, axis=0)
    along = steps / np.hypot(*steps.T)[:, None]
    before = np.roll(along, 1, axis=0) if closed else np.vstack([along[:1], along[:-1]])
    normal = lambda d: np.stack([-d[:, 1], d[:, 0]], axis=1)  # noqa: E731  # used thrice
    bisector = normal(along) + normal(before)
    joint = 2 * bisector / np.sum(bisector**2, axis=1)[:, None]
    shifted = points[:-1] + aside * joint
    last = shifted[:1] if closed else points[-1:] + aside * normal(along[-1:])
    ends = np.vstack([shifted, last])
    return np.hstack([ends[:-1], ends[1:]])


def place(course: Course, distance: float) -> tuple[float, float, float]:
    """x, y and heading of the centre line at a distance (wrapped on a closed course)."""
    marks = course.marks
    if course.closed:
        distance = distance % course.length
    i = int(np.clip(np.searchsorted(marks, distance, side="right") - 1, 0, len(marks) - 2))
    step = course.line[i + 1] - course.line[i]
    x, y = course.line[i] + step * (distance - marks[i]) / (marks[i + 1] - marks[i])
    return float(x), float(y), float(math.atan2(step[1], step[0]))


def follow_within(course: Course) -> float:
    """The largest way along the centre line (m) that a car may move on at once.

    It is 1.5 corridor widths w, and more where a mitred corner of angle a is sharp: a car that cuts
    it close to the inner wall passes nearly w tan(a / 2) of the line as it crosses the bisector.
    """
    sharp = [abs(turn.angle) for turn in course.turns if not turn.radius]
    cut = math.tan(min(max(sharp, default=0.0), SHARPEST) / 2)
    return (course.width or 1.0) * max(1.5, 1.15 * cut)


def progress(course: Course, xs: np.ndarray, ys: np.ndarray, last: float) -> np.ndarray:
    """Unwrapped distance along the centre line of each position, starting from `last`.

    Each position goes to the nearest place of the line within `follow_within` of the place before.
    So neither a neighbouring straight nor the start line confuses it.
    """
    if not len(course.line):
        return np.zeros(len(xs))
    marks, steps = course.marks[:-1], np.diff(course.line, axis=0)
    lengths = np.hypot(*steps.T)
    along = steps / lengths[:, None]
    near = follow_within(course)
    found = np.empty(len(xs))
    for n, (x, y) in enumerate(zip(xs, ys, strict=True)):
        on = np.clip((np.array([x, y]) - course.line[:-1]) * along @ [1.0, 1.0], 0.0, lengths)
        away = np.hypot(*(course.line[:-1] + on[:, None] * along - [x, y]).T)
        where = marks + on
        if course.closed:
            where = where + np.round((last - where) / course.length) * course.length
        away = np.where(np.abs(where - last) <= near, away, np.inf)
        best = int(np.argmin(away))
        last = float(where[best]) if np.isfinite(away[best]) else last
        found[n] = last
    return found


def grip_speed(course: Course, car: Car) -> float:
    """The highest speed (m/s) at which every corner of a corridor can be taken without sliding.

    The car's centre takes one arc per corner, from the outer side over the inner corner to the
    outer side. The free width w is the corridor's less the car's. An arc of radius R about a corner
    of angle a fits if R (1 - cos(a/2)) <= w. Neighbouring arcs share the straight between them:
    R (tan(a/2) + tan(b/2)) <= its length where the car drives. Then v² = mu g R. In a steady turn
    each axle carries its own share of the weight, so the one with the lesser mu slides first.
    Without corners the speed is inf.
    """
    if course.width is None or not course.turns:
        return math.inf
    free = course.width - float(car.body.width)
    grip = min(float(t.peak_friction) for t in (car.tires.front, car.tires.rear))
    radius = min(free / (1 - math.cos(abs(t.angle) / 2)) for t in course.turns)
    pairs = list(zip(course.turns, course.turns[1:], strict=False))
    if course.closed:
        first = course.turns[0]
        pairs.append((course.turns[-1], first._replace(distance=first.distance + course.length)))
    for one, two in pairs:
        tangents = math.tan(abs(one.angle) / 2) + math.tan(abs(two.angle) / 2)
        # Turns of one hand share their outer side, which is longer than the centre line.
        outer = free / 2 * tangents if one.angle * two.angle > 0 else 0.0
        radius = min(radius, (two.distance - one.distance + outer) / tangents)
    return math.sqrt(grip * GRAVITY * radius)
