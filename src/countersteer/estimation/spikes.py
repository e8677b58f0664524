"""Spikes of a sonar told from walls, without waiting for a second reading of the wall.

A spike is shorter than any wall can be: between two pings the car comes no nearer than it drives.
So the distance that may be believed is at least the one before, less what was driven. A reading
below that is not taken but kept, and the next one is measured against it too: a wall that came
into view at once (past the end of another) is believed one ping late, and that is all it costs.
Any other wall is seen in the ping that sees it. Readings that are too long, such as of an echo that
was lost, pass: nothing ahead is not a danger yet, and the next echo is as sound as if it had been
the first, which is again one ping late at most.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.signals import Reading, Scalar

SLACK = 4.0  # standard deviations of a reading by which it may be too short


class SpikeMemory(NamedTuple):
    """Of one sonar."""

    believed: Scalar  # m, less what was driven since
    heard: Scalar  # the last reading, likewise
    tick: Scalar


def initial_memory(dtype: np.dtype) -> SpikeMemory:
    """Nothing heard."""
    return SpikeMemory(dtype.type(np.inf), dtype.type(np.inf), np.int32(-1))


def update(memory: SpikeMemory, reading: Reading, driven: Scalar, noise: Scalar) -> SpikeMemory:
    """With a reading, if it is new; `driven` is how much nearer the car came at most since (m).

    A believed distance is that of the reading, or where this is a spike, of what it had to be.
    """
    believed, heard = memory.believed - driven, memory.heard - driven
    fresh = reading.tick > memory.tick
    slack = SLACK * noise
    # Too short for what was believed, and nothing like it was heard before.
    spike = reading.value < jnp.minimum(believed, heard) - slack
    taken = jnp.where(spike, believed, reading.value)
    return SpikeMemory(
        jnp.where(fresh, taken, believed),
        jnp.where(fresh, reading.value, heard),
        jnp.where(fresh, reading.tick, memory.tick),
    )
