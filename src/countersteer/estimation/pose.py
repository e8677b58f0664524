"""The pose on a known course: a particle filter on sonar over the velocity filter's motion.

A corridor looks alike from several places: `box` from four. No sensor of the car distinguishes
them. So the pose is a cloud of particles that holds all places that fit. The result is the place
with most weight around it, with the covariance there and its share of the weight.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Sonar
from countersteer.car.parameter import pytree
from countersteer.clock import shared
from countersteer.course.course import Course
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.velocity.filter import VelocityFilter
from countersteer.estimation.velocity.states import VelocityMemory
from countersteer.sensing.sonar import MERGED
from countersteer.signals import Array, Command, Reading, Readings, Scalar
from countersteer.world.chassis import Symmetric

HIT = 0.1  # m: standard deviation of a distance in a model of rays and straight walls
MISSED = 0.2  # chance that a reading is of something else: an edge, a neighbour's echo, nothing
NEWS = 0.1  # m driven until the error of a ping is independent; 1 rad turned counts as 0.2 m
WALKS = (0.03, 0.03, 0.04)  # additional random walk: forward, left (m/√s), heading (rad/√s)
HALF = 0.5  # resample when the effective number falls below this part of the particles
NEAR = (0.5, math.radians(30))  # m and rad within which particles are of one hypothesis
PERIOD = 0.025  # s between two steps of the cloud
PARTICLES = 500
ROUGH = (0.01, 0.01, 0.005)  # m, m, rad: deviation of a resampled particle from its parent,
WIDER = 0.04  # plus this part of the whole cloud's deviation, so that a thin cloud searches


class Cloud(NamedTuple):
    """The particles: arrays (particles,)."""

    x: jax.Array
    y: jax.Array
    heading: jax.Array
    weight: jax.Array  # logarithm
    motion: Estimate  # of the velocity filter at the last step
    ticks: tuple[Scalar, ...]  # of the last sonar readings that were used
    key: jax.Array


class Pose(NamedTuple):
    """The hypothesis with the most weight: mean, covariance, and its share of all weight."""

    x: Scalar
    y: Scalar
    heading: Scalar
    covariance: Symmetric  # x, y, heading
    share: Scalar


class Located(NamedTuple):
    """The cloud, its best hypothesis, and the tick of its last step."""

    cloud: Cloud
    pose: Pose
    tick: Scalar


@pytree
class PoseFilter:
    """The particle filter for walls (n, 4), padded with rows of NaN, and the nominal sonar."""

    walls: Array
    sonar: Sonar

    def uniform(self, course: Course, key: jax.Array, particles: int, motion: Estimate) -> Cloud:
        """Particles anywhere in the corridor. Raises `ValueError` without a centre line."""
        if course.width is None:
            raise ValueError(f"{course.name}: free walls have no corridor to draw from")
        along_key, aside_key, heading_key, key = jax.random.split(key, 4)
        dtype = self.walls.dtype
        marks, line = jnp.asarray(course.marks, dtype), jnp.asarray(course.line, dtype)
        at = jax.random.uniform(along_key, (particles,), dtype) * course.length
        leg = jnp.clip(jnp.searchsorted(marks, at, side="right") - 1, 0, len(marks) - 2)
        step = line[leg + 1] - line[leg]
        step = step / (marks[leg + 1] - marks[leg])[:, None]
        aside = (jax.random.uniform(aside_key, (particles,), dtype) - 0.5) * (course.width - 0.2)
        spot = line[leg] + (at - marks[leg])[:, None] * step
        heading = jax.random.uniform(heading_key, (particles,), dtype) * 2 * math.pi
        return self.memory(
            spot[:, 0] - aside * step[:, 1], spot[:, 1] + aside * step[:, 0], heading, motion, key
        )

    def known(
        self, pose: tuple[Scalar, Scalar, Scalar], key: jax.Array, particles: int, motion: Estimate
    ) -> Cloud:
        """Particles around a pose, with standard deviations of 5 cm and 2°."""
        key, own = jax.random.split(key)
        dtype = self.walls.dtype
        spread = jax.random.normal(own, (3, particles), dtype)
        x, y, heading = (
            jnp.asarray(value, dtype) + deviation * noise
            for value, deviation, noise in zip(pose, (0.05, 0.05, 0.035), spread, strict=True)
        )
        return self.memory(x, y, heading, motion, key)

    def memory(
        self, x: jax.Array, y: jax.Array, heading: jax.Array, motion: Estimate, key: jax.Array
    ) -> Cloud:
        """Particles of equal weight."""
        ticks = tuple(np.int32(0) for _ in self.sonar.mounts)
        weight = jnp.full_like(x, -math.log(len(x)))
        return Cloud(x, y, heading, weight, motion, ticks, key)

    def update(self, memory: Cloud, sonar: tuple[Reading, ...], now: Estimate, h: Scalar) -> Cloud:
        """The cloud after h seconds: moved with the velocity filter, weighted by new readings."""
        key, move_key, draw_key = jax.random.split(memory.key, 3)
        x, y, heading = self.moved(memory, now, h, move_key)
        fresh = [r.tick > tick for r, tick in zip(sonar, memory.ticks, strict=True)]
        expected = self.expected(x, y, heading)
        weight = memory.weight
        # A standing car hears the same error again and again. So a ping counts by the way driven.
        speed = jnp.sqrt(now.vx**2 + now.vy**2) + 0.2 * jnp.abs(now.yaw_rate)
        news = jnp.clip(h * speed / NEWS, 0.01, 1.0)
        for reading, is_new, distance in zip(sonar, fresh, expected, strict=True):
            weight = weight + jnp.where(is_new, news * self.likelihood(reading, distance), 0.0)
        weight = weight - jax.scipy.special.logsumexp(weight)
        effective = 1 / jnp.sum(jnp.exp(2 * weight))
        drawn = self.resampled(x, y, heading, weight, draw_key)
        poor = effective < HALF * len(x)
        x, y, heading, weight = (
            jnp.where(poor, new, old)
            for new, old in zip(drawn, (x, y, heading, weight), strict=True)
        )
        ticks = tuple(
            jnp.maximum(r.tick, tick) for r, tick in zip(sonar, memory.ticks, strict=True)
        )
        return Cloud(x, y, heading, weight, now, ticks, key)

    def moved(
        self, memory: Cloud, now: Estimate, h: Scalar, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The particles after a step: its mean velocity, its turn, and noise for both."""
        before, root = memory.motion, jnp.sqrt(h)
        covariance = now.velocity_covariance
        ahead, aside, turn = jax.random.normal(key, (3, len(memory.x)), memory.x.dtype)
        forward = h * (before.vx + now.vx) / 2 + ahead * (
            WALKS[0] * root + h * jnp.sqrt(covariance.xx)
        )
        left = h * (before.vy + now.vy) / 2 + aside * (
            WALKS[1] * root + h * jnp.sqrt(covariance.yy)
        )
        turned = now.heading - before.heading
        middle = memory.heading + turned / 2
        cosine, sine = jnp.cos(middle), jnp.sin(middle)
        return (
            memory.x + cosine * forward - sine * left,
            memory.y + sine * forward + cosine * left,
            memory.heading + turned + WALKS[2] * root * turn,
        )

    def expected(self, x: jax.Array, y: jax.Array, heading: jax.Array) -> list[jax.Array]:
        """(particles,) for each sonar: distance of the nearest wall that returns an echo, or inf.

        The nearest point of each wall within the cone counts. This is the foot of the perpendicular
        if it is inside, else the cut with an edge of the cone. Points beyond the largest
        obliqueness do not count. No other wall can hide the nearest of these points, except one: if
        only the end of a wall is in sight, the wall that it meets there may hide it. A hidden point
        does not count.
        """
        met = _met(self.walls)
        cosine, sine = jnp.cos(heading), jnp.sin(heading)
        return [
            _nearest(
                self.sonar,
                self.walls,
                met,
                x + cosine * mount.x - sine * mount.y,
                y + sine * mount.x + cosine * mount.y,
                heading + mount.angle,
            )
            for mount in self.sonar.mounts
        ]

    def likelihood(self, reading: Reading, expected: jax.Array) -> jax.Array:
        """Logarithm of a reading's likelihood: of the wall, or (`MISSED`) of anything else."""
        reach = self.sonar.reach
        seen, far = jnp.isfinite(reading.value), ~(expected <= reach)
        error = jnp.where(seen & ~far, (reading.value - expected) / HIT, 0.0)
        wall = jnp.exp(-(error**2) / 2) / (HIT * math.sqrt(2 * math.pi))
        hit = jnp.where(seen, jnp.where(far, 0.0, wall), jnp.where(far, 1.0, 0.0) / HIT)
        return jnp.log((1 - MISSED) * hit + MISSED / reach)

    def resampled(
        self, x: jax.Array, y: jax.Array, heading: jax.Array, weight: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, ...]:
        """Systematic resampling. Children are near their parents, and of equal weight."""
        start_key, rough_key = jax.random.split(key)
        count = len(x)
        total = jnp.cumsum(jnp.exp(weight))
        comb = (jnp.arange(count) + jax.random.uniform(start_key, (), x.dtype)) / count
        parent = jnp.minimum(jnp.searchsorted(total, comb * total[-1]), count - 1)
        noise = jax.random.normal(rough_key, (3, count), x.dtype)
        children = (
            value[parent] + (deviation + WIDER * jnp.std(value[parent])) * n
            for value, deviation, n in zip((x, y, heading), ROUGH, noise, strict=True)
        )
        return (*children, jnp.full_like(weight, -math.log(count)))


