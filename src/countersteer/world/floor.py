"""The floor: friction that varies with position, as a sum of waves and of painted discs."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Body, wheel_positions
from countersteer.errors import InputError
from countersteer.signals import Motion, Scalar, Wheels
from countersteer.world.angle import cosine, cosine_sine

KEYS = ("x_radpm", "y_radpm", "phase_rad")  # keys of a wave in files
PATCH_KEYS = ("x_m", "y_m", "radius_m", "friction")  # of a disc
FADES = 4.0  # the outer quarter of a disc's area fades
WAVES = 8
LARGEST = 0.95 / math.sqrt(2 * WAVES)  # deviation up to which friction is positive everywhere


class Wave(NamedTuple):
    """One wave over the floor."""

    x: Scalar  # wave vector, rad/m
    y: Scalar
    phase: Scalar  # at the origin, rad


class Patch(NamedTuple):
    """A disc with a factor on the friction. Towards its rim the factor fades to 1."""

    x: Scalar  # of its centre, m
    y: Scalar
    radius: Scalar  # m
    factor: Scalar


class Floor(NamedTuple):
    """Factor on the tyres' friction at a position p: that of the waves times that of each disc.

    The waves give 1 + amplitude · Σ cos(wave · p + phase). A disc of radius R and factor f gives
    1 + (f − 1) · w at a distance d from its centre, with w = `FADES` · (1 − d²/R²) within [0, 1].
    """

    waves: tuple[Wave, ...]
    amplitude: Scalar
    patches: tuple[Patch, ...] = ()


def draw(key: jax.Array, deviation: Scalar = 0.1, length: Scalar = 0.5) -> Floor:
    """A random floor, from a standard deviation of friction (1) and a correlation length (m).

    It is nearly a Gaussian field. Over all draws, its mean is 1, its standard deviation is
    `deviation`, and its correlation over a distance d is exp(-d² / (2 length²)). Friction stays
    within 1 ± deviation sqrt(2 WAVES). This is positive for a deviation of at most `LARGEST`.

    Source: A. Rahimi and B. Recht, Random features for large-scale kernel machines, NIPS 2007. The
    waves' directions are spread evenly, so that a single draw is alike in all directions.
    """
    radius, direction, phase = jax.random.uniform(key, (3, WAVES), jnp.result_type(float))
    number = jnp.sqrt(-2 * jnp.log1p(-radius)) / length  # of a Gaussian vector in the plane
    angle = jnp.pi * (jnp.arange(WAVES) + direction) / WAVES
    parts = number * jnp.cos(angle), number * jnp.sin(angle), 2 * jnp.pi * phase
    waves = tuple(Wave(*(part[i] for part in parts)) for i in range(WAVES))
    return Floor(waves, deviation * math.sqrt(2 / WAVES))


def friction(floor: Floor, x: Scalar, y: Scalar) -> Scalar:
    """Factor on the tyres' friction at a position x, y (m)."""
    total = sum(cosine(w.x * x + w.y * y + w.phase) for w in floor.waves)
    factor = 1 + floor.amplitude * total
    for patch in floor.patches:
        apart = ((x - patch.x) ** 2 + (y - patch.y) ** 2) / patch.radius**2
        factor *= 1 + (patch.factor - 1) * jnp.clip(FADES * (1 - apart), 0.0, 1.0)
    return factor


def under_wheels(
    floor: Floor | None, body: Body, motion: Motion, time: Scalar = 0.0
) -> Wheels | None:
    """`friction` at each contact, `time` seconds after `motion`. None without a floor."""
    if floor is None:
        return None
    angle = motion.heading + time * motion.yaw_rate
    c, s = cosine_sine(angle)
    places = (
        (ahead + time * motion.vx, left + time * motion.vy)
        for ahead, left in zip(*wheel_positions(body), strict=True)
    )
    return Wheels(
        *(
            friction(floor, motion.x + c * ahead - s * left, motion.y + s * ahead + c * left)
            for ahead, left in places
        )
    )


def floor_tables(floor: Floor) -> dict[str, Any]:
    """A floor as plain data, for `run.toml`."""
    waves = [dict(zip(KEYS, map(float, wave), strict=True)) for wave in floor.waves]
    tables: dict[str, Any] = {"amplitude": float(floor.amplitude), "waves": waves}
    painted = [patch for patch in floor.patches if patch.factor != 1]
    if painted:
        tables["patches"] = [
            dict(zip(PATCH_KEYS, map(float, patch), strict=True)) for patch in painted
        ]
    return tables


def floor_of_run(about: Mapping[str, Any]) -> Floor | None:
    """The floor in a `run.toml`; None if its friction is uniform. Raises `InputError`."""
    tables = about.get("floor")
    if tables is None:
        return None
    try:
        waves = tuple(Wave(*(np.float64(wave[key]) for key in KEYS)) for wave in tables["waves"])
        patches = tuple(
            Patch(*(np.float64(patch[key]) for key in PATCH_KEYS))
            for patch in tables.get("patches", ())
        )
        return Floor(waves, np.float64(tables["amplitude"]), patches)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"run.toml: [floor] is not as it was written: {error}") from None
