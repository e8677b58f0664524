"""The parameters of a turn, learned by driving: a cross-entropy search over random cars.

A generation of candidates is drawn around a mean, each number independently. All candidates drive
the same trials, in one batch. The best quarter, weighted by rank, moves the mean and the spread.
Half of the trials are new. The others are those that went worst before: failures are rare, and a
search that meets each only once does not learn from it.

Source of the method: R. Y. Rubinstein, Methodology and Computing in Applied Probability 1, 1999.
The weights are those of CMA-ES (N. Hansen, 2016).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer.batch.engine import LANES
from countersteer.batch.evaluate import results
from countersteer.batch.open_drives import commands, drives, repeated
from countersteer.batch.population import Population, draw
from countersteer.batch.trials import run_trials
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.policy import TABLES, Policy
from countersteer.experiments.narrowest_corner import DRAWS, attempt
from countersteer.pilot import Pilot
from countersteer.task.judge import DRIFT, Outcome, Score
from countersteer.task.turns import sideslip

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
    "power": 0.25,
}
KEEPS, STAYS = 0.35, 0.75  # weights of the old mean and the old spread in the new ones
WANTED, LEAST, MOST = 37.0, 30.0, 50.0  # degrees of peak sideslip: aim, least and largest
FREE = 11.0  # degrees of heading beyond the corridor that cost nothing
FAILED = 10.0  # cost of a failure
BRISK = 2.2  # m/s, mean speed of a trial whose time costs nothing
AGAIN = 0.5  # part of a generation's trials that went badly before
ABLE = 0.8  # least success rate and share of drifts of a car that can drift the corners
FAST = 3.0  # m/s
WIDER = (0.6, 0.8, 1.0, 1.2, 1.5, 2.0)  # m, corridors that are tried in turn
REMEMBERED = 96  # such trials for each course


class Generation(NamedTuple):
    """The result of a generation: of its mean in new trials, and of its best candidate in all."""

    cost: float
    success_rate: float
    drift_share: float  # of the successes, those that drift in every turn
    best_cost: float


class Drills(NamedTuple):
    """Drills of a course: a seed, and the speed that is asked of the driver (m/s), for each."""

    seeds: tuple[int, ...]
    speeds: tuple[float, ...]

    @classmethod
    def of(cls, seeds: Sequence[int]) -> "Drills":
        """Trials at all speeds of `SPEEDS` in turn."""
        return cls(tuple(seeds), tuple(SPEEDS[i % len(SPEEDS)] for i in range(len(seeds))))

    def joined(self, others: "Drills") -> "Drills":
        """These, and others after them."""
        return Drills(self.seeds + others.seeds, self.speeds + others.speeds)

    def picked(self, rows: np.ndarray) -> "Drills":
        """Some of them."""
        return Drills(*(tuple(column[i] for i in rows) for column in self))


def cost(score: Score, shortest: float) -> np.ndarray:
    """The cost of each trial: of failure, sideslip, heading, and time. A car's least is 0.

    Sideslip costs below `WANTED`, more below `LEAST`, and above `MOST`. The heading costs by its
    squared error at a turn's end, and where it went further than `FREE` beyond the corridor's. Time
    costs over `shortest` (s).
    """
    turns, won = score.turns, score.outcome == Outcome.REACHED.code
    ended = np.isfinite(turns.end)
    done = ended.sum(axis=1)
    slip, error = np.degrees(turns.peak_sideslip), np.abs(np.degrees(turns.error))
    missing = np.clip(WANTED - slip, 0, 20) / 10 + 3 * np.clip((LEAST - slip) / 4, 0, 1)
    much = np.clip(slip - MOST, 0, 40) / 20
    beyond = np.clip(np.degrees(turns.overshoot) - FREE, 0, 60) / 12
    each = missing + much + beyond + 0.35 * np.minimum(error / 3, 6.0) ** 2
    turned = np.where(ended, each, 0.0).sum(axis=1) / np.maximum(done, 1)
    failed = np.where(won, 0.0, FAILED + 2.0 * (1 - done / ended.shape[1]))
    late = np.where(won, np.maximum(score.goal_time / shortest - 1, 0.0), 0.0)
    total: np.ndarray = failed + turned + 2.4 * late
    return total


def search(
    courses: Sequence[Course],
    car: Car,
    population: Population,
    begin: Policy,
    generations: int,
    candidates: int = 24,
    trials: int = 56,
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
    hard = [Drills((), ()) for _ in courses]
    for number in range(generations):
        course, old = courses[number % len(courses)], hard[number % len(courses)]
        tried = mean + deviation * rng.standard_normal((candidates, len(mean)))
        tried[0] = mean
        tried = np.clip(tried, *limits)
        again = min(len(old.seeds), round(AGAIN * trials))
        first = 1000 + seed + number * trials
        own = Drills.of(range(first, first + trials - again))
        own = own.joined(old.picked(rng.permutation(len(old.seeds))[:again]))
        score = drive(course, car, population, [shaped(begin, row) for row in tried], own)
        each = cost(score, (course.lap_end(1) or 0.0) / BRISK).reshape(candidates, trials)
        costs = each.mean(axis=1)
        new = slice(0, trials - again)
        reached = score.outcome[new] == Outcome.REACHED.code
        elite = tried[np.argsort(costs)[:best]]
        slid = np.all(score.turns.peak_sideslip[new] > DRIFT, axis=1)
        slid = float(np.mean(slid[reached])) if np.any(reached) else math.nan
        cheapest = float(costs.min())
        report(number, Generation(float(each[0, new].mean()), np.mean(reached), slid, cheapest))
        worst = np.argsort(-each[0, new])[: max(1, trials // 8)]
        kept = own.picked(worst).joined(old)
        hard[number % len(courses)] = kept.picked(np.arange(min(REMEMBERED, len(kept.seeds))))
        about = np.sqrt(weights @ (elite - mean) ** 2)
        mean = KEEPS * mean + (1 - KEEPS) * (weights @ elite)
        deviation = STAYS * deviation + (1 - STAYS) * about
    return shaped(begin, mean)


def drive(
    course: Course, car: Car, population: Population, policies: Sequence[Policy], trials: Drills
) -> Score:
    """The scores of all policies in the same trials: those of the first policy, then the next."""
    count = len(trials.seeds)
    drawn = draw(population, car, course, trials.seeds, np.float32)
    plain = {speed: drift_turn(course, car, speed) for speed in SPEEDS}
    drivers = [
        dataclasses.replace(plain[speed], **policy._asdict())
        for policy in policies
        for speed in trials.speeds
    ]
    rows = np.tile(np.arange(count), len(policies))
    many: Any = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], drawn)
    pilot = Pilot.of(drivers[0], course, car)
    longest = (course.lap_end(1) or 0.0) / SLOWEST
    seeds = [trials.seeds[i] for i in rows]
    return run_trials(course, pilot, many, drivers, seeds, 1, longest)[0]


def verdict(
    courses: Sequence[Course],
    car: Car,
    population: Population,
    policy: Policy,
    first: int,
    count: int = 128,
) -> dict[str, dict[str, Any]]:
    """The policy's results by course, as `evaluate`'s, in `count` trials whose seeds begin so.

    `no_drift` says why a car does not drift a course's corners; None: it does.
    """
    own, found = Drills.of(range(first, first + count)), {}
    for course in courses:
        score = drive(course, car, population, [policy], own)
        told = results(score, own.seeds)
        able = told["success_rate"] >= ABLE and told["drift_share"] >= ABLE
        because = None if able else reason(course, car, score)
        found[course.name] = told | {"no_drift": because}
    return found


def reason(course: Course, car: Car, score: Score) -> str:
    """Why a car does not drift a course's corners, from trials of what was learned for it.

    It cannot, or it has not learned to: a sentence without its subject, which is the car.
    """
    most, at = slides(car)
    limit = f"a drift has over {math.degrees(DRIFT):.0f}°"
    if most < DRIFT:
        return (
            f"cannot drift the corners of {course.name}, because it does not slide: with the "
            f"wheels hard over at up to {at:.1f} m/s its sideslip stays under "
            f"{math.degrees(most):.0f}°, and {limit}. Slippery rear tyres help"
        )
    if course.width and course.turns and not passes(car, course.width):
        wide = [w for w in WIDER if w > course.width and passes(car, w)]
        needs = f"at least {wide[0]:g} m" if wide else f"over {WIDER[-1]:g} m"
        return (
            f"cannot drift the corners of {course.name}, because the corridor is too narrow: with "
            f"full knowledge it drifts round 90° in {needs}, and this one has {course.width:g} m"
        )
    bad = score.outcome[score.outcome != Outcome.REACHED.code]
    if len(bad) > len(score.outcome) * (1 - ABLE):
        most_often = Outcome.of(np.bincount(bad).argmax()).value
        how = f"{len(bad)} of {len(score.outcome)} random cars fail, most with '{most_often}'"
    else:
        slip = math.degrees(np.median(score.turns.peak_sideslip))
        how = f"it gets round with {slip:.0f}° of sideslip, and {limit}"
    return (
        f"has not learned to drift the corners of {course.name}: {how}. With full knowledge it "
        "can, so a longer search (--generations) or a wider one (--spread 1) may find how"
    )


def slides(car: Car) -> tuple[float, float]:
    """The largest sideslip (rad) of the nominal car on an open floor, and the top speed tried.

    Wheels hard over from speeds up to `FAST`, with all throttles from brake to full.
    """
    speeds, throttles = np.meshgrid(np.linspace(0.8, FAST, 8), np.linspace(-1.0, 1.0, 9))
    lock = min(float(car.servo.limit_left), float(car.servo.limit_right))
    drivers = [commands((0.0, float(throttle), lock)) for throttle in throttles.ravel()]
    still, count = np.zeros(speeds.size), speeds.size
    found = drives(
        repeated(car, count),
        np.ones(count, np.float32),
        drivers,
        np.stack([speeds.ravel(), still, still], axis=1),
        1.5,
    )
    return float(np.max(np.abs(sideslip(found.motion.vx, found.motion.vy)))), FAST


def passes(car: Car, width: float) -> bool:
    """Whether the nominal car drifts round 90° in a corridor (m), with full knowledge."""
    return bool(np.any(np.isfinite(attempt(car, width, True, DRAWS, LANES).time)))


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
