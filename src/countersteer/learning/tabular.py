"""Dynamic programming: the best value of each state of a grid, for a car that is wholly known.

    V(s) = max over a of  r(s, a) + discount · V(s'(s, a))

The floor is alike everywhere. So one batched sweep drives each motion with each action from the
origin; each pose of the grid is then moved by what came of it. That is the whole table of
transitions: states × actions, for the price of motions × actions drives.

V at s' is interpolated in the simplex of poses and in that of motions. The solution is by modified
policy iteration: one sweep over all actions, then `SWEEPS` with the best of them held.

Rewards are those of `task.reward` that a state tells: time, road, goal and progress. A closed
course has no end, so its laps are discounted (`Job.horizon`); on an open one the goal ends a drive.

Source: M. Puterman and M. Shin, Modified Policy Iteration Algorithms for Discounted Markov Decision
Problems, Management Science 24, 1978; R. Munos and A. Moore, Variable Resolution Discretization in
Optimal Control, Machine Learning 49, 2002 (Kuhn's simplices).
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import shapely

from countersteer.batch import engine
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.course.way import SPACING, start_of
from countersteer.drivers import stored, tabular
from countersteer.drivers.grid import (
    BY_NAME,
    KINDS,
    MOST_POINTS,
    MOST_STATES,
    Dimension,
    Grid,
    Table,
)
from countersteer.drivers.tabular import SAMPLES, Frame, driven, frame_of, in_frame, moved, repeats
from countersteer.errors import InputError
from countersteer.planning.clearance import clearance_of
from countersteer.reading.values import short
from countersteer.signals import Array, Command, Scalar
from countersteer.task.reward import Reward
from countersteer.viewing.slices import Slice

# What `learn tabular` takes. It laps `box`; docs/tabular.md has a smaller one that does.
DIMENSIONS = ("place_m=0.2", "offset_m=0.2", "heading_deg=-90:90:18",
              "vx_mps=0:2.8:0.7", "vy_mps=-1.2:1.2:0.6", "yaw_rate_degps=-345:345:115",
              "steering_deg=-28:28:28")  # fmt: skip
WEIGHTS = Reward(time=0.0, road=-10.0, goal=10.0, progress=1.0)
TERMS = ("time", "road", "goal", "progress")  # of the reward: those that a state tells
SWEEPS = 20  # with a policy held, between two over all actions
MOST_ROUNDS = 200
SETTLED = 0.02  # largest change of a value in a sweep over all actions at the end
TOUCH = (0.03, 0.03, math.radians(6))  # m, m, rad: steps of the poses that are tested for a touch
ASIDE = 0.1  # m, by which a car's centre stays off the walls
PIECES = 32  # of the table, for progress
KEPT = 0.01  # steps of the values in a file: they pack better
FAILED, ARRIVED = -1, -2  # in place of a pose


@dataclasses.dataclass(frozen=True)
class Job:
    """What is learned, and how."""

    course: Course
    car_name: str
    car: Car
    table: Table
    throttle: tuple[float, ...]
    steering: tuple[float, ...]  # rad
    decision: float  # s
    horizon: float  # s: rewards so far ahead count 1/e
    weights: Reward
    margin: float  # m from a wall that count as a touch

    @property
    def actions(self) -> Command:
        """All actions (n,): each throttle with each steering angle."""
        both = np.meshgrid(self.throttle, self.steering, indexing="ij")
        return Command(*(part.ravel().astype(np.float32) for part in both))

    @property
    def discount(self) -> float:
        """Of a decision."""
        return math.exp(-self.decision / self.horizon)


class Transitions(NamedTuple):
    """What each action makes of each state: M motions, A actions, P poses."""

    motions: Array  # (M, A, n + 1) corners of the motion behind it
    motion_weights: Array  # (M, A, n + 1)
    pose: Array  # (M, A, P) lowest corner of the pose behind it, or FAILED, or ARRIVED
    parts: Array  # (M, A, dimensions, P) uint8: the parts of its cell, over 255
    progress: Array  # (M, A, P) m, in 16 bits


class Solution(NamedTuple):
    """Values and best actions (motions, poses), and how the iteration went."""

    values: np.ndarray
    best: np.ndarray
    curve: list[dict[str, float]]  # a row for each sweep over all actions


def dimensions_of(words: Sequence[str], course: Course) -> Table:
    """The table for dimensions such as `vx_mps=0:3:0.5` or `offset_m=0.1`. Raises `InputError`.

    A range may be left out: then it is the course's own, or `grid.KINDS`'. The number of steps is
    the next whole one.
    """
    dimensions = [_dimension(word, course) for word in words]
    pose = [d for d in dimensions if BY_NAME[d.name].pose]
    motion = [d for d in dimensions if not BY_NAME[d.name].pose]
    tabular.check_dimensions("--dimensions", [d.word for d in pose], [d.word for d in motion])
    table = Table(Grid(tuple(pose)), Grid(tuple(motion)))
    if table.size > MOST_STATES:
        raise InputError(
            f"--dimensions: {table.size / 1e6:.0f} million states, over "
            f"{MOST_STATES / 1e6:.0f}: take longer steps"
        )
    return table


def _dimension(word: str, course: Course) -> Dimension:
    """A dimension of the command line."""
    name, _, text = word.partition("=")
    if name not in BY_NAME:
        known = ", ".join(kind.name for kind in KINDS)
        raise InputError(f"--dimensions {short(word)}: give one of {known}")
    kind = BY_NAME[name]
    try:
        numbers = [kind.factor * float(part) for part in text.split(":")]
        if len(numbers) not in (1, 3) or not all(map(math.isfinite, numbers)):
            raise ValueError
    except ValueError:
        raise InputError(
            f"--dimensions {short(word)}: write {name}=STEP or {name}=LOW:HIGH:STEP"
        ) from None
    if name == "place_m" and course.closed and len(numbers) == 3:
        raise InputError(
            f"--dimensions {short(word)}: a closed course has its own range: write place_m=STEP"
        )
    step = numbers[-1]
    low, high = numbers[:2] if len(numbers) == 3 else _range(name, course)
    if not (high > low and step > 0):
        raise InputError(f"--dimensions {short(word)}: needs LOW < HIGH and STEP > 0")
    points = max(2, math.ceil((high - low) / step - 1e-6) + 1)
    if points > MOST_POINTS:
        raise InputError(f"--dimensions {short(word)}: {points} points, over {MOST_POINTS}")
    full = name == "heading_deg" and high - low > 2 * math.pi - 1e-6
    return Dimension(name, low, high, points, full or (name == "place_m" and course.closed))


def _range(name: str, course: Course) -> tuple[float, float]:
    """The range of a dimension without one."""
    kind = BY_NAME[name]
    if kind.low < kind.high:
        return kind.low, kind.high
    if name == "offset_m":
        half = (course.width or 1.0) / 2 - ASIDE
        return -half, half
    if name == "place_m":
        frame = frame_of(course)
        if course.closed:
            return 0.0, SPACING * int(frame.way.whole) / repeats(course)
        begin = start_of(course, frame.way)
        return begin - 0.5, begin + _lap(course) + 0.5
    ends = course.walls.reshape(-1, 2)[:, 0 if name == "x_m" else 1]
    return float(ends.min()), float(ends.max())


def goal_of(course: Course, frame: Frame) -> float:
    """The place of the goal (m), which ends a drive on an open course; a closed one has no end."""
    return math.inf if course.closed else start_of(course, frame.way) + _lap(course)


def _lap(course: Course) -> float:
    """From start to goal along the line, m. Raises `InputError` without a goal."""
    end = course.lap_end(1)
    if end is None:
        raise InputError(f"{course.name}: has no goal, so nothing can be learned there")
    return end - course.start_distance


class Touching(NamedTuple):
    """Poses on a fine grid at which the car touches a wall."""

    grid: Grid
    touches: Array  # (size,)

    def at(self, values: Mapping[str, Scalar]) -> Scalar:
        """Whether the nearest pose touches."""
        base, parts = self.grid.locate(values)
        up = [jnp.round(p).astype(jnp.int32) for p in parts]
        return self.touches[base + sum(u * s for u, s in zip(up, self.grid.strides, strict=True))]


def touching(job: Job, frame: Frame) -> Touching:
    """The poses of a fine grid at which the car's rectangle is within the margin of a wall."""
    fine = Grid(
        tuple(
            d._replace(points=max(2, math.ceil((d.high - d.low) / step) + 1))
            for d, step in zip(job.table.pose.dimensions, TOUCH, strict=True)
        )
    )
    nodes = {word: jnp.asarray(v, jnp.float32) for word, v in fine.nodes().items()}
    x, y, heading = (np.asarray(part, float) for part in jax.vmap(lambda at: frame.pose(at))(nodes))
    body = job.car.body
    ahead = float(body.center) + float(body.length) / 2 * np.array([1, 1, -1, -1, 1])
    left = float(body.width) / 2 * np.array([1, -1, -1, 1, 1])
    cosine, sine = np.cos(heading)[:, None], np.sin(heading)[:, None]
    ring = np.stack([x[:, None] + cosine * ahead - sine * left,
                     y[:, None] + sine * ahead + cosine * left], axis=-1)  # fmt: skip
    pieces: Any = shapely.linestrings(job.course.walls.reshape(-1, 2, 2))
    walls: Any = shapely.multilinestrings(pieces)
    walls = shapely.buffer(walls, job.margin) if job.margin > 0 else walls
    shapely.prepare(walls)
    away = jax.tree.map(jnp.asarray, clearance_of(job.course, frame.way))
    beyond = np.asarray(away.clear(x, y)) <= 0
    return Touching(fine, jnp.asarray(shapely.intersects(walls, shapely.polygons(ring)) | beyond))


