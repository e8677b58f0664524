"""What every estimator is given and gives back, and the one that is told the truth."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.estimation.estimate import Estimate
from countersteer.signals import Command, Motion, Readings, Scalar


class Estimator(Protocol):
    """From readings to an `Estimate`; made for a course and a nominal car, a pytree.

    `period` is the least time between two updates (s); 0: one at each decision of the driver.
    Ground truth (`Readings.truth`) comes only to one that says `takes_truth`.
    """

    name: str  # for records
    takes_truth: bool

    @property
    def period(self) -> float:
        """Least time between two updates (s)."""
        ...

    def init(self, key: jax.Array) -> Any:
        """The memory at the start of a drive; `key` is its own."""
        ...

    def update(self, memory: Any, readings: Readings, command: Command, tick: Scalar) -> Any:
        """The memory at `tick`; `command` is what the driver asked for since the update before."""
        ...

    def estimate(self, memory: Any) -> Estimate:
        """What is believed."""
        ...


@pytree
class Truth:
    """Believes what is so: for drivers of full state, and as a yardstick."""

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
        self, memory: Estimate, readings: Readings, command: Command, tick: Scalar
    ) -> Estimate:
        """The true state, without a covariance. Raises `ValueError` where there is none."""
        del memory, command, tick
        if not isinstance(readings.truth, Motion):
            raise ValueError("the estimator truth needs ground truth: no real car tells it")
        return Estimate(*readings.truth[:6])

    def estimate(self, memory: Estimate) -> Estimate:
        """The same."""
        return memory
