"""Many closed-loop drives at once, judged as they go.

Each lane is a trial: its own car, start, noise and driver's numbers. Trials run in blocks, a block
on each core, in pieces of car time; between pieces those that are over make room for the rest. A
trial ends when its goal is reached and its last turn has ended, or when it can no longer succeed.
What is judged, and when, is as `turns` judges a recorded drive (a test holds the two together).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from countersteer.car.car import Car
from countersteer.car.parameter import Array, Scalar
from countersteer.course.along import Line, line_of
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver
from countersteer.errors import InputError
from countersteer.evaluation.population import Drawn
from countersteer.evaluation.turns import (
    LONGEST,
    SLOW,
    STRAIGHT_FOR,
    STRAIGHT_RATE,
    STRAIGHT_SLIP,
    Judge,
)
from countersteer.sensing import sonar, suite
from countersteer.sensing.faults import Fault
from countersteer.simulator import Loop, Plan, Simulator, Surroundings, begin, padded, tick
from countersteer.world import planar
from countersteer.world.floor import Floor
from countersteer.world.state import State

LANES, FEW = 128, 16  # trials of a block; where there are no more, of a smaller one
LOOK = 0.005  # s between two samples that are judged, as in truth.csv

DRIVING, REACHED, TOUCHED, ROLLED, STALLED, LOST, LATE = range(7)
STATUS = (
    "driving", "goal reached", "touched a wall", "rolled over", "stalled", "lost its state",
    "out of time",
)  # fmt: skip


class Way(NamedTuple):
    """The centre line, and what the judge must know of the course."""

    line: Line
    goal: Scalar
    bearings: Array  # (turns,) heading of the corridor behind each turn


class Turns(NamedTuple):
    """What is known of each turn; arrays of one number a turn. Times are inf until they come."""

    begin: Array
    end: Array
    stirred: Array  # 1 once the car has not gone straight in it
    calm_since: Array
    entry_speed: Array
    peak_sideslip: Array
    peak_yaw_rate: Array
    error: Array  # heading less the corridor's, at the end


class Score(NamedTuple):
    """A trial so far."""

    status: Scalar
    distance: Scalar
    furthest: Scalar
    furthest_at: Scalar
    goal_time: Scalar
    stirred_at: Scalar
    turns: Turns


def way_of(course: Course, laps: int, dtype: Any) -> Way:
    """The way between start and goal as arrays."""
    bearings = course.start[2] + np.cumsum([t.angle for t in course.turns_ahead(laps)])
    goal = np.asarray(course.lap_end(laps), dtype)
    return Way(line_of(course, dtype), goal, np.asarray(bearings, dtype))


def initial_score(course: Course, turns: int, dtype: Any) -> Score:
    """Before the first sample."""
    distance = dtype(course.start_distance)
    never, zero = np.full(turns, np.inf, dtype), np.zeros(turns, dtype)
    table = Turns(never, never, zero, zero, zero, zero, zero, zero)
    inf = dtype(np.inf)
    return Score(np.int32(DRIVING), distance, distance, dtype(0), inf, dtype(0), table)


def follow(way: Way, score: Score, state: State, turn: Scalar, time: Scalar) -> Score:
    """The score with one sample more; a trial that is over stays as it is."""
    motion = state.motion
    speed = jnp.sqrt(motion.vx**2 + motion.vy**2 + 1e-12)
    slip = jnp.where(speed > SLOW, jnp.abs(jnp.arctan2(motion.vy, motion.vx)), 0.0)
    rate = jnp.abs(motion.yaw_rate)
    calm = (rate < STRAIGHT_RATE) & (slip < STRAIGHT_SLIP)

    distance = way.line.follow(motion.x, motion.y, score.distance).distance
    ahead = distance > score.furthest + 0.05
    goal_time = jnp.where(
        jnp.isinf(score.goal_time) & (distance >= way.goal), time, score.goal_time
    )
    stirred_at = jnp.where(calm, score.stirred_at, time)

    old = score.turns
    number = jnp.arange(old.begin.shape[0])
    begins = jnp.isinf(old.begin) & (number < turn)
    begin = jnp.where(begins, time, old.begin)
    under_way = (begin <= time) & jnp.isinf(old.end)
    stirred = jnp.where(under_way & ~calm, 1.0, old.stirred)
    calm_since = jnp.where(calm & ~begins, old.calm_since, time)
    late = time - begin >= LONGEST - 1e-4
    settled = (stirred > 0) & calm & (time - calm_since >= STRAIGHT_FOR - 1e-4)
    ends = under_way & (late | settled)
    error = motion.heading - way.bearings
    error = error - 2 * math.pi * jnp.round(error / (2 * math.pi))
    turns = Turns(
        begin,
        jnp.where(ends, time, old.end),
        stirred,
        calm_since,
        jnp.where(begins, speed, old.entry_speed),
        jnp.where(under_way, jnp.maximum(old.peak_sideslip, slip), old.peak_sideslip),
        jnp.where(under_way, jnp.maximum(old.peak_yaw_rate, rate), old.peak_yaw_rate),
        jnp.where(ends, error, old.error),
    )
    reached = ~jnp.isinf(goal_time) & (
        (time - stirred_at >= STRAIGHT_FOR - 1e-4) | (time - goal_time >= LONGEST)
    )
    furthest_at = jnp.where(ahead, time, score.furthest_at)
    stalled = jnp.isinf(goal_time) & (time - furthest_at > Judge.STALLED)
    status = jnp.int32(DRIVING)
    for found, name in (
        (stalled, STALLED),
        (reached, REACHED),
        (state.rolled_over > 0, ROLLED),
        (state.wall_contacts > 0, TOUCHED),
        (~jnp.isfinite(motion.x + motion.vx + motion.yaw_rate), LOST),
    ):
        status = jnp.where(found, jnp.int32(name), status)
    new = Score(
        status,
        distance,
        jnp.where(ahead, distance, score.furthest),
        furthest_at,
        goal_time,
        stirred_at,
        turns,
    )
    over = score.status != DRIVING
    return jax.tree.map(lambda a, b: jnp.where(over, a, b), score, new)


class Trials(NamedTuple):
    """What a batch of trials runs with; leaves have an axis of trials in front."""

    car: Car
    driver: Any  # leaves that all trials share have no such axis
    charge: Array
    pose: Array  # (n, 3)
    floor: Floor | None
    seed: Array
    faults: tuple[Fault, ...] = ()  # starts and durations are each trial's


class Shared(NamedTuple):
    """What all trials share."""

    walls: Array
    corners: Array
    loss: Scalar
    nominal: Car  # the one that the filter knows
    start: tuple[Scalar, Scalar, Scalar]  # the one that the driver believes
    way: Way
    score: Score  # before the first sample
    ticks: Scalar  # at most
    watch: Any = None


class Watch(Protocol):
    """What looks on at trials beside the judge, in pytrees; a pytree itself, all trials share it.

    What it keeps of a trial is looked at every `LOOK`, before the judge's sample is taken.
    """

    def begin(self, around: Surroundings, loop: Loop) -> Any:
        """What is kept before the first tick."""
        ...

    def look(self, plan: Plan, around: Surroundings, loop: Loop, score: Score, kept: Any) -> Any:
        """What is kept with this instant; of no effect when the trial is over."""
        ...

    def end(self, kept: Any) -> Any:
        """What is given of it, as arrays."""
        ...


@partial(jax.jit, static_argnums=(0, 1))
def _rollout(
    mesh: Mesh, plan: Plan, shared: Shared, varied: Trials, driver: Any
) -> tuple[Score, Any]:
    """A block of trials on each core; `driver` holds None where the trials' drivers differ."""
    cut, same = PartitionSpec("core"), PartitionSpec()

    def on_core(shared: Shared, varied: Trials, driver: Any) -> tuple[Score, Any]:
        def one(own: Trials) -> tuple[Score, Any]:
            mine = jax.tree.map(
                lambda a, b: b if a is None else a, driver, own.driver, is_leaf=lambda x: x is None
            )
            return _trial(plan, shared, own._replace(driver=mine))

        return jax.vmap(one, axis_name="trial")(varied)

    run = jax.shard_map(
        on_core, mesh=mesh, in_specs=(same, cut, same), out_specs=cut, check_vma=False
    )
    return run(shared, varied, driver)


