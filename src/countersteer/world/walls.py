"""Walls: the car's rectangle against line segments."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Body
from countersteer.signals import Motion, Scalar
from countersteer.world.angle import cosine_sine

FAR = 1e5  # m
LEAST = 8  # rows
FEW = 16  # walls that are compared one by one
PREFERENCE = 1e-3  # depth that a wall gives up per distance by which it misses the corner


def padded(walls: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Walls with rows of NaN up to a power of two, so that like courses share a program."""
    rows = max(LEAST, 1 << math.ceil(math.log2(max(len(walls), 1))))
    full = np.full((rows, 4), np.nan, dtype)
    full[: len(walls)] = walls
    return full


class Overlap(NamedTuple):
    """How the car's rectangle and a wall overlap, in axes at the rectangle's centre (m)."""

    on_wall: Scalar  # along the wall's normal
    ahead: Scalar  # along the car, from its front
    behind: Scalar
    to_left: Scalar
    to_right: Scalar
    normal_x: Scalar  # of the wall, towards the car
    normal_y: Scalar
    point_x: Scalar  # on the wall: its deepest corner's foot
    point_y: Scalar
    missed: Scalar  # by how much the wall ends short of that corner

    @property
    def on_x(self) -> Scalar:
        """Along the car, from the nearer end."""
        return jnp.minimum(self.ahead, self.behind)

    @property
    def on_y(self) -> Scalar:
        """Across the car, from the nearer side."""
        return jnp.minimum(self.to_left, self.to_right)

    @property
    def depth(self) -> Scalar:
        """The least overlap on all axes; negative where one separates the two."""
        return jnp.minimum(jnp.minimum(self.on_x, self.on_y), self.on_wall)


class Wall(NamedTuple):
    """A segment: one end, the direction to the other and its length (m)."""

    x: Scalar
    y: Scalar
    along_x: Scalar
    along_y: Scalar
    length: Scalar

    @property
    def end(self) -> tuple[Scalar, Scalar]:
        """The other end."""
        return self.x + self.length * self.along_x, self.y + self.length * self.along_y


def overlap(body: Body, wall: Wall) -> Overlap:
    """The rectangle about the origin against a wall."""
    half_x, half_y = body.length / 2, body.width / 2
    ax, ay, tx, ty, length = wall
    bx, by = wall.end
    nx, ny = -ty, tx
    side = jnp.where(nx * ax + ny * ay > 0, -1.0, 1.0)  # towards the rectangle's centre
    nx, ny = side * nx, side * ny
    reach = jnp.abs(nx) * half_x + jnp.abs(ny) * half_y
    # Along the wall: the deepest corner, or the middle of a side that lies flat, on the wall.
    corner_x, corner_y = -_sign(nx) * half_x, -_sign(ny) * half_y
    middle = (corner_x - ax) * tx + (corner_y - ay) * ty
    spread = jnp.abs(tx) * half_x * (corner_x == 0) + jnp.abs(ty) * half_y * (corner_y == 0)
    first, last = jnp.clip(middle - spread, 0.0, length), jnp.clip(middle + spread, 0.0, length)
    at = (first + last) / 2
    return Overlap(
        on_wall=reach + nx * ax + ny * ay,
        ahead=half_x - jnp.minimum(ax, bx),
        behind=half_x + jnp.maximum(ax, bx),
        to_left=half_y - jnp.minimum(ay, by),
        to_right=half_y + jnp.maximum(ay, by),
        normal_x=nx,
        normal_y=ny,
        point_x=ax + at * tx,
        point_y=ay + at * ty,
        missed=jnp.maximum(jnp.abs(at - middle) - spread, 0.0),
    )


