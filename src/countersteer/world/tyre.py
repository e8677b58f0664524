"""Tyres: force of a contact at its slip, and its stiffness for an implicit step."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.car import MagicFormula, Tire
from countersteer.signals import Scalar

TINY = 1e-9  # keeps roots and their derivatives finite at zero slip
LEAST_LOSS = 0.1  # of a Magic Formula, at pure slip. Published sets have 1, to a thousandth.


class Contact(NamedTuple):
    """A contact at an instant: its slip velocity (m/s) and its stiffness against it (N s/m).

    Its force is push - tangent · slip velocity. Its chord -k · slip velocity removes energy. For a
    brush tyre the two are equal. Of a Magic Formula's force, the chord is the part along the slip.
    """

    slip_x: Scalar
    slip_y: Scalar
    k_x: Scalar  # >= 0
    k_y: Scalar
    push_x: Scalar  # N
    push_y: Scalar
    tangent_x: Scalar  # -d force / d slip velocity, >= 0
    tangent_y: Scalar

    @property
    def force_x(self) -> Scalar:
        """Force along the wheel, forward (N)."""
        return self.push_x - self.tangent_x * self.slip_x

    @property
    def force_y(self) -> Scalar:
        """Force to the wheel's left (N)."""
        return self.push_y - self.tangent_y * self.slip_y


def contact(tire: Tire, load: Scalar, slip_x: Scalar, slip_y: Scalar, rim_speed: Scalar) -> Contact:
    """A contact by the tyre's law, at a load (N).

    slip_x and slip_y (m/s) are the contact's velocity over the ground, along the wheel and to its
    left. rim_speed (m/s) is R w.
    """
    law = magic_formula if tire.law == "magic-formula" else brush
    return law(tire, load, slip_x, slip_y, rim_speed)


def brush(tire: Tire, load: Scalar, slip_x: Scalar, slip_y: Scalar, rim_speed: Scalar) -> Contact:
    """The brush model with parabolic pressure, two friction coefficients and a friction ellipse.

    Adhering tread has friction mu, sliding tread rho mu. With slip velocity s, tread speed
    V = sqrt((R w)² + creep²), stiffness c per unit of load F, and the linear force z = |c s / V|:

        q = min(z / (3 mu), 1)                       the sliding part of the contact
        k_i = F [ c_i (1 - q)² / V + rho mu q² (3 - 2 q) / |s| ]

    For rho = 1 and one stiffness this is Fiala's cubic, z - z²/3mu + z³/27mu². The adhering part
    pulls against the tread's deflection, the sliding part against the slip velocity. So full
    sliding opposes the motion, whatever the two stiffnesses are. Both k are >= 0: a contact
    removes energy. The largest force across the wheel is F mu (4 - 3 rho) / (3 - 2 rho)².

    If friction along the wheel is e mu, the forces lie in an ellipse. A sliding contact has the
    force on the ellipse that removes most energy. This equals the law above for the slip
    (e s_x, s_y) and the force (F_x / e, F_y), since both pairs have the same power.

    Source: H. B. Pacejka, Tire and Vehicle Dynamics, chapter 3 (brush model); E. Fiala, VDI-Z 96,
    1954; S. Goyal, A. Ruina, J. Papadopoulos, Wear 143, 1991 (limit surface, largest dissipation).
    """
    slowness = jax.lax.rsqrt(rim_speed**2 + tire.creep_speed**2)
    ellipse = tire.longitudinal_ratio
    true_x, slip_x = slip_x, ellipse * slip_x
    linear_x = tire.longitudinal_stiffness / ellipse**2 * slowness
    linear_y = tire.cornering_stiffness * slowness
    linear = jnp.sqrt((linear_x * slip_x) ** 2 + (linear_y * slip_y) ** 2 + TINY**2)
    slides = jnp.minimum(linear * (1 / (3 * tire.friction)), 1.0)
    adheres = (1 - slides) ** 2
    slip = jax.lax.rsqrt(slip_x**2 + slip_y**2 + TINY**2)  # 1 / slip velocity
    sliding = tire.sliding_ratio * tire.friction * slides**2 * (3 - 2 * slides) * slip
    k_x, k_y = load * (linear_x * adheres + sliding), load * (linear_y * adheres + sliding)
    # Along the slip, the slope is dF/dz, at least 0. Across the slip, it is k.
    slope = load * (1 - slides) * jnp.maximum(1 - (3 - 2 * tire.sliding_ratio) * slides, 0.0)
    part_x = (slip_x**2 + TINY**2 / 2) * slip**2
    tangent_x = part_x * slope * linear_x + (1 - part_x) * k_x
    tangent_y = (1 - part_x) * slope * linear_y + part_x * k_y
    k_x, tangent_x = ellipse**2 * k_x, ellipse**2 * tangent_x
    push_x, push_y = (tangent_x - k_x) * true_x, (tangent_y - k_y) * slip_y
    return Contact(true_x, slip_y, k_x, k_y, push_x, push_y, tangent_x, tangent_y)


