"""Links: a driver on board, or at the far end of a radio."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.parameter import Array, Scalar


@dataclasses.dataclass(frozen=True)
class Link:
    """Times in seconds. Static: a program is compiled for a link."""

    name: str
    control_period: float  # between two commands of the driver
    telemetry_period: float  # between two rows of telemetry
    onboard: bool
    delay: float = 0.0  # of a packet, either way
    loss: float = 0.0  # chance that a packet is lost, either way
    timeout: float = math.inf  # a car that hears nothing for so long stops


# Rates: paper, II.E. Delay, loss and timeout of the radio: assumed.
ONBOARD = Link("onboard", control_period=0.001, telemetry_period=0.005, onboard=True)
RADIO = Link("radio", 0.1, 0.03, onboard=False, delay=0.02, loss=0.05, timeout=0.5)
LINKS = {link.name: link for link in (ONBOARD, RADIO)}


class Channel(NamedTuple):
    """One direction of a radio: packets on their way, and the last one that arrived."""

    packets: Any  # a pytree whose leaves have a slot a packet in front
    lost: Array
    latest: Any
    arrived: Scalar  # tick of the last arrival; -1 before the first


def initial_channel(packet: Any, period: int, delay: int) -> Channel:
    """A channel with nothing on its way; `packet` is what its far end assumes until it hears."""
    slots = delay // period + 2
    packets = jax.tree.map(lambda leaf: np.stack([leaf] * slots), packet)
    return Channel(packets, np.ones(slots, bool), packet, np.int32(-1))


def exchange(
    channel: Channel, packet: Any, lost: Scalar, tick: Scalar, period: int, delay: int
) -> Channel:
    """One tick: sends `packet` where one is due, and delivers the one that is due."""
    slots = channel.lost.shape[0]
    sends = tick % period == 0
    into = (tick // period) % slots
    packets = jax.tree.map(
        lambda line, new: line.at[into].set(jnp.where(sends, new, line[into])),
        channel.packets,
        packet,
    )
    lost_line = channel.lost.at[into].set(jnp.where(sends, lost, channel.lost[into]))
    sent = tick - delay
    out = (sent // period) % slots
    arrives = (sent >= 0) & (sent % period == 0) & ~lost_line[out]
    latest = jax.tree.map(
        lambda line, old: jnp.where(arrives, line[out], old), packets, channel.latest
    )
    return Channel(packets, lost_line, latest, jnp.where(arrives, tick, channel.arrived))
