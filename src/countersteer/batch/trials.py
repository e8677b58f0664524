"""Many closed-loop drives at once, judged on the way.

Each lane is a trial with its own car, start, noise and driver parameters. A trial ends when its
goal is reached and its last turn has ended, or when it can no longer succeed. A block runs until
all its trials have ended.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from countersteer.batch import engine
from countersteer.batch.population import Drawn
from countersteer.car.car import Body, Car
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver
from countersteer.errors import InputError
from countersteer.link.link import ONBOARD, Link
from countersteer.pilot import Pilot, PilotMemory, traceable
from countersteer.sensing import all_sensors
from countersteer.sensing.faults import SensorFault
from countersteer.signals import Array, Motion, Scalar
from countersteer.simulator import PIECE, Loop, Simulator, begin, tick
from countersteer.task.judge import PERIOD, Outcome, Sample, Score, Task, samples
from countersteer.world import planar
from countersteer.world.floor import Floor

FEW = 16  # trials in a core's block, if one such block on each core holds them all


class Trial(NamedTuple):
    """A trial's own part; in a batch, leaves have a leading axis of trials."""

    car: Car
    driver: Any  # in a batch, None for leaves that all trials share
    charge: Array
    pose: Array  # (n, 3)
    floor: Floor | None
    seed: Array
    faults: tuple[SensorFault, ...] = ()  # starts and durations are each trial's


class Shared(NamedTuple):
    """The part that all trials share."""

    simulator: Simulator  # without the parts that each trial has of its own
    pilot: Pilot  # without its driver
    task: Task
    watch: Any = None


class Instant(NamedTuple):
    """A trial at one instant, before the judge's sample is taken."""

    simulator: Simulator
    pilot: Pilot
    loop: Loop
    memory: PilotMemory  # of the pilot
    score: Score


class Watch(Protocol):
    """An observer beside the judge, called every `PERIOD`: a pytree that all trials share."""

    def begin(self, now: Instant) -> Any:
        """The record before the first tick: a pytree."""
        ...

    def look(self, now: Instant, kept: Any) -> Any:
        """The record with this instant added. It has no effect once the trial is over."""
        ...

    def end(self, kept: Any) -> Any:
        """The result, as arrays."""
        ...


@runtime_checkable
class MotionWatch(Protocol):
    """A watch that looks at motion alone, so it can also watch drivers in Python."""

    def least(self, body: Body, motion: Motion) -> Any:
        """The result for a motion with leaves (n,)."""
        ...


class Going(NamedTuple):
    """A trial under way."""

    loop: Loop  # without its tick: one that differs by trial would make all compute every branch
    memory: PilotMemory
    score: Score
    kept: Any  # by the watch


def _on_cores(one: Callable[..., Any], mesh: Mesh, driver: Any, *lanes: Any) -> Any:
    """The results of `one(trial, …)` for the trials of a block, a share on each core.

    `lanes` begins with the trials; `driver` is None where theirs differ.
    """

    def on_core(driver: Any, own: Trial, *more: Any) -> Any:
        def alone(own: Trial, *more: Any) -> Any:
            mine = jax.tree.map(
                lambda a, b: b if a is None else a, driver, own.driver, is_leaf=lambda x: x is None
            )
            return one(own._replace(driver=mine), *more)

        return jax.vmap(alone, axis_name="trial")(own, *more)

    return engine.on_cores(on_core, mesh, (False, *(True for _ in lanes)))(driver, *lanes)


@partial(jax.jit, static_argnums=0)
def _begin(mesh: Mesh, driver: Any, own: Trial, shared: Shared) -> Going:
    """The trials of a block before their first tick."""

    def one(own: Trial) -> Going:
        simulator, pilot = _assembled(shared, own)
        loop, memory = begin(simulator), pilot.init(simulator.root)
        first = Instant(simulator, pilot, loop, memory, shared.task.init())
        kept = () if shared.watch is None else shared.watch.begin(first)
        return Going(loop._replace(tick=None), memory, first.score, kept)

    going: Going = _on_cores(one, mesh, driver, own)
    return going


@partial(jax.jit, static_argnums=0)
def _go_on(
    mesh: Mesh, driver: Any, own: Trial, going: Going, shared: Shared, span: tuple[Scalar, Scalar]
) -> Going:
    """The trials of a block from a tick to another, or until all of a core's have ended."""

    def one(own: Trial, going: Going) -> Going:
        return _drive(shared, *_assembled(shared, own), going, span)

    gone: Going = _on_cores(one, mesh, driver, own, going)
    return gone


