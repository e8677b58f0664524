"""Sonar: the nearest echo in a wide cone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Sonar
from countersteer.signals import Scalar

PAST = 1e-5  # rad by which a ray passes the end of a wall
INSIDE = 1e-3  # m, margin between an echo's point and the end of a wall
MERGED = 1e-4  # m, distance within which ends of walls are one corner
FEW = 1000  # points whose distances are all computed
MOST_WALLS = 24  # walls of a ping: the nearest ones in its cone


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
    start, end = walls[:, :2] - jnp.stack([x, y]), walls[:, 2:] - jnp.stack([x, y])
    length = jnp.sqrt(jnp.sum((end - start) ** 2, axis=1) + 1e-18)
    along = (end - start) / length[:, None]
    foot = -jnp.sum(start * along, axis=1)  # along the wall, from its start
    away = jnp.abs(start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0])
    # The piece of the wall's line that is seen within `obliqueness` of its normal.
    low, high = foot - away * jnp.tan(sonar.obliqueness), foot + away * jnp.tan(sonar.obliqueness)
    normal = start + foot[:, None] * along  # from the sonar to the foot
    ahead_foot = jnp.cos(bearing) * normal[:, 0] + jnp.sin(bearing) * normal[:, 1]
    aside_foot = jnp.cos(bearing) * normal[:, 1] - jnp.sin(bearing) * normal[:, 0]
    ahead_step = jnp.cos(bearing) * along[:, 0] + jnp.sin(bearing) * along[:, 1]
    aside_step = jnp.cos(bearing) * along[:, 1] - jnp.sin(bearing) * along[:, 0]
    slope = jnp.tan(sonar.half_angle)
    # Within the cone, slope · ahead -+ aside >= 0. Both are linear along the wall.
    for side in (1.0, -1.0):
        at_foot = slope * ahead_foot + side * aside_foot
        change = slope * ahead_step + side * aside_step
        root = foot - at_foot / jnp.where(jnp.abs(change) > 1e-9, change, 1e-9)
        low = jnp.where(change > 0, jnp.maximum(low, root), low)
        high = jnp.where(change > 0, high, jnp.minimum(high, root))
    low, high = jnp.maximum(low, 0.0), jnp.minimum(high, length)
    # Not the very end: where two walls meet, the end of a hidden wall would be visible.
    inner = jnp.minimum(INSIDE, (high - low) / 2)
    at = jnp.clip(foot, low + inner, high - inner)
    point = start + at[:, None] * along
    # If that point is hidden, the wall may still be visible past the end of the nearer wall.
    ends = jnp.concatenate([start, end])
    past = jnp.concatenate([ends + PAST * _left(ends), ends - PAST * _left(ends)])
    span = _cross(past[:, None], (end - start)[None])
    scale = _cross(start, end - start)[None] / jnp.where(jnp.abs(span) > 1e-12, span, jnp.inf)
    glimpse = scale[..., None] * past[:, None]
    place = jnp.sum((glimpse - start) * along, axis=-1)
    beyond = jnp.sum((glimpse - jnp.concatenate([ends, ends])[:, None]) ** 2, axis=-1)
    glimpsed = (scale > 0) & (place >= low) & (place <= high) & (beyond > INSIDE**2)
    points = jnp.concatenate([point, glimpse.reshape(-1, 2), corners - jnp.stack([x, y])])
    reach = jnp.sqrt(jnp.sum(points**2, axis=1) + 1e-18)
    ahead = jnp.cos(bearing) * points[:, 0] + jnp.sin(bearing) * points[:, 1]
    within = ahead > reach * jnp.cos(sonar.half_angle)
    seen = jnp.concatenate(
        [low <= high, glimpsed.reshape(-1), (lit > 0) & within[-corners.shape[0] :]]
    )
    seen = seen & ~_hidden(start, end, points)
    reach = jnp.where(seen, reach, jnp.inf)
    nearest = jnp.argmin(reach)
    return reach[nearest], x + points[nearest, 0], y + points[nearest, 1]


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


def _left(vector: jax.Array) -> jax.Array:
    """The vectors, turned by 90° to the left."""
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """The cross product of two vectors in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _hidden(start: jax.Array, end: jax.Array, points: jax.Array) -> jax.Array:
    """True for points that a wall hides from the origin. A wall does not hide points on it."""
    ray, a, b = points[:, None], start[None], end[None]
    span = _cross(ray, b - a)
    safe = jnp.where(jnp.abs(span) > 1e-12, span, jnp.inf)
    on_ray, on_wall = _cross(a, b - a) / safe, _cross(a, ray) / safe
    return jnp.any((on_ray > 1e-6) & (on_ray < 1 - 1e-4) & (on_wall >= 0) & (on_wall <= 1), axis=1)
