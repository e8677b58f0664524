"""The rear axle's friction, over the nominal: while it slides, its force is its friction."""

import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.estimation.kalman import correct, predict
from countersteer.estimation.velocity.encoder import wheel_arm
from countersteer.estimation.velocity.hold import MEMORY, Effort
from countersteer.estimation.velocity.predict import Push, Track
from countersteer.estimation.velocity.states import RATE, VX, VY, Belief, VelocityMemory
from countersteer.signals import Scalar

FRICTION = 0.1  # standard deviation at the start
FELT = 0.09  # of what a moment tells
FORGETS = 0.05  # per root second: how fast it may change
GATE = 4.0  # standard deviations beyond which a measurement is rejected


def update_friction(
    car: Car, memory: VelocityMemory, belief: Belief, track: Track, push: Push, work: Effort
) -> tuple[Scalar, Scalar]:
    """Friction scale and its variance: the force is mu against the slip, where the axle slides."""
    mean, rear = belief.mean, car.tires.rear
    behind = car.body.wheelbase - car.body.front_axle
    slip_y = mean[VY] - behind * mean[RATE]
    slip_x = mean[VX] - wheel_arm(car) * mean[RATE] - track.wheel
    against = -slip_y / jnp.sqrt(slip_x**2 + slip_y**2 + 1e-6)
    full = rear.sliding_ratio * rear.friction * against
    sliding = rear.cornering_stiffness * jnp.abs(slip_y) > 4 * rear.friction * memory.friction * (
        track.wheel + 0.1
    )
    # While the car counter-steers, the front wheels' pulls differ and turn it by an unknown amount.
    countersteers = track.actuators.steering * mean[RATE] < 0
    (friction,), ((variance,),), _ = correct(
        (memory.friction,),
        predict(((memory.friction_variance,),), {}, {0: FORGETS**2 * push.h}),
        {0: full},
        work.rear_pull - full * memory.friction,
        (FELT * rear.friction) ** 2 * 2 * MEMORY * (1 / jnp.maximum(push.h, 1e-6)),
        sliding & push.measured & (jnp.abs(against) > 0.5) & ~countersteers,
        GATE,
    )
    return jnp.clip(friction, 0.2, 3.0), variance
