"""The state of the planar world at one instant."""

from typing import NamedTuple

from countersteer.signals import Array, Motion, Scalar


class State(NamedTuple):
    """A car in its world between two ticks."""

    motion: Motion
    throttle_line: Array  # commands within the pure delays, one slot a tick; or speeds
    steering_line: Array
    airborne: Scalar  # time for which a pair of wheels has had no load, s
    touching: Scalar  # remaining time in which a contact counts as the same touch, s
    wall_contacts: Scalar  # separate touches so far
    energy_limited: Scalar  # 1 if `planar.guarded` limited the last tick
    rolled_over: Scalar  # 1 from the moment the car counts as rolled over