class Poses(NamedTuple):
    """The grid's poses in the world: arrays (P,)."""

    x: Array
    y: Array
    heading: Array
    place: Array
    touches: Array


def poses_of(job: Job, frame: Frame, touch: Touching) -> Poses:
    """The poses of the table's grid."""
    grid = job.table.pose
    nodes = {word: jnp.asarray(v, jnp.float32) for word, v in grid.nodes().items()}
    x, y, heading = jax.vmap(lambda at: frame.pose(at))(nodes)
    if "place" in nodes:
        place = nodes["place"]
    else:
        place = SPACING * jnp.asarray(nearest_rows(frame, x, y), jnp.float32)
    return Poses(x, y, heading, place, jax.vmap(touch.at)(nodes))


def nearest_rows(frame: Frame, x: Any, y: Any) -> np.ndarray:
    """The rows of the way that are nearest to points."""
    rows = slice(0, int(frame.way.last) + 1)
    tree = shapely.STRtree(shapely.points(frame.way.x[rows], frame.way.y[rows]))
    found: np.ndarray = tree.nearest(shapely.points(x, y))
    return found


def reactions(job: Job) -> Any:
    """The motion of each motion and action from the origin: leaves (M A, SAMPLES)."""
    count = len(job.actions.throttle)
    nodes = {
        word: np.repeat(v, count).astype(np.float32) for word, v in job.table.motion.nodes().items()
    }
    size = job.table.motion.size
    actions = Command(*(np.tile(part, size) for part in job.actions))
    car = jax.tree.map(lambda leaf: np.float32(leaf), job.car)

    def one(at: dict[str, Scalar], action: Command) -> Any:
        # What the table does not hold is taken as settled.
        steering = at.get("steering", action.steering)
        before = Command(action.throttle, steering)
        return driven(car, tabular.velocity(at), steering, before, action, job.decision)

    return jax.jit(jax.vmap(one))(nodes, actions)


