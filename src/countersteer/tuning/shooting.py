"""Multiple shooting: many windows of logs at once, simulated from what was measured at their start.

Windows are short enough that errors of a car's parameters show before chaos does. All of a window
depends on the car by JAX: where the servo and the speed controller stand at its start, what the
wheels turn at, and the motion to its end. So residuals have exact derivatives.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Wheels
from countersteer.car.parameter import Array, Scalar
from countersteer.runs.run import Run
from countersteer.tuning import windows
from countersteer.tuning.windows import (
    QUANTITIES,
    asked,
    body_at,
    find_references,
    quantities_of,
    radii,
    read_measured,
    rolling,
)
from countersteer.world import motor, planar, servo
from countersteer.world.chassis import Vector
from countersteer.world.planar import Command
from countersteer.world.state import Motion

BEFORE = 0.6  # s before a window in which servo and controller settle from an old command
SAMPLE = 0.05  # s between the instants at which motions are compared


class Shots(NamedTuple):
    """Windows of logs; every leaf has a leading axis of windows. SI units."""

    run: Array  # index of the log
    surface: Array  # index of the surface
    velocity: Vector  # at the start, of the centre of mass in the body's axes
    acceleration: tuple[Array, Array]  # that the loads follow, forward and left
    wheel_speed: Array  # mean rim speed; NaN: wheels roll
    rims: Wheels  # rim speeds; NaN: not known one by one
    charge: Array  # of the battery; NaN: the log does not tell
    throttle: Array  # (windows, ticks from `BEFORE` on), asked for
    steering: Array
    measured: Array  # (windows, quantities, samples after the start); NaN: not known


def joined(parts: Sequence[Shots]) -> Shots:
    """All windows in one."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def take(
    run: Run, car: Car, number: int, surface: int, horizon: float, every: float, dt: float
) -> tuple[Shots, np.ndarray] | None:
    """The windows of the run of this number, `every` seconds, and when they start; None if none.

    They are those that `replay --compare` judges by; the car serves for what is known of it: its
    radii, and which quantities its readings are.
    """
    measured = read_measured(run, car)
    ticks = round(horizon / dt)
    starts, resting = windows.window_starts(measured, run.commands, ticks, dt)
    kept: list[int] = []
    for i, start in enumerate(starts):
        if resting[i] or not kept or (start - starts[kept[-1]]) * dt >= every - 1e-6:
            kept.append(i)
    starts, resting = starts[kept], resting[kept]
    if len(starts) == 0:
        return None
    time = starts * dt
    vx, vy, yaw_rate, ax, ay = body_at(measured, time, resting)
    references = find_references(measured)
    after = time[:, None] + SAMPLE * np.arange(1, round(horizon / SAMPLE) + 1)
    seen = []
    for name in QUANTITIES:
        if name not in references:
            seen.append(np.full(after.shape, np.nan))
            continue
        reference = references[name]
        seen.append(reference.undone(after) if reference.sensor else reference.signal.at(after))
    wheels = references.get("wheel_speed_mps")
    nothing = np.full(len(starts), np.nan)
    mean = nothing if wheels is None else wheels.undone(time, resting)
    rims = (
        Wheels(*(signal.at(time) for signal in measured.wheels))
        if measured.wheels is not None
        else Wheels(*[nothing] * 4)
    )
    before = round(BEFORE / dt)
    throttle, steering = asked(run.commands, starts[:, None] + np.arange(-before, ticks + 1), dt)
    shots = Shots(
        np.full(len(starts), number),
        np.full(len(starts), surface),
        Vector(vx, vy, yaw_rate),
        (ax, ay),
        mean,
        rims,
        np.full(len(starts), float(run.about.get("battery_charge", math.nan))),
        throttle,
        steering,
        np.stack(seen, axis=1),
    )
    known = np.isfinite(vx + vy + yaw_rate)
    if not known.any():
        return None
    return jax.tree.map(lambda leaf: leaf[known], shots), time[known]


def predict(car: Car, shot: Shots, dt: float) -> Array:
    """What the car would do in one window, whose charge is known: (quantities, samples)."""
    samples = shot.measured.shape[-1]
    every = round(SAMPLE / dt)
    before = round(BEFORE / dt)
    throttle = _late(shot.throttle, car.motor.delay / dt)
    steering = _late(shot.steering, car.servo.delay / dt)
    goals = Command(motor.duty(car.motor, throttle), servo.target(car.servo, steering))

    def settle(at: tuple[Scalar, Scalar], goal: Command) -> tuple[tuple[Scalar, Scalar], None]:
        angle, duty = at
        return (
            servo.turn(car.servo, angle, goal.steering, dt),
            duty - (goal.throttle - duty) * jnp.expm1(-dt / car.motor.lag),
        ), None

    first = (goals.steering[0], goals.throttle[0])
    (angle, duty), _ = jax.lax.scan(settle, first, jax.tree.map(lambda g: g[:before], goals))
    motion = _start(car, shot, angle, duty)
    no_walls = jnp.full((1, 4), jnp.nan)
    state = planar.initial_state(car, dt, slots=1)._replace(motion=motion)
    state = jax.tree.map(jnp.asarray, state)

    def tick(state: planar.State, now: Command) -> tuple[planar.State, None]:
        work = planar.Tick(car, no_walls, now, now, 0, dt)
        return planar.move(state, work)[0], None

    def sample(state: planar.State, now: Command) -> tuple[planar.State, tuple[Scalar, ...]]:
        state, _ = jax.lax.scan(tick, state, now)
        return state, quantities_of(car, state.motion)

    pieces = jax.tree.map(
        lambda line: line[before : before + samples * every].reshape(samples, every),
        Command(throttle, steering),
    )
    _, seen = jax.lax.scan(sample, state, pieces)
    vx, vy, yaw_rate, rims = seen
    # An encoder counts over two samples; the one before the window is as the one at its start.
    line = jnp.concatenate([quantities_of(car, motion)[3][None], rims, rims[-1:]])
    counted = (line[:-2] + 2 * line[1:-1] + line[2:]) / 4
    return jnp.stack([vx, vy, yaw_rate, counted])


def _start(car: Car, shot: Shots, angle: Scalar, duty: Scalar) -> Motion:
    """The state at a window's start, as far as it was measured."""
    rims = rolling(car, shot.velocity, angle, shot.wheel_speed)
    wheels = Wheels(
        *(
            jnp.where(jnp.isnan(known), rim, known) / radius
            for rim, known, radius in zip(rims, shot.rims, radii(car), strict=True)
        )
    )
    zero = 0.0 * shot.charge
    ax, ay = shot.acceleration
    return Motion(zero, zero, zero, *shot.velocity, wheels, angle, duty, ax, ay, shot.charge)


def _late(line: Array, ticks: Scalar) -> Array:
    """The line so many ticks later, by interpolation; it was what it is at its start before."""
    at = jnp.arange(line.shape[0]) - ticks
    whole = jnp.floor(at)
    part = at - whole
    index = whole.astype(jnp.int32)
    last = line.shape[0] - 1
    here, there = (line[jnp.clip(i, 0, last)] for i in (index, index + 1))
    return here + part * (there - here)
