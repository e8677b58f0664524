"""Simulated people at the cockpit's keys, with gyroscope and without: `python -m studies.players`.

A player sees the picture late: each look is 250 ms old, give or take 50 ms, and a key stays as it
is for 80 ms at least. He has three keys: throttle, left and right. He knows the course, and where
the car will be when his finger moves, as far as what he saw goes on as it was. Each player has
habits of his own: when he lifts, when he presses, how fast he likes to go. The car is the nominal
one; only people differ. The habits were found on other seeds (`--search`).
"""

import argparse
import os
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.batch.evaluate import interval
from countersteer.batch.population import Drawn
from countersteer.batch.trials import run_trials
from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.car.parameter import pytree
from countersteer.cockpit import gyro
from countersteer.cockpit.gyro import Assist, Hands, Ramps
from countersteer.compiling import configure_jax
from countersteer.course.course import Course
from countersteer.course.files import load_course
from countersteer.course.position import Legs, legs_of
from countersteer.drivers.driver import ROUNDING, Observation
from countersteer.pilot import Pilot
from countersteer.signals import Array, Command, Scalar
from countersteer.task.judge import DRIFT, Outcome

REACTION, JITTER = 0.25, 0.05  # s
FRAME, HELD = 0.02, 0.08  # s between two looks; a key's least time
FRAMES = 32  # that are remembered
PLAYERS, FIRST = 200, 7_000_000
SEARCHED, STEPS, TRIED, BEST = 1_200_000, 8, 384, 12  # first seed of the search, and its size
SPREAD = 0.05  # of each habit among players, relative
LONGEST = 30.0  # s of a drive


class Habits(NamedTuple):
    """How a player drives."""

    press: Scalar  # m before the corner at which he steers into it
    lift: Scalar  # m before the corner at which he lets go of the throttle
    release: Scalar  # rad of the corner that are left when he lets go of the key
    speed: Scalar  # m/s above which he lets go of the throttle
    power: Scalar  # the same within a corner
    offset: Scalar  # rad of correction per metre beside the middle
    damping: Scalar  # s, of the yaw rate
    dead: Scalar  # rad of error that he leaves alone
    expects: Scalar  # rad/s of yaw rate that he expects of a steering key


# Found on other seeds: by `--search on` in 8 steps, by `--search off` in 7.
WITH_GYRO = Habits(0.981, 1.19, 0.489, 1.427, 2.508, 1.001, 0.234, 0.257, 1.018)
WITHOUT = Habits(0.69, 1.418, 0.73, 1.313, 1.057, 0.905, 0.225, 0.252, 1.076)
# Ranges of the search.
LOW = Habits(0.3, 0.2, 0.2, 1.3, 1.0, 0.3, 0.0, 0.05, 0.0)
HIGH = Habits(1.8, 2.0, 1.5, 3.0, 3.5, 2.0, 0.4, 0.3, 4.0)


class Memory(NamedTuple):
    """A player between two decisions."""

    key: Array
    frames: Array  # (FRAMES, 6): x, y, heading, speed along it, yaw rate, his steering key
    looked: Scalar  # s, time of the last frame
    frame: Scalar  # its number
    changed: Scalar  # s, time at which a steering key moved last
    pressed: Scalar  # s, the same of the throttle
    steer: Scalar  # keys
    throttle: Scalar
    leg: Scalar
    turning: Scalar
    habits: Habits  # his own
    time: Scalar  # of the last command, s
    ramps: Ramps
    command: Command


