"""What the planar world knows about a car at one instant."""

from typing import NamedTuple

from countersteer.car.car import Wheels
from countersteer.car.parameter import Array, Scalar


class Motion(NamedTuple):
    """All that changes smoothly. SI units, radians, ISO 8855 axes."""

    x: Scalar  # centre of mass, m
    y: Scalar
    heading: Scalar  # unwrapped
    vx: Scalar  # velocity of the centre of mass along the body's axes, m/s
    vy: Scalar
    yaw_rate: Scalar
    wheels: Wheels  # spin of each wheel, rad/s, positive forward
    steering: Scalar  # angle that a wheel between the front wheels would have
    duty: Scalar  # of the speed controller, -1 to 1, behind the throttle
    load_ax: Scalar  # accelerations that the wheel loads have followed so far, m/s²
    load_ay: Scalar
    charge: Scalar  # of the battery, 0 to 1


class State(NamedTuple):
    """A car in its world between two ticks."""

    motion: Motion
    throttle_line: Array  # commands on their way, one slot a tick
    steering_line: Array
    airborne: Scalar  # time that a pair of wheels has carried nothing, s
    touching: Scalar  # time left in which a touch of a wall counts as the same one, s
    wall_contacts: Scalar  # separate touches so far
    wary: Scalar  # 1 where the last tick was cut short of gaining energy
    rolled_over: Scalar  # 1 from the moment the car counts as rolled over
