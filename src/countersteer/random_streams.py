"""Random streams by name: each draw of a drive has its own key.

root(seed) ─► key(root, stream) ─► key(root, stream, tick) ─► one draw, or a split for several
"""

from enum import IntEnum

import jax

from countersteer.signals import Scalar


class Stream(IntEnum):
    """The parts that draw. Never change a number: a record repeats only with the same numbers."""

    GYROSCOPE = 1
    ACCELEROMETER = 2
    VOLTMETER = 3
    SONAR = 4
    LIDAR = 5
    POSITION = 6
    LINK = 7
    FAULTS = 8
    WATCH = 9
    DRIVER = 10
    ESTIMATOR = 11
    FLOOR = 12


def root(seed: Scalar) -> jax.Array:
    """The key of a drive."""
    return jax.random.key(seed)


def key(root: jax.Array, stream: Stream, tick: Scalar = None) -> jax.Array:
    """The key of a stream that draws once, or of a stream's draw at a tick."""
    own = jax.random.fold_in(root, stream)
    return own if tick is None else jax.random.fold_in(own, tick)
