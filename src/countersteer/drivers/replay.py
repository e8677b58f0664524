"""Replays a list of commands."""

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.drivers.driver import Observation
from countersteer.signals import AnyCommand

EARLY = 1e-6  # s by which a command may come early, as times are rounded


@pytree
class Replay:
    """Holds each command until the next one is due. Before the first, commands are 0."""

    times: np.ndarray  # s, rising
    commands: AnyCommand  # of columns: a car is commanded by throttle or in m/s

    @property
    def command_type(self) -> type[AnyCommand]:
        """The type of its commands."""
        return type(self.commands)

    def reset(self, key: jax.Array) -> tuple[()]:
        """No memory: the time is enough."""
        del key
        return ()

    def act(self, memory: tuple[()], observation: Observation) -> tuple[AnyCommand, tuple[()]]:
        """The last command whose time has come."""
        last = jnp.searchsorted(jnp.asarray(self.times), observation.time + EARLY, side="right") - 1
        row = jnp.maximum(last, 0)
        begun = jnp.where(last >= 0, 1.0, 0.0)
        held = jax.tree.map(lambda column: begun * jnp.asarray(column)[row], self.commands)
        return held, memory