def collide(body: Body, walls: jax.Array, motion: Motion) -> tuple[Motion, Scalar]:
    """The motion after the deepest contact with a wall, and 1 where there was one, else 0.

    `walls` is (n, 4), the ends of segments in metres; rows of NaN touch nothing. Rectangle and
    segment overlap unless one of three axes separates them: the rectangle's two and the segment's
    normal. The axis of least overlap is the contact's normal. On the segment's normal the contact
    is the deepest corner of the rectangle, or the middle of what touches where a side lies flat;
    else it is the deepest end of the segment. The car is moved out along the normal, and a contact
    that approaches takes an impulse (`impulse`).
    """
    cosine, sine = cosine_sine(motion.heading)

    def to_body(wall: Wall) -> Wall:
        dx, dy = wall.x - motion.x, wall.y - motion.y
        return Wall(
            cosine * dx + sine * dy - body.center,
            cosine * dy - sine * dx,
            cosine * wall.along_x + sine * wall.along_y,
            cosine * wall.along_y - sine * wall.along_x,
            wall.length,
        )

    def score(wall: Wall) -> Scalar:
        # Of the pieces of one wall, all equally deep, the one that has the corner is preferred.
        against = overlap(body, to_body(wall))
        return against.depth - jnp.where(against.depth > 0, PREFERENCE * against.missed, 0.0)

    wall = to_body(_highest(score, _segments(walls)))
    ax, ay = wall.x, wall.y
    bx, by = wall.end
    deepest = overlap(body, wall)
    hits = deepest.depth > 0
    by_wall = deepest.on_wall <= jnp.minimum(deepest.on_x, deepest.on_y)
    by_x = deepest.on_x <= deepest.on_y
    from_front = deepest.ahead < deepest.behind
    from_left = deepest.to_left < deepest.to_right
    # The normal points from the wall into the car.
    along = jnp.where(by_x, jnp.where(from_front, -1.0, 1.0), 0.0)
    across = jnp.where(by_x, 0.0, jnp.where(from_left, -1.0, 1.0))
    normal_x = jnp.where(by_wall, deepest.normal_x, along)
    normal_y = jnp.where(by_wall, deepest.normal_y, across)
    first_end = jnp.where(
        by_x,
        jnp.where(from_front, ax < bx, ax > bx),
        jnp.where(from_left, ay < by, ay > by),
    )
    point_x = jnp.where(by_wall, deepest.point_x, jnp.where(first_end, ax, bx)) + body.center
    point_y = jnp.where(by_wall, deepest.point_y, jnp.where(first_end, ay, by))

    speed_n = normal_x * (motion.vx - motion.yaw_rate * point_y) + normal_y * (
        motion.vy + motion.yaw_rate * point_x
    )
    speed_t = normal_x * (motion.vy + motion.yaw_rate * point_x) - normal_y * (
        motion.vx - motion.yaw_rate * point_y
    )
    arm_n = point_x * normal_y - point_y * normal_x
    arm_t = point_x * normal_x + point_y * normal_y
    k_nn = 1 / body.mass + arm_n**2 / body.yaw_inertia
    k_tt = 1 / body.mass + arm_t**2 / body.yaw_inertia
    k_nt = arm_n * arm_t / body.yaw_inertia
    meets = hits & (speed_n < 0)
    impulse_n, impulse_t = impulse(jnp.where(meets, speed_n, -1.0), speed_t, k_nn, k_tt, k_nt, body)
    impulse_n, impulse_t = jnp.where(meets, impulse_n, 0.0), jnp.where(meets, impulse_t, 0.0)

    out = jnp.where(hits, deepest.depth, 0.0)
    out_x, out_y = out * normal_x, out * normal_y
    force_x = normal_x * impulse_n - normal_y * impulse_t
    force_y = normal_y * impulse_n + normal_x * impulse_t
    moved = motion._replace(
        x=motion.x + cosine * out_x - sine * out_y,
        y=motion.y + sine * out_x + cosine * out_y,
        vx=motion.vx + force_x / body.mass,
        vy=motion.vy + force_y / body.mass,
        yaw_rate=motion.yaw_rate + (point_x * force_y - point_y * force_x) / body.yaw_inertia,
    )
    touched = jax.tree.map(lambda a, b: jnp.where(hits, a, b), moved, motion)
    return touched, jnp.where(hits, 1.0, 0.0)


def _segments(walls: jax.Array) -> Wall:
    """The rows as walls. Padding stands far off: it touches nothing, its derivatives are finite."""
    walls = jnp.where(jnp.isnan(walls), jnp.asarray([FAR, FAR, FAR + 1, FAR], walls.dtype), walls)
    x, y, dx, dy = walls[:, 0], walls[:, 1], walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    length = jnp.sqrt(dx**2 + dy**2 + 1e-18)
    return Wall(x, y, dx / length, dy / length, length)


def _highest(score: Callable[[Wall], Scalar], walls: Wall) -> Wall:
    """The wall of the highest score.

    A few are compared one by one, in scalars: a batch's look-ups by an index are slow.
    """
    count = walls.x.shape[0]
    if count > FEW:
        chosen = jnp.argmax(score(walls))
        return Wall(*(values[chosen] for values in walls))
    rows = [Wall(*(values[i] for values in walls)) for i in range(count)]
    best, highest = rows[0], score(rows[0])
    for row in rows[1:]:
        this = score(row)
        best = Wall(*(jnp.where(this > highest, a, b) for a, b in zip(row, best, strict=True)))
        highest = jnp.maximum(this, highest)
    return best


def impulse(
    speed_n: Scalar, speed_t: Scalar, k_nn: Scalar, k_tt: Scalar, k_nt: Scalar, body: Body
) -> tuple[Scalar, Scalar]:
    """The impulse (N s) along the normal and the tangent at a contact that approaches.

    Speeds of the contact before it in m/s (speed_n < 0), k the inverse masses there (1/kg). First
    the plastic impulse (n, t), after which the contact has no normal speed: it sticks where that
    takes |t| <= mu n; else t = -mu s n, s the sign of the slip that is left. So t takes energy out.
    Then the wall gives back e n along the normal, e the restitution, or less where the energy
    would rise: with what n and t took out, E, e n <= sqrt(2 E / k_nn).
    """
    mu = body.wall_friction
    determinant = k_nn * k_tt - k_nt**2
    stick_n = (k_nt * speed_t - k_tt * speed_n) / determinant
    stick_t = (k_nt * speed_n - k_nn * speed_t) / determinant
    n, t = -speed_n / k_nn, 0.0 * speed_t  # should neither direction of sliding last
    onward = jnp.where(speed_t == 0, jnp.sign(k_nt), jnp.sign(speed_t))
    for s in (-onward, onward):
        give = k_nn - mu * s * k_nt
        slides_n = -speed_n / jnp.where(give > 0, give, k_nn)
        left = speed_t + (k_nt - mu * s * k_tt) * slides_n
        lasts = (give > 0) & (left * s >= 0)
        n, t = jnp.where(lasts, slides_n, n), jnp.where(lasts, -mu * s * slides_n, t)
    sticks = (stick_n > 0) & (jnp.abs(stick_t) <= mu * stick_n)
    n, t = jnp.where(sticks, stick_n, n), jnp.where(sticks, stick_t, t)
    change = n * speed_n + t * speed_t + (k_nn * n**2 + 2 * k_nt * n * t + k_tt * t**2) / 2
    bound = jnp.sqrt(jnp.maximum(-2 * change / k_nn, 1e-30))
    return n + jnp.minimum(body.wall_restitution * n, bound), t


def _sign(component: jax.Array) -> jax.Array:
    """The sign of a normal's component; 0 where it is too small to tell a corner from a side."""
    return jnp.where(jnp.abs(component) < 1e-6, 0.0, jnp.sign(component))
