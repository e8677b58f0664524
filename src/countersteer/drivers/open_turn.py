"""One turn in the open, stopped at a yaw rate; the turn uses no other measurement."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.drivers.driver import Observation, Status
from countersteer.drivers.straighten import holding_throttle
from countersteer.drivers.turning import Turning
from countersteer.signals import Command, Scalar

RUN_UP = 0.3  # s straight ahead before the wheels turn over

AHEAD, SPIN, STOP = 0, 1, 2


class OpenTurnMemory(NamedTuple):
    """The driver between two decisions."""

    phase: Scalar
    spun: Scalar  # when the wheels turned over, s
    turn: Scalar  # 1 once they have


@pytree
class OpenTurn:
    """Runs up, spins by `Turning.spin`, and stops by the lock of `Turning.stop`, without throttle.

    The throttle is killed at the yaw rate `kill`, or `longest` seconds after the spin began.
    """

    turning: Turning
    speed: Scalar  # of entry, m/s; the run-up holds it
    hand: Scalar  # 1 left, -1 right
    kill: Scalar  # rad/s, in the turn's hand
    longest: Scalar  # s
    hold: Scalar  # throttle that holds the speed
    limit: Scalar  # of steering, rad
    run_up: Scalar = RUN_UP  # s

    def reset(self, key: jax.Array) -> OpenTurnMemory:
        """Straight ahead."""
        del key
        return OpenTurnMemory(AHEAD, 0.0, 0)

    def act(
        self, memory: OpenTurnMemory, observation: Observation
    ) -> tuple[Command, OpenTurnMemory]:
        """One control period."""
        estimate, now = observation.estimate, observation.time
        rate = self.hand * estimate.yaw_rate
        begins = (memory.phase == AHEAD) & (now >= self.run_up - 1e-6)
        spun = jnp.where(begins, now, memory.spun)
        killed = (rate >= self.kill) | (now - spun >= self.longest - 1e-6)
        phase = jnp.where(begins, SPIN, memory.phase)
        phase = jnp.where((memory.phase == SPIN) & killed, STOP, phase)
        spin = self.turning.spin(self.speed, rate)
        stop = self.turning.stop(self.speed, 0.0)
        steering = jnp.where(phase == SPIN, spin.steering, stop.steering)
        throttle = jnp.where(phase == SPIN, spin.throttle, 0.0)
        ahead = phase == AHEAD
        held = jnp.clip(self.hold + 0.25 * (self.speed - estimate.vx), 0.0, 1.0)
        command = Command(
            jnp.clip(jnp.where(ahead, held, throttle), -1.0, 1.0),
            jnp.where(ahead, 0.0, jnp.clip(self.hand * steering, -self.limit, self.limit)),
        )
        return command, OpenTurnMemory(phase, spun, jnp.where(phase == AHEAD, 0, 1))

    def status(self, memory: OpenTurnMemory) -> Status:
        """The turn (1 once it has begun) and its phase."""
        return Status(memory.turn, memory.phase)


def open_turn(
    car: Car, turning: Turning, speed: float, hand: int, kill: float, longest: float
) -> OpenTurn:
    """For a nominal car. `hand` is 1 (left) or -1 (right); `kill` is a yaw rate (rad/s)."""
    return OpenTurn(
        turning=turning,
        speed=speed,
        hand=float(hand),
        kill=kill,
        longest=longest,
        hold=holding_throttle(car, speed) + float(car.motor.dead_zone),
        limit=min(float(car.servo.limit_left), float(car.servo.limit_right)),
    )
