"""MPPI: an expert driver that plans with the nominal car's model, 50 times a second.

Each decision draws `samples` sequences of commands around the best one so far, drives each of them
for `HORIZON` on the plant, and takes their mean with the weights

    w_i = exp(-(J_i - min J) / temperature)

J is the cost of a drive (`Costs`). The first command of the mean is given, and the rest, moved on
by a knot, is where the next decision begins. What no sensor reports (wheel speeds, steering, duty,
loads) is the model's own prediction from the commands that were given.

Source: G. Williams et al., Information-Theoretic Model Predictive Control, IEEE T-RO 34, 2018.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.course.way import Way, start_of, way_of
from countersteer.drivers.driver import Observation
from countersteer.planning.clearance import Clearance, clearance_of
from countersteer.signals import Array, Command, Motion, Scalar, Wheels
from countersteer.world import plant

KNOT = 0.02  # s for which a command is held: one decision
HORIZON = 0.8  # s
KNOTS = round(HORIZON / KNOT)
STEP = 0.01  # s of the plant
SAMPLES = 1000


class Costs(NamedTuple):
    """Weights of the terms of a drive's cost. Each term is a mean over the horizon, but progress.

    The unit is that of progress: a metre.
    """

    progress: float = 1.0  # per m along the line up to the goal, negative
    goal: float = 5.0  # of the part of the horizon that lies behind the goal, negative
    speed: float = 0.5  # behind the goal: of the speed, in m/s
    facing: float = 2.0  # behind the goal: of 1 - cos(heading off the line)
    clearance: float = 20.0  # of the square of how far a corner comes within `margin`, over it
    hit: float = 30.0  # of the time with a corner beyond a wall
    sideslip: float = 1.0  # of the square of how far the sideslip is from what it should be
    excess: float = 4.0  # factor of that on more sideslip than there should be
    straight: float = 1.0  # the part of that on straights, where it should be 0
    overshoot: float = 6.0  # of the square of the heading beyond the corner's way out, rad²
    smoothness: float = 0.05  # of the square of the change of a command, in full commands, a knot
    backwards: float = 10.0  # of facing against the line; the sideslip does not count there
    standing: float = 2.0  # before the goal: of the part by which the speed is under `SLOW`
    margin: float = 0.15  # m
    drift: float = math.radians(30)  # what the sideslip should be in corners


class Search(NamedTuple):
    """How commands are drawn. Deviations are of a knot; the next knot keeps the part `lasting`."""

    throttle: float = 0.5
    steering: float = 0.5  # of the full lock
    lasting: float = 0.8
    temperature: float = 0.05


class Problem(NamedTuple):
    """All that a plan is made for, as 32-bit arrays."""

    car: Car
    way: Way
    clearance: Clearance
    costs: Costs
    search: Search
    lock: Scalar  # rad, full steering
    goal: Scalar  # m along the line; inf: none


class Memory(NamedTuple):
    """The planner between two decisions."""

    key: Array  # as plain numbers
    motion: Motion  # predicted for the next decision
    place: Scalar  # along the line, m
    commands: Command  # (KNOTS,) the plan
    given: Command  # (HISTORY,) the last commands, the newest last


class Rollouts(NamedTuple):
    """Sequences of one decision as they were driven on the plant."""

    motion: Motion  # (count, KNOTS), after each knot
    cost: Array  # (count,)
    weight: Array  # (count,) within the decision
    plan: Motion  # (KNOTS,) their weighted mean


MOST_SLIP = 9.0  # of that square
ASTRAY = 0.2  # cosine of the heading off the line, under which a car faces backwards
# In m/s, of the speed and 0.1:
SLOW = 0.5  # a slower car stands
BACKING = 1.0  # a slower car that goes backwards backs off
HISTORY = 16  # knots; a longer pure delay is cut off
# Throttle, and steering as a part of the lock.
HELD = tuple((throttle, side) for throttle in (-1.0, -0.5, 0.5, 1.0) for side in (-1.0, 0.0, 1.0))
SEEN = ("x", "y", "heading", "vx", "vy", "yaw_rate")


def per_tick(problem: Problem, given: Command, commands: Command, step: float) -> Command:
    """Commands (knots,) as they reach motor and servo, a value for each step of the plant."""
    each = round(KNOT / step)
    asked = jax.tree.map(lambda a, b: jnp.repeat(jnp.concatenate([a, b]), each), given, commands)
    arrives = plant.as_it_arrives(problem.car, asked, step)
    return jax.tree.map(lambda line: line[len(given.throttle) * each :], arrives)


def drive(
    problem: Problem, motion: Motion, given: Command, commands: Command, step: float = STEP
) -> Motion:
    """The motion after each knot of a plan: leaves (knots,). The plant's `step` is in s."""
    state = plant.state_of(problem.car, motion, step)
    ticks = per_tick(problem, given, commands, step)
    every = round(KNOT / step)
    _, seen = plant.rollout(problem.car, state, ticks, every, step, lambda s: s.motion)
    return seen


