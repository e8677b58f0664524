"""The paper's learner: it learns as it drives, with a simulator beside it that tries each action.

At each decision the car's model tries all actions from where the car is. The value of the cell that
it is in becomes the best of what they promise:

    V(s) <- max over a of  r(s, a) + discount · V(s'(s, a))

Then the car takes the best action, or now and then a random one, which becomes rarer. This is
real-time dynamic programming. It needs no step size, as Q-learning does, and no learned model, as
Dyna does: the paper's transitions come from a simulator too. Cells are not interpolated.

Rewards are those of `learning.tabular`: progress, a penalty for a touch, and on an open course a
prize at the goal. After a touch, or the goal, the car begins anew at the start, at rest.

Source: A. Barto, S. Bradtke and S. Singh, Learning to Act Using Real-Time Dynamic Programming,
Artificial Intelligence 72, 1995.
"""

import functools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.course.way import start_of
from countersteer.drivers import tabular
from countersteer.drivers.grid import Grid
from countersteer.drivers.tabular import driven, frame_of, in_frame, motion_seen, moved
from countersteer.learning.tabular import Job, Touching, goal_of, touching
from countersteer.signals import Array, Command, Motion, Scalar
from countersteer.viewing.learners import Learners

# What `learn online` takes: few cells, since a car visits them one by one.
DIMENSIONS = ("place_m=0.3", "offset_m=0.3", "heading_deg=-90:90:30", "vx_mps=0:2.8:0.4",
              "yaw_rate_degps=-345:345:172.5")  # fmt: skip
FIRST = 0.3  # part of the actions that are random at first
TEST = 10.0  # s of a drive that tests the values, without random actions
TESTS = 60  # in a learner's life


class Going(NamedTuple):
    """A car under way."""

    pose: tuple[Scalar, Scalar, Scalar]
    place: Scalar  # m
    velocity: tuple[Scalar, Scalar, Scalar]
    steering: Scalar  # rad
    before: Command


class Choices(NamedTuple):
    """What the actions make of a car: leaves (actions,)."""

    after: Going
    promised: Array  # reward, and the discounted value behind it
    ends: Array  # it touches, or is at the goal


