"""Separates a sonar's spikes from walls, without waiting for a second reading of a wall.

Between two pings the car comes no nearer to a wall than it drives. So a credible distance is at
least the last one, less the way driven. A shorter reading is a spike.

A spike is not believed but kept, and the next reading is compared with it too. So a wall that
appears suddenly (past the end of another) is believed one ping late. That is the only cost: any
other wall is believed at once. Readings that are too long pass, such as a lost echo: nothing ahead
is no danger yet. The next echo then counts as a first one, and is one ping late at most.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.signals import Reading, Scalar

SLACK = 4.0  # standard deviations by which a reading may be too short


class SpikeMemory(NamedTuple):
    """The memory of one sonar."""

    believed: Scalar  # credible distance, m, less the way driven since
    heard: Scalar  # the last reading, likewise
    tick: Scalar


def initial_memory(dtype: np.dtype) -> SpikeMemory:
    """Before the first reading."""
    return SpikeMemory(dtype.type(np.inf), dtype.type(np.inf), np.int32(-1))


def update(memory: SpikeMemory, reading: Reading, driven: Scalar, noise: Scalar) -> SpikeMemory:
    """The memory after a reading, if it is new.

    `driven` is the largest approach since the last call (m). The believed distance is the reading.
    If the reading is a spike, it is the last believed distance less `driven`.
    """
    believed, heard = memory.believed - driven, memory.heard - driven
    fresh = reading.tick > memory.tick
    slack = SLACK * noise
    # Shorter than the believed distance, and than the reading before.
    spike = reading.value < jnp.minimum(believed, heard) - slack
    taken = jnp.where(spike, believed, reading.value)
    return SpikeMemory(
        jnp.where(fresh, taken, believed),
        jnp.where(fresh, reading.value, heard),
        jnp.where(fresh, reading.tick, memory.tick),
    )
