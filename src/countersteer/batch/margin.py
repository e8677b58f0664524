"""The margin of a drive: how near its car came to a wall."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.batch.trials import Instant
from countersteer.car.car import Body
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.signals import Array, Motion, Scalar
from countersteer.world.walls import padded

ROWS = 1024  # of a motion, or a multiple


@pytree
class Margin:
    """A watch (`batch.trials.Watch`) that keeps the least distance of car and walls, m."""

    walls: Array  # (n, 4); rows of NaN are padding

    @classmethod
    def of(cls, course: Course) -> "Margin":
        """For the walls of a course."""
        return cls(walls=padded(course.walls, np.dtype(np.float32)))

    def begin(self, now: Instant) -> Scalar:
        """Before the first tick."""
        return jnp.full_like(now.score.time, jnp.inf)

    def look(self, now: Instant, kept: Scalar) -> Scalar:
        """With this instant."""
        world: Any = now.simulator.world
        return jnp.minimum(kept, self.clear(world.car.body, world.motion(now.loop.state)))

    def end(self, kept: Scalar) -> Scalar:
        """The least margin."""
        return kept

    def least(self, body: Body, motion: Motion) -> Scalar:
        """The least margin of a motion with leaves (n,)."""
        count = len(motion.x)
        # The last row fills up: drives of any length share a program.
        rows = np.minimum(np.arange(math.ceil(count / ROWS) * ROWS), count - 1)
        filled = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[rows], motion)
        return np.float32(np.min(_clear(self, body, filled)))

    def clear(self, body: Body, motion: Motion) -> Scalar:
        """Distance (m) of the car's rectangle to the nearest wall. It counts until they touch.

        Two figures that do not overlap are nearest at a corner of one of them: corners of the
        rectangle to a wall, or ends of a wall to the rectangle.
        """
        cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)

        def to_body(x: Array, y: Array) -> tuple[Array, Array]:
            dx, dy = x - motion.x, y - motion.y
            return cosine * dx + sine * dy - body.center, cosine * dy - sine * dx

        ends = [to_body(self.walls[:, i], self.walls[:, i + 1]) for i in (0, 2)]
        half_length, half_width = body.length / 2, body.width / 2
        nearest: Any = jnp.inf  # squared
        for x, y in ends:
            ahead = jnp.maximum(jnp.abs(x) - half_length, 0.0)
            aside = jnp.maximum(jnp.abs(y) - half_width, 0.0)
            nearest = jnp.minimum(nearest, ahead**2 + aside**2)
        (ax, ay), (bx, by) = ends
        length2 = jnp.maximum((bx - ax) ** 2 + (by - ay) ** 2, 1e-12)
        for cx in (half_length, -half_length):
            for cy in (half_width, -half_width):
                on = jnp.clip(((cx - ax) * (bx - ax) + (cy - ay) * (by - ay)) / length2, 0.0, 1.0)
                dx, dy = ax + on * (bx - ax) - cx, ay + on * (by - ay) - cy
                nearest = jnp.minimum(nearest, dx**2 + dy**2)
        return jnp.sqrt(jnp.min(jnp.where(jnp.isnan(self.walls[:, 0]), jnp.inf, nearest)))


@jax.jit
def _clear(margin: Margin, body: Body, motion: Motion) -> Array:
    """The margin at each row of a motion."""
    return jax.vmap(margin.clear, (None, 0))(body, motion)
