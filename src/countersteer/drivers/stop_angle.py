"""How far the car still turns when the turn is stopped: the paper's regression."""

import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.signals import Array, Scalar


@pytree
class StopAngle:
    """Lines over the yaw rate r at the stop, one for each region of the speed v there.

    angle = offset + slope r, in rad, with r >= 0 in the turn's hand. Between the regions' middles
    `speeds` it is interpolated; beyond the outermost theirs holds.
    """

    speeds: Array  # (n,) m/s, rising
    offset: Array  # rad
    slope: Array  # s
    deviation: Array  # standard deviation of an angle about its line, rad

    def angle(self, speed: Scalar, rate: Scalar) -> Scalar:
        """What the car is expected to turn yet (rad)."""
        offset, slope = (interpolate(self.speeds, t, speed) for t in (self.offset, self.slope))
        return offset + slope * rate


def interpolate(nodes: Array, table: Array, value: Scalar) -> Scalar:
    """Linear between nodes, constant beyond; nodes and table are short, and written out."""
    nodes, table = jnp.asarray(nodes), jnp.asarray(table)
    found = table[0]
    for i in range(nodes.shape[0] - 1):
        part = jnp.clip((value - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)
        found = found + part * (table[i + 1] - table[i])
    return found