def best(memory: Cloud) -> Pose:
    """The heaviest hypothesis: the particles `NEAR` the one with the most weight around it.

    Only the 64 heaviest particles are candidates for its centre.
    """
    weight = jnp.exp(memory.weight)
    tops = jax.lax.top_k(memory.weight, min(64, len(weight)))[1]

    def around(i: Scalar) -> jax.Array:
        away = (memory.x - memory.x[i]) ** 2 + (memory.y - memory.y[i]) ** 2
        aligned = jnp.cos(memory.heading - memory.heading[i]) > math.cos(NEAR[1])
        return jnp.where((away < NEAR[0] ** 2) & aligned, weight, 0.0)

    masses = jax.vmap(lambda i: jnp.sum(around(i)))(tops)
    share = jnp.max(masses)
    centre = tops[jnp.argmax(masses)]
    part = around(centre) / share
    x, y = jnp.sum(part * memory.x), jnp.sum(part * memory.y)
    # Headings are not wrapped: those of one hypothesis may be whole turns apart.
    off = memory.heading - memory.heading[centre]
    off = jnp.arctan2(jnp.sin(off), jnp.cos(off))
    heading = memory.heading[centre] + jnp.sum(part * off)
    dx, dy, dh = memory.x - x, memory.y - y, off - jnp.sum(part * off)
    covariance = Symmetric(
        *(jnp.sum(part * a * b) for a, b in ((dx, dx), (dy, dy), (dh, dh))),
        *(jnp.sum(part * a * b) for a, b in ((dx, dy), (dx, dh), (dy, dh))),
    )
    return Pose(x, y, heading, covariance, share)


