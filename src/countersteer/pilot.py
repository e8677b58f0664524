"""The pilot: all that the car carries. Readings in, command out, on the car's clock.

    readings ──► estimator ──► Estimate ─┐
        └───────────────── ages ─────────┴─► driver ──► command

It knows the nominal car and the course, but not the world. A batch runs it, and a real car can.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer import random_streams
from countersteer.car.car import Car
from countersteer.car.files import car_from_tables
from countersteer.car.parameter import pytree
from countersteer.course.course import Course
from countersteer.course.files import course_of_run
from countersteer.drivers.driver import Driver, Heard, Observation, Status, status_of
from countersteer.drivers.own import told_in_a_line
from countersteer.drivers.plan import Read
from countersteer.drivers.registry import driver_of_tables
from countersteer.errors import InputError
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.estimator import Estimator
from countersteer.estimation.registry import ESTIMATORS
from countersteer.kept_programs import kept
from countersteer.link.link import LINKS, ONBOARD, Link
from countersteer.random_streams import Stream
from countersteer.reading.values import shown
from countersteer.signals import AnyCommand, Array, Command, Reading, Readings, Scalar, SpeedCommand

PYTHON_PERIOD = 0.005  # s, default time between two decisions of a driver in plain Python


LOCKS = (-math.pi / 2, math.pi / 2)  # rad, range of a steering command


class PilotMemory(NamedTuple):
    """The pilot between two decisions."""

    estimate: Any  # the estimator's
    driver: Any
    command: AnyCommand  # the last


@pytree
class Pilot:
    """An estimator and a driver with their periods.

    `init` and `act` are pure. A driver that is no pytree is called from Python. Then JAX cannot
    trace `act`, and only its estimator is compiled.
    """

    estimator: Estimator
    driver: Any  # a `Driver`
    dt: float = dataclasses.field(metadata={"static": True})  # s, a tick of the clock
    control: int = dataclasses.field(default=1, metadata={"static": True})  # ticks a decision
    estimating: int = dataclasses.field(default=1, metadata={"static": True})  # ticks an update

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
        """For a course and the nominal car. The pilot knows nothing else of the real car.

        `estimate` names one of `estimation.registry.ESTIMATORS`.
        """
        return cls.with_estimator(driver, ESTIMATORS[estimate](course, nominal, dt), link, dt)

    @classmethod
    def with_estimator(
        cls, driver: Driver, estimator: Estimator, link: Link = ONBOARD, dt: float = 0.001
    ) -> "Pilot":
        """With your own estimator. Decisions come at the link's pace, or slower by the driver's.

        Raises `InputError` for a driver that commands speeds over a radio, which sends throttles.
        """
        if not link.onboard and command_type(driver) is SpeedCommand:
            raise InputError(f"the {link.name} sends throttles, and the commands are in m/s")
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
        """The same pilot, with its estimator in this precision."""
        real = np.dtype(dtype).type
        estimator: Estimator = jax.tree.map(
            lambda leaf: real(leaf) if _is_real(leaf) else leaf, self.estimator
        )
        return dataclasses.replace(self, estimator=estimator)

    @property
    def dtype(self) -> Any:
        """The precision of the estimator."""
        reals = [leaf for leaf in jax.tree.leaves(self.estimator) if _is_real(leaf)]
        return np.dtype(getattr(reals[0], "dtype", np.float64) if reals else np.float64)

    def rerun(self, seed: int, readings: Readings, ticks: Array) -> AnyCommand:
        """The commands of its decisions at the ticks (n,), without a car.

        Leaves of `readings` have a leading axis of n. `seed` is the drive's. JAX must be able to
        trace the pilot (`traced`).
        """
        dtype = self.dtype
        with jax.enable_x64(dtype == np.float64):
            told = jax.tree.map(
                lambda leaf: leaf if leaf.dtype.kind == "i" else leaf.astype(dtype), readings
            )
            return jax.tree.map(np.asarray, _rerun(self, random_streams.root(seed), told, ticks))

    def init(self, root: jax.Array) -> PilotMemory:
        """Before the first decision; `root` is the drive's key (`random_streams.root`)."""
        if isinstance(root, jax.core.Tracer):
            return _init(self, root)
        with jax.enable_x64(self.dtype == np.float64):
            return _compiled_init(self, root) if self.traced else _init(self, root)

    def act(
        self, memory: PilotMemory, readings: Readings, tick: Scalar
    ) -> tuple[AnyCommand, PilotMemory]:
        """The command from this tick on, and the memory after it.

        A call from Python runs compiled code. Raises `InputError` if a driver in Python returns a
        wrong value (`checked`).
        """
        if isinstance(tick, jax.core.Tracer):
            return _act(self, memory, readings, tick)
        with jax.enable_x64(self.dtype == np.float64):
            if self.traced:
                return _compiled_act(self, memory, readings, jnp.asarray(tick))
            silent, bare = dataclasses.replace(self, driver=None), memory._replace(driver=())
            estimate, observation = _compiled_observe(silent, bare, readings, jnp.asarray(tick))
            try:
                answer = self.driver.act(memory.driver, jax.tree.map(np.asarray, observation))
            except InputError:
                raise
            except Exception as error:
                where = f"{type(self.driver).__name__}.act at {self.dt * int(tick):.3f} s"
                raise InputError(f"{where}: {told_in_a_line(error)}") from error
            command, own = checked(self.driver, answer)
            command = jax.tree.map(self.dtype.type, bounded(command))
            return command, PilotMemory(estimate, own, command)

    def observe(
        self, memory: PilotMemory, readings: Readings, tick: Scalar
    ) -> tuple[Any, Observation]:
        """The estimator's memory at this tick, and the driver's observation."""
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

    def estimate(self, memory: PilotMemory) -> Estimate:
        """The estimate after the last update. A call from Python runs compiled code."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(memory.estimate)):
            return self.estimator.estimate(memory.estimate)
        with jax.enable_x64(self.dtype == np.float64):
            found = _compiled_estimate(self.estimator, memory.estimate)
            return jax.tree.map(np.asarray, found)

    def status(self, memory: PilotMemory) -> Status:
        """The status that the driver reports."""
        return status_of(self.driver, memory.driver)


def _init(pilot: Pilot, root: jax.Array) -> PilotMemory:
    estimate = pilot.estimator.init(random_streams.key(root, Stream.ESTIMATOR))
    memory = pilot.driver.reset(random_streams.key(root, Stream.DRIVER))
    dtype = jnp.result_type(pilot.estimator.estimate(estimate).x)
    if pilot.traced:
        memory = jax.tree.map(lambda leaf: _typed(leaf, dtype), memory)
    zero = dtype.type(0)
    first = command_type(pilot.driver)(zero, zero)
    return PilotMemory(estimate, memory, first)


def _act(
    pilot: Pilot, memory: PilotMemory, readings: Readings, tick: Scalar
) -> tuple[AnyCommand, PilotMemory]:
    estimate, observation = pilot.observe(memory, readings, tick)
    command, own = pilot.driver.act(memory.driver, observation)
    after = PilotMemory(
        estimate,
        jax.tree.map(_like, own, memory.driver),
        jax.tree.map(_like, bounded(command), memory.command),
    )
    return after.command, after


_compiled_init, _compiled_act = kept()(_init), jax.jit(_act)
_compiled_observe = jax.jit(Pilot.observe)
_compiled_estimate = jax.jit(lambda estimator, memory: estimator.estimate(memory))


@jax.jit
def _rerun(pilot: Pilot, root: jax.Array, readings: Readings, ticks: Array) -> AnyCommand:
    def decide(memory: PilotMemory, now: tuple[Readings, Scalar]) -> tuple[PilotMemory, AnyCommand]:
        command, memory = pilot.act(memory, *now)
        return memory, command

    return jax.lax.scan(decide, pilot.init(root), (readings, ticks))[1]


def pilot_of_run(about: Mapping[str, Any], read: Read) -> Pilot:
    """The pilot of a `run.toml`. `read` reads a `commands.csv` that a plan names.

    Raises `InputError` without a nominal car or a course, for the estimator `truth` or an unknown
    one, and if the driver was not plain data, such as one in Python.
    """
    course = course_of_run(dict(about))
    if not isinstance(about.get("nominal"), dict) or course is None:
        raise InputError("run.toml: tells no [nominal] car or no [course]: it holds no pilot")
    if about.get("estimate") not in ESTIMATORS or about["estimate"] == "truth":
        raise InputError(
            f"run.toml: estimate {shown(about.get('estimate'))}: it needs what no car reports"
        )
    try:
        driver_tables, laps, bits = about["pilot"], int(about["laps"]), about["precision_bits"]
        link, dt = LINKS[about["link"]["name"]], float(about["rates"]["dt_s"])
    except KeyError as error:
        raise InputError(f"run.toml: {error.args[0]} is missing, or is not known") from None
    nominal = car_from_tables(about["nominal"], "run.toml: nominal")
    driver = driver_of_tables(driver_tables, course, nominal, laps, read)
    pilot = Pilot.of(driver, course, nominal, str(about["estimate"]), link, dt)
    return pilot.typed(np.float32) if bits == 32 else pilot


def traceable(driver: Any) -> bool:
    """Whether a driver is a pytree, so that JAX can trace it."""
    return not jax.tree_util.all_leaves([driver])


def command_type(driver: Any) -> type[AnyCommand]:
    """What a driver commands: `Command`, or what its `command_type` says."""
    return getattr(driver, "command_type", Command)


def checked(driver: Any, answer: Any) -> tuple[AnyCommand, Any]:
    """The checked result of a Python driver's `act`. Raises `InputError` if it is wrong."""
    name = f"{type(driver).__name__}.act"
    kind = command_type(driver)
    # A command alone is a pair as well.
    if isinstance(answer, kind) or not isinstance(answer, tuple) or len(answer) != 2:
        raise InputError(
            f"{name} must return (Command(throttle, steering), memory), not {answer!r:.60}"
        )
    command, memory = answer
    if not isinstance(command, tuple) or len(command) != 2:
        raise InputError(
            f"{name} must return a Command(throttle, steering) first, not {command!r:.60}"
        )
    for key, value in zip(kind._fields, command, strict=True):
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise InputError(f"{name}: {key} must be a finite number, not {value!r:.60}")
    return kind(*map(float, command)), memory


def bounded(command: AnyCommand) -> AnyCommand:
    """The command within its limits: throttle in ±1, steering in ±90°. A speed has no limit."""
    if isinstance(command, SpeedCommand):
        return command._replace(steering=jnp.clip(command.steering, *LOCKS))
    return Command(jnp.clip(command.throttle, -1.0, 1.0), jnp.clip(command.steering, *LOCKS))


def _is_real(leaf: Any) -> bool:
    """Whether a leaf holds real numbers, not counts or keys."""
    if isinstance(leaf, float):
        return True
    return bool(jnp.issubdtype(getattr(leaf, "dtype", np.int32), jnp.floating))


def _typed(leaf: Any, dtype: Any) -> Any:
    """A driver's Python number in the given precision, or as a 32-bit integer."""
    if isinstance(leaf, bool | int):
        return np.int32(leaf)
    return dtype.type(leaf) if isinstance(leaf, float) else leaf


def _like(new: Any, old: Any) -> Any:
    """A new value of driver or estimator, with the type of the old one, as a loop needs."""
    return jnp.asarray(new, jnp.result_type(old))
