"""Sonar: the nearest echo in a wide cone."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Mount, Sonar
from countersteer.car.parameter import Scalar

MERGED = 1e-4  # m within which ends of walls are one corner


def edges(walls: jax.Array) -> jax.Array:
    """(2n, 3): the ends of all walls, and 1 where such an end can scatter sound, else 0.

    An end scatters if it stands free or sticks out: not in the inside of a corner. Which side is
    in is not known to free walls, so a corner scatters unless its walls meet in line; in an inner
    corner the walls themselves are nearer in every direction from which they can be seen.
    """
    ends = jnp.concatenate([walls[:, :2], walls[:, 2:]])
    others = jnp.concatenate([walls[:, 2:], walls[:, :2]])
    along = others - ends
    along = along / jnp.sqrt(jnp.sum(along**2, axis=1, keepdims=True) + 1e-18)
    same = jnp.sum((ends[:, None] - ends[None]) ** 2, axis=-1) < MERGED**2
    straight = jnp.sum(along[:, None] * along[None], axis=-1) < -0.999
    scatters = ~jnp.any(same & straight, axis=1)
    return jnp.concatenate([ends, scatters[:, None]], axis=1)


def distances(
    sonar: Sonar,
    walls: jax.Array,
    corners: jax.Array,
    pose: tuple[Scalar, Scalar, Scalar],
    fires: tuple[Scalar, ...],
    key: jax.Array,
) -> tuple[Scalar, ...]:
    """What each mount reports after a ping, in metres; inf without an echo.

    `pose` is x, y, heading of the car; `fires` is 1 for each mount that pings. A wall returns an
    echo from its point nearest to the foot of the perpendicular, among the points within the cone
    and seen at no more than `obliqueness`; `corners` (from `edges`) echo by chance each ping.
    Whatever a wall hides returns nothing. A mount that pings together with others also hears
    their echoes, at half the way out and back, if they come from within `hearing`.
    """
    spots = [_mounted(mount, pose) for mount in sonar.mounts]
    keys = jax.random.split(key, len(spots) + 1)
    chance = jax.random.uniform(keys[0], (corners.shape[0],))
    lit = corners.at[:, 2].set(jnp.where(chance < sonar.edge_echo, corners[:, 2], 0.0))
    echoes = [_echo(sonar, walls, lit, *spot) for spot in spots]
    heard = []
    for i, (x, y, bearing) in enumerate(spots):
        best = echoes[i][0]
        for j, (distance, echo_x, echo_y) in enumerate(echoes):
            if j == i:
                continue
            dx, dy = echo_x - x, echo_y - y
            back = jnp.sqrt(dx**2 + dy**2 + 1e-12)
            within = jnp.cos(bearing) * dx + jnp.sin(bearing) * dy > back * jnp.cos(sonar.hearing)
            stray = jnp.where(within & (fires[j] > 0), (distance + back) / 2, jnp.inf)
            best = jnp.minimum(best, stray)
        noisy = best + sonar.noise * jax.random.normal(keys[i + 1], dtype=jnp.result_type(best))
        step = jnp.maximum(sonar.resolution, 1e-6)
        read = jnp.maximum(jnp.round(noisy / step) * step, sonar.nearest)
        heard.append(jnp.where(best <= sonar.reach, read, jnp.inf))
    return tuple(heard)


def _mounted(mount: Mount, pose: tuple[Scalar, Scalar, Scalar]) -> tuple[Scalar, Scalar, Scalar]:
    x, y, heading = pose
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    return (
        x + cosine * mount.x - sine * mount.y,
        y + sine * mount.x + cosine * mount.y,
        heading + mount.angle,
    )


def _echo(
    sonar: Sonar, walls: jax.Array, corners: jax.Array, x: Scalar, y: Scalar, bearing: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Distance and place of the nearest echo of one mount."""
    start, end = walls[:, :2] - jnp.stack([x, y]), walls[:, 2:] - jnp.stack([x, y])
    length = jnp.sqrt(jnp.sum((end - start) ** 2, axis=1) + 1e-18)
    along = (end - start) / length[:, None]
    foot = -jnp.sum(start * along, axis=1)  # along the wall, from its start
    away = jnp.abs(start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0])
    # The piece of the wall's line within the cone: between where its two rays cut it.
    low, high = foot - away * jnp.tan(sonar.obliqueness), foot + away * jnp.tan(sonar.obliqueness)
    normal = start + foot[:, None] * along  # from the sonar to the foot
    ahead_foot = jnp.cos(bearing) * normal[:, 0] + jnp.sin(bearing) * normal[:, 1]
    aside_foot = jnp.cos(bearing) * normal[:, 1] - jnp.sin(bearing) * normal[:, 0]
    ahead_step = jnp.cos(bearing) * along[:, 0] + jnp.sin(bearing) * along[:, 1]
    aside_step = jnp.cos(bearing) * along[:, 1] - jnp.sin(bearing) * along[:, 0]
    slope = jnp.tan(sonar.half_angle)
    # Within the cone: slope · ahead -+ aside >= 0, each linear along the wall.
    for side in (1.0, -1.0):
        at_foot = slope * ahead_foot + side * aside_foot
        change = slope * ahead_step + side * aside_step
        root = foot - at_foot / jnp.where(jnp.abs(change) > 1e-9, change, 1e-9)
        low = jnp.where(change > 0, jnp.maximum(low, root), low)
        high = jnp.where(change > 0, high, jnp.minimum(high, root))
    low, high = jnp.maximum(low, 0.0), jnp.minimum(high, length)
    at = jnp.clip(foot, low, high)
    point = start + at[:, None] * along
    points = jnp.concatenate([point, corners[:, :2] - jnp.stack([x, y])])
    reach = jnp.sqrt(jnp.sum(points**2, axis=1) + 1e-18)
    ahead = jnp.cos(bearing) * points[:, 0] + jnp.sin(bearing) * points[:, 1]
    lit = ahead > reach * jnp.cos(sonar.half_angle)
    seen = jnp.concatenate([low <= high, (corners[:, 2] > 0) & lit[walls.shape[0] :]])
    seen = seen & ~_hidden(start, end, points)
    reach = jnp.where(seen, reach, jnp.inf)
    nearest = jnp.argmin(reach)
    return reach[nearest], x + points[nearest, 0], y + points[nearest, 1]


def _hidden(start: jax.Array, end: jax.Array, points: jax.Array) -> jax.Array:
    """Which points, seen from the origin, have a wall before them (not one that they lie on)."""
    cross = lambda a, b: a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]  # noqa: E731  # four uses
    ray, a, b = points[:, None], start[None], end[None]
    span = cross(ray, b - a)
    safe = jnp.where(jnp.abs(span) > 1e-12, span, jnp.inf)
    on_ray, on_wall = cross(a, b - a) / safe, cross(a, ray) / safe
    return jnp.any((on_ray > 1e-6) & (on_ray < 1 - 1e-4) & (on_wall >= 0) & (on_wall <= 1), axis=1)
