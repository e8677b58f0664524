"""Walls: the car's rectangle against line segments."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Body
from countersteer.car.parameter import Scalar
from countersteer.world.state import Motion

FAR = 1e5  # m
PREFERENCE = 1e-3  # depth that a wall gives up per distance by which it misses the corner


def collide(body: Body, walls: jax.Array, motion: Motion) -> tuple[Motion, Scalar]:
    """The motion after the deepest contact with a wall, and 1 where there was one, else 0.

    `walls` is (n, 4), the ends of segments in metres; rows of NaN touch nothing. Rectangle and
    segment overlap unless one of three axes separates them: the rectangle's two and the segment's
    normal. The axis of least overlap is the contact's normal. On the segment's normal the contact
    is the deepest corner of the rectangle, or the middle of what touches where a side lies flat;
    else it is the deepest end of the segment. The car is moved out along the normal, and a contact
    that approaches takes an impulse (`impulse`).
    """
    cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)

    def to_body(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        dx, dy = x - motion.x, y - motion.y
        return cosine * dx + sine * dy - body.center, cosine * dy - sine * dx

    # Padding stands far off, where it touches nothing and every derivative is finite.
    walls = jnp.where(jnp.isnan(walls), jnp.asarray([FAR, FAR, FAR + 1, FAR], walls.dtype), walls)
    ax, ay = to_body(walls[:, 0], walls[:, 1])
    bx, by = to_body(walls[:, 2], walls[:, 3])
    half_x, half_y = body.length / 2, body.width / 2
    length = jnp.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + 1e-18)
    tx, ty = (bx - ax) / length, (by - ay) / length
    nx, ny = -ty, tx
    side = jnp.where(nx * ax + ny * ay > 0, -1.0, 1.0)  # towards the rectangle's centre
    nx, ny = side * nx, side * ny
    # Overlap along the segment's normal and along the rectangle's axes (from either side).
    reach = jnp.abs(nx) * half_x + jnp.abs(ny) * half_y
    on_wall = reach + nx * ax + ny * ay
    ahead = half_x - jnp.minimum(ax, bx)
    behind = half_x + jnp.maximum(ax, bx)
    to_left = half_y - jnp.minimum(ay, by)
    to_right = half_y + jnp.maximum(ay, by)
    on_x, on_y = jnp.minimum(ahead, behind), jnp.minimum(to_left, to_right)
    depth = jnp.minimum(jnp.minimum(on_x, on_y), on_wall)

    # Along each wall: the deepest corner, or the middle of a side that lies flat, on the wall.
    corner_x, corner_y = -_sign(nx) * half_x, -_sign(ny) * half_y
    middle = (corner_x - ax) * tx + (corner_y - ay) * ty
    spread = jnp.abs(tx) * half_x * (corner_x == 0) + jnp.abs(ty) * half_y * (corner_y == 0)
    first, last = jnp.clip(middle - spread, 0.0, length), jnp.clip(middle + spread, 0.0, length)
    at = (first + last) / 2
    # Of the pieces of one wall, all equally deep, the one that has the corner takes the contact.
    missed = jnp.maximum(jnp.abs(at - middle) - spread, 0.0)
    deepest = jnp.argmax(depth - jnp.where(depth > 0, PREFERENCE * missed, 0.0))
    take = lambda values: values[deepest]  # noqa: E731  # it is used all over below
    hits = take(depth) > 0
    by_wall = take(on_wall) <= jnp.minimum(take(on_x), take(on_y))
    by_x = take(on_x) <= take(on_y)
    from_front, from_left = take(ahead) < take(behind), take(to_left) < take(to_right)
    # The normal points from the wall into the car.
    normal_x = jnp.where(by_wall, take(nx), jnp.where(by_x, jnp.where(from_front, -1.0, 1.0), 0.0))
    normal_y = jnp.where(by_wall, take(ny), jnp.where(by_x, 0.0, jnp.where(from_left, -1.0, 1.0)))
    first_end = jnp.where(
        by_x,
        jnp.where(from_front, take(ax) < take(bx), take(ax) > take(bx)),
        jnp.where(from_left, take(ay) < take(by), take(ay) > take(by)),
    )
    point_x = jnp.where(by_wall, take(ax + at * tx), jnp.where(first_end, take(ax), take(bx)))
    point_y = jnp.where(by_wall, take(ay + at * ty), jnp.where(first_end, take(ay), take(by)))
    point_x = point_x + body.center

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

    out = jnp.where(hits, take(depth), 0.0)
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
