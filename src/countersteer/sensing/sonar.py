"""Sonar: the nearest echo in a wide cone."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Sonar
from countersteer.signals import Array, Scalar

PAST = 1e-5  # rad by which a ray passes the end of a wall
INSIDE = 1e-3  # m, margin between an echo's point and the end of a wall
MERGED = 1e-4  # m, distance within which ends of walls are one corner
FEW = 1000  # points whose distances are all computed
MOST_WALLS = 24  # walls of a ping: the nearest ones in its cone


class Flat(NamedTuple):
    """Vectors in the plane, each coordinate an array of its own."""

    x: Array
    y: Array


def edges(walls: np.ndarray) -> np.ndarray:
    """Ends x, y of all walls, and 1 if the end can scatter sound, else 0: (2n, 3).

    An end scatters unless it is a seam, where two walls meet in line. An end in an inside corner
    scatters too. This has no effect, since the walls beside it are nearer.
    """
    ends = np.concatenate([walls[:, :2], walls[:, 2:]])
    along = np.concatenate([walls[:, 2:], walls[:, :2]]) - ends
    along = along / np.sqrt(np.sum(along**2, axis=1, keepdims=True) + 1e-18)
    scatters = np.ones(len(ends), bool)
    real = np.nonzero(np.all(np.isfinite(ends), axis=1))[0]
    if len(real):
        one, other = real[_near_pairs(ends[real])].T
        seams = np.sum(along[one] * along[other], axis=1) < -0.999
        scatters[one[seams]] = scatters[other[seams]] = False
    return np.concatenate([ends, scatters[:, None]], axis=1).astype(walls.dtype)


def _near_pairs(points: np.ndarray) -> np.ndarray:
    """(pairs, 2): indices of points (n, 2) within `MERGED` of each other."""
    if len(points) <= FEW:
        near = np.sum((points[:, None] - points) ** 2, axis=-1) <= MERGED**2
        return np.argwhere(np.triu(near, 1))
    from scipy.spatial import KDTree  # it takes a quarter of a second to import

    pairs: np.ndarray = KDTree(points).query_pairs(MERGED, output_type="ndarray")
    return pairs


def distances(
    sonar: Sonar,
    walls: jax.Array,
    corners: jax.Array,
    pose: tuple[Scalar, Scalar, Scalar],
    fires: tuple[Scalar, ...],
    key: jax.Array,
) -> tuple[Scalar, ...]:
    """The report of each mount after a ping (m); inf without an echo.

    `pose` is x, y, heading of the car. `fires` is 1 for each mount that pings. A wall returns an
    echo from its nearest visible point within the cone and within `obliqueness` of its normal.
    `corners` (from `edges`) echo at random in each ping. Hidden points return nothing. Walls are
    assumed to meet only at their ends. A mount also hears the echoes of other mounts' pings, if
    they come from within `hearing`. Their distance is half the path out and back.

    A ping uses the `MOST_WALLS` nearest walls that may reach into its cone. These are all such
    walls, unless more of them are within `reach`.
    """
    x, y, bearing = (jnp.stack(values) for values in zip(*_spots(sonar, pose), strict=True))
    edge_key, noise_key = jax.random.split(key)
    chance = jax.random.uniform(edge_key, (corners.shape[0],))
    lit = jnp.where(chance < sonar.edge_echo, corners[:, 2], 0.0)
    away, echo_x, echo_y = jax.vmap(partial(_echo, sonar, walls, corners[:, :2], lit))(
        x, y, bearing
    )
    # Rows: the mount that hears. Columns: the mount that pings.
    dx, dy = echo_x - x[:, None], echo_y - y[:, None]
    back = jnp.sqrt(dx**2 + dy**2 + 1e-12)
    ahead = jnp.cos(bearing)[:, None] * dx + jnp.sin(bearing)[:, None] * dy
    hears = (ahead > back * jnp.cos(sonar.hearing)) & (jnp.stack(fires) > 0)
    stray = jnp.where(hears, (away + back) / 2, jnp.inf)
    best = jnp.minimum(away, jnp.min(stray, axis=1))
    noisy = best + sonar.noise * jax.random.normal(noise_key, best.shape, best.dtype)
    step = jnp.maximum(sonar.resolution, 1e-6)
    read = jnp.maximum(jnp.round(noisy / step) * step, sonar.nearest)
    return tuple(jnp.where(best <= sonar.reach, read, jnp.inf))


def _spots(
    sonar: Sonar, pose: tuple[Scalar, Scalar, Scalar]
) -> list[tuple[Scalar, Scalar, Scalar]]:
    """Position and bearing of each mount."""
    x, y, heading = pose
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    return [
        (
            x + cosine * mount.x - sine * mount.y,
            y + sine * mount.x + cosine * mount.y,
            heading + mount.angle,
        )
        for mount in sonar.mounts
    ]


def _echo(
    sonar: Sonar,
    walls: jax.Array,
    corners: jax.Array,
    lit: jax.Array,
    x: Scalar,
    y: Scalar,
    bearing: Scalar,
) -> tuple[Scalar, Scalar, Scalar]:
    """Distance and position of the nearest echo of one mount. `lit` is 1 for corners that echo."""
    if walls.shape[0] > MOST_WALLS:
        near = _nearest(sonar, walls, x, y, bearing)
        both = jnp.concatenate([near, near + walls.shape[0]])
        walls, corners, lit = walls[near], corners[both], lit[both]
    # Each coordinate is an array of its own, with x forward and y left of the sonar: a batch of
    # pairs would not fill the vector units.
    start, end = (_from(walls[:, i], walls[:, i + 1], x, y, bearing) for i in (0, 2))
    edge = _from(corners[:, 0], corners[:, 1], x, y, bearing)
    step = Flat(end.x - start.x, end.y - start.y)
    length = _length(step)
    along = Flat(step.x / length, step.y / length)
    foot = -(start.x * along.x + start.y * along.y)  # along the wall, from its start
    away = jnp.abs(_cross(start, along))
    # The piece of the wall's line that is seen within `obliqueness` of its normal.
    low, high = foot - away * jnp.tan(sonar.obliqueness), foot + away * jnp.tan(sonar.obliqueness)
    normal = Flat(start.x + foot * along.x, start.y + foot * along.y)  # from sonar to foot
    slope = jnp.tan(sonar.half_angle)
    # Within the cone, slope · x -+ y >= 0. Both are linear along the wall.
    for side in (1.0, -1.0):
        at_foot = slope * normal.x + side * normal.y
        change = slope * along.x + side * along.y
        root = foot - at_foot / jnp.where(jnp.abs(change) > 1e-9, change, 1e-9)
        low = jnp.where(change > 0, jnp.maximum(low, root), low)
        high = jnp.where(change > 0, high, jnp.minimum(high, root))
    low, high = jnp.maximum(low, 0.0), jnp.minimum(high, length)
    # Not the very end: where two walls meet, the end of a hidden wall would be visible.
    inner = jnp.minimum(INSIDE, (high - low) / 2)
    at = jnp.clip(foot, low + inner, high - inner)
    point = Flat(start.x + at * along.x, start.y + at * along.y)
    within = edge.x > _length(edge) * jnp.cos(sonar.half_angle)
    points = _joined(point, edge)
    seen = jnp.concatenate([low <= high, (lit > 0) & within]) & ~_hidden(start, step, points)

    # If that point is hidden, the wall may still be visible past the end of the nearer wall.
    ends = _joined(start, end)
    past = _joined(*(Flat(ends.x - p * ends.y, ends.y + p * ends.x) for p in (PAST, -PAST)))
    scale, on_wall = _crossings(start, step, past)
    place = on_wall * length
    beyond = jnp.abs(scale - 1) * _length(past)[:, None]
    echoes = (scale > 0) & (place >= low) & (place <= high) & (beyond > INSIDE)
    # The ray ends at the first wall that it meets, whether that wall returns an echo or not.
    met = (scale > 1e-6) & (on_wall >= 0) & (on_wall <= 1)
    first = jnp.min(jnp.where(met, scale, jnp.inf), axis=1, keepdims=True)
    echoes = echoes & (scale * (1 - 1e-4) <= first)
    glimpse = jnp.min(jnp.where(echoes, scale, jnp.inf), axis=1)
    glimpsed = jnp.isfinite(glimpse)
    part = jnp.where(glimpsed, glimpse, 1.0)
    points = _joined(points, Flat(part * past.x, part * past.y))

    reach = jnp.where(jnp.concatenate([seen, glimpsed]), _length(points), jnp.inf)
    nearest = jnp.argmin(reach)
    cosine, sine = jnp.cos(bearing), jnp.sin(bearing)
    ahead, aside = points.x[nearest], points.y[nearest]
    return reach[nearest], x + cosine * ahead - sine * aside, y + sine * ahead + cosine * aside


def _nearest(sonar: Sonar, walls: jax.Array, x: Scalar, y: Scalar, bearing: Scalar) -> jax.Array:
    """Sorted indices of the `MOST_WALLS` nearest walls that may reach into the cone."""
    start, end = walls[:, :2] - jnp.stack([x, y]), walls[:, 2:] - jnp.stack([x, y])
    step = end - start
    at = -jnp.sum(start * step, axis=1) / (jnp.sum(step**2, axis=1) + 1e-18)
    away = jnp.sum((start + jnp.clip(at, 0.0, 1.0)[:, None] * step) ** 2, axis=1)
    inside = ~jnp.isnan(away)  # padding
    slope = jnp.tan(sonar.half_angle)
    cosine, sine = jnp.cos(bearing), jnp.sin(bearing)
    for side in (1.0, -1.0):
        within = [
            slope * (cosine * p[:, 0] + sine * p[:, 1]) + side * (cosine * p[:, 1] - sine * p[:, 0])
            for p in (start, end)
        ]
        # A little wider than the cone, since rays pass the ends of walls.
        inside = inside & (jnp.maximum(*within) > -0.01)
    return jnp.sort(jax.lax.top_k(jnp.where(inside, -away, -jnp.inf), MOST_WALLS)[1])


def _from(x: Array, y: Array, at_x: Scalar, at_y: Scalar, bearing: Scalar) -> Flat:
    """Points as seen from a place: x along the bearing, y to its left."""
    dx, dy, cosine, sine = x - at_x, y - at_y, jnp.cos(bearing), jnp.sin(bearing)
    return Flat(cosine * dx + sine * dy, cosine * dy - sine * dx)


def _joined(*parts: Flat) -> Flat:
    """All vectors of some arrays, in their order."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _length(vector: Flat) -> Array:
    """The lengths of vectors."""
    return jnp.sqrt(vector.x**2 + vector.y**2 + 1e-18)


def _cross(a: Flat, b: Flat) -> Array:
    """The cross product of vectors in the plane."""
    return a.x * b.y - a.y * b.x


def _crossings(start: Flat, step: Flat, rays: Flat) -> tuple[Array, Array]:
    """Where rays (m) from the origin cross the lines of walls (n).

    Two arrays (m, n): the place as a part of the ray, and as a part of the wall.
    """
    ray = Flat(rays.x[:, None], rays.y[:, None])
    span = _cross(ray, step)
    over = jnp.where(jnp.abs(span) > 1e-12, 1 / span, 0.0)
    return _cross(start, step) * over, _cross(start, ray) * over


def _hidden(start: Flat, step: Flat, points: Flat) -> Array:
    """True for points that a wall hides from the origin. A wall does not hide points on it."""
    on_ray, on_wall = _crossings(start, step, points)
    return jnp.any((on_ray > 1e-6) & (on_ray < 1 - 1e-4) & (on_wall >= 0) & (on_wall <= 1), axis=1)