def transitions(
    job: Job,
    frame: Frame,
    cores: int,
    report: Callable[[float], None] = lambda _: None,
) -> tuple[Transitions, Poses]:
    """The whole table. `report` is told the part that is done."""
    grid, motion_grid = job.table
    size, count = motion_grid.size, len(job.actions.throttle)
    touch = touching(job, frame)
    poses = poses_of(job, frame, touch)
    after = reactions(job)
    end = jax.tree.map(lambda leaf: leaf[:, -1], after)
    corners, weights = tabular.interpolation(motion_grid, tabular.motion_seen(end))
    by = np.stack([after.x, after.y, after.heading], axis=1)  # (M A, 3, SAMPLES)
    goal = goal_of(job.course, frame)

    def one(by: Array) -> tuple[Array, Array, Array]:
        def of_pose(pose: Poses) -> tuple[Scalar, Array, Scalar]:
            at, fails = {}, jnp.asarray(False)
            for i in range(SAMPLES):
                there = moved((pose.x, pose.y, pose.heading), (by[0, i], by[1, i], by[2, i]))
                seen = frame.seen(there, pose.place)
                at = in_frame(grid, seen)
                fails = fails | touch.at(at) | ~grid.inside(at)
            base, parts = grid.locate(at)
            base = jnp.where(at["place"] >= goal, ARRIVED, base)
            small = jnp.stack([jnp.round(255 * part).astype(jnp.uint8) for part in parts])
            gone = (at["place"] - pose.place).astype(jnp.float16)
            return jnp.where(fails, FAILED, base), small, gone

        return jax.vmap(of_pose, out_axes=(0, 1, 0))(poses)

    mesh = engine.all_cores(cores)
    run = jax.jit(engine.on_cores(lambda rows: jax.lax.map(one, rows), mesh, (True,)))
    found = []
    width = math.ceil(len(by) / PIECES / cores) * cores
    for first in range(0, len(by), width):
        rows = np.arange(first, first + width) % len(by)
        left = len(by) - first
        found.append([np.asarray(leaf)[:left] for leaf in run(by[rows])])
        report(min(1.0, (first + width) / len(by)))
    base, parts, gone = (np.concatenate(leaves) for leaves in zip(*found, strict=True))
    return Transitions(
        np.stack(corners, axis=-1).reshape(size, count, -1).astype(np.int32),
        np.stack(weights, axis=-1).reshape(size, count, -1).astype(np.float32),
        base.reshape(size, count, -1),
        parts.reshape(size, count, len(grid.dimensions), -1),
        gone.reshape(size, count, -1),
    ), poses


