"""What the planar world knows about a car at one instant."""

from typing import NamedTuple

from countersteer.signals import Array, Motion, Scalar


class State(NamedTuple):
    """A car in its world between two ticks."""

    motion: Motion
    throttle_line: Array  # commands on their way, one slot a tick
    steering_line: Array
    airborne: Scalar  # time that a pair of wheels has carried nothing, s
    touching: Scalar  # time left in which a touch of a wall counts as the same one, s
    wall_contacts: Scalar  # separate touches so far
    energy_limited: Scalar  # 1 where the last tick was cut short of gaining energy
    rolled_over: Scalar  # 1 from the moment the car counts as rolled over