def _trial(plan: Plan, shared: Shared, own: Trials) -> tuple[Score, Any]:
    """One trial; a block goes on until all its trials are over."""
    every = max(1, round(LOOK / plan.dt))
    key, driver_key = jax.random.split(jax.random.key(own.seed))
    known = (shared.loss, shared.nominal, own.floor, own.faults)
    around = Surroundings(shared.walls, shared.corners, key, *known)
    zero = jnp.zeros_like(own.charge)
    pose = (own.pose[0], own.pose[1], own.pose[2])
    still = (zero, zero, zero)
    loop = begin(
        plan,
        own.car,
        around,
        own.driver,
        pose,
        shared.start,
        still,
        own.charge,
        driver_key,
    )

    def one(loop: Loop, _: None) -> tuple[Loop, None]:
        return tick(plan, own.car, around, own.driver, loop)[0], None

    watch = shared.watch
    kept = () if watch is None else watch.begin(around, loop)

    def look(carry: tuple[Loop, Score, Scalar, Any]) -> tuple[Loop, Score, Scalar, Any]:
        loop, score, _, kept = carry
        if watch is not None:
            told = watch.look(plan, around, loop, score, kept)
            live = score.status == DRIVING
            kept = jax.tree.map(lambda new, old: jnp.where(live, new, old), told, kept)
        time = plan.dt * loop.tick.astype(score.distance.dtype)
        turn = jnp.asarray(getattr(loop.memory, "turn", 0))
        score = follow(shared.way, score, loop.state, turn, time)
        loop, _ = jax.lax.scan(one, loop, None, length=every)
        # Common to the block, so that the loop's end is.
        going = jax.lax.pmax((score.status == DRIVING).astype(jnp.int32), "trial")
        return loop, score, going, kept

    def goes_on(carry: tuple[Loop, Score, Scalar, Any]) -> Any:
        return (carry[2] > 0) & (carry[0].tick <= shared.ticks)

    first = (loop, shared.score, jnp.int32(1), kept)
    loop, score, _, kept = jax.lax.while_loop(goes_on, look, first)
    late = score.status == DRIVING
    return score._replace(status=jnp.where(late, jnp.int32(LATE), score.status)), (
        () if watch is None else watch.end(kept)
    )