def _assembled(shared: Shared, own: Trial) -> tuple[Simulator, Pilot]:
    """The simulator and the pilot of a trial."""
    world: Any = shared.simulator.world
    simulator = dataclasses.replace(
        shared.simulator,
        world=dataclasses.replace(world, car=own.car, floor=own.floor),
        pose=(own.pose[0], own.pose[1], own.pose[2]),
        velocity=(jnp.zeros_like(own.charge),) * 3,
        charge=own.charge,
        seed=own.seed,
        faults=own.faults,
    )
    return simulator, dataclasses.replace(shared.pilot, driver=own.driver)


def _drive(
    shared: Shared, simulator: Simulator, pilot: Pilot, going: Going, span: tuple[Scalar, Scalar]
) -> Going:
    """A trial of a block, driven and judged from a tick to another."""
    task, watch = shared.task, shared.watch
    every = max(1, round(PERIOD / simulator.dt))

    def one(carry: tuple[Loop, PilotMemory], _: None) -> tuple[tuple[Loop, PilotMemory], None]:
        after = tick(simulator, pilot, *carry)
        return after[:2], None

    def look(carry: tuple[Scalar, Going, Scalar]) -> tuple[Scalar, Going, Scalar]:
        count, (loop, memory, score, kept), _ = carry
        loop = loop._replace(tick=count)
        if watch is not None:
            new = watch.look(Instant(simulator, pilot, loop, memory, score), kept)
            live = score.outcome == Outcome.DRIVING.code
            kept = jax.tree.map(lambda new, old: jnp.where(live, new, old), new, kept)
        time = simulator.dt * loop.tick.astype(score.distance.dtype)
        motion, events = simulator.world.motion(loop.state), simulator.world.events(loop.state)
        turn = jnp.asarray(pilot.status(memory).turn)
        score = task.update(score, Sample(time, motion, *events, turn))
        (loop, memory), _ = jax.lax.scan(one, (loop, memory), None, length=every)
        going = Going(loop._replace(tick=None), memory, score, kept)
        return loop.tick, going, live_in_block(score)

    def goes_on(carry: tuple[Scalar, Going, Scalar]) -> Any:
        return (carry[2] > 0) & (carry[0] < span[1])

    after: Going = jax.lax.while_loop(goes_on, look, (span[0], going, live_in_block(going.score)))[
        1
    ]
    return after


def live_in_block(score: Score) -> Scalar:
    """1 while a trial of the block drives, so that all its trials leave the loop together."""
    return jax.lax.pmax((score.outcome == Outcome.DRIVING.code).astype(jnp.int32), "trial")