def magic_formula(
    tire: Tire, load: Scalar, slip_x: Scalar, slip_y: Scalar, rim_speed: Scalar
) -> Contact:
    """The Magic Formula in combined slip. The tangent is its slope, at least 0.

    With the hub's speed u = slip_x + R w, the slip is slip_x / max(|u|, creep) and the slip angle
    atan(slip_y / max(|u|, creep)). The formula's shifts push even at zero slip. They fade out
    below the speed `creep`, so that a car at rest stays at rest.
    """
    hub = jnp.abs(slip_x + rim_speed)
    speed = jnp.maximum(hub, tire.creep_speed)
    moving = hub / speed
    shifts = moving**2 * (3 - 2 * moving)

    def force(slip_x: Scalar, slip_y: Scalar) -> tuple[Scalar, Scalar]:
        return magic_forces(
            tire.magic_formula, load, slip_x / speed, jnp.arctan(slip_y / speed), shifts
        )

    (force_x, force_y), slope_x = jax.jvp(
        lambda x: force(x, slip_y), (slip_x,), (jnp.ones_like(slip_x),)
    )
    _, slope_y = jax.jvp(lambda y: force(slip_x, y), (slip_y,), (jnp.ones_like(slip_y),))
    tangent_x, tangent_y = jnp.maximum(-slope_x[0], 0.0), jnp.maximum(-slope_y[1], 0.0)
    removed = jnp.maximum(-force_x * slip_x - force_y * slip_y, 0.0)
    k = removed / (slip_x**2 + slip_y**2 + TINY**2)
    push_x, push_y = force_x + tangent_x * slip_x, force_y + tangent_y * slip_y
    return Contact(slip_x, slip_y, k, k, push_x, push_y, tangent_x, tangent_y)


def magic_forces(
    m: MagicFormula, load: Scalar, slip: Scalar, angle: Scalar, shifts: Scalar = 1.0
) -> tuple[Scalar, Scalar]:
    """Forces along the wheel and to its left (N) at a slip and a slip angle (rad).

    slip is 1 - R w / u: positive while braking. There is no camber. The shift of the sine is
    inside the sine, as in CommonRoad's code. For b, -slip along and the angle across,

        pure   D sin(C atan(B b - E (B b - atan B b)))     D = d load, B = k load / (C D)
        loss   G(b) = cos(C atan(B b - E (B b - atan B b)))

    The force along is its pure force times G(angle + shift) / G(shift). The force across is its
    pure force times G(slip + shift) / G(shift), plus a shift by slip. `shifts` scales all shifts.
    G(shift) is taken as `LEAST_LOSS` if it is less.

    Source: H. B. Pacejka, Tire and Vehicle Dynamics, chapter 4; CommonRoad vehicle models 3.0.2.
    """

    def bent(b: Scalar, curvature: Scalar) -> Scalar:
        return jnp.arctan((1 - curvature) * b + curvature * jnp.arctan(b))

    def loss(steepness: Scalar, c: Scalar, e: Scalar, b: Scalar, shift: Scalar) -> Scalar:
        shifted = jnp.cos(c * bent(steepness * (b + shift), e))
        return shifted / jnp.maximum(jnp.cos(c * bent(steepness * shift, e)), LEAST_LOSS)

    along = m.p_kx1 / (m.p_cx1 * m.p_dx1) * (-slip + shifts * m.p_hx1)
    pure_x = m.p_dx1 * jnp.sin(m.p_cx1 * bent(along, m.p_ex1) + shifts * load * m.p_vx1)
    across = m.p_ky1 / (m.p_cy1 * m.p_dy1) * angle
    pure_y = m.p_dy1 * jnp.sin(m.p_cy1 * bent(across, m.p_ey1))
    steep_x = m.r_bx1 * jnp.cos(jnp.arctan(m.r_bx2 * slip))
    steep_y = m.r_by1 * jnp.cos(jnp.arctan(m.r_by2 * (angle - shifts * m.r_by3)))
    by_slip = (
        m.r_vy1
        * jnp.cos(jnp.arctan(m.r_vy4 * angle))
        * jnp.sin(m.r_vy5 * jnp.arctan(m.r_vy6 * slip))
    )
    force_x = pure_x * loss(steep_x, m.r_cx1, m.r_ex1, angle, shifts * m.r_hx1)
    force_y = pure_y * loss(steep_y, m.r_cy1, m.r_ey1, slip, shifts * m.r_hy1)
    return load * force_x, load * (force_y + shifts * m.p_dy1 * by_slip)


def scaled(tire: Tire, friction: Scalar) -> Tire:
    """The tyre with its friction times a factor. Its stiffnesses do not change."""
    if tire.law == "magic-formula":
        m = tire.magic_formula
        peaks = {"p_dx1": friction * m.p_dx1, "p_dy1": friction * m.p_dy1}
        return dataclasses.replace(tire, magic_formula=dataclasses.replace(m, **peaks))
    return dataclasses.replace(tire, friction=friction * tire.friction)


def limit(tire: Tire, load: Scalar) -> Scalar:
    """Upper limit of a contact's force (N): a brush's adhering tread, or the formula's peak."""
    if tire.law == "magic-formula":
        return jnp.maximum(tire.magic_formula.p_dx1, tire.magic_formula.p_dy1) * load
    return tire.friction * jnp.maximum(tire.longitudinal_ratio, 1.0) * load
