"""Hostile drives of random cars: `python -m studies.fuzz_physics [--drives N] [--seed N]`.

Each car is drawn over its whole declared ranges, ends of ranges included. It starts anywhere on a
course, at up to 50 m/s, with random commands. Every tick is checked against what must hold for
every car, at every step and in both precisions:

- no number is NaN or infinite;
- with the motor off, kinetic energy does not rise;
- the way of the outline's centre crosses no wall.

The checks are computed apart from the world, in 64 bits. What fails is shortened to its last tick,
and each parameter that does not matter is put back to its default. The rest is written as a case.
"""

import argparse
import dataclasses
import functools
import json
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Tires
from countersteer.car.parameter import changed, declarations
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.signals import Command, Motion, Wheels
from countersteer.world import planar
from countersteer.world.state import State
from countersteer.world.walls import padded

FASTEST, FASTEST_TURN = 50.0, 50.0  # m/s, rad/s
STEPS = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2)  # s
TICKS, HOLD = 200, 20  # ticks of a drive, and ticks for which a command is held
SLOTS = 32  # of the delay lines; a longer delay is cut off there
LANES = 2048
LAWS = ("brush", "magic-formula")
COURSES = ("none", "box")
# Rounding of a tick, as a part of the energy without cancellation (`energies`).
TOLERANCE = {32: 2e-6, 64: 1e-13}
LEAST_ENERGY = {32: 1e-25, 64: 1e-60}  # J
PHYSICS = ("body", "tires", "drivetrain", "motor", "battery", "servo")


class Start(NamedTuple):
    """A drive's start and commands, in 64 bits; leaves have a leading axis of drives."""

    car: Car
    motion: Motion
    throttle: Any  # (drives, blocks)
    steering: Any
    dt: Any


def parameters(part: Any, path: str = "") -> dict[str, tuple[float, float, float]]:
    """Default, low and high of each number below a part of a car, by its path."""
    found = {}
    for name, declared in declarations(type(part)).values():
        if not declared.choices and not declared.whole:
            found[path + name] = (float(getattr(part, name)), declared.low, declared.high)
    for field in dataclasses.fields(part):
        inner = getattr(part, field.name)
        if dataclasses.is_dataclass(inner):
            found |= parameters(inner, f"{path}{field.name}.")
    return found


def hostile_car(law: str) -> Car:
    """The default car with tyres of a law."""
    tires = Tires()
    front, rear = (dataclasses.replace(t, law=law) for t in (tires.front, tires.rear))
    return dataclasses.replace(Car(), tires=Tires(front=front, rear=rear))


def draw_values(low: float, high: float, rng: np.random.Generator, count: int) -> np.ndarray:
    """Values of a parameter: even, even in their logarithm, small, or at an end of the range."""
    kind = rng.choice(4, count, p=(0.4, 0.4, 0.1, 0.1))
    even = rng.uniform(low, high, count)
    least = low if low > 0 else min(1e-6 * high, 1e-6)
    wide = np.exp(rng.uniform(math.log(least), math.log(high), count)) if high > 0 else even
    if low < 0:
        wide = wide * rng.choice((-1, 1), count)
    return np.select([kind == 0, kind == 1, kind == 2], [even, wide, low], high).clip(low, high)


def draw(law: str, walls: np.ndarray, rng: np.random.Generator, count: int) -> Start:
    """Random starts. A third of the cars differ from the default in every tenth parameter only."""
    car: Any = hostile_car(law)
    share = rng.choice((0.1, 0.5, 1.0), count)
    for path, (default, low, high) in parameters(car).items():
        if path.partition(".")[0] in PHYSICS:
            drawn = rng.random(count) < share
            value = np.where(drawn, draw_values(low, high, rng, count), default)
            car = changed(car, path, value)
    # Between parameters, as `car.files.check`.
    body, motor = car.body, car.motor
    front = np.minimum(body.front_axle, 0.99 * body.wheelbase)
    full = np.maximum(motor.full_throttle, motor.dead_zone + 0.01)
    car = dataclasses.replace(
        car,
        body=dataclasses.replace(body, front_axle=front),
        motor=dataclasses.replace(motor, full_throttle=full),
    )
    car = jax.tree.map(lambda leaf: np.broadcast_to(np.float64(leaf), count).copy(), car)

    speed = FASTEST * rng.choice((0.0, 1e-20, 1e-6, 0.01, 0.1, 1.0), count) * rng.random(count)
    bearing, heading = rng.uniform(-math.pi, math.pi, (2, count))
    turning = FASTEST_TURN * speed / FASTEST * rng.normal(size=count)
    place = places(walls, rng, count)
    vx, vy = speed * np.cos(bearing), speed * np.sin(bearing)
    rolling = rng.choice((0.0, 1.0, 1.0, 2.0), (4, count)) * vx
    radii = [car.tires.front.radius] * 2 + [car.tires.rear.radius] * 2
    zero = np.zeros(count)
    motion = Motion(
        place[:, 0], place[:, 1], heading, vx, vy, turning,
        Wheels(*(r / radius for r, radius in zip(rolling, radii, strict=True))),
        rng.uniform(-0.6, 0.6, count) * rng.integers(0, 2, count), zero,
        zero, zero, rng.choice((0.0, 0.5, 1.0), count),
    )  # fmt: skip
    blocks = TICKS // HOLD
    off = rng.random((count, 1)) < 0.6
    throttle = np.where(off, 0.0, rng.uniform(-1.2, 1.2, (count, blocks)))
    steering = rng.uniform(-1.5, 1.5, (count, blocks))
    return Start(car, motion, throttle, steering, rng.choice(STEPS, count))


