"""The car's offset and angle in its corridor: a Kalman filter on the side sonars.

The states are the offset from the corridor's middle (m, to the left), the angle of the car to it
(rad, to the left) and the gyroscope's bias (rad/s). Speed and gyroscope predict them, and so
include the response to steering. Each side sonar measures the distance of its wall. No sonar
measures the angle, but its readings over a distance driven do. They correct the heading's slow
drift.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Lidar
from countersteer.car.parameter import pytree
from countersteer.estimation import lidar_walls
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.kalman import Covariance, correct, diagonal, entry, predict
from countersteer.signals import Reading, Scalar

OFFSET, ANGLE, BIAS = range(3)
START = (0.1, 0.05, 0.005)  # standard deviations at the start: m, rad, rad/s
WALKS = (0.02, 0.02, 0.001)  # their random walks, per root second
TURNING = 1.0  # rad/s of yaw rate, from which sonars are ignored: a wall may be a corner's
STEEPEST = math.radians(20)  # angle to the walls beyond which sonars are ignored
SCANNED = math.radians(35)  # the same of a lidar's beams
NEAREST = 0.08  # m; the middle of a car cannot be nearer to a wall
CARRIED = 0.1  # m: standard deviation of an offset that is known from before a corner
COARSE = 0.05  # m: additional error of a reading while the offset is hardly known
REPEATS = 16  # equal readings after which a sonar counts as stuck
GATE = 3.5  # standard deviations beyond which a reading is not of the wall
FORGETS = 0.5  # s without an accepted reading, after which the offset's variance grows
ROUNDING = 2e-5  # s, rounding error of a time in 32 bits
CURVES = 0.03  # rad/m: standard deviation of the walls' curvature on a nominal straight


class WallAngleMemory(NamedTuple):
    """The filter between two steps."""

    mean: tuple[Scalar, ...]
    covariance: Covariance
    time: Scalar
    heading: Scalar  # the velocity filter's, at that time
    believed: Scalar  # time of the last accepted reading
    last: tuple[Scalar, ...]  # last reading of each side sonar, m
    repeats: tuple[Scalar, ...]  # equal readings in a row before it

    @property
    def offset(self) -> Scalar:
        """Offset from the corridor's middle, to the left (m)."""
        return self.mean[OFFSET]

    @property
    def angle(self) -> Scalar:
        """Angle of the car to the corridor, to the left (rad)."""
        return self.mean[ANGLE]

    @property
    def offset_deviation(self) -> Scalar:
        """Standard deviation of the offset (m)."""
        return jnp.sqrt(entry(self.covariance, OFFSET, OFFSET))

    @property
    def angle_deviation(self) -> Scalar:
        """Standard deviation of the angle (rad)."""
        return jnp.sqrt(entry(self.covariance, ANGLE, ANGLE))


