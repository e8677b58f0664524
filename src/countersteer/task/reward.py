"""Rewards for learning, from the judge's scores before and after a decision.

Each term is a difference of what the judge keeps, so the sum over an episode is what the judge
says in the end: how far the car came, how much its turns slid, how far they went beyond the
corridor.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.errors import InputError
from countersteer.signals import Command, Scalar
from countersteer.task.judge import DRIFT, Outcome, Score, Task

ENOUGH = math.radians(32)  # sideslip of a turn from which more is worth nothing


class Reward(NamedTuple):
    """Weights of the terms; also the terms themselves, each times its weight.

    The first three are the paper's.
    """

    time: Scalar = -1.0  # a second
    road: Scalar = -10.0  # for a drive that fails: a wall, a roll-over, no progress
    goal: Scalar = 10.0  # for reaching it
    progress: Scalar = 0.0  # a metre along the centre line that the car was not at before
    sideslip: Scalar = 0.0  # for a turn with `ENOUGH` sideslip at its peak, in proportion to less
    drift: Scalar = 0.0  # for a turn that becomes a drift
    overshoot: Scalar = 0.0  # a radian by which the heading goes beyond the corridor's, negative
    smoothness: Scalar = 0.0  # of the square of a command's change, in full commands, negative

    @property
    def total(self) -> Scalar:
        """The sum of the terms."""
        return sum(self)


PAPER = Reward()
# What `learn ppo` takes. A touch must cost more than all the turns that are left are worth, or the
# policy drives faster and touches more.
DRIFTING = Reward(
    time=-0.2, road=-60.0, progress=1.0, sideslip=8.0, drift=8.0, overshoot=-1.0, smoothness=-0.02
)


def reward(
    weights: Reward, task: Task, before: Score, after: Score, given: Command, last: Command
) -> Reward:
    """The terms of one decision. Commands are in full ones: throttle and steering in ±1."""

    def sideslip(score: Score) -> Scalar:
        return jnp.sum(jnp.minimum(score.turns.peak_sideslip, ENOUGH)) / ENOUGH

    def drifts(score: Score) -> Scalar:
        return jnp.sum(jnp.where(score.turns.peak_sideslip > DRIFT, 1.0, 0.0))

    def overshoot(score: Score) -> Scalar:
        return jnp.sum(score.turns.overshoot)

    def reached(score: Score) -> Scalar:
        return jnp.where(jnp.isfinite(score.goal_time), 1.0, 0.0)

    good = (after.outcome == Outcome.DRIVING.code) | (after.outcome == Outcome.REACHED.code)
    changed = (given.throttle - last.throttle) ** 2 + (given.steering - last.steering) ** 2
    # What lies behind the goal is worth nothing: a lap is over there.
    ahead = jnp.minimum(after.furthest, task.goal) - jnp.minimum(before.furthest, task.goal)
    terms = Reward(
        weights.time * (after.time - before.time) * (1 - reached(before)),
        weights.road * jnp.where(good, 0.0, 1.0),
        weights.goal * (reached(after) - reached(before)),
        weights.progress * ahead,
        weights.sideslip * (sideslip(after) - sideslip(before)),
        weights.drift * (drifts(after) - drifts(before)),
        weights.overshoot * (overshoot(after) - overshoot(before)),
        weights.smoothness * changed,
    )
    dtype = jnp.result_type(weights.time)
    return Reward(*(jnp.asarray(term, dtype) for term in terms))


def weights_of(
    changes: Sequence[str], weights: Reward, terms: Sequence[str] = Reward._fields
) -> Reward:
    """The weights with changes such as `sideslip=5`, to these terms. Raises `InputError`."""
    for change in changes:
        name, _, value = change.partition("=")
        if name not in terms:
            raise InputError(
                f"--reward {change}: there is no term {name!r}: give one of " + ", ".join(terms)
            )
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f"--reward {change}: {value!r} is not a number")
        weights = weights._replace(**{name: number})
    return weights