def places(walls: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Points near the walls' ends and between them."""
    if not len(walls):
        return rng.uniform(-1, 1, (count, 2))
    low, high = walls.reshape(-1, 2).min(axis=0) - 0.5, walls.reshape(-1, 2).max(axis=0) + 0.5
    return rng.uniform(low, high, (count, 2))


def value_of(part: Any, path: str) -> Any:
    """A parameter of a car."""
    return functools.reduce(getattr, path.split("."), part)


@functools.partial(jax.jit, static_argnames="ticks")
def drive(start: Start, walls: jax.Array, ticks: int = TICKS) -> Motion:
    """The motion at the start and after each tick: (ticks + 1, drives)."""
    dtype = start.dt.dtype

    def one(start: Start) -> Motion:
        line, zero = jnp.zeros(SLOTS, dtype), jnp.zeros((), dtype)
        state = State(start.motion, line, line, zero, zero, zero, zero, zero)

        def tick(state: State, count: Any) -> tuple[State, Motion]:
            block = count // HOLD % start.throttle.shape[0]
            command = Command(start.throttle[block], start.steering[block])
            after = planar.step(start.car, walls, state, command, count, start.dt)
            return after, after.motion

        _, motion = jax.lax.scan(tick, state, jnp.arange(ticks))
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start.motion, motion)

    return jax.vmap(one, out_axes=1)(start)


def run(start: Start, walls: np.ndarray, bits: int, ticks: int = TICKS) -> Motion:
    """`drive` in 32 or 64 bits; the result is in 64."""
    dtype = np.float64 if bits == 64 else np.float32
    with jax.enable_x64(bits == 64):
        motion = drive(jax.tree.map(dtype, start), padded(walls, np.dtype(dtype)), ticks)
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), motion)


