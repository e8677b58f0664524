"""`Shared`: a car that a person and a driver share, as one driver that JAX can trace.

What hands do, who drives and how the car helps are leaves: they change without a new program. The
estimator hears of the command that the car has got, whoever gave it. While the person drives, the
driver is asked as well and its command is dropped: so it follows the course, and can take over.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.clock import shared
from countersteer.cockpit import gyro
from countersteer.cockpit.gyro import Assist, Hands, Ramps
from countersteer.drivers.driver import ROUNDING, Observation, Status, status_of
from countersteer.signals import Command, Scalar

PERIOD = 0.005  # s between two commands to a person's car, as between readings of the gyroscope

LONGEST = 0.1  # s, time that a command's ramps move by at most


class SharedMemory(NamedTuple):
    """Between two decisions."""

    time: Scalar  # of the person's last command, s
    command: Command  # the person's last
    ramps: Ramps
    own: Any  # the driver's


@pytree
class Shared:
    """A person and a driver (None: there is none, and `given` is driven instead)."""

    driver: Any
    hands: Hands = Hands()
    assist: Assist = Assist()
    person: Scalar = 1.0  # 1: the person drives, 0: the driver
    given: Command = Command(0.0, 0.0)
    cut: Scalar = 0.0  # 1: the person's throttle is zero at once

    def reset(self, key: jax.Array) -> SharedMemory:
        """At rest."""
        zero = Command(0.0, 0.0)
        own = None if self.driver is None else self.driver.reset(key)
        return SharedMemory(-1.0, zero, Ramps(), own)

    def act(self, memory: SharedMemory, seen: Observation) -> tuple[Command, SharedMemory]:
        """The command of who drives."""
        theirs, own = self.given, memory.own
        if self.driver is not None:
            theirs, own = self.driver.act(own, seen)
        due = shared(seen.time - memory.time > PERIOD - ROUNDING)
        rate, speed = seen.gyroscope, jnp.hypot(seen.estimate.vx, seen.estimate.vy)
        yaw_rate = jnp.where(jnp.isfinite(rate.age), rate.value, 0.0)
        # A radio asks less often.
        dt = jnp.clip(seen.time - memory.time, PERIOD, LONGEST)
        command, ramps = gyro.steer(self.assist, memory.ramps, self.hands, yaw_rate, speed, dt)
        ramps = ramps._replace(throttle=jnp.where(self.cut > 0.5, 0.0, ramps.throttle))
        command = command._replace(throttle=ramps.throttle)
        time, command, ramps = jax.tree.map(
            lambda new, old: jnp.where(due, new, old),
            (seen.time, command, ramps),
            (memory.time, memory.command, memory.ramps),
        )
        command = command._replace(throttle=jnp.where(self.cut > 0.5, 0.0, command.throttle))
        drives = jax.tree.map(
            lambda a, b: jnp.where(self.person > 0.5, a, b), command, Command(*theirs)
        )
        return drives, SharedMemory(time, command, ramps, own)

    def status(self, memory: SharedMemory) -> Status:
        """The driver's."""
        return Status() if self.driver is None else status_of(self.driver, memory.own)
