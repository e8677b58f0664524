"""Links between driver and car: on board, or by radio."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.signals import Array, Scalar


@dataclasses.dataclass(frozen=True)
class Link:
    """A link. Times are in seconds. It is static: each link has its own compiled program."""

    name: str
    control_period: float  # between two commands of the driver
    telemetry_period: float  # between two rows of telemetry
    onboard: bool
    delay: float = 0.0  # of a packet, either way
    loss: float = 0.0  # chance that a packet is lost, either way
    timeout: float = math.inf  # without a packet for so long, the car's throttle goes to 0

    def in_ticks(self, dt: float) -> "Ticks":
        """The times in ticks of dt seconds. Periods and a finite timeout are at least one tick."""

        def ticks(time: float) -> int:
            return max(1, round(time / dt))

        return Ticks(
            ticks(self.control_period),
            ticks(self.telemetry_period),
            round(self.delay / dt),
            0 if math.isinf(self.timeout) else ticks(self.timeout),
            self.onboard,
        )


class Ticks(NamedTuple):
    """A link's times in ticks. Hashable, since a program is compiled for them."""

    control: int  # between two commands
    telemetry: int
    delay: int
    timeout: int  # 0: none
    onboard: bool


# Rates: paper, II.E. Delay, loss and timeout of the radio: assumed.
ONBOARD = Link("onboard", control_period=0.001, telemetry_period=0.005, onboard=True)
RADIO = Link("radio", 0.1, 0.03, onboard=False, delay=0.02, loss=0.05, timeout=0.5)
LINKS = {link.name: link for link in (ONBOARD, RADIO)}


class Packets(NamedTuple):
    """One direction of a radio: packets in flight, and the last one that arrived."""

    packets: Any  # a pytree; the first axis of its leaves is one slot per packet
    lost: Array
    latest: Any
    arrived: Scalar  # tick of the last arrival; -1 before the first


def initial_packets(packet: Any, period: int, delay: int) -> Packets:
    """No packet in flight. The receiver assumes `packet` until the first arrival."""
    slots = delay // period + 2
    packets = jax.tree.map(lambda leaf: np.stack([leaf] * slots), packet)
    return Packets(packets, np.ones(slots, bool), packet, np.int32(-1))


def exchange(
    air: Packets, packet: Any, lost: Scalar, tick: Scalar, period: int, delay: int
) -> Packets:
    """One tick: send `packet` if one is due, and deliver the packet whose delay is over."""
    slots = air.lost.shape[0]
    sends = tick % period == 0
    into = (tick // period) % slots
    packets = jax.tree.map(
        lambda line, new: line.at[into].set(jnp.where(sends, new, line[into])),
        air.packets,
        packet,
    )
    lost_line = air.lost.at[into].set(jnp.where(sends, lost, air.lost[into]))
    sent = tick - delay
    out = (sent // period) % slots
    arrives = (sent >= 0) & (sent % period == 0) & ~lost_line[out]
    latest = jax.tree.map(lambda line, old: jnp.where(arrives, line[out], old), packets, air.latest)
    return Packets(packets, lost_line, latest, jnp.where(arrives, tick, air.arrived))
