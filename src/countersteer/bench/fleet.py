"""A batch of planar cars in random drives, for the bench."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.batch.engine import CACHED_LANES, whole_blocks
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.signals import Command, Wheels
from countersteer.world import planar
from countersteer.world.state import State
from countersteer.world.walls import padded

# In a block, each delay line has its slots as the first axis. So the lanes of a slot are adjacent.
MOTION: Any = 0  # one axis for all leaves of a motion
AXES = State(MOTION, 1, 1, 0, 0, 0, 0, 0)


def advance(
    own: tuple[Any, State, Command],
    same: Any,
    walls: Any,
    first: Any,
    dt: float,
    ticks: int,
) -> State:
    """A block's states after `ticks` ticks, each lane with its own command; plain `vmap`.

    `own` holds each lane's `Car`, state and command. If the car is None, all lanes have `same`.
    """
    car, states, commands = own
    axes = (None if car is None else 0, None, AXES, 0, None, None)
    step = jax.vmap(planar.step, axes, AXES)

    def turned(states: State) -> State:
        return states._replace(
            throttle_line=states.throttle_line.T, steering_line=states.steering_line.T
        )

    last, _ = jax.lax.scan(
        lambda states, count: (
            step(same if car is None else car, walls, states, commands, count, dt),
            None,
        ),
        turned(states),
        first + jnp.arange(ticks, dtype=jnp.int32),
    )
    return turned(last)


class Fleet:
    """Cars in random drives on box: the inputs of a batch."""

    def __init__(
        self,
        cars: int,
        cores: int,
        varied: bool = False,
        block: int | None = None,
        dt: float = 0.001,
    ):
        """At least `cars` cars, in whole blocks on each core. With `varied`, each car differs."""
        self.dt, self.varied = dt, varied
        self.cars = cars = whole_blocks(cars, block or CACHED_LANES, cores)
        rng = np.random.default_rng(0)
        course, car = load_course("box"), load_car("rx7")
        car = jax.tree.map(np.float32, car)
        start = planar.initial_state(car, dt, course.start)
        self.states = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], cars, 0), start)
        # Anywhere on the corridor's first side, roughly along it.
        speed = rng.uniform(0.0, 3.0, cars).astype(np.float32)
        rolling = [speed / tire.radius for tire in planar.tires_by_wheel(car)]
        motion = self.states.motion._replace(
            wheels=Wheels(*rolling),
            x=rng.uniform(0.0, 3.0, cars).astype(np.float32),
            y=rng.uniform(-0.4, 0.4, cars).astype(np.float32),
            heading=rng.uniform(-0.5, 0.5, cars).astype(np.float32),
            vx=speed,
        )
        self.states = self.states._replace(motion=motion)
        self.commands = Command(
            rng.uniform(0.0, 1.0, cars).astype(np.float32),
            rng.uniform(-0.5, 0.5, cars).astype(np.float32),
        )
        self.walls = padded(course.walls, np.dtype(np.float32))
        if varied:  # only downwards: a locked differential is at its upper limit
            car = jax.tree.map(lambda p: (p * rng.uniform(0.95, 1.0, cars)).astype(np.float32), car)
        self.car = car
        self.states, self.commands, self.car = jax.tree.map(
            jnp.asarray, (self.states, self.commands, self.car)
        )

    def compiled(self, program: Any) -> Any:
        """The program, compiled for these inputs."""
        return program.lower(*self.inputs()).compile()

    def inputs(self) -> tuple[Any, ...]:
        """The arguments of `advance`."""
        return self.inputs_of(self.states, self.commands, self.walls, 0)

    def inputs_of(
        self, states: State, commands: Command, walls: Any, first: int
    ) -> tuple[Any, ...]:
        """The arguments of `advance` with other states, commands and walls, from tick `first`."""
        own, same = (self.car, None) if self.varied else (None, self.car)
        return (own, states, commands), same, walls, np.int32(first)

    def call(self, program: Any) -> Callable[[], Any]:
        """A function that runs the program once, from the start."""
        return lambda: jax.block_until_ready(program(*self.inputs()))
