"""The functional environment: pure `reset` and `step` of one car, for people who train in JAX.

A decision is `Environment.ticks` ticks of the planar world with one command held, actuators, delays
and walls as in a drive. The observation is `drivers.ppo.features` of the true state. The judge
(`task.judge`) looks at each decision's end. So an episode ends as a drive does.

    lanes, seen = jax.vmap(environment.reset, (0, 0, None))(own, keys, 0)
    lanes, seen, terms, ended = jax.vmap(environment.step, (0, 0, None))(lanes, actions, tick)

All lanes share the clock: `tick` is the number of ticks since the first `reset`.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.batch.population import Drawn, Population, draw
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.way import Way, start_of, way_of
from countersteer.drivers.ppo import FAR, PERIOD, Past, Sight, features, full_lock
from countersteer.signals import Array, Command, Scalar
from countersteer.task.judge import DRIFT, STALLED, Outcome, Sample, Score, Task
from countersteer.task.reward import ENOUGH, Reward, reward
from countersteer.world import planar
from countersteer.world.floor import Floor
from countersteer.world.state import State
from countersteer.world.walls import padded

DT = 0.001  # s
TICKS = round(PERIOD / DT)  # of a decision
LONGEST = 15.0  # s, after which an episode is cut short by those who step it
ROLLING = 2.5  # m/s, most at a start in motion
ASIDE, ASKEW = 0.2, 0.2  # parts of the corridor's width, and rad, of a start in motion
LEFT = 1.0  # m before the goal, up to which a start in motion may be


class Own(NamedTuple):
    """What an episode is driven with: a trial of a population."""

    car: Car
    floor: Floor | None
    charge: Scalar
    pose: Array  # (3,) at the course's start


class Lane(NamedTuple):
    """An episode under way."""

    own: Own
    state: State
    score: Score
    place: Scalar  # along the way, m
    past: Past
    first: Scalar  # tick at which it began
    rolling: Scalar  # 1 if it began in motion, somewhere on the course


@pytree
class Environment:
    """A course and a nominal car, as an environment."""

    walls: Array
    way: Way
    place: Scalar  # of the start along the way, m
    task: Task
    weights: Reward
    lock: Scalar  # rad, full steering
    width: Scalar  # m, of the corridor
    rolling: Scalar  # part of the episodes that begin in motion, anywhere on the course
    ticks: int = dataclasses.field(default=TICKS, metadata={"static": True})
    slots: int = dataclasses.field(default=32, metadata={"static": True})

    @classmethod
    def of(
        cls,
        course: Course,
        car: Car,
        weights: Reward,
        slots: int,
        laps: int = 1,
        rolling: float = 0.0,
        dtype: Any = np.float32,
    ) -> "Environment":
        """For a course with a goal. `slots` is `planar.delay_slots` of all cars."""
        way, number = way_of(course), np.dtype(dtype).type
        made = cls(
            walls=padded(course.walls, np.dtype(dtype)),
            way=way,
            place=number(start_of(course, way)),
            task=Task.of(course, laps, walls_end=True, dtype=dtype),
            weights=jax.tree.map(number, weights),
            lock=number(full_lock(car)),
            width=number(course.width or 1.0),
            rolling=number(rolling),
            slots=slots,
        )
        return jax.tree.map(jnp.asarray, made)

    def reset(self, own: Own, key: jax.Array, tick: Scalar) -> tuple[Lane, Array]:
        """A new episode at a tick, and its first observation."""
        lane = self._begun(own, jax.random.uniform(key, (5,), own.charge.dtype), tick)
        return lane, self.observe(lane)

    def _begun(self, own: Own, even: Array, tick: Scalar) -> Lane:
        """A new episode: at the course's start, or in motion (uniform numbers decide)."""
        rolling = jnp.where(even[0] < self.rolling, 1.0, 0.0).astype(own.charge.dtype)
        begin = self.place + even[1] * (self.task.goal - self.task.start - LEFT)
        row = self.way.row(begin)
        along_x, along_y = self.way.along_x[row], self.way.along_y[row]
        aside = ASIDE * self.width * (2 * even[2] - 1)
        askew = ASKEW * (2 * even[3] - 1)
        there = (
            self.way.x[row] - aside * along_y,
            self.way.y[row] + aside * along_x,
            jnp.arctan2(along_y, along_x) + askew,
        )
        x, y, heading = (jnp.where(rolling > 0, b, a) for a, b in zip(own.pose, there, strict=True))
        speed, still = rolling * ROLLING * even[4], jnp.zeros_like(rolling)
        pose: Any = (x, y, heading)
        velocity: Any = (speed, still, still)
        state = planar.initial_state(own.car, DT, pose, velocity, own.charge, self.slots)
        state = jax.tree.map(
            lambda leaf: jnp.asarray(leaf) if jnp.ndim(leaf) else leaf + still, state
        )
        at = jnp.where(rolling > 0, begin - self.place + self.task.start, self.task.start)
        score: Any = jax.tree.map(jnp.asarray, self.task.init())
        score = score._replace(distance=at, furthest=at)
        none: Any = jax.tree.map(jnp.asarray, Past.none(still.dtype))
        place = self.way.follow(x, y, jnp.where(rolling > 0, begin, self.place))
        return Lane(own, state, score, place, none, tick, rolling)

    def observe(self, lane: Lane) -> Array:
        """The observation (FEATURES,)."""
        return features(self.way, lane.place, sight_of(lane), lane.past)

    def judged(self, lane: Lane) -> Array:
        """What the reward depends on beside the motion (3 + 5 · turns,), each about 1 in size.

        The way left, the time without progress, whether the goal is behind; for each turn whether
        it has begun and ended, its sideslip so far, whether that is a drift, and its overshoot.
        """
        score, turns = lane.score, lane.score.turns
        left = (self.task.goal - score.furthest) / (self.task.goal - self.task.start)
        waited = (score.time - score.furthest_at) / STALLED
        parts = [
            jnp.stack([4 * left - 2, waited, jnp.isfinite(score.goal_time)]),
            jnp.isfinite(turns.begin),
            jnp.isfinite(turns.end),
            turns.peak_sideslip / ENOUGH,
            turns.peak_sideslip > DRIFT,
            turns.overshoot,
        ]
        return jnp.clip(jnp.concatenate(parts), -FAR, FAR)

    def step(self, lane: Lane, action: Array, tick: Scalar) -> tuple[Lane, Array, Reward, Scalar]:
        """One decision from a tick on: lane, observation, terms of the reward, and end.

        `action` (2,) is throttle and steering to the left, in ±1. The end is 1 once the judge has
        ended the drive (`lane.score.outcome`). A limit of time is the caller's: it truncates.
        """
        given = Command(*(jnp.clip(action[i], -1.0, 1.0) for i in (0, 1)))
        command = Command(given.throttle, self.lock * given.steering)
        own = lane.own

        def one(state: State, count: Scalar) -> tuple[State, None]:
            return planar.step(own.car, self.walls, state, command, count, DT, own.floor), None

        counts = tick + jnp.arange(self.ticks, dtype=jnp.int32)
        state, _ = jax.lax.scan(one, lane.state, counts)
        m = state.motion
        time = DT * (tick + self.ticks - lane.first).astype(m.x.dtype)
        score = self.task.update(
            lane.score, Sample(time, m, state.wall_contacts, state.rolled_over)
        )
        last = Command(lane.past.throttle[-1], lane.past.steering[-1])
        terms = reward(self.weights, self.task, lane.score, score, given, last)
        place = self.way.follow(m.x, m.y, lane.place)
        after = lane._replace(
            state=state, score=score, place=place, past=lane.past.then(given, sight_of(lane))
        )
        ended = jnp.where(score.outcome != Outcome.DRIVING.code, 1.0, 0.0).astype(m.x.dtype)
        return after, self.observe(after), terms, ended

    def renewed(self, lane: Lane, done: Scalar, even: Array, tick: Scalar) -> Lane:
        """The lane, or a new episode with its car where `done`. `even` are 5 uniform numbers."""
        new = self._begun(lane.own, even, tick)
        return jax.tree.map(
            lambda a, b: jnp.where(done > 0, jnp.asarray(a, jnp.result_type(b)), b), new, lane
        )


def sight_of(lane: Lane) -> Sight:
    """What a network is told of the lane's motion: the truth."""
    m = lane.state.motion
    return Sight(m.x, m.y, m.heading, m.vx, m.vy, m.yaw_rate)


def owns(
    population: Population, car: Car, course: Course, seeds: Any, dtype: Any = np.float32
) -> tuple[Own, int]:
    """A trial of the population for each seed, and the slots of delay lines that all need."""
    drawn: Drawn = draw(population, car, course, seeds, dtype)
    return Own(drawn.cars, drawn.floor, drawn.charge, drawn.pose), planar.delay_slots(
        drawn.cars, DT
    )
