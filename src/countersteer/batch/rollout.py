"""Many closed-loop drives at once, judged as they go.

Each lane is a trial: its own car, start, noise and driver's numbers. Trials run in blocks, a block
on each core, in pieces of car time; between pieces those that are over make room for the rest. A
trial ends when its goal is reached and its last turn has ended, or when it can no longer succeed.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from countersteer.batch.population import Drawn
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver
from countersteer.errors import InputError
from countersteer.link.link import ONBOARD, Link
from countersteer.pilot import Memory, Pilot
from countersteer.sensing import suite
from countersteer.sensing.faults import Fault
from countersteer.signals import Array, Scalar
from countersteer.simulator import Loop, Simulator, begin, tick
from countersteer.task.task import PERIOD, Outcome, Sample, Score, Task
from countersteer.world import planar
from countersteer.world.floor import Floor

LANES, FEW = 128, 16  # trials of a block; where there are no more, of a smaller one


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

    simulator: Simulator  # the one whose parts the trials' own take the place of
    pilot: Pilot  # the same, of its driver
    task: Task
    ticks: Scalar  # at most
    watch: Any = None


class Watch(Protocol):
    """What looks on at trials beside the judge, in pytrees; a pytree itself, all trials share it.

    What it keeps of a trial is looked at every `PERIOD`, before the judge's sample is taken.
    """

    def begin(self, simulator: Simulator, pilot: Pilot, loop: Loop, memory: Memory) -> Any:
        """What is kept before the first tick."""
        ...

    def look(
        self,
        simulator: Simulator,
        pilot: Pilot,
        loop: Loop,
        memory: Memory,
        score: Score,
        kept: Any,
    ) -> Any:
        """What is kept with this instant; of no effect when the trial is over."""
        ...

    def end(self, kept: Any) -> Any:
        """What is given of it, as arrays."""
        ...


@partial(jax.jit, static_argnums=0)
def _rollout(mesh: Mesh, shared: Shared, varied: Trials, driver: Any) -> tuple[Score, Any]:
    """A block of trials on each core; `driver` holds None where the trials' drivers differ."""
    cut, same = PartitionSpec("core"), PartitionSpec()

    def on_core(shared: Shared, varied: Trials, driver: Any) -> tuple[Score, Any]:
        def one(own: Trials) -> tuple[Score, Any]:
            mine = jax.tree.map(
                lambda a, b: b if a is None else a, driver, own.driver, is_leaf=lambda x: x is None
            )
            return _trial(shared, own._replace(driver=mine))

        return jax.vmap(one, axis_name="trial")(varied)

    run = jax.shard_map(
        on_core, mesh=mesh, in_specs=(same, cut, same), out_specs=cut, check_vma=False
    )
    return run(shared, varied, driver)


def _trial(shared: Shared, own: Trials) -> tuple[Score, Any]:
    """One trial; a block goes on until all its trials are over."""
    task, watch = shared.task, shared.watch
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
    pilot = dataclasses.replace(shared.pilot, driver=own.driver)
    every = max(1, round(PERIOD / simulator.dt))
    loop, memory = begin(simulator), pilot.init(simulator.root)

    def one(carry: tuple[Loop, Memory], _: None) -> tuple[tuple[Loop, Memory], None]:
        after = tick(simulator, pilot, *carry)
        return after[:2], None

    kept = () if watch is None else watch.begin(simulator, pilot, loop, memory)

    def look(carry: tuple[Loop, Memory, Score, Scalar, Any]) -> Any:
        loop, memory, score, _, kept = carry
        if watch is not None:
            told = watch.look(simulator, pilot, loop, memory, score, kept)
            live = score.outcome == Outcome.DRIVING.code
            kept = jax.tree.map(lambda new, old: jnp.where(live, new, old), told, kept)
        time = simulator.dt * loop.tick.astype(score.distance.dtype)
        motion, events = simulator.world.motion(loop.state), simulator.world.events(loop.state)
        turn = jnp.asarray(pilot.status(memory).turn)
        score = task.update(score, Sample(time, motion, *events, turn))
        (loop, memory), _ = jax.lax.scan(one, (loop, memory), None, length=every)
        # Common to the block, so that the loop's end is.
        going = jax.lax.pmax((score.outcome == Outcome.DRIVING.code).astype(jnp.int32), "trial")
        return loop, memory, score, going, kept

    def goes_on(carry: tuple[Loop, Memory, Score, Scalar, Any]) -> Any:
        return (carry[3] > 0) & (carry[0].tick <= shared.ticks)

    first = (loop, memory, task.init(), jnp.int32(1), kept)
    _, _, score, _, kept = jax.lax.while_loop(goes_on, look, first)
    late = score.outcome == Outcome.DRIVING.code
    return score._replace(outcome=jnp.where(late, jnp.int32(Outcome.LATE.code), score.outcome)), (
        () if watch is None else watch.end(kept)
    )


def watched(
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
    faults: tuple[Fault, ...] = (),
    link: Link = ONBOARD,
) -> tuple[Score, Any]:
    """One trial for each seed, its driver and what was drawn for it; and what `watch` has kept.

    `pilot` says how it is driven, but by whom. In the precision of the leaves of `drawn`. Leaves
    of `faults` and of the result have an axis of trials in front.
    """
    if course.goal_distance is None:
        raise InputError("trials need a course with a goal")
    dtype = np.asarray(drawn.charge).dtype
    first: Any = jax.tree.map(lambda leaf: leaf[0], drawn)
    simulator = Simulator.of(course, first.cars, link=link, dt=pilot.dt, floor=first.floor)
    world: Any = dataclasses.replace(  # type: ignore[type-var]  # planar
        simulator.world, slots=planar.delay_slots(drawn.cars, pilot.dt)
    )
    simulator = dataclasses.replace(
        _without(simulator, "pose", "velocity", "charge", "seed"),
        world=_without(world, "car", "floor"),
        slots=suite.position_slots(drawn.cars, pilot.dt),
    )
    common, own = _common(drivers, dtype)
    shared = Shared(
        simulator,
        _without(pilot.typed(dtype), "driver"),
        Task.of(course, laps, walls_end=True, dtype=dtype),
        np.int32(round(longest / pilot.dt)),
        watch,
    )
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
    for first_row in range(0, count, width):
        picked = np.arange(first_row, first_row + width) % count
        with jax.enable_x64(dtype == np.float64):
            results = _rollout(mesh, shared, _rows(varied, picked), common)
        found.append(_rows(results, np.arange(min(width, count - first_row))))
        report(min(first_row + width, count), count)
    whole: tuple[Score, Any] = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    return whole


def rollouts(
    course: Course,
    pilot: Pilot,
    drawn: Drawn,
    drivers: Sequence[Driver],
    seeds: Sequence[int],
    laps: int,
    longest: float,
    report: Callable[[int, int], None] = lambda *_: None,
    lanes: int | None = None,
    link: Link = ONBOARD,
) -> Score:
    """`watched` with nobody looking on."""
    return watched(
        course, pilot, drawn, drivers, seeds, laps, longest, None, report, lanes, link=link
    )[0]


def _without(tree: Any, *names: str) -> Any:
    """The tree without parts that each trial has of its own."""
    return dataclasses.replace(tree, **dict.fromkeys(names))


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