@pytree
class PoseEstimator:
    """The particle filter beside the velocity filter, as an `Estimator`, from a known start."""

    moving: VelocityFilter
    place: PoseFilter
    name = "pose"
    takes_truth = False
    period = VelocityFilter.period

    @property
    def every(self) -> int:
        """The least number of ticks between two steps of the cloud."""
        return max(1, round(PERIOD / self.moving.dt))

    def init(self, key: jax.Array) -> tuple[VelocityMemory, Located]:
        """At rest, with the cloud around the start."""
        memory = self.moving.init(key)
        known = self.moving.estimate(memory)
        cloud = self.place.known(self.moving.start, key, PARTICLES, known)
        return memory, Located(cloud, best(cloud), jnp.int32(-self.every))

    def update(
        self,
        memory: tuple[VelocityMemory, Located],
        readings: Readings,
        command: Command,
        tick: Scalar,
    ) -> tuple[VelocityMemory, Located]:
        """Both filters at `tick`; the cloud steps when it is due."""
        moves = self.moving.update(memory[0], readings, command, tick)
        known = self.moving.estimate(moves)

        since = tick - memory[1].tick

        def step(place: Located) -> Located:
            h = self.moving.dt * since.astype(place.cloud.x.dtype)
            cloud = self.place.update(place.cloud, readings.sonar, known, h)
            return Located(cloud, best(cloud), tick)

        place = jax.lax.cond(shared(since >= self.every), step, lambda same: same, memory[1])
        return moves, place

    def estimate(self, memory: tuple[VelocityMemory, Located]) -> Estimate:
        """The velocity filter's estimate, with the pose of the best hypothesis."""
        return located(memory[1], self.moving.estimate(memory[0]))