def cost(problem: Problem, place: Scalar, motion: Motion, commands: Command) -> Scalar:
    """J of a drive (leaves (knots,)) that began at a place."""
    way, costs, body = problem.way, problem.costs, problem.car.body

    def on(place: Scalar, at: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        place = way.follow(*at, place)
        return place, place

    end, places = jax.lax.scan(on, place, (motion.x, motion.y))
    row = way.row(places)
    cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)
    nearest = jnp.full_like(motion.x, jnp.inf)
    for ahead in (body.center + body.length / 2, body.center - body.length / 2):
        for left in (body.width / 2, -body.width / 2):
            corner_x = motion.x + cosine * ahead - sine * left
            corner_y = motion.y + sine * ahead + cosine * left
            nearest = jnp.minimum(nearest, problem.clearance.clear(corner_x, corner_y))
    close = jnp.clip((costs.margin - nearest) / costs.margin, 0.0, 3.0) ** 2
    # A drive that has met a wall is over.
    hit = jnp.cumsum(jnp.where(nearest <= 0, 1.0, 0.0)) > 0

    bend = way.bend[row]
    speed = jnp.sqrt(motion.vx**2 + motion.vy**2) + 0.1
    # To back off is no spin.
    forward = jnp.where(speed < BACKING, jnp.abs(motion.vx), motion.vx)
    # Nose in, by `drift`, in a corner; straight elsewhere.
    off = (jnp.arctan2(motion.vy, forward) + bend * costs.drift) / costs.drift
    weight = jnp.where(bend == 0, costs.straight, 1.0) * jnp.minimum(speed, 1.0)
    # Too much is a spin to come: it counts more than too little.
    much = jnp.where(bend * off < 0, costs.excess, 1.0)
    facing = cosine * way.along_x[row] + sine * way.along_y[row]
    # A car that faces backwards has to turn, whatever its sideslip: else to stand would cost least.
    ahead = jnp.clip(facing / ASTRAY, 0.0, 1.0)
    slips = weight * ahead * jnp.minimum(much * off**2, MOST_SLIP)
    out_x, out_y = way.out_x[row], way.out_y[row]
    beyond = jnp.arctan2(out_x * sine - out_y * cosine, out_x * cosine + out_y * sine)
    over = jnp.maximum(bend * beyond, 0.0) ** 2
    against = jnp.maximum(ASTRAY - facing, 0.0)
    # A car with its nose to a wall has to back off. Within the horizon that only loses way, so to
    # stand has to cost more.
    stands = jnp.maximum(1.0 - speed / SLOW, 0.0)
    changes = jnp.diff(commands.throttle) ** 2 + (jnp.diff(commands.steering) / problem.lock) ** 2
    arrived = jnp.where(places > problem.goal, 1.0, 0.0)
    left = jnp.minimum(end, problem.goal) - jnp.minimum(place, problem.goal)
    return (
        -costs.progress * left
        + jnp.mean(arrived * (costs.speed * speed + costs.facing * (1 - facing) - costs.goal))
        + costs.clearance * jnp.mean(close)
        + costs.hit * jnp.mean(jnp.where(hit, 1.0, 0.0))
        + costs.sideslip * jnp.mean(slips)
        + costs.overshoot * jnp.mean(over)
        + costs.smoothness * jnp.sum(changes)
        + costs.backwards * jnp.mean(against)
        + costs.standing * jnp.mean((1.0 - arrived) * stands)
    )


