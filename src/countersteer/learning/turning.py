"""The parameters of a turn, learned by driving: a cross-entropy search over random cars.

A generation of candidates is drawn around a mean, each number independently. All candidates drive
the same trials, in one batch. The best quarter, weighted by rank, moves the mean and the spread.

Source of the method: R. Y. Rubinstein, Methodology and Computing in Applied Probability 1, 1999.
The weights are those of CMA-ES (N. Hansen, 2016).
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer.batch.population import Population, draw
from countersteer.batch.trials import run_trials
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.policy import TABLES, Policy
from countersteer.pilot import Pilot
from countersteer.task.judge import Outcome, Score

SPEEDS = (1.5, 2.0, 2.5, 3.0)  # m/s asked of the driver, one trial after another
SLOWEST = 1.1  # m/s, mean speed; a slower trial is out of time
# First spread of a search, in the units used inside. Numbers that are not here are not searched.
SPREAD = {
    "offset": 0.05,
    "slope": 0.03,
    "lead": 0.15,
    "lock": 0.1,
    "rate": 0.6,
    "throttle": 0.2,
    "counter": 0.12,
    "rate_gain": 0.1,
    "stop_gain": 0.3,
    "settled": 0.4,
    "hold_p": 0.3,
    "hold_d": 0.06,
    "hold_slip": 0.3,
    "hold_throttle": 0.1,
    "slip_aim": 0.1,
    "slip_gain": 0.4,
    "lead_grip": 0.5,
    "rate_grip": 0.5,
    "rate_servo": 0.3,
    "stop_servo": 0.8,
    "aim_servo": 0.5,
}
KEEPS, STAYS = 0.35, 0.75  # weights of the old mean and the old spread in the new ones
WANTED, LEAST, MOST = 37.0, 28.0, 48.0  # degrees of peak sideslip: aim, least and largest


class Generation(NamedTuple):
    """The result of a generation: of its mean, and of its best candidate."""

    cost: float
    success_rate: float
    best_cost: float


def cost(score: Score) -> np.ndarray:
    """The cost of each trial: failure, too little or too much sideslip, squared heading errors."""
    turns, won = score.turns, score.outcome == Outcome.REACHED.code
    ended = np.isfinite(turns.end)
    done = ended.sum(axis=1)
    slip, error = np.degrees(turns.peak_sideslip), np.abs(np.degrees(turns.error))
    missing = np.clip(WANTED - slip, 0, 20) / 10 + 1.2 * np.clip((LEAST - slip) / 4, 0, 1)
    much = np.clip(slip - MOST, 0, 40) / 20
    each = missing + much + 0.35 * np.minimum(error / 3, 6.0) ** 2
    turned = np.where(ended, each, 0.0).sum(axis=1) / np.maximum(done, 1)
    failed = np.where(won, 0.0, 6.0 + 2.0 * (1 - done / ended.shape[1]))
    total: np.ndarray = failed + turned
    return total


def search(
    courses: Sequence[Course],
    car: Car,
    population: Population,
    begin: Policy,
    generations: int,
    candidates: int = 32,
    trials: int = 48,
    spread: float = 0.5,
    seed: int = 0,
    report: Callable[[int, Generation], None] = lambda *_: None,
) -> Policy:
    """The policy after all generations, from the policy `begin` on.

    Each generation drives one course, with new seeds. They count from 1000 + `seed` on. `spread` is
    the first spread over `SPREAD`.
    """
    rng, mean = np.random.default_rng(seed), flat(begin)
    deviation = spread * np.concatenate(
        [np.full(np.size(value), SPREAD[name]) for name, value in _numbers(begin)]
    )
    limits = ranges(begin)
    best = max(candidates // 4, 1)
    weights = np.log(best + 0.5) - np.log(np.arange(1, best + 1))
    weights /= weights.sum()
    for number in range(generations):
        tried = mean + deviation * rng.standard_normal((candidates, len(mean)))
        tried[0] = mean
        tried = np.clip(tried, *limits)
        seeds = range(1000 + seed + number * trials, 1000 + seed + (number + 1) * trials)
        policies = [shaped(begin, numbers) for numbers in tried]
        score = drive(courses[number % len(courses)], car, population, policies, seeds)
        costs = cost(score).reshape(candidates, trials).mean(axis=1)
        won = np.mean(score.outcome[:trials] == Outcome.REACHED.code)
        elite = tried[np.argsort(costs)[:best]]
        report(number, Generation(float(costs[0]), float(won), float(costs.min())))
        about = np.sqrt(weights @ (elite - mean) ** 2)
        mean = KEEPS * mean + (1 - KEEPS) * (weights @ elite)
        deviation = STAYS * deviation + (1 - STAYS) * about
    return shaped(begin, mean)


def drive(
    course: Course,
    car: Car,
    population: Population,
    policies: Sequence[Policy],
    seeds: Sequence[int],
) -> Score:
    """The scores of all policies in the same trials: those of the first policy, then the next."""
    drawn = draw(population, car, course, seeds, np.float32)
    plain = {speed: drift_turn(course, car, speed) for speed in SPEEDS}
    drivers = [
        dataclasses.replace(plain[SPEEDS[i % len(SPEEDS)]], **policy._asdict())
        for policy in policies
        for i in range(len(seeds))
    ]
    rows = np.tile(np.arange(len(seeds)), len(policies))
    many: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], drawn)
    pilot = Pilot.of(drivers[0], course, car)
    longest = (course.lap_end(1) or 0.0) / SLOWEST
    drawn_seeds = [seeds[i] for i in rows]
    return run_trials(course, pilot, many, drivers, drawn_seeds, 1, longest)[0]


def _numbers(policy: Policy) -> list[tuple[str, Any]]:
    """The searched numbers by name, in a fixed order."""
    return [
        (name, getattr(getattr(policy, part), name))
        for part, (_, entries) in TABLES.items()
        for name in entries
        if name in SPREAD
    ]


def ranges(like: Policy) -> tuple[np.ndarray, np.ndarray]:
    """The declared range of each number of `flat`: lowest and highest."""
    lows, highs = [], []
    for part, (_, entries) in TABLES.items():
        for name, entry in entries.items():
            if name in SPREAD:
                count = np.size(getattr(getattr(like, part), name))
                lows.append(np.full(count, entry.declared.low))
                highs.append(np.full(count, entry.declared.high))
    return np.concatenate(lows), np.concatenate(highs)


def flat(policy: Policy) -> np.ndarray:
    """All searched numbers in one array."""
    return np.concatenate([np.ravel(value) for _, value in _numbers(policy)])


def shaped(like: Policy, numbers: np.ndarray) -> Policy:
    """The inverse of `flat`. Numbers that are not searched are those of `like`."""
    parts, first = {}, 0
    for part, (_, entries) in TABLES.items():
        table, changes = getattr(like, part), {}
        for name in entries:
            if name in SPREAD:
                size = np.size(getattr(table, name))
                values = numbers[first : first + size]
                changes[name] = values if np.ndim(getattr(table, name)) else float(values[0])
                first += size
        parts[part] = dataclasses.replace(table, **changes)
    return Policy(**parts)
