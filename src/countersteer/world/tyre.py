"""The brush tyre, as the stiffness of a contact against its slip velocity."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Tire
from countersteer.car.parameter import Scalar

TINY = 1e-9  # keeps roots and their derivatives finite at no slip


class Contact(NamedTuple):
    """A contact at an instant: its slip velocity (m/s) and its stiffness against it (N s/m)."""

    slip_x: Scalar
    slip_y: Scalar
    k_x: Scalar  # force over slip velocity, >= 0
    k_y: Scalar
    tangent_x: Scalar  # change of force over change of slip velocity, >= 0
    tangent_y: Scalar


def contact(tire: Tire, load: Scalar, slip_x: Scalar, slip_y: Scalar, rim_speed: Scalar) -> Contact:
    """A contact's stiffness, longitudinal and lateral; its force is -k · slip velocity.

    The brush model with a parabolic pressure and separate friction for adhering (mu) and sliding
    (rho mu) tread. With slip velocity s, tread speed V = sqrt((R w)² + creep²), stiffness c per
    unit of load F, and the linear force z = |c s / V|:

        q = min(z / (3 mu), 1)                       the part of the contact that slides
        k_i = F [ c_i (1 - q)² / V + rho mu q² (3 - 2 q) / |s| ]

    For rho = 1 and one stiffness this is Fiala's cubic, z - z²/3mu + z³/27mu². The adhering part
    pulls against the tread's deflection, the sliding part against the slip velocity itself, so
    full sliding opposes the motion whatever the two stiffnesses are. Both k are >= 0: a contact
    takes energy out. The largest force is F mu (4 - 3 rho) / (3 - 2 rho)².

    Source: H. B. Pacejka, Tire and Vehicle Dynamics, chapter 3 (brush model); E. Fiala, VDI-Z 96,
    1954. The slip speeds are those of the contact over the ground (m/s), rim_speed is R w.
    """
    speed = jnp.sqrt(rim_speed**2 + tire.creep_speed**2)
    linear_x = tire.longitudinal_stiffness / speed
    linear_y = tire.cornering_stiffness / speed
    linear = jnp.sqrt((linear_x * slip_x) ** 2 + (linear_y * slip_y) ** 2 + TINY**2)
    slides = jnp.minimum(linear / (3 * tire.friction), 1.0)
    adheres = (1 - slides) ** 2
    slip = jnp.sqrt(slip_x**2 + slip_y**2 + TINY**2)
    sliding = tire.sliding_ratio * tire.friction * slides**2 * (3 - 2 * slides) / slip
    k_x, k_y = load * (linear_x * adheres + sliding), load * (linear_y * adheres + sliding)
    # Along the slip the slope is dF/dz, and never less than none; across it, it is k itself.
    slope = load * (1 - slides) * jnp.maximum(1 - (3 - 2 * tire.sliding_ratio) * slides, 0.0)
    part_x = (slip_x**2 + TINY**2 / 2) / slip**2
    tangent_x = part_x * slope * linear_x + (1 - part_x) * k_x
    tangent_y = (1 - part_x) * slope * linear_y + part_x * k_y
    return Contact(slip_x, slip_y, k_x, k_y, tangent_x, tangent_y)