def draw(problem: Problem, key: Array, plan: Command, samples: int) -> Command:
    """Sequences of commands (samples, KNOTS) around a plan.

    The first is the plan itself. The last ones hold a command throughout (`HELD`): noise that lasts
    for a tenth of a second never backs a car out of a spin.
    """
    search = problem.search
    normal = jax.random.normal(key, (2, samples, KNOTS + 1), jnp.float32)
    normal = normal.at[:, 0].set(0.0)
    fresh = jnp.sqrt(1 - search.lasting**2)

    def follow(before: Array, new: Array) -> tuple[Array, Array]:
        now = search.lasting * before + fresh * new
        return now, now

    _, noise = jax.lax.scan(follow, normal[:, :, 0], normal[:, :, 1:].transpose(2, 0, 1))
    throttle = plan.throttle + search.throttle * noise[:, 0].T
    steering = plan.steering + search.steering * problem.lock * noise[:, 1].T
    held = jnp.asarray(HELD, throttle.dtype)
    throttle = throttle.at[-len(HELD) :].set(held[:, :1])
    steering = steering.at[-len(HELD) :].set(problem.lock * held[:, 1:])
    return Command(jnp.clip(throttle, -1.0, 1.0), jnp.clip(steering, -problem.lock, problem.lock))


def put(mesh: Mesh, tree: Any, dtype: Any = np.float32) -> Any:
    """The tree on all cores, in one precision: inputs of one kind share one program."""
    here = NamedSharding(mesh, PartitionSpec())

    def on(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return jax.device_put(array.astype(dtype) if array.dtype.kind == "f" else array, here)

    with jax.enable_x64(dtype == np.float64):
        return jax.tree.map(on, tree)


def costs_of(
    mesh: Mesh,
    problem: Problem,
    place: Scalar,
    motion: Motion,
    given: Command,
    drawn: Command,
    step: float = STEP,
) -> Array:
    """J of each sequence of commands (samples, knots), a share on each core; inf without an end."""
    cut, same = PartitionSpec("core"), PartitionSpec()

    def on_core(
        drawn: Command, problem: Problem, motion: Motion, given: Command, place: Scalar
    ) -> Array:
        def one(commands: Command) -> Scalar:
            driven = drive(problem, motion, given, commands, step)
            return cost(problem, place, driven, commands)

        return jax.vmap(one)(drawn)

    found = jax.shard_map(
        on_core, mesh=mesh, in_specs=(cut, same, same, same, same), out_specs=cut, check_vma=False
    )(drawn, problem, motion, given, place)
    return jnp.where(jnp.isfinite(found), found, jnp.inf)


def now(problem: Problem, predicted: Motion, seen: Array) -> Motion:
    """The predicted motion with the pose and velocities `seen` (`SEEN`). Wheels keep their slip."""
    tires, wheels = problem.car.tires, predicted.wheels
    moved = predicted._replace(**dict(zip(SEEN, seen, strict=True)))
    faster = moved.vx - predicted.vx
    front, rear = faster / tires.front.radius, faster / tires.rear.radius
    fast = (front, front, rear, rear)
    return moved._replace(wheels=jax.tree.map(jnp.add, wheels, Wheels(*fast)))


def weighed(
    mesh: Mesh, samples: int, problem: Problem, memory: Memory, motion: Motion
) -> tuple[Array, Scalar, Command, Array, Array]:
    """The next key, the place, and the sequences of a decision with their costs and weights."""
    key, fresh = jax.random.split(jax.random.wrap_key_data(memory.key))
    place = problem.way.follow(motion.x, motion.y, memory.place)
    drawn = draw(problem, fresh, memory.commands, samples)
    found = costs_of(mesh, problem, place, motion, memory.given, drawn)
    weights = jnp.exp((jnp.min(found) - found) / problem.search.temperature)
    return jax.random.key_data(key), place, drawn, found, weights / jnp.sum(weights)


@functools.partial(jax.jit, static_argnums=(0, 1))
def decide(
    mesh: Mesh, samples: int, problem: Problem, memory: Memory, seen: Array
) -> tuple[Command, Memory]:
    """The command of the next knot, and the memory after it."""
    motion = now(problem, memory.motion, seen)
    key, place, drawn, _, weights = weighed(mesh, samples, problem, memory, motion)
    plan = jax.tree.map(lambda lines: weights @ lines, drawn)
    command = jax.tree.map(lambda line: line[0], plan)
    # Where the model will be when the next command is given.
    first = jax.tree.map(lambda line: line[:1], plan)
    after = jax.tree.map(lambda leaf: leaf[-1], drive(problem, motion, memory.given, first))
    moved = jax.tree.map(lambda line: jnp.append(line[1:], line[-1]), plan)
    given = jax.tree.map(lambda line, new: jnp.append(line[1:], new), memory.given, command)
    return command, Memory(key, after, place, moved, given)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def look(
    mesh: Mesh, samples: int, count: int, problem: Problem, memory: Memory, seen: Array
) -> Rollouts:
    """The first `count` sequences of a decision, and its plan, driven on the plant."""
    motion = now(problem, memory.motion, seen)
    _, _, drawn, found, weights = weighed(mesh, samples, problem, memory, motion)
    plan = jax.tree.map(lambda lines: weights @ lines, drawn)

    def on(commands: Command) -> Motion:
        return drive(problem, motion, memory.given, commands)

    some = jax.vmap(on)(jax.tree.map(lambda lines: lines[:count], drawn))
    return Rollouts(some, found[:count], weights[:count], on(plan))


def problem_of(
    course: Course, car: Car, laps: int, costs: Costs, search: Search
) -> tuple[Problem, float]:
    """The problem of a course and a nominal car, and the place of the start (m)."""
    way = way_of(course)
    lock = min(float(car.servo.limit_left), float(car.servo.limit_right))
    place, end = start_of(course, way), course.lap_end(laps)
    goal = math.inf if end is None else place + end - course.start_distance
    return Problem(car, way, clearance_of(course, way), costs, search, lock, goal), place


def at_rest(pose: tuple[Scalar, Scalar, Scalar]) -> Motion:
    """The motion of a car that stands, with a full battery."""
    parts: list[Any] = [*pose, *[0.0] * 3, Wheels(*[0.0] * 4), *[0.0] * 4, 1.0]
    return Motion(*parts)


class Mppi:
    """Plans with the car's model 50 times a second (MPPI), on `--estimate truth` or `pose`."""

    period = KNOT

    def __init__(
        self,
        course: Course,
        car: Car,
        laps: int = 1,
        *,
        costs: Costs = Costs(),  # noqa: B008  # it is immutable
        search: Search = Search(),  # noqa: B008  # so is this
        samples: int = SAMPLES,
    ) -> None:
        """For a course with a centre line and the nominal car. Raises `InputError`."""
        self._mesh = Mesh(np.array(jax.devices()), ("core",))
        self._samples = math.ceil(samples / self._mesh.size) * self._mesh.size
        problem, self._place = problem_of(course, car, laps, costs, search)
        self._start = course.start
        self._problem = self._put(problem)

    def _put(self, tree: Any) -> Any:
        return put(self._mesh, tree)

    def reset(self, key: Array) -> Memory:
        """At rest at the start, with no throttle planned."""
        motion = at_rest(self._start)
        none = Command(np.zeros(KNOTS), np.zeros(KNOTS))
        given = Command(np.zeros(HISTORY), np.zeros(HISTORY))
        memory: Memory = self._put(
            Memory(jax.random.key_data(key), motion, self._place, none, given)
        )
        return memory

    def act(self, memory: Memory, observation: Observation) -> tuple[Command, Memory]:
        """One decision."""
        with jax.enable_x64(False):
            seen = _seen(observation)
            command, memory = decide(self._mesh, self._samples, self._problem, memory, seen)
        return Command(float(command.throttle), float(command.steering)), memory

    def rollouts(self, memory: Memory, observation: Observation, count: int) -> Rollouts:
        """The first `count` sequences that `act` draws for the same arguments."""
        with jax.enable_x64(False):
            looked = look(
                self._mesh, self._samples, count, self._problem, memory, _seen(observation)
            )
        found: Rollouts = jax.tree.map(np.asarray, looked)
        return found


def _seen(observation: Observation) -> np.ndarray:
    """What the estimate says of the motion (`SEEN`), in one array: it is placed on all cores."""
    return np.array([getattr(observation.estimate, name) for name in SEEN], np.float32)
