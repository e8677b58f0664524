"""A table of values that dynamic programming filled: it drives where the model promises most.

The table (`drivers.grid`) holds the value of each state: what a drive from there is worth. Each
`PERIOD` the driver drives the nominal car's model through each action for one decision, and takes

    argmax over a of  r(s, a) + discount · V(s'(s, a))

V is interpolated. The model begins at the estimate, so it is told more than the table may hold:
the steering angle follows from the commands given. `learn tabular` makes the file.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.way import Way, start_of, way_of
from countersteer.drivers import stored
from countersteer.drivers.driver import Observation, paced
from countersteer.drivers.grid import KINDS, Dimension, Grid, Table
from countersteer.errors import InputError
from countersteer.reading.values import short, shown
from countersteer.signals import Array, Command, Motion, Scalar
from countersteer.world import motor, planar, plant, servo

KIND = "tabular"
FORMAT = 1
PERIOD = 0.02  # s between two decisions of the driver
STEP = 0.01  # s of the model
ROUNDING = 0.5  # corridor widths: so round, the way's normals do not cross before the inner corner
FRAMES = (("place", "offset", "heading"), ("x", "y", "heading"))
SAMPLES = 2  # poses of a decision that are looked at: at its middle and its end


class Frame(NamedTuple):
    """How a pose is told in a table: along the course, or in the world's axes."""

    way: Way  # rounded by `ROUNDING`

    def pose(self, at: Mapping[str, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        """x, y and heading of a grid's point."""
        if "x" in at:
            return at["x"], at["y"], at["heading"]
        row = self.way.row(at["place"])
        x, y = self.way.point(at["place"])
        along_x, along_y = self.way.along_x[row], self.way.along_y[row]
        heading = jnp.arctan2(along_y, along_x) + at["heading"]
        return x - at["offset"] * along_y, y + at["offset"] * along_x, heading

    def seen(self, pose: tuple[Scalar, Scalar, Scalar], near: Scalar) -> dict[str, Scalar]:
        """All that dimensions may ask of a pose; `near` is a place of before.

        `heading` is off the way, `world_heading` off the x axis.
        """
        x, y, heading = pose
        place = self.way.follow(x, y, near)
        row = self.way.row(place)
        along_x, along_y = self.way.along_x[row], self.way.along_y[row]
        on_x, on_y = self.way.point(place)
        cosine, sine = jnp.cos(heading), jnp.sin(heading)
        off = jnp.arctan2(along_x * sine - along_y * cosine, along_x * cosine + along_y * sine)
        offset = along_x * (y - on_y) - along_y * (x - on_x)
        return {
            "x": x, "y": y, "world_heading": heading,
            "place": place, "offset": offset, "heading": off,
        }  # fmt: skip


def in_frame(grid: Grid, seen: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """What the dimensions of a pose's grid ask of what is seen."""
    found = dict(seen)
    if grid.dimensions[0].word == "x":
        found["heading"] = seen["world_heading"]
    return found


def moved(
    pose: tuple[Scalar, Scalar, Scalar], by: tuple[Scalar, Scalar, Scalar]
) -> tuple[Scalar, Scalar, Scalar]:
    """A pose after a motion, which is told in the pose's axes."""
    x, y, heading = pose
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    return (
        x + cosine * by[0] - sine * by[1],
        y + sine * by[0] + cosine * by[1],
        heading + by[2],
    )


def motion_seen(motion: Motion) -> dict[str, Scalar]:
    """All that dimensions may ask of a motion."""
    speed = jnp.sqrt(motion.vx**2 + motion.vy**2)
    # At rest the sideslip is 0.
    sideslip = jnp.arctan2(motion.vy, jnp.maximum(jnp.abs(motion.vx), 1e-3))
    return {
        "vx": motion.vx, "vy": motion.vy, "speed": speed, "sideslip": sideslip,
        "yaw_rate": motion.yaw_rate, "steering": motion.steering,
    }  # fmt: skip


def velocity(at: Mapping[str, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
    """vx, vy and yaw rate of a grid's point. What the table does not hold is 0."""
    yaw_rate = at.get("yaw_rate", 0.0)
    if "vx" in at:
        return at["vx"], at.get("vy", 0.0), yaw_rate
    sideslip = at.get("sideslip", 0.0)
    return at["speed"] * jnp.cos(sideslip), at["speed"] * jnp.sin(sideslip), yaw_rate


def driven(
    car: Car,
    velocity: tuple[Scalar, Scalar, Scalar],
    steering: Scalar,
    before: Command,
    action: Command,
    decision: float,
) -> Motion:
    """The motion from the origin under one command: leaves (SAMPLES,), the last at the end.

    The wheels roll at first, and the motor follows the command `before`, which also holds until
    the delays are over.
    """
    zero = jnp.zeros_like(velocity[0])
    origin: Any = (zero, zero, zero)
    state: Any = planar.initial_state(car, STEP, origin, velocity, 1.0, 1)
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf, zero.dtype) + zero, state)
    duty = motor.duty(car.motor, before.throttle) + zero
    state = state._replace(motion=state.motion._replace(steering=steering + zero, duty=duty))
    every = max(1, round(decision / STEP / SAMPLES))
    time = STEP * (jnp.arange(every * SAMPLES, dtype=zero.dtype) + 0.5)
    commands = Command(
        jnp.where(time < car.motor.delay, before.throttle, action.throttle),
        jnp.where(time < car.servo.delay, before.steering, action.steering),
    )
    _, seen = plant.rollout(car, state, commands, every, STEP, lambda state: state.motion)
    return seen


class TableMemory(NamedTuple):
    """Between two decisions."""

    time: Scalar  # s
    command: Command
    place: Scalar  # m along the way
    steering: Scalar  # rad, by the servo's model


@pytree
class TableDriver:
    """Drives by a table of values, on any estimate with a pose."""

    frame: Frame
    car: Car  # the nominal one
    values: Array  # (motions, poses)
    throttle: Array  # (actions,)
    steering: Array  # (actions,) rad
    place: Scalar  # of the start along the way, m
    progress: Scalar  # reward a metre
    road: Scalar  # value of a failure
    discount: Scalar  # a decision
    table: Table = dataclasses.field(metadata={"static": True})
    decision: float = dataclasses.field(metadata={"static": True})  # s

    def reset(self, key: jax.Array) -> TableMemory:
        """At the start, without a command."""
        del key
        return TableMemory(-1.0, Command(0.0, 0.0), self.place, 0.0)

    def act(self, memory: TableMemory, observation: Observation) -> tuple[Command, TableMemory]:
        """One control period."""
        return paced(self._think, memory, observation, PERIOD)

    def _think(self, memory: TableMemory, seen: Observation) -> tuple[Command, TableMemory]:
        known, before = seen.estimate, memory.command
        pose = (known.x, known.y, known.heading)
        place = self.frame.way.follow(known.x, known.y, memory.place)
        promised = jax.vmap(
            lambda throttle, steering: self.promise(
                pose,
                place,
                (known.vx, known.vy, known.yaw_rate),
                memory.steering,
                before,
                Command(throttle, steering),
            )
        )(self.throttle, self.steering)
        best = jnp.argmax(promised)
        command = Command(self.throttle[best], self.steering[best])
        steering = self._turned(memory.steering, before, command)
        return command, TableMemory(seen.time, command, place, steering)

    def promise(
        self,
        pose: tuple[Scalar, Scalar, Scalar],
        place: Scalar,
        velocity: tuple[Scalar, Scalar, Scalar],
        steering: Scalar,
        before: Command,
        action: Command,
    ) -> Scalar:
        """What an action is worth at a state: its reward, and the discounted value behind it."""
        start: Any = tuple(jnp.asarray(part, jnp.result_type(self.values)) for part in velocity)
        motion = driven(self.car, start, steering, before, action, self.decision)
        end: Motion = jax.tree.map(lambda leaf: leaf[-1], motion)
        at = self.frame.seen(moved(pose, (end.x, end.y, end.heading)), place)
        behind = worth(self.table, self.values, at, end)
        promised = self.progress * (at["place"] - place) + self.discount * behind
        return jnp.where(self.table.pose.inside(in_frame(self.table.pose, at)), promised, self.road)

    def _turned(self, steering: Scalar, before: Command, command: Command) -> Scalar:
        """The steering angle a `PERIOD` later."""
        old = jnp.clip(self.car.servo.delay, 0.0, PERIOD)
        held = servo.turn(
            self.car.servo, steering, servo.target(self.car.servo, before.steering), old
        )
        goal = servo.target(self.car.servo, command.steering)
        return servo.turn(self.car.servo, held, goal, PERIOD - old)


def interpolation(grid: Grid, at: Mapping[str, Scalar]) -> tuple[list[Scalar], list[Scalar]]:
    """The corners around a point, and their weights."""
    return grid.simplex(*grid.locate(at))


def worth(table: Table, values: Array, at: Mapping[str, Scalar], motion: Motion) -> Scalar:
    """The interpolated value of a state, from values (motions, poses)."""
    poses, pose_weights = interpolation(table.pose, in_frame(table.pose, at))
    motions, motion_weights = interpolation(table.motion, motion_seen(motion))
    found: Scalar = sum(
        m * sum(p * values[i, j] for j, p in zip(poses, pose_weights, strict=True))
        for i, m in zip(motions, motion_weights, strict=True)
    )
    return found


def frame_of(course: Course) -> Frame:
    """The frame of a course with a centre line. Raises `InputError`."""
    return Frame(jax.tree.map(jnp.asarray, way_of(course, ROUNDING)))


def repeats(course: Course) -> int:
    """How many times a closed course repeats itself on a lap: the corners of a box are alike."""
    if not course.closed or course.width is None or not course.turns:
        return 1
    marks = np.array([turn.distance for turn in course.turns])
    apart = np.diff(np.append(marks, marks[0] + course.length))
    shape = np.array([(t.angle, t.radius, a) for t, a in zip(course.turns, apart, strict=True)])
    count = len(shape)
    parts = (n for n in range(count, 0, -1) if count % n == 0)
    return next(n for n in parts if np.allclose(shape, np.roll(shape, count // n, axis=0)))


def table_driver(
    course: Course,
    car: Car,
    arrays: Mapping[str, np.ndarray],
    about: Mapping[str, Any],
    table: Table,
) -> TableDriver:
    """The driver of a file's content (`read_table`)."""
    frame = frame_of(course)
    reward: Any = about["reward"]
    return TableDriver(
        table=table,
        frame=frame,
        car=car,
        values=arrays["values"].astype(np.float32),
        throttle=arrays["throttle"],
        steering=arrays["steering"],
        place=start_of(course, frame.way),
        progress=float(reward["progress"]),
        road=float(reward["road"]),
        discount=float(about["discount"]),
        decision=float(about["decision_s"]),
    )


def grids_told(table: Table) -> dict[str, Any]:
    """The grids for a file: SI units and radians."""
    return {name: [list(d) for d in grid.dimensions] for name, grid in table._asdict().items()}


def read_table(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], Table]:
    """The arrays of a file, what it says, and its grids. Raises `InputError` in one line."""
    where = short(str(path))
    held, about = stored.read(path, KIND)
    if about.get("format") != FORMAT:
        raise InputError(
            f"{where}: is of another version (format {shown(about.get('format'))}): "
            f"learn it again with 'learn {KIND}'"
        )
    table = Table(*(_grid_told(where, name, about.get(name)) for name in Table._fields))
    for name in ("decision_s", "discount"):
        if not _is_number(about.get(name)) or not 0 < about[name] <= 1:
            raise InputError(f"{where}: {name} must be in (0, 1], not {shown(about.get(name))}")
    reward = about.get("reward")
    if not isinstance(reward, dict) or not all(
        _is_number(reward.get(name)) for name in ("progress", "road")
    ):
        raise InputError(f"{where}: reward must hold the numbers progress and road")
    count = held["throttle"].shape if "throttle" in held else ()
    shapes = {
        "values": (table.motion.size, table.pose.size),
        "throttle": count,
        "steering": count,
    }
    for name, shape in shapes.items():
        array = held.get(name)
        if array is None or array.dtype.kind != "f" or array.shape != shape or not array.size:
            raise InputError(f"{where}: {name} is missing, or does not fit the grid")
        if not np.all(np.isfinite(array)):
            raise InputError(f"{where}: {name} holds numbers that are not finite")
    if len(count) != 1:
        raise InputError(f"{where}: throttle must be a list")
    return held, about, table


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _grid_told(where: str, name: str, told: Any) -> Grid:
    """A grid that a file tells. Raises `InputError`."""
    known = {kind.name for kind in KINDS if kind.pose == (name == "pose")}
    try:
        grid = Grid(tuple(Dimension(*map(_plain, one)) for one in told))
        good = all(
            d.name in known and d.low < d.high and isinstance(d.points, int) and d.points > 1
            for d in grid.dimensions
        )
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(f"{where}: {name} is no grid: learn it again with 'learn {KIND}'")
    _check_words(where, [d.word for d in grid.dimensions], name)
    return grid


def _plain(value: Any) -> Any:
    """A cell of a grid's list: a text, a finite number or a truth value."""
    if isinstance(value, str | bool) or _is_number(value):
        return value
    raise TypeError


def _check_words(where: str, words: Sequence[str], name: str) -> None:
    """Raises `InputError` where dimensions do not make a pose, or a motion."""
    if name == "pose":
        if tuple(words) not in FRAMES:
            raise InputError(
                f"{where}: a pose is {' or '.join(', '.join(f) for f in FRAMES)}, "
                f"not {', '.join(words)}"
            )
    elif ("vx" in words) == ("speed" in words) or len(set(words)) < len(words):
        raise InputError(f"{where}: a motion has either vx or speed, and each dimension once")


def check_dimensions(where: str, pose: Sequence[str], motion: Sequence[str]) -> None:
    """Raises `InputError` where words of dimensions do not make a table."""
    _check_words(where, pose, "pose")
    _check_words(where, motion, "motion")