def corners_of(grid: Grid, base: Array, parts: Array) -> tuple[list[Array], list[Array]]:
    """The corners around stored poses, and their weights. `parts` has the dimensions first."""
    exact = [part.astype(jnp.float32) / 255 for part in parts]
    return grid.simplex(jnp.maximum(base, 0), exact)


def ended(job: Job, base: Array, value: Array) -> Array:
    """The value, or what a drive that ends is worth."""
    value = jnp.where(base == FAILED, job.weights.road, value)
    return jnp.where(base == ARRIVED, job.weights.goal, value)


class Solver:
    """The sweeps over a table, compiled for all cores."""

    def __init__(self, job: Job, table: Transitions, poses: Poses, cores: int) -> None:
        """Copies the table to the cores."""
        self.job, self.touches = job, poses.touches
        self.count = job.table.motion.size
        mesh = engine.all_cores(cores)
        # Each core has as many motions: the first ones fill up.
        rows = np.arange(math.ceil(self.count / cores) * cores) % self.count
        self.size = len(rows)
        whole = jax.tree.map(lambda leaf: leaf if len(leaf) == len(rows) else leaf[rows], table)
        self.table = engine.shared_out(whole, cores)
        shared, own = False, True
        self._improve = jax.jit(engine.on_cores(self._best, mesh, (shared, own)))
        self._hold = jax.jit(engine.on_cores(self._held, mesh, (shared, own, own)))

    def solve(
        self,
        report: Callable[[dict[str, float]], None] = lambda _: None,
        look: Callable[[Array], float] | None = None,
    ) -> Solution:
        """Iterate until the values have settled. `report` is told each row of the curve.

        `look` makes a figure `metres` of the values (motions, poses) of each row.
        """
        values = jnp.zeros((self.size, self.job.table.pose.size), jnp.float32)
        curve: list[dict[str, float]] = []
        spent = 0.0
        for number in range(1, MOST_ROUNDS + 1):
            begun = time.process_time()
            new, best = self._improve(values, self.table)
            change = float(jnp.max(jnp.abs(new - values)))
            values = new
            spent += time.process_time() - begun
            row = {"sweep": float(number), "change": change, "cpu_s": spent}
            if look is not None:
                row["metres"] = look(values[: self.count])
            curve.append(row)
            report(row)
            if change < SETTLED:
                break
            begun = time.process_time()
            for _ in range(SWEEPS):
                values = self._hold(values, best, self.table)
            values.block_until_ready()
            spent += time.process_time() - begun
        return Solution(np.asarray(values)[: self.count], np.asarray(best)[: self.count], curve)

    def _step(self, base: Array, gone: Array, value: Array) -> Array:
        """The value of a decision."""
        job = self.job
        gain = job.weights.time * job.decision + job.weights.progress * gone.astype(jnp.float32)
        return ended(job, base, gain + job.discount * value)

    def _best(self, values: Array, table: Transitions) -> tuple[Array, Array]:
        """A sweep over all actions: values and best actions."""

        def action(one: Transitions) -> Array:
            # First the motion: whole rows of the table, which are read in order.
            row = one.motion_weights @ values[one.motions]
            corners, weights = corners_of(self.job.table.pose, one.pose, one.parts)
            value = sum(w * row[c] for c, w in zip(corners, weights, strict=True))
            return self._step(one.pose, one.progress, value)

        def motion(one: Transitions) -> tuple[Array, Array]:
            promised = jax.lax.map(action, one)
            best = jnp.argmax(promised, axis=0).astype(jnp.uint8)
            return self._grounded(jnp.max(promised, axis=0)), best

        found: tuple[Array, Array] = jax.lax.map(motion, table)
        return found

    def _held(self, values: Array, best: Array, table: Transitions) -> Array:
        """A sweep with the policy held."""
        flat, width = values.reshape(-1), self.job.table.pose.size
        pose = jnp.arange(width)

        def motion(told: tuple[Array, Transitions]) -> Array:
            chosen, one = told[0].astype(jnp.int32), told[1]
            base = one.pose[chosen, pose]
            parts = one.parts[chosen, :, pose].T
            corners, weights = corners_of(self.job.table.pose, base, parts)
            motions, motion_weights = one.motions[chosen], one.motion_weights[chosen]
            value = sum(
                motion_weights[:, i]
                * sum(
                    w * flat[width * motions[:, i] + c]
                    for c, w in zip(corners, weights, strict=True)
                )
                for i in range(motions.shape[1])
            )
            return self._grounded(self._step(base, one.progress[chosen, pose], value))

        found: Array = jax.lax.map(motion, (best, table))
        return found

    def _grounded(self, values: Array) -> Array:
        """A pose that touches a wall has failed."""
        return jnp.where(self.touches, self.job.weights.road, values)


