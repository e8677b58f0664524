"""Walls: contact of the car's rectangle with line segments."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Body
from countersteer.signals import Motion, Scalar
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Vector, combine

FAR = 1e5  # m, position of padding
LEAST = 8  # rows of the shortest array
CLEARANCE = 1e-3  # m, by which the centre of a car stays away from a wall
STILL = 1e-20  # m, of a way that is none
FEW = 16  # walls; up to so many are compared one by one
PREFERENCE = 1e-3  # reduction of a wall's depth, per distance by which it misses the corner


def padded(walls: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Walls (n, 4), padded with NaN to a power of two of rows: similar courses share a program."""
    rows = max(LEAST, 1 << math.ceil(math.log2(max(len(walls), 1))))
    full = np.full((rows, 4), np.nan, dtype)
    full[: len(walls)] = walls
    return full


class Overlap(NamedTuple):
    """Overlap of the car's rectangle and a wall (m), in axes at the rectangle's centre."""

    on_wall: Scalar  # along the wall's normal
    ahead: Scalar  # along the car, from its front
    behind: Scalar
    to_left: Scalar
    to_right: Scalar
    normal_x: Scalar  # of the wall, towards the car
    normal_y: Scalar
    point_x: Scalar  # on the wall: foot of the rectangle's deepest corner
    point_y: Scalar
    missed: Scalar  # distance from the wall's end to that foot, if it lies beyond

    @property
    def on_x(self) -> Scalar:
        """Overlap along the car, from the nearer end."""
        return jnp.minimum(self.ahead, self.behind)

    @property
    def on_y(self) -> Scalar:
        """Overlap across the car, from the nearer side."""
        return jnp.minimum(self.to_left, self.to_right)

    @property
    def depth(self) -> Scalar:
        """The smallest overlap of all axes. It is negative if an axis separates the two."""
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
    """The overlap of the rectangle about the origin with a wall."""
    half_x, half_y = body.length / 2, body.width / 2
    ax, ay, tx, ty, length = wall
    bx, by = wall.end
    nx, ny = -ty, tx
    side = jnp.where(nx * ax + ny * ay > 0, -1.0, 1.0)  # towards the rectangle's centre
    nx, ny = side * nx, side * ny
    reach = jnp.abs(nx) * half_x + jnp.abs(ny) * half_y
    # Position along the wall: of the deepest corner, or of the middle of a side that lies flat.
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


def clear_part(wall: Wall, x: Scalar, y: Scalar, dx: Scalar, dy: Scalar) -> Scalar:
    """The part (0 to 1) of a straight way from a point that ends `CLEARANCE` before a wall.

    Around the wall is a rectangle, larger than it by the clearance on all sides. A point within it
    can only move away from the wall.
    """
    from_x, from_y = x - wall.x, y - wall.y
    aside = wall.along_x * from_y - wall.along_y * from_x  # to the wall's left
    along = wall.along_x * from_x + wall.along_y * from_y
    moves_aside = wall.along_x * dy - wall.along_y * dx
    moves_along = wall.along_x * dx + wall.along_y * dy

    def within(at: Scalar, moves: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
        """The parts of the way at which it comes between two bounds, and leaves them."""
        per = 1 / jnp.where(jnp.abs(moves) < STILL, STILL, moves)
        first, second = (low - at) * per, (high - at) * per
        return jnp.minimum(first, second), jnp.maximum(first, second)

    sides = within(aside, moves_aside, -CLEARANCE, CLEARANCE)
    ends = within(along, moves_along, -CLEARANCE, wall.length + CLEARANCE)
    enters, leaves = jnp.maximum(sides[0], ends[0]), jnp.minimum(sides[1], ends[1])
    meets = (enters < leaves) & (leaves > 0) & ((enters > 0) | (aside * moves_aside < 0))
    return jnp.where(meets, jnp.clip(enters, 0.0, 1.0), 1.0)


def clear_way(walls: Wall, x: Scalar, y: Scalar, dx: Scalar, dy: Scalar) -> Scalar:
    """`clear_part` of the first of several walls, given as arrays."""
    if walls.x.shape[0] > FEW:
        return jnp.min(clear_part(walls, x, y, dx, dy))
    return functools.reduce(
        jnp.minimum, [clear_part(row, x, y, dx, dy) for row in _one_by_one(walls)]
    )


def collide(body: Body, walls: jax.Array, before: Motion, motion: Motion) -> tuple[Motion, Scalar]:
    """The motion after the deepest contact with a wall, and 1 if there was one, else 0.

    The centre of the rectangle never crosses a wall: its straight way from `before`, a tick ago,
    ends at the first one. So does its way from there to its place after the contact. So no speed
    or step is too large. A tick's rest is lost where a way was cut short.

    `walls` is (n, 4), the ends of segments in metres. Rows of NaN touch nothing. Rectangle and
    segment overlap unless one of three axes separates them: the rectangle's two and the segment's
    normal. The axis of smallest overlap is the contact's normal. If that is the segment's normal,
    the contact is the deepest corner of the rectangle, or, if a side lies flat, the middle of the
    touching part. Otherwise it is the deepest end of the segment. The car is moved out along the
    normal. An approaching contact takes an impulse (`impulse`).
    """
    rows = _segments(walls)
    cosine, sine = cosine_sine(motion.heading)
    cosine_before, sine_before = cosine_sine(before.heading)
    from_x, from_y = before.x + body.center * cosine_before, before.y + body.center * sine_before
    dx, dy = motion.x + body.center * cosine - from_x, motion.y + body.center * sine - from_y
    way = clear_way(rows, from_x, from_y, dx, dy)
    x, y = from_x + way * dx, from_y + way * dy

    def to_body(wall: Wall) -> Wall:
        dx, dy = wall.x - x, wall.y - y
        return Wall(
            cosine * dx + sine * dy,
            cosine * dy - sine * dx,
            cosine * wall.along_x + sine * wall.along_y,
            cosine * wall.along_y - sine * wall.along_x,
            wall.length,
        )

    def score(wall: Wall) -> Scalar:
        # Pieces of one wall are equally deep. The piece that holds the corner is preferred.
        against = overlap(body, to_body(wall))
        return against.depth - jnp.where(against.depth > 0, PREFERENCE * against.missed, 0.0)

    wall = to_body(_highest(score, rows))
    ax, ay = wall.x, wall.y
    bx, by = wall.end
    deepest = overlap(body, wall)
    hits = deepest.depth > 0
    # A centre that was stopped before a wall goes back, whatever the outline.
    by_wall = (way < 1) | (deepest.on_wall <= jnp.minimum(deepest.on_x, deepest.on_y))
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
    dx = x + out * (cosine * normal_x - sine * normal_y) - from_x
    dy = y + out * (sine * normal_x + cosine * normal_y) - from_y
    part = clear_way(rows, from_x, from_y, dx, dy)
    force_x = normal_x * impulse_n - normal_y * impulse_t
    force_y = normal_y * impulse_n + normal_x * impulse_t
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)
    change = Vector(
        force_x / body.mass,
        force_y / body.mass,
        (point_x * force_y - point_y * force_x) / body.yaw_inertia,
    )
    after = combine(1.0, velocity, passive_part(body, velocity, change), change)
    moved = motion._replace(
        x=from_x + part * dx - body.center * cosine,
        y=from_y + part * dy - body.center * sine,
        vx=after.x,
        vy=after.y,
        yaw_rate=after.yaw,
    )
    stopped = hits | (way < 1)
    touched = jax.tree.map(lambda a, b: jnp.where(stopped, a, b), moved, motion)
    return touched, jnp.where(hits, 1.0, 0.0)


