"""The pilot: all that the car carries. Readings in, command out, on the car's clock.

    readings ──► estimator ──► Estimate ─┐
        └───────────────── ages ─────────┴─► driver ──► command

It knows the nominal car and the course, and never the world: a batch runs it, a real car can.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer import streams
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.drivers.driver import Driver, Heard, Observation, Status, status_of
from countersteer.errors import InputError
from countersteer.estimation.estimator import Estimator
from countersteer.estimation.library import ESTIMATORS
from countersteer.link.link import ONBOARD, Link
from countersteer.signals import Command, Reading, Readings, Scalar
from countersteer.streams import Stream

PYTHON_PERIOD = 0.005  # s between two decisions of a driver in plain Python, unless it has its own


class Memory(NamedTuple):
    """What the pilot carries from one decision to the next."""

    estimate: Any  # the estimator's
    driver: Any
    command: Command  # the last


@pytree
class Pilot:
    """An estimator and a driver with their periods.

    `init` and `act` are pure. A driver that is no pytree is called from Python: `act` then has a
    compiled part of its own, and cannot be traced.
    """

    estimator: Estimator
    driver: Any  # a `Driver`
    dt: float = dataclasses.field(metadata={"static": True})  # s, a tick of the clock
    control: int = dataclasses.field(default=1, metadata={"static": True})  # ticks by decision
    estimating: int = dataclasses.field(default=1, metadata={"static": True})  # by update

    @classmethod
    def of(
        cls,
        driver: Driver,
        course: Course | None,
        nominal: Car,
        estimate: str = "filter",
        link: Link = ONBOARD,
        dt: float = 0.001,
    ) -> "Pilot":
        """For a course and the nominal car, which is all that the pilot knows of the real one.

        `estimate` names one of `estimation.library.ESTIMATORS`.
        """
        return cls.with_estimator(driver, ESTIMATORS[estimate](course, nominal, dt), link, dt)

    @classmethod
    def with_estimator(
        cls, driver: Driver, estimator: Estimator, link: Link = ONBOARD, dt: float = 0.001
    ) -> "Pilot":
        """With an estimator of one's own. Decisions come at the link's pace, or the driver's."""
        period = link.control_period
        if not traceable(driver):
            period = max(period, float(getattr(driver, "period", PYTHON_PERIOD)))
        control = max(1, round(period / dt))
        return cls(
            estimator=estimator,
            driver=driver,
            dt=dt,
            control=control,
            estimating=control * max(1, round(estimator.period / dt / control)),
        )

    @property
    def traced(self) -> bool:
        """Whether JAX can trace it."""
        return traceable(self.driver)

    def typed(self, dtype: Any) -> "Pilot":
        """The same, estimating in a precision."""
        estimator: Estimator = jax.tree.map(np.dtype(dtype).type, self.estimator)
        return dataclasses.replace(self, estimator=estimator)

    def init(self, root: jax.Array) -> Memory:
        """Before the first decision; `root` is the drive's key (`streams.root`)."""
        estimate = self.estimator.init(streams.key(root, Stream.ESTIMATOR))
        memory = self.driver.reset(streams.key(root, Stream.DRIVER))
        dtype = jnp.result_type(self.estimator.estimate(estimate).x)
        if self.traced:
            memory = jax.tree.map(lambda leaf: _typed(leaf, dtype), memory)
        zero = dtype.type(0)
        return Memory(estimate, memory, Command(zero, zero))

    def act(self, memory: Memory, readings: Readings, tick: Scalar) -> tuple[Command, Memory]:
        """The command from this tick on, and the memory after it.

        Raises `InputError` where a driver in Python returns something else than it should.
        """
        if not self.traced:
            return self._called(memory, readings, tick)
        estimate, observation = self.observe(memory, readings, tick)
        command, own = self.driver.act(memory.driver, observation)
        after = Memory(
            estimate,
            jax.tree.map(_like, own, memory.driver),
            jax.tree.map(_like, command, memory.command),
        )
        return after.command, after

    def observe(self, memory: Memory, readings: Readings, tick: Scalar) -> tuple[Any, Observation]:
        """The estimator's memory at this tick, and what the driver is told."""
        told = readings if self.estimator.takes_truth else readings._replace(truth=None)

        def update(estimate: Any) -> Any:
            after = self.estimator.update(estimate, told, memory.command, tick)
            return jax.tree.map(_like, after, estimate)

        estimate = memory.estimate
        if self.estimating == self.control:
            estimate = update(estimate)
        else:
            now = tick % self.estimating == 0
            estimate = jax.lax.cond(now, update, lambda same: same, estimate)
        known = self.estimator.estimate(estimate)
        dtype = jnp.result_type(known.x)

        def heard(reading: Reading) -> Heard:
            age = self.dt * (tick - reading.tick).astype(dtype)
            return Heard(reading.value, jnp.where(reading.tick >= 0, age, jnp.inf))

        ages: Any = jax.tree.map(heard, told[:-1], is_leaf=lambda node: isinstance(node, Reading))
        return estimate, Observation(*(self.dt * tick.astype(dtype), *ages, known))

    def status(self, memory: Memory) -> Status:
        """What the driver says it is about."""
        return status_of(self.driver, memory.driver)

    def _called(self, memory: Memory, readings: Readings, tick: Scalar) -> tuple[Command, Memory]:
        """`act` with a driver in Python."""
        silent = dataclasses.replace(self, driver=None)
        bare = memory._replace(driver=())
        estimate, observation = _observe(silent, bare, readings, jnp.asarray(tick))
        answer = self.driver.act(memory.driver, jax.tree.map(np.asarray, observation))
        command, own = checked(self.driver, answer)
        after = Memory(estimate, own, jax.tree.map(_like, command, memory.command))
        return after.command, after


_observe = jax.jit(Pilot.observe)


def traceable(driver: Any) -> bool:
    """Whether a driver is a pytree, so that JAX can trace it."""
    return not jax.tree_util.all_leaves([driver])


def checked(driver: Any, answer: Any) -> tuple[Command, Any]:
    """What `act` of a driver in Python returned. Raises `InputError` where it is wrong."""
    name = f"{type(driver).__name__}.act"
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise InputError(
            f"{name} must return (Command(throttle, steering), memory), not {answer!r:.60}"
        )
    command, memory = answer
    if not isinstance(command, tuple) or len(command) != 2:
        raise InputError(
            f"{name} must return a Command(throttle, steering) first, not {command!r:.60}"
        )
    for key, value in zip(Command._fields, command, strict=True):
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f"{name}: {key} must be a finite number, not {value!r:.60}")
    return Command(*map(float, command)), memory


def _typed(leaf: Any, dtype: Any) -> Any:
    """A driver's number with a type of its own: that of the car, or a 32-bit integer."""
    if isinstance(leaf, bool | int):
        return np.int32(leaf)
    return dtype.type(leaf) if isinstance(leaf, float) else leaf


def _like(new: Any, old: Any) -> Any:
    """What a driver or an estimator gave, with the type that the loop carries."""
    return jnp.asarray(new, jnp.result_type(old))
