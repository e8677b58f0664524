"""Wheels, differentials and rotor, eliminated in closed form from one linearly implicit step."""

from typing import NamedTuple

import jax

from countersteer.car.car import Car
from countersteer.signals import Scalar, Wheels
from countersteer.world.motor import Drive

COUPLING = 1e-3  # N m s/rad of a differential locked by half
STANDSTILL = 0.5  # wheel speed (rad/s) below which dry drag fades out


class Axle(NamedTuple):
    """One axle in a step of h: how its wheels answer to torque impulses.

    Wheel speeds after the step are (inverse of [[own_left + link, -link], [.., own_right + link]])
    times (J w + h R k v + half the shaft's torque impulse) for each of the two wheels.
    """

    own_left: Scalar  # J + h (R² k + b), kg m²
    own_right: Scalar
    link: Scalar  # h times the differential's coupling
    inverse: Scalar  # of the determinant
    share_left: Scalar  # speed of a wheel per torque impulse of the shaft
    share_right: Scalar
    resistance: Scalar  # torque impulse per mean speed of the axle


class Shaft(NamedTuple):
    """The coupling of the two axles: torque impulse = constant - matrix · free mean speeds."""

    front: Scalar
    rear: Scalar
    front_front: Scalar
    rear_rear: Scalar
    front_rear: Scalar


def coupling(lock: Scalar) -> Scalar:
    """Viscous coupling (N m s) of a differential: 0 open, nearly rigid at a lock of 1."""
    return COUPLING * lock / (1 - lock + 1e-6)


def driven_speed(car: Car, wheels: Wheels) -> Scalar:
    """Speed of the motor's shaft divided by the gear ratio (rad/s)."""
    front = (wheels.front_left + wheels.front_right) / 2
    rear = (wheels.rear_left + wheels.rear_right) / 2
    share = car.drivetrain.front_share
    return share * front + (1 - share) * rear


def rotor_inertia(car: Car) -> Scalar:
    """Inertia of the rotor seen from the driven wheels (kg m²)."""
    return car.drivetrain.gear_ratio**2 * car.motor.rotor_inertia


def drag(car: Car, speed: Scalar) -> Scalar:
    """Drag of one wheel as a torque per speed (N m s): dry drag fades out at standstill."""
    dry = car.drivetrain.drag * jax.lax.rsqrt(speed**2 + STANDSTILL**2)
    return (dry + car.drivetrain.drag_viscous) / 4


def axle(lock: Scalar, own_left: Scalar, own_right: Scalar, h: Scalar) -> Axle:
    """The axle whose wheels have these own inertias (J + h (R² k + b)) in a step of h."""
    link = h * coupling(lock)
    both = own_left + own_right
    determinant = own_left * own_right + link * both
    inverse = 1 / determinant
    return Axle(
        own_left,
        own_right,
        link,
        inverse,
        (own_right + 2 * link) * (inverse / 2),
        (own_left + 2 * link) * (inverse / 2),
        4 * determinant / (both + 4 * link),
    )


def shaft(car: Car, front: Axle, rear: Axle, drive: Drive, speed: Scalar, h: Scalar) -> Shaft:
    """Motor, rotor and centre coupling between two axles.

    With a = diag(axle resistances) and C the shaft's own matrix, the torque impulses are
    a (a + C)⁻¹ p c - a (a + C)⁻¹ C s for the axles' free mean speeds s. Expanded so that
    nothing cancels when the centre is all but rigid.
    """
    to_front = car.drivetrain.front_share
    to_rear = 1 - to_front
    inertia = rotor_inertia(car)
    load = h * drive.slope + inertia
    impulse = h * drive.torque + inertia * speed
    link = h * coupling(car.drivetrain.center_lock)
    c_ff = to_front**2 * load + link
    c_rr = to_rear**2 * load + link
    c_fr = to_front * to_rear * load - link
    a_f, a_r = front.resistance, rear.resistance
    inverse = 1 / (a_f * a_r + a_f * c_rr + a_r * c_ff + link * load)
    front_part, rear_part = a_f * inverse, a_r * inverse
    return Shaft(
        front_part * (to_front * a_r + link) * impulse,
        rear_part * (to_rear * a_f + link) * impulse,
        front_part * (a_r * c_ff + link * load),
        rear_part * (a_f * c_rr + link * load),
        front_part * a_r * c_fr,
    )


def shaft_impulses(s: Shaft, front: Axle, rear: Axle, momenta: Wheels) -> tuple[Scalar, Scalar]:
    """Torque impulses on the front and rear axle for the wheels' free angular momenta."""
    free_front = front.share_left * momenta.front_left + front.share_right * momenta.front_right
    free_rear = rear.share_left * momenta.rear_left + rear.share_right * momenta.rear_right
    return (
        s.front - s.front_front * free_front - s.front_rear * free_rear,
        s.rear - s.front_rear * free_front - s.rear_rear * free_rear,
    )


def wheel_speeds(a: Axle, left: Scalar, right: Scalar, impulse: Scalar) -> tuple[Scalar, Scalar]:
    """Speeds of an axle's wheels from their free angular momenta and the shaft's impulse."""
    return (
        ((a.own_right + a.link) * left + a.link * right) * a.inverse + a.share_left * impulse,
        ((a.own_left + a.link) * right + a.link * left) * a.inverse + a.share_right * impulse,
    )