def located(memory: Located, now: Estimate) -> Estimate:
    """The estimate `now`, with the cloud's pose moved on since the cloud's last step."""
    pose, then = memory.pose, memory.cloud.motion
    off = pose.heading - then.heading
    cosine, sine = jnp.cos(off), jnp.sin(off)
    dx, dy = now.x - then.x, now.y - then.y
    return now._replace(
        x=pose.x + cosine * dx - sine * dy,
        y=pose.y + sine * dx + cosine * dy,
        heading=now.heading + off,
        pose_covariance=pose.covariance,
    )


def _met(walls: jax.Array) -> jax.Array:
    """(2, n, 2): vector along the wall that meets each wall's start and end; zeros without."""
    starts, stops = walls[:, :2], walls[:, 2:]
    ends, others = jnp.concatenate([starts, stops]), jnp.concatenate([stops, starts])
    apart = jnp.sum((ends[:, None] - ends) ** 2, axis=-1)
    meets = (apart < MERGED**2) & ~jnp.eye(len(ends), dtype=bool)
    way = jnp.where(meets[..., None], others - ends, 0.0).sum(axis=1)
    return jnp.reshape(way, (2, -1, 2))


def _nearest(
    sonar: Sonar,
    walls: jax.Array,
    met: jax.Array,
    x: jax.Array,
    y: jax.Array,
    bearing: jax.Array,
) -> jax.Array:
    """(particles,): distance of the nearest point of all walls within the cone, or inf."""
    ax, ay, bx, by = (walls[:, i] - at[:, None] for i, at in enumerate((x, y, x, y)))
    length = jnp.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + 1e-18)
    ux, uy = (bx - ax) / length, (by - ay) / length
    foot = -(ax * ux + ay * uy)
    away = jnp.abs(ax * uy - ay * ux)
    cosine, sine = jnp.cos(bearing)[:, None], jnp.sin(bearing)[:, None]
    nx, ny = ax + foot * ux, ay + foot * uy  # from the sonar to the foot
    slope = jnp.tan(sonar.half_angle)
    oblique = away * jnp.tan(sonar.obliqueness)
    low, high = jnp.maximum(foot - oblique, 0.0), jnp.minimum(foot + oblique, length)
    for side in (1.0, -1.0):
        at_foot = slope * (cosine * nx + sine * ny) + side * (cosine * ny - sine * nx)
        change = slope * (cosine * ux + sine * uy) + side * (cosine * uy - sine * ux)
        root = foot - at_foot / jnp.where(jnp.abs(change) > 1e-9, change, 1e-9)
        low = jnp.where(change > 0, jnp.maximum(low, root), low)
        high = jnp.where(change > 0, high, jnp.minimum(high, root))
    at = jnp.clip(foot, low, high)
    distance = jnp.sqrt(away**2 + (at - foot) ** 2)
    # At an end, the wall met there hides this one if it runs between the sonar and this one.
    shows = low <= high
    for end, sign, (to_x, to_y) in (
        (at <= 0.0, 1.0, (-ax, -ay)),
        (at >= length, -1.0, (-ax - length * ux, -ay - length * uy)),
    ):
        way_x, way_y = met[0 if sign > 0 else 1].T
        before = to_x * way_y - to_y * way_x
        behind = sign * (way_x * uy - way_y * ux)
        turn = sign * (to_x * uy - to_y * ux)
        shows = shows & ~(end & (before * behind > 0) & (before * turn > 0))
    return jnp.min(jnp.where(shows, distance, jnp.inf), axis=1)
