"""The stop angle: how far the car still turns after the stop begins. The paper's regression."""

import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.signals import Array, Scalar


@pytree
class StopAngle:
    """Lines over the yaw rate r at the stop, one for each region of the speed v there.

    angle = offset + slope r, in rad. r >= 0 is in the turn's hand. `speeds` are the middles of the
    regions. Between them the line is interpolated; beyond the outermost it is constant.
    """

    speeds: Array  # (n,) m/s, rising
    offset: Array  # rad
    slope: Array  # s
    deviation: Array  # standard deviation of an angle about its line, rad

    def angle(self, speed: Scalar, rate: Scalar) -> Scalar:
        """The expected stop angle (rad)."""
        offset, slope = (interpolate(self.speeds, t, speed) for t in (self.offset, self.slope))
        return offset + slope * rate


def interpolate(nodes: Array, table: Array, value: Scalar) -> Scalar:
    """Linear interpolation between nodes, constant beyond. The loop is unrolled: nodes are few."""
    nodes, table = jnp.asarray(nodes), jnp.asarray(table)
    found = table[0]
    for i in range(nodes.shape[0] - 1):
        part = jnp.clip((value - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)
        found = found + part * (table[i + 1] - table[i])
    return found