class Online:
    """Learners that drive beside each other, compiled once."""

    def __init__(self, job: Job, seconds: float) -> None:
        """Each learner drives for `seconds`."""
        self.job, self.frame = job, frame_of(job.course)
        self.touch: Touching = touching(job, self.frame)
        self.goal = goal_of(job.course, self.frame)
        self.car = jax.tree.map(lambda leaf: np.float32(leaf), job.car)
        self.per_test = math.ceil(seconds / TESTS / job.decision)
        self.fading = self.per_test * TESTS / 3  # decisions until random ones are 1/e as frequent
        self._learn = jax.jit(jax.vmap(self._some, (0, 0, 0, 0, None)))
        self._test = jax.jit(jax.vmap(self._metres))
        self._smooth = jax.jit(functools.partial(self._metres, smooth=True))
        self.start = self._at_start()

    def learn(
        self,
        seeds: int,
        first: int,
        exploring: bool,
        report: Callable[[int], None] = lambda _: None,
    ) -> tuple[np.ndarray, Learners]:
        """Values (seeds, motions, poses) and curves. `report` is told how many tests are done."""
        table = self.job.table
        values = jnp.zeros((seeds, table.motion.size, table.pose.size), jnp.float32)
        keys = jax.vmap(jax.random.key)(first + jnp.arange(seeds))
        going = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (seeds,)), self.start)
        chance = jnp.full(seeds, FIRST if exploring else 0.0, jnp.float32)
        metres, cpu, begun = [], [], time.process_time()
        for number in range(TESTS):
            going, values = self._learn(going, values, keys, chance, number * self.per_test)
            jax.block_until_ready(values)
            cpu.append((time.process_time() - begun) / seeds)
            metres.append(np.asarray(self._test(values)))
            begun += time.process_time() - begun - seeds * cpu[-1]  # a test is no learning
            report(number + 1)
        driven = self.job.decision * self.per_test * np.arange(1, TESTS + 1)
        return np.asarray(values), Learners(driven, np.stack(metres, axis=1), np.array(cpu))

    def test(self, values: Array) -> float:
        """Metres that a car comes in `TEST` by interpolated values (motions, poses)."""
        return float(self._smooth(jnp.asarray(values)))

    def _at_start(self) -> Going:
        """At rest at the course's start."""
        x, y, heading = (jnp.float32(part) for part in self.job.course.start)
        zero = jnp.zeros_like(x)
        place = zero + start_of(self.job.course, jax.tree.map(np.asarray, self.frame.way))
        return Going((x, y, heading), place, (zero, zero, zero), zero, Command(zero, zero))

    def _some(
        self, going: Going, values: Array, key: Array, chance: Scalar, first: Scalar
    ) -> tuple[Going, Array]:
        """A learner's decisions between two tests."""

        def one(carry: tuple[Going, Array], number: Scalar) -> tuple[tuple[Going, Array], None]:
            going, values = carry
            coin, which = jax.random.split(jax.random.fold_in(key, number))
            found = self._tried(going, values, smooth=False)
            values = values.at[self._cell(going)].set(jnp.max(found.promised))
            best = jnp.argmax(found.promised)
            any_one = jax.random.randint(which, (), 0, len(found.promised))
            rare = chance * jnp.exp(-number / self.fading)
            action = jnp.where(jax.random.uniform(coin) < rare, any_one, best)
            after = jax.tree.map(lambda leaf: leaf[action], found.after)
            again = found.ends[action]
            after = jax.tree.map(lambda a, b: jnp.where(again, a, b), self.start, after)
            return (after, values), None

        (going, values), _ = jax.lax.scan(
            one, (going, values), first + jnp.arange(self.per_test, dtype=jnp.int32)
        )
        return going, values

    def _metres(self, values: Array, smooth: bool = False) -> Scalar:
        """Metres that a car comes by the values, up to a touch or the goal."""

        def one(carry: tuple[Going, Scalar], _: None) -> tuple[tuple[Going, Scalar], None]:
            going, over = carry
            found = self._tried(going, values, smooth)
            best = jnp.argmax(found.promised)
            over = over | found.ends[best]
            after = jax.tree.map(lambda leaf: leaf[best], found.after)
            return (jax.tree.map(lambda a, b: jnp.where(over, a, b), going, after), over), None

        (going, _), _ = jax.lax.scan(
            one, (self.start, jnp.asarray(False)), None, length=round(TEST / self.job.decision)
        )
        return going.place - self.start.place

    def _tried(self, going: Going, values: Array, smooth: bool) -> Choices:
        """Each action from where the car is."""
        job, grid = self.job, self.job.table.pose
        actions = jax.tree.map(jnp.asarray, job.actions)

        def one(action: Command) -> Choices:
            motion = driven(
                self.car, going.velocity, going.steering, going.before, action, job.decision
            )
            fails, seen = jnp.asarray(False), {}
            pose = going.pose
            for i in range(tabular.SAMPLES):
                m: Motion = jax.tree.map(lambda leaf, i=i: leaf[i], motion)
                pose = moved(going.pose, (m.x, m.y, m.heading))
                seen = self.frame.seen(pose, going.place)
                at = in_frame(grid, seen)
                fails = fails | self.touch.at(at) | ~grid.inside(at)
            velocity = (m.vx, m.vy, m.yaw_rate)
            after = Going(pose, seen["place"], velocity, m.steering, action)
            if smooth:
                worth = tabular.worth(job.table, values, seen, m)
            else:
                worth = values[self._cell(after)]
            arrives = after.place >= self.goal
            gain = job.weights.time * job.decision
            gain = gain + job.weights.progress * (after.place - going.place)
            ahead = jnp.where(arrives, job.weights.goal, gain + job.discount * worth)
            return Choices(after, jnp.where(fails, job.weights.road, ahead), fails | arrives)

        return jax.vmap(one)(actions)

    def _cell(self, going: Going) -> tuple[Scalar, Scalar]:
        """The cell (motion, pose) around a car: its nearest point."""
        zero = jnp.zeros_like(going.place)
        wheels: Any = (zero,) * 4
        parts: list[Any] = [*going.pose, *going.velocity, wheels, going.steering, *[zero] * 4]
        m = Motion(*parts)
        seen = in_frame(self.job.table.pose, self.frame.seen(going.pose, going.place))
        return nearest(self.job.table.motion, motion_seen(m)), nearest(self.job.table.pose, seen)


def nearest(grid: Grid, values: dict[str, Scalar]) -> Scalar:
    """The point of a grid nearest to values. Where a dimension wraps, its first point counts."""
    index: Any = 0
    for d, stride in zip(grid.dimensions, grid.strides, strict=True):
        at = (values[d.word] - d.low) / d.step
        at = jnp.round(at).astype(jnp.int32)
        at = at % (d.points - 1) if d.wraps else jnp.clip(at, 0, d.points - 1)
        index = index + stride * at
    return index


def unwrapped(grid: Grid, values: np.ndarray) -> np.ndarray:
    """Values (…, points) with each dimension's last point as its first, where it wraps."""
    table = values.reshape(*values.shape[:-1], *grid.shape)
    for i, d in enumerate(grid.dimensions):
        if d.wraps:
            axis = values.ndim - 1 + i
            table = np.concatenate(
                [np.take(table, np.arange(d.points - 1), axis), np.take(table, [0], axis)], axis
            )
    return table.reshape(values.shape)
