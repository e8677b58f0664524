"""Replays a list of commands."""

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.drivers.driver import Observation
from countersteer.signals import Command

EARLY = 1e-6  # s by which a command may come early, as times are rounded


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
        last = jnp.searchsorted(jnp.asarray(self.times), observation.time + EARLY, side="right") - 1
        held = jnp.maximum(last, 0)
        begun = jnp.where(last >= 0, 1.0, 0.0)
        throttle, steering = jnp.asarray(self.throttle), jnp.asarray(self.steering)
        return Command(begun * throttle[held], begun * steering[held]), memory
