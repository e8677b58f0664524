"""Turns one corner of 90° by grip or by drift, on ground truth: the best that a law can do."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from countersteer.car.parameter import pytree
from countersteer.drivers.driver import Observation
from countersteer.drivers.stop_angle import StopAngle
from countersteer.drivers.turning import Turning
from countersteer.signals import Command, Scalar

AHEAD, TURN, STOP, SETTLE = 0, 1, 2, 3


class CornerMemory(NamedTuple):
    """The driver between two decisions."""

    phase: Scalar
    entry: Scalar  # m/s


@pytree
class Corner:
    """A left turn of 90° that begins at a given x. If it `slides`, drift-turn's laws drive it."""

    turning: Turning
    stop_angle: StopAngle
    slides: Scalar  # 1 by drift, 0 by grip
    speed: Scalar
    begin: Scalar  # x at which the wheels turn over, m
    lock: Scalar  # largest, by grip, rad
    hold: Scalar  # throttle that holds the speed
    power: Scalar  # by drift: factor on the throttle of the spin
    limit: Scalar
    front_axle: Scalar

    def reset(self, key: jax.Array) -> CornerMemory:
        """Straight ahead."""
        del key
        return CornerMemory(AHEAD, 0.0)

    def act(self, memory: CornerMemory, observation: Observation) -> tuple[Command, CornerMemory]:
        """One control period."""
        seen, own = observation.estimate, self.turning
        speed = jnp.maximum(seen.vx, 0.5)
        left_over = math.pi / 2 - seen.heading
        begins = (memory.phase == AHEAD) & (seen.x >= self.begin)
        entry = jnp.where(begins, speed, memory.entry)
        missing = left_over - self.stop_angle.angle(speed, jnp.maximum(seen.yaw_rate, 0.0))
        stops = (memory.phase == TURN) & (missing <= 0)
        settles = (memory.phase == STOP) & (seen.yaw_rate < own.settled)
        phase = memory.phase
        for happens, into in ((begins, TURN), (stops, STOP), (settles, SETTLE)):
            phase = jnp.where(happens, into, phase)
        held = jnp.clip(self.hold + 0.25 * (self.speed - seen.vx), 0.0, 1.0)
        spin, stop = own.spin(entry, seen.yaw_rate), own.stop(entry, missing)
        slip = jnp.arctan2(seen.vy + self.front_axle * seen.yaw_rate, speed)
        settle = own.hold_p * left_over - own.hold_d * seen.yaw_rate + own.hold_slip * slip
        straight = -0.9 * seen.heading - 0.1 * seen.yaw_rate
        steering, throttle = straight, held
        for which, lock, power in (
            (TURN, spin.steering, self.power * spin.throttle),
            (STOP, stop.steering, stop.throttle),
            (SETTLE, settle, held),
        ):
            steering = jnp.where(phase == which, lock, steering)
            throttle = jnp.where(phase == which, power, throttle)
        # By grip, the lock decreases in time for the car to leave the corner straight.
        arc = jnp.clip(2.0 * left_over - 0.25 * seen.yaw_rate, -self.lock, self.lock)
        slides, ahead = self.slides > 0, phase == AHEAD
        steering = jnp.where(slides | ahead, steering, arc)
        throttle = jnp.where(slides, throttle, held)
        return Command(
            jnp.clip(throttle, 0.0, 1.0), jnp.clip(steering, -self.limit, self.limit)
        ), CornerMemory(phase, entry)
