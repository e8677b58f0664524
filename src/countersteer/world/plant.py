"""The plant: one open-loop rollout of the planar world, for fits and planners.

Commands in, motion out. There are no sensors, no link and no delay lines. Instead, `delayed`
shifts the commands before the rollout. So the delays have derivatives too.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.signals import AnyCommand, Array, Command, Motion, Scalar, Wheels
from countersteer.world import planar, servo, speed_controller
from countersteer.world.floor import Floor
from countersteer.world.planar import State

Seen = TypeVar("Seen")


def delayed(line: Array, ticks: Scalar) -> Array:
    """The line delayed by `ticks`, by interpolation. Before its start, its first value holds."""
    at = jnp.arange(line.shape[0]) - ticks
    whole = jnp.floor(at)
    part = at - whole
    index = whole.astype(jnp.int32)
    last = line.shape[0] - 1
    here, there = (line[jnp.clip(i, 0, last)] for i in (index, index + 1))
    return here + part * (there - here)


def as_it_arrives(car: Car, asked: AnyCommand, dt: float) -> AnyCommand:
    """Commands (ticks,) as they reach motor and servo, after the car's pure delays."""
    drive, steering = asked
    return type(asked)(
        delayed(drive, car.motor.delay / dt), delayed(steering, car.servo.delay / dt)
    )


def settled(car: Car, commands: AnyCommand, wheels: Wheels, dt: float) -> tuple[Scalar, Scalar]:
    """Steering angle (rad) and duty after commands (ticks,).

    They begin at the steady state of the first command. `wheels` (ticks,) are the spins that a
    speed controller measures; throttles do not need them.
    """
    goals = speed_controller.goals(car, commands, wheels)

    def settle(at: tuple[Scalar, Scalar], goal: Command) -> tuple[tuple[Scalar, Scalar], None]:
        angle, duty = at
        return (
            servo.turn(car.servo, angle, goal.steering, dt),
            duty - (goal.throttle - duty) * jnp.expm1(-dt / car.motor.lag),
        ), None

    first = (goals.steering[0], goals.throttle[0])
    at, _ = jax.lax.scan(settle, first, goals)
    return at


def state_of(car: Car, motion: Motion, dt: float) -> State:
    """A state of the world with this motion, and no command under way."""
    state = planar.initial_state(car, dt, slots=1)._replace(motion=motion)
    return jax.tree.map(jnp.asarray, state)


def rollout(
    car: Car,
    state: State,
    commands: AnyCommand,
    every: int,
    dt: float,
    look: Callable[[State], Seen],
    walls: Array | None = None,
    floor: Floor | None = None,
) -> tuple[State, Seen]:
    """The state after commands (ticks,), and the results of `look` after each `every` ticks.

    Commands are as they reach motor and servo. The number of ticks is a multiple of `every`.
    Without `walls` (n, 4) the floor is open: contacts and roll-over are not computed.
    """
    nowhere = jnp.full((1, 4), jnp.nan)
    stages = (planar.move,) if walls is None else (planar.move, planar.collide, planar.judge)

    def tick(state: State, now: AnyCommand) -> tuple[State, None]:
        work = planar.Tick(
            car, nowhere if walls is None else walls, now, now, 0, dt, floor, state.motion
        )
        for stage in stages:
            state, work = stage(state, work)
        return state, None

    def sample(state: State, now: AnyCommand) -> tuple[State, Seen]:
        state, _ = jax.lax.scan(tick, state, now)
        return state, look(state)

    pieces = jax.tree.map(lambda line: line.reshape(-1, every), commands)
    return jax.lax.scan(sample, state, pieces)