def policy_file(
    job: Job, values: np.ndarray, learned: Mapping[str, Any], cost: Mapping[str, float]
) -> bytes:
    """The content of a policy's file. Values are kept in steps of `KEPT`.

    `learned` says how, and `cost` has `samples` and `cpu_s`.
    """
    about = {
        "kind": tabular.KIND,
        "format": tabular.FORMAT,
        "course": job.course.name,
        "car": job.car_name,
        "task": "lap",
        **tabular.grids_told(job.table),
        "decision_s": job.decision,
        "discount": job.discount,
        "reward": {name: getattr(job.weights, name) for name in TERMS},
        "learned_with": {"horizon_s": job.horizon, "margin_m": job.margin, **learned},
        "cost": dict(cost),
        "fingerprint": stored.fingerprint(job.course, job.car),
    }
    values = KEPT * np.round(values / KEPT)
    arrays = {"values": values.astype(np.float16), **job.actions._asdict()}
    return stored.packed(arrays, about)


class Learned(NamedTuple):
    """What `learn` returns."""

    solution: Solution
    cost: dict[str, float]  # for the record


def learn(
    job: Job,
    cores: int,
    report: Callable[[str, float], None] = lambda *_: None,
    look: Callable[[Array], float] | None = None,
) -> Learned:
    """The table, and its solution. `report` is told what is done: a part, or the last change.

    `look` is `Solver.solve`'s.
    """
    begun = time.process_time()
    table, poses = transitions(job, frame_of(job.course), cores, lambda part: report("table", part))
    made = time.process_time()
    solver = Solver(job, table, poses, cores)
    placed = time.process_time()
    solution = solver.solve(lambda row: report("change", row["change"]), look)
    count = len(job.actions.throttle)
    cost = {
        "samples": float(job.table.motion.size * count),
        "transitions": float(job.table.size * count),
        "table_cpu_s": made - begun,
        "cpu_s": placed - begun + solution.curve[-1]["cpu_s"],
    }
    return Learned(solution, cost)


