"""The path of a drive, for pictures."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from countersteer.batch.trials import Instant
from countersteer.car.parameter import pytree
from countersteer.signals import Array

PERIOD, LONGEST = 0.02, 15.0  # s between two poses, and of the longest path
ROWS = round(LONGEST / PERIOD)


@pytree
class Trace:
    """A watch (`batch.trials.Watch`): x, y, heading, vx, vy, yaw rate (ROWS, 6); NaN at the end."""

    def begin(self, now: Instant) -> Array:
        """Before the first tick."""
        return jnp.full((ROWS, 6), jnp.nan, jnp.result_type(now.score.time))

    def look(self, now: Instant, kept: Array) -> Array:
        """With this instant."""
        m = now.simulator.world.motion(now.loop.state)
        time = now.simulator.dt * now.loop.tick
        row = jnp.clip(jnp.floor(time / PERIOD + 1e-3).astype(jnp.int32), 0, ROWS - 1)
        seen = jnp.stack([m.x, m.y, m.heading, m.vx, m.vy, m.yaw_rate])
        return kept.at[row].set(seen)

    def end(self, kept: Array) -> Array:
        """The path."""
        return kept


def path_of(kept: Any) -> np.ndarray:
    """The rows (n, 6) of a path up to its end."""
    rows = np.asarray(kept)
    return rows[np.isfinite(rows[:, 0])]
