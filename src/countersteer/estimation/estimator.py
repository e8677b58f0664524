"""The interface of estimators, and the one that returns ground truth."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.estimation.estimate import Estimate
from countersteer.signals import AnyCommand, Motion, Readings, Scalar


class Estimator(Protocol):
    """Makes an `Estimate` of readings. It is a pytree, made for a course and a nominal car.

    `period` is the least time between two updates (s); 0: one at each decision of the driver.
    Only an estimator with `takes_truth` receives ground truth (`Readings.truth`).
    """

    name: str  # for records
    takes_truth: bool

    @property
    def period(self) -> float:
        """Least time between two updates (s)."""
        ...

    def init(self, key: jax.Array) -> Any:
        """The memory at the start of a drive. `key` is for this estimator alone."""
        ...

    def update(self, memory: Any, readings: Readings, command: AnyCommand, tick: Scalar) -> Any:
        """The memory at `tick`; `command` is what the driver asked for since the update before."""
        ...

    def estimate(self, memory: Any) -> Estimate:
        """The estimate after the last update."""
        ...


@pytree
class Truth:
    """Returns ground truth: for drivers of full state, and as a yardstick."""

    start: tuple[Scalar, Scalar, Scalar]  # x, y, heading
    name = "truth"
    takes_truth = True
    period = 0.0

    def init(self, key: jax.Array) -> Estimate:
        """At rest at the start."""
        del key
        x, y, heading = map(jnp.asarray, self.start)
        zero = jnp.zeros_like(x)
        return Estimate(x, y, heading, zero, zero, zero)

    def update(
        self, memory: Estimate, readings: Readings, command: AnyCommand, tick: Scalar
    ) -> Estimate:
        """The true state, without a covariance. Raises `ValueError` without ground truth."""
        del memory, command, tick
        if not isinstance(readings.truth, Motion):
            raise ValueError("the estimator truth needs ground truth: no real car tells it")
        return Estimate(*readings.truth[:6])

    def estimate(self, memory: Estimate) -> Estimate:
        """The true state at the last update."""
        return memory
