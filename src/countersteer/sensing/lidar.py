"""Lidar: the nearest wall along each of many beams."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Lidar
from countersteer.sensing.error_models import quantised
from countersteer.signals import Array, Scalar

SEAM = 1e-5  # m added to both ends of a wall, so that no beam passes between two walls


def bearings(lidar: Lidar) -> Array:
    """Direction of each beam from straight ahead (rad), from right to left: (beams,)."""
    part = (jnp.arange(lidar.beams) + 0.5) / lidar.beams - 0.5
    return lidar.angle + lidar.field * part


def ranges(
    lidar: Lidar, walls: jax.Array, pose: tuple[Scalar, Scalar, Scalar], noise: Array
) -> Array:
    """Reading of each beam of a car at x, y, heading (m); inf beyond its reach: (beams,).

    `walls` is (n, 4), with rows of NaN as padding. `noise` is (beams,), standard normal.
    A beam from o along d meets the wall from a along the unit vector w where o + t d = a + s w.
    """
    x, y, heading = pose
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    to_x = walls[:, 0] - (x + cosine * lidar.x - sine * lidar.y)
    to_y = walls[:, 1] - (y + sine * lidar.x + cosine * lidar.y)
    wall_x, wall_y = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    length = jnp.sqrt(wall_x**2 + wall_y**2 + 1e-18)
    wall_x, wall_y = wall_x / length, wall_y / length
    bearing = (heading + bearings(lidar))[:, None]
    beam_x, beam_y = jnp.cos(bearing), jnp.sin(bearing)
    across = beam_x * wall_y - beam_y * wall_x
    across = jnp.where(jnp.abs(across) > 1e-9, across, jnp.nan)  # a wall along the beam is not seen
    away = (to_x * wall_y - to_y * wall_x) / across
    place = (to_x * beam_y - to_y * beam_x) / across
    meets = (away >= 0) & (place >= -SEAM) & (place <= length + SEAM)
    nearest = jnp.min(jnp.where(meets, away, jnp.inf), axis=1, initial=jnp.inf)
    read = jnp.maximum(quantised(nearest + lidar.noise * noise, lidar.resolution), 0.0)
    return jnp.where(nearest <= lidar.reach, read, jnp.inf)