@pytree
class Player:
    """A person at the keys, as a driver over the truth."""

    legs: Legs
    habits: Habits
    assist: Assist
    spread: Scalar = SPREAD

    def reset(self, key: Array) -> Memory:
        """He has not looked yet."""
        own, key = jax.random.split(key)
        factors = 1 + self.spread * jax.random.normal(own, (len(self.habits),), jnp.float32)
        mine = Habits(*(h * jnp.maximum(f, 0.5) for h, f in zip(self.habits, factors, strict=True)))
        zero = jnp.float32(0)
        parts: Any = (
            jax.random.key_data(key), jnp.zeros((FRAMES, 6), jnp.float32), zero - 1.0,
            jnp.int32(-1), zero - 1.0, zero - 1.0, zero, zero, jnp.int32(0), zero, mine, zero - 1.0,
            Ramps(zero, zero, zero), Command(zero, zero),
        )  # fmt: skip
        return Memory(*parts)

    def act(self, memory: Memory, seen: Observation) -> tuple[Command, Memory]:
        """The command of the car's own gyroscope and ramps for his keys."""
        memory = jax.lax.cond(
            seen.time - memory.looked > FRAME - ROUNDING,
            lambda m: self.look(m, seen),
            lambda m: m,
            memory,
        )
        return self.steer(memory, seen)

    def look(self, memory: Memory, seen: Observation) -> Memory:
        """He sees a frame late, and moves his fingers."""
        now = seen.estimate
        frame = memory.frame + 1
        own = [now.x, now.y, now.heading, now.vx, now.yaw_rate, memory.steer]
        frames = memory.frames.at[frame % FRAMES].set(jnp.stack(own).astype(jnp.float32))
        drawn, key = jax.random.split(jax.random.wrap_key_data(memory.key))
        late = REACTION + JITTER * jax.random.normal(drawn, (), jnp.float32)
        back = jnp.clip(
            jnp.round(late / FRAME).astype(jnp.int32), 0, jnp.minimum(frame, FRAMES - 1)
        )
        x, y, heading, speed, rate, key_then = frames[(frame - back) % FRAMES]
        # He is used to his own delay, and knows what his fingers have done since.
        before, rate = rate, rate + memory.habits.expects * (memory.steer - key_then)
        x = x + REACTION * speed * jnp.cos(heading)
        y = y + REACTION * speed * jnp.sin(heading)
        heading = heading + REACTION * (before + rate) / 2
        steer, throttle, leg, turning = self.decide(memory, x, y, heading, speed, rate)
        time = seen.time
        moves = (steer != memory.steer) & (time - memory.changed >= HELD)
        presses = (throttle != memory.throttle) & (time - memory.pressed >= HELD)
        return memory._replace(
            key=jax.random.key_data(key),
            frames=frames,
            looked=time,
            frame=frame,
            changed=jnp.where(moves, time, memory.changed),
            pressed=jnp.where(presses, time, memory.pressed),
            steer=jnp.where(moves, steer, memory.steer),
            throttle=jnp.where(presses, throttle, memory.throttle),
            leg=leg,
            turning=turning,
        )

    def decide(
        self, memory: Memory, x: Scalar, y: Scalar, heading: Scalar, speed: Scalar, rate: Scalar
    ) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """The keys that he wants down, his leg, and whether he is in a corner."""
        habits, bearings = memory.habits, jnp.asarray(self.legs.bearing)
        corner = bearings[memory.leg + 1] - bearings[memory.leg]
        place = self.legs.seen(memory.leg, x, y, heading)
        turning = (memory.turning > 0.5) | ((place.distance < habits.press) & (corner != 0))
        left = corner - (heading - bearings[memory.leg])
        through = turning & (left * jnp.sign(corner) < habits.release)
        leg = memory.leg + through.astype(jnp.int32)
        turning = turning & ~through
        place = self.legs.seen(leg, x, y, heading)
        error = place.bearing + habits.offset * place.offset + habits.damping * rate
        correction = jnp.where(jnp.abs(error) < habits.dead, 0.0, -jnp.sign(error))
        steer = jnp.where(turning, jnp.sign(corner), correction)
        most = jnp.where(turning, habits.power, habits.speed)
        lifts = ~turning & (place.distance < habits.lift)
        throttle = jnp.where((speed > most) | lifts, 0.0, 1.0)
        return steer, throttle, leg, turning.astype(jnp.float32)

    def steer(self, memory: Memory, seen: Observation) -> tuple[Command, Memory]:
        """What the car makes of the keys."""
        dt = jnp.clip(seen.time - memory.time, 0.0, 0.1)
        speed = jnp.hypot(seen.estimate.vx, seen.estimate.vy)
        rate = jnp.where(jnp.isfinite(seen.gyroscope.age), seen.gyroscope.value, 0.0)
        hands = Hands(memory.steer, memory.throttle, 0.0)
        command, ramps = gyro.steer(self.assist, memory.ramps, hands, rate, speed, dt)
        return command, memory._replace(time=seen.time, ramps=ramps, command=command)


