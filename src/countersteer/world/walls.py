"""Walls: the car's rectangle against line segments."""

import jax
import jax.numpy as jnp

from countersteer.car.car import Body
from countersteer.car.parameter import Scalar
from countersteer.world.state import Motion


def collide(body: Body, walls: jax.Array, motion: Motion) -> tuple[Motion, Scalar]:
    """The motion after the deepest contact with a wall, and 1 where there was one, else 0.

    `walls` is (n, 4), the ends of segments in metres; rows of NaN touch nothing. Rectangle and
    segment overlap unless one of three axes separates them: the rectangle's two and the segment's
    normal. The axis of least overlap is the contact's normal; the contact is the rectangle's
    deepest corner on the segment's normal, else the deepest end of the segment. The car is moved
    out along the normal. Where the contact approaches, it takes the impulse that stops it
    (with Coulomb friction), times 1 + restitution; both never add energy: the plastic impulse p
    satisfies p · v' <= 0, so that (1 + e) p changes the energy by (1 + e)(1 - e)/2 p · v <= 0.
    """
    cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)

    def to_body(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        dx, dy = x - motion.x, y - motion.y
        return cosine * dx + sine * dy - body.center, cosine * dy - sine * dx

    ax, ay = to_body(walls[:, 0], walls[:, 1])
    bx, by = to_body(walls[:, 2], walls[:, 3])
    half_x, half_y = body.length / 2, body.width / 2
    length = jnp.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + 1e-18)
    nx, ny = (ay - by) / length, (bx - ax) / length
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
    depth = jnp.where(jnp.isnan(depth), -1.0, depth)

    deepest = jnp.argmax(depth)
    take = lambda values: values[deepest]  # noqa: E731  # twelve uses below
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
    # A corner of the rectangle, or an end of the wall; a flat side touches in its middle.
    corner_x = -_sign(take(nx)) * half_x
    corner_y = -_sign(take(ny)) * half_y
    point_x = jnp.where(by_wall, corner_x, jnp.where(first_end, take(ax), take(bx))) + body.center
    point_y = jnp.where(by_wall, corner_y, jnp.where(first_end, take(ay), take(by)))

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
    determinant = k_nn * k_tt - k_nt**2
    stick_n = (k_nt * speed_t - k_tt * speed_n) / determinant
    stick_t = (k_nt * speed_n - k_nn * speed_t) / determinant
    # Sliding: friction at its limit against the tangential speed, the normal speed stopped.
    slip = -jnp.sign(speed_t) * body.wall_friction
    along = k_nn + k_nt * slip
    slide_n = -speed_n / jnp.where(along > 0, along, k_nn)
    sticks = (jnp.abs(stick_t) <= body.wall_friction * stick_n) & (stick_n >= 0)
    slides = along > 0
    impulse_n = jnp.where(sticks, stick_n, jnp.where(slides, slide_n, -speed_n / k_nn))
    impulse_t = jnp.where(sticks, stick_t, jnp.where(slides, slip * slide_n, 0.0))
    # Friction that would turn the slip around in one impulse has stopped it on the way.
    after_t = speed_t + k_nt * impulse_n + k_tt * impulse_t
    turns = ~sticks & (after_t * speed_t < 0)
    impulse_t = jnp.where(turns, jnp.where(stick_n >= 0, stick_t, 0.0), impulse_t)
    impulse_n = jnp.where(turns, jnp.where(stick_n >= 0, stick_n, -speed_n / k_nn), impulse_n)
    push = jnp.where(hits & (speed_n < 0), 1 + body.wall_restitution, 0.0)
    impulse_n, impulse_t = push * impulse_n, push * impulse_t

    out = jnp.where(hits, take(depth), 0.0)
    out = jnp.where(jnp.isnan(out), 0.0, out)
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


def _sign(component: jax.Array) -> jax.Array:
    """The sign of a normal's component; 0 where it is too small to tell a corner from a side."""
    return jnp.where(jnp.abs(component) < 1e-6, 0.0, jnp.sign(component))
