"""Observers beside the judge of trials: for errors of the estimates, and for the pose.

Each is a `trials.Watch`. It keeps sums instead of records, so that thousands of trials fit.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer import random_streams
from countersteer.batch.trials import Instant
from countersteer.car.car import Sonar
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.position import Legs
from countersteer.drivers.drift_turn import STRAIGHT
from countersteer.estimation import dead_reckoning, pose, spikes
from countersteer.estimation.estimate import Estimate
from countersteer.random_streams import Stream
from countersteer.signals import Array, Scalar
from countersteer.simulator import heard
from countersteer.task.judge import PERIOD
from countersteer.world.chassis import Vector, dot, solve

SLIPS = math.radians(10)  # sideslip; above it, the car drifts
FASTER = 0.5  # m/s; below it, sideslip has no meaning
WARM = 0.5  # s after the start that are left out
SAMPLE, SAMPLES = 20, 240  # looks between two samples of the normalised error; number of samples
FIT = 0.05  # m; a ping closer to the expected wall is of that wall
PARTICLES = 2000
SETTLED = (0.3, math.radians(15))  # m and rad, largest error of a settled pose


class Kept(NamedTuple):
    """Sums over the looks at a trial, and the memory for the next look."""

    drifting: Scalar  # looks in drifts
    slip: Scalar  # squared errors of the sideslip in them
    reckoned: Scalar  # the same of dead reckoning
    looks: Scalar
    inside: Scalar  # looks with errors inside the covariance's 95 %
    alone: tuple[Scalar, ...]  # squared errors of vx, vy, yaw rate over each one's variance
    squares: Array  # (SAMPLES,) normalised error squared of vx, vy, yaw rate; NaN: none
    straight: Scalar  # looks on straights
    offset_error: Scalar  # squared, of the driver's offset and angle to its corridor
    angle_error: Scalar
    offset_normal: Scalar  # squared over their variance
    angle_normal: Scalar
    offset: Scalar  # squared, of the car
    angle: Scalar
    pings: Scalar  # of the front sonar from the expected wall
    alarms: Scalar  # these pings, if `spikes` takes them for spikes
    doubts: Scalar  # the same, if the driver doubts them
    strays: Scalar  # front pings shorter than to the expected wall
    passed: Scalar  # strays that `spikes` believes
    estimate: Estimate  # the last
    charge: Scalar
    reckoning: dead_reckoning.ReckoningMemory
    spike: spikes.SpikeMemory
    sound: Scalar  # 1 if the last look had a ping from the expected wall


@pytree
class Errors:
    """Errors of the driver's estimates, in a loop whose estimator is the velocity filter."""

    legs: Legs
    sonar: Sonar  # the nominal car's
    inside: Scalar  # 95 % of a chi-squared distribution with three degrees of freedom

    def begin(self, now: Instant) -> Kept:
        """An empty record."""
        m = now.simulator.world.motion(now.loop.state)
        dtype = jnp.result_type(m.x)
        zero = jnp.zeros((), dtype)
        told = jax.tree.map(lambda _: zero, Estimate(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        none: list[Any] = [zero] * len(Kept._fields)
        return Kept(*none)._replace(
            alone=(zero,) * 3,
            squares=jnp.full(SAMPLES, jnp.nan, dtype),
            estimate=told,
            reckoning=dead_reckoning.initial_memory((m.x, m.y, m.heading), dtype),
            spike=spikes.initial_memory(np.dtype(dtype)),
        )

    def look(self, now: Instant, kept: Kept) -> Kept:
        """The record with one more instant."""
        motion, dt = now.simulator.world.motion(now.loop.state), now.simulator.dt
        _, seen = now.pilot.observe(now.memory, heard(now.simulator, now.loop), now.loop.tick)
        told = jax.tree.map(lambda value: jnp.asarray(value, motion.charge.dtype), seen.estimate)
        time = seen.time
        warm = time > WARM

        slip = jnp.arctan2(motion.vy, motion.vx)
        fast = motion.vx**2 + motion.vy**2 > FASTER**2
        drifts = jnp.where(warm & fast & (jnp.abs(slip) > SLIPS), 1.0, 0.0)
        reckoning = dead_reckoning.update(kept.reckoning, now.loop.readings, dt)

        def square(other: Estimate) -> Scalar:
            off = other.sideslip - slip
            return jnp.arctan2(jnp.sin(off), jnp.cos(off)) ** 2

        off = Vector(told.vx - motion.vx, told.vy - motion.vy, told.yaw_rate - motion.yaw_rate)
        normal = dot(off, solve(told.velocity_covariance, off))
        looked = jnp.where(warm, 1.0, 0.0)
        number = now.loop.tick // round(PERIOD / dt)
        place = jnp.minimum(number // SAMPLE, SAMPLES - 1)
        fills = warm & (number % SAMPLE == 0)
        squares = kept.squares.at[place].set(jnp.where(fills, normal, kept.squares[place]))

        own = now.pilot.status(now.memory)
        _, offset, angle = self.legs.seen(jnp.asarray(own.turn), motion.x, motion.y, motion.heading)
        goes_on = own.phase == STRAIGHT
        straight = jnp.where(warm & goes_on & (jnp.abs(angle) < 0.3), 1.0, 0.0)
        offset_error, angle_error = (own.offset - offset) ** 2, (own.angle - angle) ** 2
        variances = (own.offset_deviation**2, own.angle_deviation**2)

        front = now.loop.readings.sonar[0]
        expected = pose.PoseFilter(walls=now.simulator.walls, sonar=self.sonar).expected(
            *(jnp.reshape(value, (1,)) for value in (motion.x, motion.y, motion.heading))
        )[0][0]
        came = (front.tick > kept.spike.tick) & jnp.isfinite(front.value) & warm
        fits = jnp.abs(front.value - expected) < FIT
        sound, stray = came & fits, came & (front.value < expected - FIT)
        speed = jnp.sqrt(motion.vx**2 + motion.vy**2)
        spike = spikes.update(kept.spike, front, PERIOD * speed, self.sonar.noise)
        held = spike.believed != front.value
        # By now the driver has received the ping of the last look.
        doubted = (kept.sound > 0) & (own.doubts > 0) & goes_on

        one = lambda true: jnp.where(true, 1.0, 0.0)  # noqa: E731  # used five times
        return Kept(
            kept.drifting + drifts,
            kept.slip + drifts * square(told),
            kept.reckoned + drifts * square(reckoning.estimate),
            kept.looks + looked,
            kept.inside + looked * (normal < self.inside),
            tuple(
                sum_ + looked * error**2 / variance
                for sum_, error, variance in zip(
                    kept.alone, off, told.velocity_covariance[:3], strict=True
                )
            ),
            squares,
            kept.straight + straight,
            kept.offset_error + straight * offset_error,
            kept.angle_error + straight * angle_error,
            kept.offset_normal + straight * offset_error / variances[0],
            kept.angle_normal + straight * angle_error / variances[1],
            kept.offset + straight * offset**2,
            kept.angle + straight * angle**2,
            kept.pings + one(sound),
            kept.alarms + one(sound & held),
            kept.doubts + one(doubted),
            kept.strays + one(stray),
            kept.passed + one(stray & ~held),
            told,
            motion.charge,
            reckoning,
            spike,
            one(sound),
        )

    def end(self, kept: Kept) -> Kept:
        """The whole record."""
        return kept


class Placed(NamedTuple):
    """Distances of the pose filter's best hypothesis from each of the places that look alike."""

    distance: Array  # (places,) m, at the end of the second turn
    angle: Array  # (places,) rad
    share: Scalar  # of the hypothesis in the weight
    settled_at: Scalar  # s, start of the last settled time; inf: not settled


@pytree
class Places:
    """A pose filter that starts from anywhere on the course, beside the loop.

    `turns` holds the angles of rotation about `middle` that map the course onto itself.
    """

    place: pose.PoseFilter
    uniform: tuple[Array, Array, Array]  # many x, y, headings, from which each trial draws its own
    middle: Array  # (2,)
    turns: Array  # (places,) rad
    particles: int = dataclasses.field(default=PARTICLES, metadata={"static": True})

    def begin(self, now: Instant) -> tuple[pose.Cloud, Placed]:
        """A cloud anywhere on the course, with noise of its own for each trial."""
        motion = now.simulator.world.motion(now.loop.state)
        zero = jnp.zeros_like(motion.x)
        still = Estimate(zero, zero, motion.heading, zero, zero, zero)
        key, own = jax.random.split(random_streams.key(now.simulator.root, Stream.WATCH))
        none = jnp.full_like(self.turns, jnp.inf)
        still = still._replace(heading=now.pilot.estimator.estimate(now.memory.estimate).heading)
        picked = jax.random.randint(own, (self.particles,), 0, len(self.uniform[0]))
        x, y, heading = (jnp.asarray(value)[picked] for value in self.uniform)
        cloud = self.place.memory(x, y, heading, _slim(still), key)
        return cloud, Placed(none, none, zero, zero + jnp.inf)

    def look(self, now: Instant, kept: tuple[pose.Cloud, Placed]) -> tuple[pose.Cloud, Placed]:
        """The record with one more instant. The cloud steps at its own period."""
        every = round(pose.PERIOD / now.simulator.dt)

        def step(kept: tuple[pose.Cloud, Placed]) -> tuple[pose.Cloud, Placed]:
            cloud, placed = kept
            _, seen = now.pilot.observe(now.memory, heard(now.simulator, now.loop), now.loop.tick)
            cloud = self.place.update(
                cloud, now.loop.readings.sonar, _slim(seen.estimate), pose.PERIOD
            )
            best = pose.best(cloud)
            motion = now.simulator.world.motion(now.loop.state)
            cosine, sine = jnp.cos(self.turns), jnp.sin(self.turns)
            dx, dy = motion.x - self.middle[0], motion.y - self.middle[1]
            x = self.middle[0] + cosine * dx - sine * dy
            y = self.middle[1] + sine * dx + cosine * dy
            distance = jnp.hypot(best.x - x, best.y - y)
            off = best.heading - motion.heading - self.turns
            angle = jnp.abs(jnp.arctan2(jnp.sin(off), jnp.cos(off)))
            good = jnp.any((distance < SETTLED[0]) & (angle < SETTLED[1]))
            since = jnp.where(good, jnp.minimum(placed.settled_at, seen.time), jnp.inf)
            open_yet = jnp.isinf(now.score.turns.end[1])
            found = Placed(distance, angle, best.share, since)
            return cloud, jax.tree.map(lambda a, b: jnp.where(open_yet, a, b), found, placed)

        return jax.lax.cond(now.loop.tick % every == 0, step, lambda same: same, kept)

    def end(self, kept: tuple[pose.Cloud, Placed]) -> Placed:
        """The result, without the cloud."""
        return kept[1]


def _slim(estimate: Estimate) -> Estimate:
    """The fields that the pose filter needs, all of one type."""
    dtype = jnp.result_type(estimate.x)
    slim = Estimate(*estimate[:6])._replace(velocity_covariance=estimate.velocity_covariance)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), slim)


def anywhere(course: Course, place: pose.PoseFilter, count: int) -> tuple[Array, Array, Array]:
    """Poses drawn evenly from the corridor, for `Places.uniform`."""
    zero = jnp.zeros((), place.walls.dtype)
    still = jax.tree.map(lambda _: zero, Estimate(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    cloud = place.uniform(course, jax.random.key(0), count, still)
    return np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.heading)
