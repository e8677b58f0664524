"""Plays recorded commands in a turn: open loop, between a driver that goes on before and after."""

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
    """Of the driver within, and when the turn began (s)."""

    inner: Any
    turn: Scalar
    begun: Scalar


@pytree
class PlayedTurn:
    """A turn's commands played back from where the driver within hands over to it."""

    inner: DriftTurn
    throttle: np.ndarray  # each `STEP` seconds from the turn's beginning
    steering: np.ndarray  # rad

    def reset(self, key: jax.Array) -> PlayedTurnMemory:
        """Before the turn."""
        return PlayedTurnMemory(self.inner.reset(key), 0, math.inf)

    def status(self, memory: PlayedTurnMemory) -> Status:
        """That of the driver within."""
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
        # What the driver within made of the turn is not asked: behind it, it straightens.
        over = (index >= count) & (now - begun < (count + 2) * STEP)
        inner = inner._replace(phase=jnp.where(over, STRAIGHT, inner.phase))
        command = Command(
            jnp.where(playing, throttle, command.throttle),
            jnp.where(playing, steering, command.steering),
        )
        return command, PlayedTurnMemory(inner, turn, begun)
