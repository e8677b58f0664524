"""Replays a list of commands."""

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.drivers.driver import Observation
from countersteer.signals import Command, Scalar, SpeedCommand

EARLY = 1e-6  # s by which a command may come early, as times are rounded


@pytree
class SpeedReplay:
    """As `Replay`, for a car that is commanded in m/s."""

    command_type = SpeedCommand

    times: np.ndarray  # s, rising
    speed: np.ndarray  # m/s
    steering: np.ndarray  # rad

    def reset(self, key: jax.Array) -> tuple[()]:
        """No memory: the time is enough."""
        del key
        return ()

    def act(self, memory: tuple[()], observation: Observation) -> tuple[SpeedCommand, tuple[()]]:
        """The last command whose time has come."""
        return SpeedCommand(*held(self.times, observation.time, self.speed, self.steering)), memory


@pytree
class Replay:
    """Holds each command until the next one is due. Before the first, commands are 0."""

    times: np.ndarray  # s, rising
    throttle: np.ndarray
    steering: np.ndarray  # rad

    def reset(self, key: jax.Array) -> tuple[()]:
        """No memory: the time is enough."""
        del key
        return ()

    def act(self, memory: tuple[()], observation: Observation) -> tuple[Command, tuple[()]]:
        """The last command whose time has come."""
        return Command(*held(self.times, observation.time, self.throttle, self.steering)), memory


def held(times: np.ndarray, now: Scalar, *columns: np.ndarray) -> tuple[Scalar, ...]:
    """The last value of each column whose time has come; 0 before the first."""
    last = jnp.searchsorted(jnp.asarray(times), now + EARLY, side="right") - 1
    row = jnp.maximum(last, 0)
    begun = jnp.where(last >= 0, 1.0, 0.0)
    return tuple(begun * jnp.asarray(column)[row] for column in columns)