SHOWN = (0.5, 0.85)  # speeds of the slices, over the fastest of the grid


def slices(job: Job, solution: Solution) -> list[Slice]:
    """Slices at two speeds, straight along the course."""
    frame, grid = frame_of(job.course), job.table.pose
    shape = grid.shape
    nodes = {word: jnp.asarray(v, jnp.float32) for word, v in grid.nodes().items()}
    x, y, heading = (
        np.asarray(part).reshape(shape) for part in jax.vmap(lambda at: frame.pose(at))(nodes)
    )
    near = nearest_rows(frame, x[..., 0].ravel(), y[..., 0].ravel()).reshape(shape[:2])
    bearing = np.arctan2(frame.way.along_y[near], frame.way.along_x[near])
    off = np.abs(np.angle(np.exp(1j * (heading - np.asarray(bearing)[..., None]))))
    along = np.argmin(off, axis=-1)[..., None]  # of the headings, the one along the course

    def shown(table: np.ndarray) -> np.ndarray:
        return np.take_along_axis(table.reshape(shape), along, axis=-1)[..., 0]

    motions = job.table.motion.nodes()
    fast = "vx" if "vx" in motions else "speed"
    found = []
    for part in SHOWN:
        speed = part * np.max(motions[fast])
        away = sum(((v - (speed if word == fast else 0.0)) / max(np.ptp(v), 1e-9)) ** 2
                   for word, v in motions.items())  # fmt: skip
        motion = int(np.argmin(away))
        best, value = shown(solution.best[motion]), shown(solution.values[motion])
        value = np.where(value <= job.weights.road + 1e-3, np.nan, value)
        actions = job.actions
        found.append(
            Slice(
                f"{motions[fast][motion]:.2g} m/s along the course",
                x[..., 0],
                y[..., 0],
                value,
                np.where(np.isnan(value), np.nan, actions.throttle[best]),
                np.where(np.isnan(value), np.nan, np.degrees(actions.steering[best])),
            )
        )
    return [turned(one, job.course, frame, grid) for one in found]


def turned(one: Slice, course: Course, frame: Frame, grid: Grid) -> Slice:
    """The slice on the whole lap, of a grid that holds a repeated part of it."""
    count = repeats(course) if grid.dimensions[0].word == "place" else 1
    if count == 1:
        return one
    rows = slice(0, int(frame.way.whole))
    middle = float(np.mean(frame.way.x[rows])), float(np.mean(frame.way.y[rows]))
    angle = sum(turn.angle for turn in course.turns) / count
    xs, ys = [], []
    for i in range(count):
        cosine, sine = math.cos(i * angle), math.sin(i * angle)
        dx, dy = one.x - middle[0], one.y - middle[1]
        xs.append(middle[0] + cosine * dx - sine * dy)
        ys.append(middle[1] + sine * dx + cosine * dy)
    tables = (np.concatenate([table] * count) for table in one[3:])
    return Slice(one.name, np.concatenate(xs), np.concatenate(ys), *tables)