def alike(car: Car, course: Course, count: int) -> Drawn:
    """The nominal car at the start, so many times."""
    cars = jax.tree.map(lambda leaf: np.full(count, leaf, np.float32), car)
    pose = np.tile(np.array(course.start, np.float32), (count, 1))
    return Drawn(cars=cars, charge=np.ones(count, np.float32), pose=pose, speed=None, floor=None)


def drive(players: list[Player], course: Course, car: Car, first: int) -> Any:
    """The scores of players, each with a seed of his own."""
    pilot = Pilot.of(players[0], course, car, "truth")
    seeds = range(first, first + len(players))
    drawn = alike(car, course, len(players))
    return run_trials(course, pilot, drawn, players, seeds, 1, LONGEST)[0]


def player(course: Course, car: Car, habits: Habits, on: bool, strength: float = 1.0) -> Player:
    """A player of a course."""
    lock = float(min(car.servo.limit_left, car.servo.limit_right))
    assist = Assist(float(on), strength, lock)
    return Player(legs=legs_of(course, 1), habits=habits, assist=assist)


def row(name: str, score: Any) -> str:
    """A line of the table."""
    count = len(score.outcome)
    reached = np.asarray(score.outcome) == Outcome.REACHED.code
    slips = np.asarray(score.turns.peak_sideslip)
    drifts = reached & (slips.min(axis=1) > DRIFT)
    corners = np.isfinite(np.asarray(score.turns.end)).sum(axis=1)
    laps = np.asarray(score.goal_time)[reached]

    def share(which: np.ndarray) -> str:
        low, high = interval(int(which.sum()), count)
        return f"{which.sum()} ({100 * low:.0f}–{100 * high:.0f} %)"

    cells = [name, share(reached), share(drifts), f"{np.mean(corners):.1f}"]
    cells.append(f"{np.degrees(np.median(slips[reached])):.0f}°" if reached.any() else "–")
    cells.append(f"{np.median(laps):.1f} s" if reached.any() else "–")
    return f"| {' | '.join(cells)} |"


def search(course: Course, car: Car, on: bool, first: int) -> Habits:
    """Habits that drift round the course, by the cross-entropy method."""
    draw = np.random.default_rng(first)
    low, high = np.array(LOW), np.array(HIGH)
    middle, wide = (low + high) / 2, (high - low) / 2.5
    for step in range(STEPS):
        tried = np.clip(middle + wide * draw.standard_normal((TRIED, len(low))), low, high)
        players = [player(course, car, Habits(*map(float, t)), on) for t in tried]
        score = drive(players, course, car, first + step * TRIED)
        best = tried[np.argsort(-worth(score, course))[:BEST]]
        middle, wide = best.mean(axis=0), best.std(axis=0) + 0.01 * (high - low)
        print(step, Habits(*(round(float(value), 3) for value in middle)), flush=True)
    return Habits(*map(float, middle))


def worth(score: Any, course: Course) -> np.ndarray:
    """How well each drive went: progress, and how much each turn was a drift."""
    reached = np.asarray(score.outcome) == Outcome.REACHED.code
    slips = np.asarray(score.turns.peak_sideslip) * np.isfinite(np.asarray(score.turns.end))
    drifted = np.clip(slips / DRIFT, 0, 1)
    way = np.asarray(score.furthest) - course.start_distance
    found: np.ndarray = way / course.length + 0.5 * reached + 1.5 * np.mean(drifted**2, axis=1)
    return found + 3.0 * (reached & (drifted.min(axis=1) >= 1)) + drifted.min(axis=1)


def main() -> int:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--search", choices=("on", "off"), help="look for habits, on other seeds")
    given = options.parse_args()
    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    course, car = load_course("box"), load_car("rx7")
    if given.search:
        search(course, car, given.search == "on", SEARCHED)
        return 0
    print("| steering | get round | get round drifting | turns | sideslip | lap |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, habits, on in (("gyroscope", WITH_GYRO, True), ("keys alone", WITHOUT, False)):
        players = [player(course, car, habits, on)] * PLAYERS
        print(row(name, drive(players, course, car, FIRST)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