@pytree
class WallAngle:
    """The filter for a car's side sonars in a corridor.

    `sides` is 1 for a sonar that looks left, -1 for one that looks right, in the order of `mounts`.
    """

    width: Scalar  # of the corridor, m
    xs: tuple[Scalar, ...]  # where the side sonars sit, m
    ys: tuple[Scalar, ...]
    noise: Scalar  # of a distance, m
    resolution: Scalar
    mounts: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    sides: tuple[float, ...] = dataclasses.field(metadata={"static": True})
    lidar: Lidar | None = None  # if the car has one, its beams are used too

    def initial_memory(
        self,
        offset: float = 0.0,
        angle: float = 0.0,
        heading: float = 0.0,
        dtype: type = np.float64,
    ) -> WallAngleMemory:
        """At the start of a straight."""
        none = tuple(0.0 for _ in self.mounts)
        return jax.tree.map(
            lambda value: jnp.asarray(value, dtype),
            WallAngleMemory((offset, angle, 0.0), diagonal(START), 0.0, heading, 0.0, none, none),
        )

    def turned(
        self,
        memory: WallAngleMemory,
        angle: Scalar,
        doubt: Scalar = 0.03,
        offset: Scalar | None = None,
    ) -> WallAngleMemory:
        """The memory in the corridor after a corner of this angle.

        `doubt` is what the corner adds to the angle's standard deviation (rad). `offset` (m) is
        that in the new corridor, if it is known.
        """
        bias = entry(memory.covariance, BIAS, BIAS)
        steep = entry(memory.covariance, ANGLE, ANGLE)
        spread = self.width / 4 if offset is None else CARRIED
        covariance = diagonal([spread, jnp.sqrt(steep) + doubt, jnp.sqrt(bias)])
        mean = (0.0 * angle if offset is None else offset, memory.angle - angle, memory.mean[BIAS])
        return memory._replace(mean=mean, covariance=covariance)

    def update(
        self,
        memory: WallAngleMemory,
        sonar: Sequence[Reading | Any],
        ages: tuple[Scalar, ...],
        estimate: Estimate,
        time: Scalar,
        scan: Reading | Any | None = None,
        scan_age: Scalar = math.inf,
    ) -> WallAngleMemory:
        """The memory after the new readings: those whose age (s) is less than the step.

        A sonar at (x, y) measures the distance d of the nearest point of its wall. So
        side (w/2 - d) = offset + x sin(angle) + y cos(angle), if that point is within the cone.
        """
        h = time - memory.time
        turned = estimate.heading - memory.heading
        offset, angle, bias = memory.mean
        halfway = angle + (turned - h * bias) / 2
        cosine, sine = jnp.cos(halfway), jnp.sin(halfway)
        vx, vy = estimate.vx, estimate.vy
        mean = (offset + h * (vx * sine + vy * cosine), angle + turned - h * bias, bias)
        speeds = estimate.velocity_covariance
        covariance = predict(
            memory.covariance,
            {OFFSET: {ANGLE: h * (vx * cosine - vy * sine)}, ANGLE: {BIAS: -h}},
            {
                OFFSET: WALKS[0] ** 2 * h + 0.2 * h * (speeds.yy + speeds.xx * sine**2),
                ANGLE: WALKS[1] ** 2 * h + (CURVES * vx * h) ** 2,
                BIAS: WALKS[2] ** 2 * h,
            },
        )
        believed, last, repeats = memory.believed, [], []
        for i, (mount, side) in enumerate(zip(self.mounts, self.sides, strict=True)):
            x, y = self.xs[i], self.ys[i]
            fresh = ages[mount] < h - ROUNDING
            same = sonar[mount].value == memory.last[i]
            repeats.append(
                jnp.where(fresh, jnp.where(same, memory.repeats[i] + 1, 0.0), memory.repeats[i])
            )
            last.append(jnp.where(fresh, sonar[mount].value, memory.last[i]))
            vague = entry(covariance, OFFSET, OFFSET) > (2 * COARSE) ** 2
            cosine, sine = jnp.cos(mean[ANGLE]), jnp.sin(mean[ANGLE])
            seen = side * (self.width / 2 - sonar[mount].value)
            mean, covariance, accepted = correct(
                mean,
                covariance,
                {OFFSET: 1.0, ANGLE: x * cosine - y * sine},
                seen - (mean[OFFSET] + x * sine + y * cosine),
                self.noise**2 + self.resolution**2 / 12 + jnp.where(vague, COARSE**2, 1e-8),
                fresh
                & (repeats[i] < REPEATS)
                & (jnp.abs(seen) < self.width / 2 - NEAREST)  # false for inf and NaN too
                & (jnp.abs(mean[ANGLE]) < STEEPEST)
                & (jnp.abs(estimate.yaw_rate) < TURNING),
                GATE,
            )
            believed = jnp.where(accepted, time, believed)
        if self.lidar is not None and scan is not None:
            mean, covariance, accepted = lidar_walls.line_up(
                self.lidar,
                self.width,
                mean,
                covariance,
                scan.value,
                (scan_age < h - ROUNDING) & (jnp.abs(mean[ANGLE]) < SCANNED),
                GATE,
            )
            believed = jnp.where(accepted, time, believed)
        # Long without an accepted reading: raise the variance, so that not all are rejected.
        lost = jnp.where(time - believed > FORGETS, (0.3 * self.width) ** 2 * h, 0.0)
        covariance = predict(covariance, {}, {OFFSET: lost})
        return WallAngleMemory(
            mean, covariance, time, estimate.heading, believed, tuple(last), tuple(repeats)
        )


def wall_angle(car: Car, width: float) -> WallAngle:
    """The filter for the nominal car's sonars that look to a side, within 30° of square."""
    sonar = car.sensors.sonar
    found = [
        (number, math.copysign(1.0, float(mount.angle)), mount)
        for number, mount in enumerate(sonar.mounts)
        if abs(abs(float(mount.angle)) - math.pi / 2) < math.radians(30)
    ]
    return WallAngle(
        width=width,
        xs=tuple(mount.x for _, _, mount in found),
        ys=tuple(mount.y for _, _, mount in found),
        noise=sonar.noise,
        resolution=sonar.resolution,
        mounts=tuple(number for number, _, _ in found),
        sides=tuple(side for _, side, _ in found),
        lidar=car.sensors.lidar if car.sensors.lidar.beams else None,
    )