def run_trials(
    course: Course,
    pilot: Pilot,
    drawn: Drawn,
    drivers: Sequence[Driver],
    seeds: Sequence[int],
    laps: int,
    longest: float,
    watch: Watch | None = None,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int | None = None,
    faults: tuple[SensorFault, ...] = (),
    link: Link = ONBOARD,
) -> tuple[Score, Any]:
    """Run one trial for each seed: its score, and the result of `watch` (`()` without one).

    Each seed has its row in `drawn`, and its driver in `drivers`, which replaces the pilot's own.
    Drivers that JAX cannot trace drive one after another. They have no `faults`, and their watch
    is a `MotionWatch`.
    The precision is that of the leaves of `drawn`. Leaves of `faults` and of the result have a
    leading axis of trials. Raises `InputError` if the course has no goal.
    """
    if course.goal_distance is None:
        raise InputError("trials need a course with a goal")
    if not traceable(drivers[0]):
        if faults or (watch is not None and not isinstance(watch, MotionWatch)):
            raise InputError("of a driver in Python, only its motion can be watched")
        return _one_by_one(
            course, pilot, drawn, drivers, seeds, laps, longest, report, link, watch
        )  # fmt: skip
    dtype = np.asarray(drawn.charge).dtype
    first: Any = jax.tree.map(lambda leaf: leaf[0], drawn)
    simulator = Simulator.of(course, first.cars, link=link, dt=pilot.dt, floor=first.floor)
    world: Any = dataclasses.replace(  # type: ignore[type-var]  # planar
        simulator.world, slots=planar.delay_slots(drawn.cars, pilot.dt)
    )
    simulator = dataclasses.replace(
        _without(simulator, "pose", "velocity", "charge", "seed"),
        world=_without(world, "car", "floor"),
        slots=all_sensors.position_slots(drawn.cars, pilot.dt),
    )
    common, own = _common(drivers, dtype)
    shared = Shared(
        simulator,
        _without(pilot.typed(dtype), "driver"),
        Task.of(course, laps, walls_end=True, dtype=dtype),
        watch,
    )
    varied = Trial(
        drawn.cars,
        own,
        drawn.charge,
        drawn.pose,
        drawn.floor,
        np.asarray(seeds, np.int32),
        jax.tree.map(dtype.type, faults),
    )
    mesh = engine.all_cores()
    count = len(seeds)
    last, every = round(longest / pilot.dt), max(1, round(PERIOD / pilot.dt))
    piece = max(1, round(PIECE / pilot.dt / every)) * every
    width = (lanes or (FEW if count <= FEW * mesh.size else engine.LANES)) * mesh.size

    def run(block: Trial, done: Callable[[float], None]) -> tuple[Score, Any]:
        with jax.enable_x64(dtype == np.float64):
            going, end, live = _begin(mesh, common, block, shared), 0, True
            while live and end <= last:
                span = np.int32(end), np.int32(min(end + piece, last + 1))
                going, end = _go_on(mesh, common, block, going, shared, span), end + piece
                driving = np.asarray(going.score.outcome) == Outcome.DRIVING.code
                live = bool(np.any(driving))
                done(float(np.mean(~driving)))
            score = going.score
            late = np.where(driving, Outcome.LATE.code, np.asarray(score.outcome))
            score = score._replace(outcome=late.astype(np.int32))
            return score, () if watch is None else jax.jit(jax.vmap(watch.end))(going.kept)

    whole: tuple[Score, Any] = engine.in_turn(run, varied, width, report)
    return whole


def _one_by_one(
    course: Course, pilot: Pilot, drawn: Drawn, drivers: Sequence[Driver], seeds: Sequence[int],
    laps: int, longest: float, report: Callable[[int, int], None], link: Link,
    watch: Any = None,
) -> tuple[Score, Any]:  # fmt: skip
    """The scores for drivers that JAX cannot trace, one drive after another, and their watch's."""
    scores, seen, dtype = [], [], np.asarray(drawn.charge).dtype
    task = Task.of(course, laps, walls_end=True)
    for i, (driver, seed) in enumerate(zip(drivers, seeds, strict=True)):
        alone, floor = jax.tree.map(
            lambda leaf, i=i: dtype.type(leaf[i]), (drawn.cars, drawn.floor)
        )
        simulator = Simulator.of(
            course, alone, link=link, dt=pilot.dt, seed=int(seed), charge=drawn.charge[i],
            start=tuple(drawn.pose[i]), floor=floor,
        )  # fmt: skip
        score = task.init()
        every, motions = max(1, round(PERIOD / pilot.dt)), []
        with contextlib.closing(
            simulator.run(dataclasses.replace(pilot, driver=driver), longest)
        ) as pieces:
            for record in pieces:
                rows = np.nonzero(record.tick % every == 0)[0]
                score, _ = task.follow(score, samples(record, rows, pilot.dt))
                motions.append(jax.tree.map(lambda leaf, r=rows: leaf[r], record.motion))
                if score.outcome != Outcome.DRIVING.code:
                    break
        if score.outcome == Outcome.DRIVING.code:
            score = score._replace(outcome=np.int32(Outcome.LATE.code))
        scores.append(score)
        if watch is not None:
            motion = jax.tree.map(lambda *leaves: np.concatenate(leaves), *motions)
            seen.append(watch.least(alone.body, motion))
        report(i + 1, len(seeds))
    whole: Score = jax.tree.map(lambda *leaves: np.stack(leaves), *scores)
    return whole, np.array(seen) if watch is not None else ()


def _without(tree: Any, *names: str) -> Any:
    """The tree with None for the parts that each trial has of its own."""
    return dataclasses.replace(tree, **dict.fromkeys(names))


def _common(drivers: Sequence[Driver], dtype: Any) -> tuple[Any, Any]:
    """Two trees: the leaves that all drivers share, and the others, stacked; elsewhere None."""
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
