"""The best there is: commands for a whole drive of the nominal car, improved by random search.

It is a yardstick for drivers: what the car can do where nothing is unknown. Each round tries many
changes of the commands. A change is a bump in throttle and steering, around a random instant and of
a random width, or it moves a stretch of the commands in time. Each is driven over its whole length
on the plant. The best one stays, if it costs less: a (1 + n) evolution strategy. The cost is that
of the planner.

All is in 64 bits, and the step is the world's. A drift is unstable: within a lap, an error of 32
bits, or of a step of 2 ms, grows to the width of the course.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from countersteer.planning.mppi import HISTORY, KNOT, Problem, costs_of, put
from countersteer.signals import Array, Command, Motion, Scalar

STEP = 0.001  # s of the plant: that of the world
COUNT = 512  # changes in a round
WIDTH = (0.02, 0.5)  # s, of a bump
HEIGHT = (0.02, 1.0)  # in full commands
SHIFT = 0.1  # s, standard deviation by which a stretch is moved
TOLD = 10  # rounds between two reports


class Optimum(NamedTuple):
    """Commands, a value every `KNOT`, and what they cost."""

    commands: Command
    cost: float
    first_cost: float  # of the commands at the beginning


def changed(problem: Problem, key: Array, plan: Command, count: int) -> Command:
    """`count` changes (count, knots) of a plan. The first is the plan itself."""
    knots = len(plan.throttle)
    keys = jax.random.split(key, 6)
    where, wide, high, kind = (jax.random.uniform(k, (count, 1)) for k in keys[:4])
    width, height = _between(WIDTH, wide) / KNOT, _between(HEIGHT, high)
    index = jnp.arange(knots)
    bump = jnp.exp(-(((index - where * knots) / width) ** 2) / 2)
    bump = bump.at[0].set(0.0)
    # A third moves the commands in time; a third changes both, a sixth each of them alone.
    kind = jnp.floor(6 * kind)
    push = height * jax.random.normal(keys[4], (count, 2))
    throttle = jnp.where((kind >= 2) & (kind <= 4), push[:, :1], 0.0)
    steering = jnp.where((kind >= 2) & (kind != 4), push[:, 1:], 0.0)
    shift = jnp.where(kind < 2, SHIFT / KNOT * jax.random.normal(keys[5], (count, 1)), 0.0)
    from_knot = jnp.clip(index - shift * bump, 0.0, knots - 1.0)
    whole = jnp.minimum(jnp.floor(from_knot), knots - 2.0).astype(jnp.int32)
    part = from_knot - whole

    def moved(line: Array) -> Array:
        return line[whole] + part * (line[whole + 1] - line[whole])

    lock = problem.lock
    return Command(
        jnp.clip(moved(plan.throttle) + throttle * bump, -1.0, 1.0),
        jnp.clip(moved(plan.steering) + lock * steering * bump, -lock, lock),
    )


def _between(ends: tuple[float, float], part: Array) -> Array:
    """Values between two ends, even in their logarithm."""
    low, high = map(math.log, ends)
    return jnp.exp(low + (high - low) * part)


@functools.partial(jax.jit, static_argnums=(0, 1))
def better(
    mesh: Mesh,
    count: int,
    problem: Problem,
    place: Scalar,
    motion: Motion,
    given: Command,
    plan: Command,
    key: Array,
) -> tuple[Command, Scalar, Array]:
    """A round: the best of `count` changes, its cost, and the next key."""
    key, fresh = jax.random.split(jax.random.wrap_key_data(key))
    drawn = changed(problem, fresh, plan, count)
    found = costs_of(mesh, problem, place, motion, given, drawn, STEP)
    least = jnp.min(found)
    # Not `argmin`: XLA 0.10.2 aborts on it under some flags.
    first = jnp.where(found == least, 1.0, 0.0)
    first = jnp.where(jnp.cumsum(first) == 1, first, 0.0)
    best = jax.tree.map(lambda lines: jnp.sum(first[:, None] * lines, axis=0), drawn)
    return best, least, jax.random.key_data(key)


def search(
    problem: Problem,
    place: float,
    motion: Motion,
    commands: Command,
    rounds: int,
    count: int = COUNT,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda *_: None,
) -> Optimum:
    """The best commands found for a drive that begins with `motion` at a place along the line (m).

    They are as many as `commands`, with which the search begins. Beyond the goal the drive goes on,
    since slowing down for it would cost time before it. `report` gets the number of a round and the
    least cost, every `TOLD` rounds.
    """
    mesh = Mesh(np.array(jax.devices()), ("core",))
    none = Command(np.zeros(HISTORY), np.zeros(HISTORY))
    # All in one precision: a problem of 32 bits would be compiled apart.
    endless, place, motion, given, plan = put(
        mesh, (problem._replace(goal=math.inf), place, motion, none, commands), np.float64
    )
    costs: list[float] = []
    with jax.enable_x64(True):
        key = put(mesh, jax.random.key_data(jax.random.key(seed)))
        for number in range(rounds):
            plan, least, key = better(
                mesh, math.ceil(count / mesh.size) * mesh.size, endless, place, motion, given, plan,
                key,
            )  # fmt: skip
            if number % TOLD == 0 or number == rounds - 1:
                costs.append(float(least))
                report(number + 1, costs[-1])
    return Optimum(jax.tree.map(np.asarray, plan), costs[-1], costs[0])
