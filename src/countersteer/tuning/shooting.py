"""Multiple shooting: many windows of logs at once, each simulated from its measured start.

Windows are short enough that parameter errors show before chaos does. JAX traces a whole window
from the car's parameters: servo, speed controller and wheel speeds at its start, and the motion to
its end. So residuals have exact derivatives.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.errors import InputError
from countersteer.runs.run import Run
from countersteer.signals import AnyCommand, Array, Motion, Scalar, SpeedCommand, Wheels
from countersteer.tuning import windows
from countersteer.tuning.windows import (
    QUANTITIES,
    asked,
    body_at,
    find_references,
    measured_for,
    quantities_of,
    radii,
    rims_at,
    rolling,
    spins,
)
from countersteer.world import plant
from countersteer.world.chassis import Vector

BEFORE = 0.6  # s of commands before a window, in which servo and controller settle
SAMPLE = 0.05  # s between compared motions


class Shots(NamedTuple):
    """Windows of logs; every leaf has a leading axis of windows. SI units."""

    run: Array  # index of the log
    surface: Array  # index of the surface
    velocity: Vector  # at the start, of the centre of mass in the body's axes
    acceleration: tuple[Array, Array]  # at the start, forward and left; sets the wheel loads
    wheel_speed: Array  # that the encoder sees; NaN: wheels roll
    sees: Wheels  # share of each wheel in it
    rims: Wheels  # rim speeds; NaN: not known for each wheel
    charge: Array  # of the battery; NaN: not stated by the log
    commands: AnyCommand  # (windows, ticks from `BEFORE` on)
    rims_before: Array  # measured rim speed in the ticks of `BEFORE`, for a speed controller
    measured: Array  # (windows, quantities, samples after the start); NaN: not known


def joined(parts: Sequence[Shots]) -> Shots:
    """The windows of all parts in one `Shots`.

    Raises `InputError` if some logs are commanded by throttle and some by speed.
    """
    if len({type(part.commands) for part in parts}) > 1:
        raise InputError(
            "some logs are commanded by throttle and some in m/s (speed_mps): fit them apart"
        )
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def take(
    run: Run, car: Car, number: int, surface: int, horizon: float, every: float, dt: float
) -> tuple[Shots, np.ndarray] | None:
    """The windows of a run, and their start times (s): (windows,). None if there are none.

    They are windows of `replay --compare`, at least `every` seconds apart; all starts from rest
    are kept. `number` is the index of the run. The car gives its wheel radii and the timing of its
    sensors.
    """
    measured = measured_for(run, car)
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
    whole = asked(run.commands, np.arange(int(starts.max()) + 1), dt)
    angle = windows.actuators(car, measured, whole, dt)[0][starts]
    vx, vy, yaw_rate, ax, ay = body_at(car, measured, angle, time, resting)
    references = find_references(measured)
    after = time[:, None] + SAMPLE * np.arange(1, round(horizon / SAMPLE) + 1)
    seen = []
    for name in QUANTITIES:
        if name not in references:
            seen.append(np.full(after.shape, np.nan))
            continue
        reference = references[name]
        seen.append(reference.undone(after) if reference.timing else reference.signal.at(after))
    wheels = references.get("wheel_speed_mps")
    nothing = np.full(len(starts), np.nan)
    mean = nothing if wheels is None else wheels.undone(time, resting)
    sees = windows.MEAN if wheels is None else wheels.sees
    rims = (
        Wheels(*(signal.at(time) for signal in measured.wheels))
        if measured.wheels is not None
        else Wheels(*[nothing] * 4)
    )
    before = round(BEFORE / dt)
    commands = asked(run.commands, starts[:, None] + np.arange(-before, ticks + 1), dt)
    rims_before = np.zeros((len(starts), 0))
    if isinstance(commands, SpeedCommand):
        rims_before = rims_at(measured, time[:, None] + dt * np.arange(-before, 0))
    shots = Shots(
        np.full(len(starts), number),
        np.full(len(starts), surface),
        Vector(vx, vy, yaw_rate),
        (ax, ay),
        mean,
        Wheels(*(np.full(len(starts), share) for share in sees)),
        rims,
        windows.charges(run, time, math.nan),
        commands,
        rims_before,
        np.stack(seen, axis=1),
    )
    known = np.isfinite(vx + vy + yaw_rate)
    if not known.any():
        return None
    return jax.tree.map(lambda leaf: leaf[known], shots), time[known]


def predict(car: Car, shot: Shots, dt: float) -> Array:
    """The simulated quantities of one window with a known charge: (quantities, samples)."""
    samples = shot.measured.shape[-1]
    every = round(SAMPLE / dt)
    before = round(BEFORE / dt)
    commands = plant.as_it_arrives(car, shot.commands, dt)
    angle, duty = plant.settled(
        car, jax.tree.map(lambda line: line[:before], commands), spins(car, shot.rims_before), dt
    )
    motion = _start(car, shot, angle, duty)
    ahead = jax.tree.map(lambda line: line[before : before + samples * every], commands)
    _, seen = plant.rollout(
        car,
        plant.state_of(car, motion, dt),
        ahead,
        every,
        dt,
        lambda state: quantities_of(car, state.motion, shot.sees),
    )
    vx, vy, yaw_rate, rims = seen
    # An encoder counts over two samples. The one before the window equals the one at its start.
    line = jnp.concatenate([quantities_of(car, motion, shot.sees)[3][None], rims, rims[-1:]])
    counted = (line[:-2] + 2 * line[1:-1] + line[2:]) / 4
    return jnp.stack([vx, vy, yaw_rate, counted])


def _start(car: Car, shot: Shots, angle: Scalar, duty: Scalar) -> Motion:
    """The state at a window's start from the measured quantities. The pose is 0."""
    rims = rolling(car, shot.velocity, angle, shot.wheel_speed, shot.sees)
    wheels = Wheels(
        *(
            jnp.where(jnp.isnan(known), rim, known) / radius
            for rim, known, radius in zip(rims, shot.rims, radii(car), strict=True)
        )
    )
    zero = 0.0 * shot.charge
    ax, ay = shot.acceleration
    return Motion(zero, zero, zero, *shot.velocity, wheels, angle, duty, ax, ay, shot.charge)