def passive_part(body: Body, velocity: Vector, change: Vector) -> Scalar:
    """The part of a change of velocity that adds no energy: 1, but for rounding.

    The energy after a part p is E + p g + p² K. If the whole change adds energy, p = -g / 2K.
    """
    inertia = Vector(body.mass, body.mass, body.yaw_inertia)
    slope = sum(m * v * d for m, v, d in zip(inertia, velocity, change, strict=True))
    curvature = sum(m * d**2 for m, d in zip(inertia, change, strict=True)) / 2
    gains = slope + curvature > 0
    part = jnp.clip(-slope / (2 * jnp.where(curvature > 0, curvature, 1.0)), 0.0, 1.0)
    return jnp.where(gains, part, 1.0)


def _segments(walls: jax.Array) -> Wall:
    """The rows as walls. Padding moves to `FAR`: it touches nothing, its derivatives are finite."""
    walls = jnp.where(jnp.isnan(walls), jnp.asarray([FAR, FAR, FAR + 1, FAR], walls.dtype), walls)
    x, y, dx, dy = walls[:, 0], walls[:, 1], walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    length = jnp.sqrt(dx**2 + dy**2 + 1e-18)
    return Wall(x, y, dx / length, dy / length, length)


def _highest(score: Callable[[Wall], Scalar], walls: Wall) -> Wall:
    """The wall with the highest score.

    Up to `FEW` walls are compared one by one, in scalars: indexing is slow in a batch.
    """
    count = walls.x.shape[0]
    if count > FEW:
        chosen = jnp.argmax(score(walls))
        return Wall(*(values[chosen] for values in walls))
    rows = _one_by_one(walls)
    best, highest = rows[0], score(rows[0])
    for row in rows[1:]:
        this = score(row)
        best = Wall(*(jnp.where(this > highest, a, b) for a, b in zip(row, best, strict=True)))
        highest = jnp.maximum(this, highest)
    return best


def _one_by_one(walls: Wall) -> list[Wall]:
    return [Wall(*(values[i] for values in walls)) for i in range(walls.x.shape[0])]


def impulse(
    speed_n: Scalar, speed_t: Scalar, k_nn: Scalar, k_tt: Scalar, k_nt: Scalar, body: Body
) -> tuple[Scalar, Scalar]:
    """The impulse (N s) along the normal and the tangent of an approaching contact.

    The speeds (m/s) are the contact's before it, with speed_n < 0. k are the inverse masses there
    (1/kg). First, the plastic impulse (n, t) removes the normal speed. The contact sticks if this
    needs |t| <= mu n. Otherwise t = -mu s n, with s the sign of the remaining slip. So t removes
    energy. Then the wall returns e n along the normal, with e the restitution. It returns less if
    the energy would rise: e n <= sqrt(2 E / k_nn), with E the energy that n and t removed.
    """
    mu = body.wall_friction
    determinant = k_nn * k_tt - k_nt**2
    stick_n = (k_nt * speed_t - k_tt * speed_n) / determinant
    stick_t = (k_nt * speed_n - k_nn * speed_t) / determinant
    n, t = -speed_n / k_nn, 0.0 * speed_t  # if sliding lasts in neither direction
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
    left = -2 * change / k_nn
    bound = jnp.where(left > 0, jnp.sqrt(jnp.where(left > 0, left, 1.0)), 0.0)
    return n + jnp.minimum(body.wall_restitution * n, bound), t


def _sign(component: jax.Array) -> jax.Array:
    """The sign of a normal's component. It is 0 if the component is too small: a side lies flat."""
    return jnp.where(jnp.abs(component) < 1e-6, 0.0, jnp.sign(component))
