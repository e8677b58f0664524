"""Wheels, differentials and rotor, eliminated in closed form from one linearly implicit step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.car import Car, Tire
from countersteer.signals import Scalar, Wheels
from countersteer.world.motor import Drive

COUPLING = 1e-3  # N m s/rad, of a differential at lock 0.5
STANDSTILL = 0.5  # wheel speed (rad/s) below which dry drag fades out


class Axle(NamedTuple):
    """Linear response of an axle's wheel speeds to impulses, in a step of h seconds.

    The wheel speeds after the step are A⁻¹ p, with

        A = [[own_left + link, -link], [-link, own_right + link]]
        p = J w + h R (k v - push) + half the shaft's torque impulse

    for each wheel. v is the hub's speed along the wheel; k and push are of `tyre.Contact`.
    """

    own_left: Scalar  # J + h (R² k + b), kg m²
    own_right: Scalar
    link: Scalar  # h · coupling of the differential
    inverse: Scalar  # 1 / determinant of A
    share_left: Scalar  # speed of the left wheel per torque impulse of the shaft
    share_right: Scalar
    resistance: Scalar  # torque impulse per mean speed of the axle


class Shaft(NamedTuple):
    """The shaft's torque impulses on both axles: (front, rear) - matrix · free mean speeds.

    An axle's free mean speed is the mean of its wheel speeds without the shaft's impulse.
    """

    front: Scalar
    rear: Scalar
    front_front: Scalar
    rear_rear: Scalar
    front_rear: Scalar


def coupling(lock: Scalar) -> Scalar:
    """Viscous coupling (N m s) of a differential. It is 0 at lock 0 and nearly rigid at lock 1."""
    return COUPLING * lock / (1 - lock + 1e-6)


def driven_speed(car: Car, wheels: Wheels) -> Scalar:
    """Speed of the motor's shaft divided by the gear ratio (rad/s)."""
    front = (wheels.front_left + wheels.front_right) / 2
    rear = (wheels.rear_left + wheels.rear_right) / 2
    share = car.drivetrain.front_share
    return share * front + (1 - share) * rear


def rotor_inertia(car: Car) -> Scalar:
    """Inertia of the rotor, referred to the driven wheels (kg m²)."""
    return car.drivetrain.gear_ratio**2 * car.motor.rotor_inertia


def drag(car: Car, tire: Tire, across: Scalar, speed: Scalar) -> Scalar:
    """Drag torque of one wheel per speed (N m s), with the tyre's force across it (N).

    A tyre that is pushed aside rolls harder: its dry drag grows by cornering_drag · |across| at its
    radius. Dry drag fades out at standstill.
    """
    cornering = tire.cornering_drag * tire.radius * jnp.abs(across)
    fading = jax.lax.rsqrt(speed**2 + STANDSTILL**2)
    return (car.drivetrain.drag / 4 + cornering) * fading + car.drivetrain.drag_viscous / 4


def axle(lock: Scalar, own_left: Scalar, own_right: Scalar, h: Scalar) -> Axle:
    """The `Axle` of two wheels with own = J + h (R² k + b), in a step of h seconds."""
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
    """The `Shaft` of motor, rotor and centre coupling between two axles.

    The torque impulses are a (a + C)⁻¹ (p c - C s). a = diag(axle resistances), C is the shaft's
    own matrix, p its free impulse, c the axles' torque shares and s their free mean speeds. The
    expanded form has no cancellation when the centre coupling is nearly rigid.
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
    """Torque impulses on front and rear axle, from the wheels' free angular momenta (N m s)."""
    free_front = front.share_left * momenta.front_left + front.share_right * momenta.front_right
    free_rear = rear.share_left * momenta.rear_left + rear.share_right * momenta.rear_right
    return (
        s.front - s.front_front * free_front - s.front_rear * free_rear,
        s.rear - s.front_rear * free_front - s.rear_rear * free_rear,
    )


def wheel_speeds(a: Axle, left: Scalar, right: Scalar, impulse: Scalar) -> tuple[Scalar, Scalar]:
    """Speeds of an axle's wheels, from their free angular momenta and the shaft's impulse."""
    return (
        ((a.own_right + a.link) * left + a.link * right) * a.inverse + a.share_left * impulse,
        ((a.own_left + a.link) * right + a.link * left) * a.inverse + a.share_right * impulse,
    )