def energies(start: Start, motion: Motion, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Kinetic energy at each instant (J), of the car as that precision knows it.

    The second one is a scale for rounding: the energy if all wheels turned the same way. Wheels
    that turn against each other leave the rotor a small difference of large speeds.
    """
    dtype = np.float64 if bits == 64 else np.float32
    car = jax.tree.map(lambda leaf: np.float64(dtype(leaf)), start.car)
    body, train = car.body, car.drivetrain
    twice = body.mass * (motion.vx**2 + motion.vy**2) + body.yaw_inertia * motion.yaw_rate**2
    tires = (car.tires.front, car.tires.front, car.tires.rear, car.tires.rear)
    for tire, speed in zip(tires, motion.wheels, strict=True):
        twice = twice + tire.inertia * speed**2
    rotor = train.gear_ratio**2 * car.motor.rotor_inertia

    def driven(wheels: Any) -> Any:
        front, rear = ((wheels[i] + wheels[i + 1]) / 2 for i in (0, 2))
        return train.front_share * front + (1 - train.front_share) * rear

    speeds = driven(motion.wheels), driven([*map(np.abs, motion.wheels)])
    energy, scale = ((twice + rotor * speed**2) / 2 for speed in speeds)
    return energy, scale


def crossings(car: Car, motion: Motion, walls: np.ndarray) -> np.ndarray:
    """Whether the outline's centre crosses a wall on its way to each instant but the first."""
    x = motion.x + np.cos(motion.heading) * car.body.center
    y = motion.y + np.sin(motion.heading) * car.body.center
    crossed = np.zeros(x[1:].shape, bool)
    for ax, ay, bx, by in walls:

        def side(px: Any, py: Any, a: Any = (ax, ay, bx, by)) -> Any:
            return (a[2] - a[0]) * (py - a[1]) - (a[3] - a[1]) * (px - a[0])

        before, after = side(x[:-1], y[:-1]), side(x[1:], y[1:])
        dx, dy = np.diff(x, axis=0), np.diff(y, axis=0)
        first = dx * (ay - y[:-1]) - dy * (ax - x[:-1])
        second = dx * (by - y[:-1]) - dy * (bx - x[:-1])
        crossed |= (before * after < 0) & (first * second < 0)
    return crossed


def failures(start: Start, motion: Motion, walls: np.ndarray, bits: int) -> dict[str, np.ndarray]:
    """The first tick (from 1) at which each drive fails, by the kind of failure; 0: never."""
    with np.errstate(all="ignore"):
        wrong = ~np.isfinite(np.stack(jax.tree.leaves(motion))).all(axis=0)[1:]
        energy, scale = energies(start, motion, bits)
        rounding = TOLERANCE[bits] * np.maximum(scale[1:], scale[:-1])
        allowed = energy[:-1] + rounding + LEAST_ENERGY[bits]
        gains = (energy[1:] > allowed) & np.all(start.throttle == 0, axis=1)
        passed = crossings(start.car, motion, walls)
    found = {"not finite": wrong, "energy gained": gains & ~wrong, "wall passed": passed & ~wrong}
    return {
        kind: np.where(where.any(axis=0), where.argmax(axis=0) + 1, 0)
        for kind, where in found.items()
    }


def minimised(start: Start, walls: np.ndarray, bits: int, kind: str) -> tuple[Start, list[str]]:
    """One failing drive with as many default parameters as it still fails with, and the others."""
    plain: Any = hostile_car(start.car.tires.front.law)
    ranges = parameters(plain)
    paths = [p for p in ranges if p.partition(".")[0] in PHYSICS]

    def fails(cars: list[Car]) -> np.ndarray:
        batch = Start(
            jax.tree.map(lambda *leaves: np.stack(leaves), *cars),
            *jax.tree.map(lambda leaf: np.repeat(leaf[None], len(cars), axis=0), start[1:]),
        )
        return failures(batch, run(batch, walls, bits), walls, bits)[kind] > 0

    car, left = start.car, [p for p in paths if value_of(start.car, p) != ranges[p][0]]
    while left:
        tried = [changed(car, path, np.float64(ranges[path][0])) for path in left]
        tried += [car] * (len(paths) - len(tried))  # one shape: one program
        able = fails(tried)[: len(left)]
        if not able.any():
            break
        chosen = int(able.argmax())
        car, left = tried[chosen], left[:chosen] + left[chosen + 1 :]
    return start._replace(car=car), left


def write_case(folder: Path, start: Start, left: list[str], about: dict[str, Any]) -> None:
    """A failing drive as plain data."""
    folder.mkdir(parents=True, exist_ok=True)
    content = about | {
        "parameters": {path: float(value_of(start.car, path)) for path in left},
        "dt_s": float(start.dt),
        "throttle": start.throttle.tolist(),
        "steering_rad": start.steering.tolist(),
        "motion": [float(leaf) for leaf in jax.tree.leaves(start.motion)],
    }
    (folder / "drive.json").write_text(json.dumps(content, indent=1) + "\n")


def main() -> int:
    """Runs all combinations of law, precision and course; exit status 1 if a drive fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--law", choices=LAWS, action="append")
    parser.add_argument("--bits", type=int, choices=(32, 64), action="append")
    parser.add_argument("--course", choices=COURSES, action="append")
    parser.add_argument("--out", type=Path, help="where cases of failures are written")
    options = parser.parse_args()
    configure_jax()
    groups = [
        (law, bits, course)
        for law in options.law or LAWS
        for bits in options.bits or (32, 64)
        for course in options.course or COURSES
    ]
    rounds = math.ceil(options.drives / len(groups) / LANES)
    bad = 0
    for law, bits, course in groups:
        walls = np.zeros((0, 4)) if course == "none" else load_course(course).walls
        counts: dict[str, int] = {}
        for number in range(rounds):
            index = LAWS.index(law), bits, COURSES.index(course), number
            rng = np.random.default_rng((options.seed, *index))
            start = draw(law, walls, rng, LANES)
            for kind, ticks in failures(start, run(start, walls, bits), walls, bits).items():
                lanes = np.nonzero(ticks)[0]
                if len(lanes) and options.out and not counts.get(kind):
                    one: Start = jax.tree.map(lambda leaf, i=lanes[0]: leaf[i], start)
                    small, left = minimised(one, walls, bits, kind)
                    about = {
                        "law": law, "bits": bits, "course": course, "seed": options.seed,
                        "round": number, "lane": int(lanes[0]), "tick": int(ticks[lanes[0]]),
                    }  # fmt: skip
                    name = f"{kind.replace(' ', '-')}-{law}-{bits}-{course}"
                    write_case(options.out / name, small, left, {"failure": kind} | about)
                counts[kind] = counts.get(kind, 0) + len(lanes)
        bad += sum(counts.values())
        words = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        print(f"{law:14}{bits:3} bits, {course:5}: {rounds * LANES} drives: {words}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