def watched(
    simulator: Simulator,
    drawn: Drawn,
    drivers: Sequence[Driver],
    seeds: Sequence[int],
    laps: int,
    longest: float,
    watch: Watch | None,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int | None = None,
    faults: tuple[Fault, ...] = (),
) -> tuple[Score, Any]:
    """One trial for each seed, its driver and what was drawn for it; and what `watch` has kept.

    `simulator` says how: course, link, step, estimate; its car is the nominal one. In the precision
    of the leaves of `drawn`. Leaves of `faults` and of the result have an axis of trials in front.
    """
    course = simulator.course
    if course is None or course.goal_distance is None:
        raise InputError("trials need a course with a goal")
    dtype = np.asarray(drawn.charge).dtype
    slots = planar.delay_slots(drawn.cars, simulator.dt)
    told = suite.position_slots(drawn.cars, simulator.dt)
    plan = simulator.plan()._replace(slots=slots, told=told, fails=bool(faults))
    walls = padded(course.walls, dtype)
    way = way_of(course, laps, dtype)
    start = initial_score(course, len(way.bearings), dtype.type)
    shared = Shared(
        walls,
        sonar.edges(walls),
        dtype.type(simulator.link.loss),
        jax.tree.map(dtype.type, simulator.nominal or simulator.car),
        tuple(map(dtype.type, course.start)),
        way,
        start,
        np.int32(round(longest / simulator.dt)),
        watch,
    )
    common, own = _common(drivers, dtype)
    varied = Trials(
        drawn.cars,
        own,
        drawn.charge,
        drawn.pose,
        drawn.floor,
        np.asarray(seeds, np.int32),
        jax.tree.map(dtype.type, faults),
    )
    mesh = Mesh(np.array(jax.devices()), ("core",))
    count = len(seeds)
    width = (lanes or (FEW if count <= FEW * mesh.size else LANES)) * mesh.size
    found = []
    for first in range(0, count, width):
        picked = np.arange(first, first + width) % count
        with jax.enable_x64(dtype == np.float64):
            results = _rollout(mesh, plan, shared, _rows(varied, picked), common)
        found.append(_rows(results, np.arange(min(width, count - first))))
        report(min(first + width, count), count)
    whole: tuple[Score, Any] = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    return whole


def rollouts(
    simulator: Simulator,
    drawn: Drawn,
    drivers: Sequence[Driver],
    seeds: Sequence[int],
    laps: int,
    longest: float,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int | None = None,
) -> Score:
    """`watched` with nobody looking on."""
    return watched(simulator, drawn, drivers, seeds, laps, longest, None, report, lanes)[0]


def _rows(tree: Any, picked: np.ndarray) -> Any:
    """The picked trials of a batch."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[picked], tree)


def _common(drivers: Sequence[Driver], dtype: Any) -> tuple[Any, Any]:
    """Leaves that all drivers share, and stacked those that differ; None where it is the other."""
    flat = [jax.tree.flatten(driver) for driver in drivers]
    treedef = flat[0][1]
    common, own = [], []
    for leaves in zip(*(leaves for leaves, _ in flat), strict=True):
        arrays = [np.asarray(leaf) for leaf in leaves]
        arrays = [a.astype(dtype) if a.dtype.kind == "f" else a for a in arrays]
        same = all(np.array_equal(arrays[0], a, equal_nan=a.dtype.kind == "f") for a in arrays[1:])
        common.append(arrays[0] if same else None)
        own.append(None if same else np.stack(arrays))
    return jax.tree.unflatten(treedef, common), jax.tree.unflatten(treedef, own)
