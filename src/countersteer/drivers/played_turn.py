"""Plays recorded commands in a turn, open loop. Another driver drives before and after it."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import pytree
from countersteer.drivers.drift_turn import STRAIGHT, DriftTurn
from countersteer.drivers.driver import Observation, Status
from countersteer.signals import Command, Scalar

STEP = 0.01  # s between the recorded commands


class PlayedTurnMemory(NamedTuple):
    """The inner driver's memory, its turns, and when the turn began (s)."""

    inner: Any
    turn: Scalar
    begun: Scalar


@pytree
class PlayedTurn:
    """Plays a turn's commands, from the moment at which the inner driver begins the turn."""

    inner: DriftTurn
    throttle: np.ndarray  # each `STEP` seconds from the turn's beginning
    steering: np.ndarray  # rad

    def reset(self, key: jax.Array) -> PlayedTurnMemory:
        """Before the turn."""
        return PlayedTurnMemory(self.inner.reset(key), 0, math.inf)

    def status(self, memory: PlayedTurnMemory) -> Status:
        """The inner driver's status."""
        return self.inner.status(memory.inner)

    def act(
        self, memory: PlayedTurnMemory, observation: Observation
    ) -> tuple[Command, PlayedTurnMemory]:
        """The recorded command in the turn, else the inner driver's."""
        now = observation.time
        command, inner = self.inner.act(memory.inner, observation)
        turn = self.inner.status(inner).turn
        begun = jnp.where(turn > memory.turn, now, memory.begun)
        index = jnp.floor((now - begun) / STEP + 1e-3)
        count = self.throttle.shape[-1]
        playing = (index >= 0) & (index < count)
        at = jnp.clip(jnp.where(playing, index, 0), 0, count - 1).astype(jnp.int32)
        throttle, steering = jnp.asarray(self.throttle)[at], jnp.asarray(self.steering)[at]
        # After the turn the inner driver straightens, whichever phase it has reached.
        over = (index >= count) & (now - begun < (count + 2) * STEP)
        inner = inner._replace(phase=jnp.where(over, STRAIGHT, inner.phase))
        command = Command(
            jnp.where(playing, throttle, command.throttle),
            jnp.where(playing, steering, command.steering),
        )
        return command, PlayedTurnMemory(inner, turn, begun)
