"""Grids over a car's state: dimensions with range and step, and simplex interpolation on them.

A state is a pose and a motion. Each has a grid of its own, so a table is a matrix: a row for each
motion, a column for each pose. The floor is the same everywhere, so how a car moves depends on its
motion alone. That is why the table of transitions is small.
"""

import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.signals import Scalar

MOST_POINTS = 200  # of a dimension
MOST_STATES = 30_000_000


class Kind(NamedTuple):
    """A quantity that can be a dimension. SI units and radians."""

    name: str  # at the edges, with its unit
    low: float
    high: float
    meaning: str
    pose: bool = False
    factor: float = 1.0  # from the unit of the edges

    @property
    def word(self) -> str:
        """The name without its unit."""
        return self.name.rpartition("_")[0]


DEGREE = math.pi / 180
KINDS = (
    Kind("x_m", 0.0, 0.0, "centre of mass; the course's own range", True),
    Kind("y_m", 0.0, 0.0, "centre of mass; the course's own range", True),
    Kind("place_m", 0.0, 0.0, "along the course; wraps at a lap, or at its repeated part", True),
    Kind("offset_m", 0.0, 0.0, "left of the course's middle; the corridor's range", True),
    Kind("heading_deg", -math.pi, math.pi, "off the course, or off east", True, DEGREE),
    Kind("speed_mps", 0.0, 3.25, "of the centre of mass"),
    Kind("vx_mps", 0.0, 3.0, "forward velocity"),
    Kind("vy_mps", -1.5, 1.5, "velocity to the left"),
    Kind("sideslip_deg", -math.pi / 3, math.pi / 3, "atan2(vy, vx)", False, DEGREE),
    Kind("yaw_rate_degps", -7.0, 7.0, "yaw rate", False, DEGREE),
    Kind("steering_deg", -math.radians(28), math.radians(28), "front wheels", False, DEGREE),
)
BY_NAME = {kind.name: kind for kind in KINDS}


class Dimension(NamedTuple):
    """Points at equal distances. Where it wraps, the last point is the first again."""

    name: str  # with the unit of the edges
    low: float
    high: float
    points: int
    wraps: bool = False

    @property
    def word(self) -> str:
        """The name without its unit."""
        return BY_NAME[self.name].word

    @property
    def step(self) -> float:
        """From a point to the next."""
        return (self.high - self.low) / (self.points - 1)

    @property
    def values(self) -> np.ndarray:
        """The points."""
        return np.linspace(self.low, self.high, self.points)


class Grid(NamedTuple):
    """Dimensions; the last one varies fastest."""

    dimensions: tuple[Dimension, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Points of each dimension."""
        return tuple(d.points for d in self.dimensions)

    @property
    def size(self) -> int:
        """Points of the grid."""
        return math.prod(self.shape)

    @property
    def strides(self) -> tuple[int, ...]:
        """Indices between neighbours in each dimension."""
        return tuple(math.prod(self.shape[i + 1 :]) for i in range(len(self.shape)))

    def nodes(self) -> dict[str, np.ndarray]:
        """The values (size,) of each dimension at the grid's points, by word."""
        mesh = np.meshgrid(*(d.values for d in self.dimensions), indexing="ij")
        return {d.word: m.ravel() for d, m in zip(self.dimensions, mesh, strict=True)}

    def locate(self, values: Mapping[str, Scalar]) -> tuple[Scalar, list[Scalar]]:
        """The lowest corner of the cell around a point, and the part of the cell passed in each.

        Dimensions that wrap do; others end at their ranges.
        """
        base: Any = 0
        parts = []
        for d, stride in zip(self.dimensions, self.strides, strict=True):
            at = (values[d.word] - d.low) / d.step
            if d.wraps:
                at = jnp.mod(at, d.points - 1)
            at = jnp.clip(at, 0.0, d.points - 1 - 1e-4)
            whole = jnp.floor(at)
            base = base + stride * whole.astype(jnp.int32)
            parts.append(at - whole)
        return base, parts

    def inside(self, values: dict[str, Scalar]) -> Scalar:
        """Whether a point is within the ranges of all dimensions that do not wrap."""
        found: Any = True
        for d in self.dimensions:
            if not d.wraps:
                value = values[d.word]
                found = found & (value >= d.low - 1e-4) & (value <= d.high + 1e-4)
        return found

    def simplex(self, base: Scalar, parts: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """The corners around a point, and their weights: n + 1 each for n dimensions.

        The corners are those of the simplex of Kuhn's triangulation that holds the point. From the
        lowest corner one goes along each dimension in turn, the one with the largest part first.
        The weights are the differences of the sorted parts.
        """
        count = len(parts)
        # The rank of each part; of equal ones the first comes first.
        ranks = [
            sum(
                jnp.where(parts[j] > parts[i] if j > i else parts[j] >= parts[i], 1, 0)
                for j in range(count)
                if j != i
            )
            if count > 1
            else jnp.zeros_like(base)
            for i in range(count)
        ]
        ordered = [
            sum(jnp.where(ranks[i] == k, parts[i], 0.0) for i in range(count)) for k in range(count)
        ]
        steps = [
            sum(jnp.where(ranks[i] == k, self.strides[i], 0) for i in range(count))
            for k in range(count)
        ]
        corners = list(itertools.accumulate(steps, initial=base))
        edges = [1.0, *ordered, 0.0]
        return corners, [edges[k] - edges[k + 1] for k in range(count + 1)]


class Table(NamedTuple):
    """The two grids of a table (motions, poses)."""

    pose: Grid
    motion: Grid

    @property
    def size(self) -> int:
        """The number of states."""
        return self.pose.size * self.motion.size
