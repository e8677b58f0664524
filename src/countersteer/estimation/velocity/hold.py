"""How hard the axles work, and what follows while the rear one holds: it hardly moves sideways."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import GRAVITY, Car
from countersteer.estimation import steering
from countersteer.estimation.velocity.predict import Push, Track
from countersteer.estimation.velocity.states import RATE, VX, VY, Belief
from countersteer.signals import Scalar
from countersteer.world.angle import cosine_sine

USED = 0.6  # part of the nominal friction up to which an axle holds
KEEPS = 0.0022  # m/s: standard deviation of the sideways speed of an axle that holds,
CREEPS = 0.085  # and part by which its creep differs from what its tyre's stiffness gives
MEMORY = 0.2  # s for which such an error stays the same
GATE = 4.0  # standard deviations beyond which a measurement is rejected


class Effort(NamedTuple):
    """Forces over loads, and whether the axles hold."""

    pull: Scalar  # both axles' longitudinal force over the weight
    rear_pull: Scalar  # the rear axle's lateral force over its load
    front_pull: Scalar
    gives: Scalar  # the rear tread's slip over that of a linear tyre
    holds: Scalar


def effort(
    car: Car, track: Track, push: Push, yaw_acceleration: Scalar, friction: Scalar
) -> Effort:
    """From the smoothed accelerations; `friction` is the rear axle's over the nominal."""
    body = car.body
    accel_x, accel_y = push.accel_x, push.accel_y
    behind = body.wheelbase - body.front_axle
    lever = body.yaw_inertia * yaw_acceleration / body.mass
    front_push = (accel_y * behind + lever) / body.wheelbase
    bend = jnp.tan(track.actuators.steering)
    # The front axle's outer wheel bears more load and has more drag: that turns the car as well.
    lever = lever + bend * front_push * body.cm_height * accel_y / GRAVITY
    rear_load = (body.front_axle * GRAVITY + body.cm_height * accel_x) / body.wheelbase
    rear_pull = (accel_y * body.front_axle - lever) / (body.wheelbase * rear_load)
    # The wheels' pull, and what the front axle's side force takes from it.
    pull = (accel_x + bend * front_push) / GRAVITY
    front_load = (behind * GRAVITY - body.cm_height * accel_x) / body.wheelbase
    driven = car.drivetrain.front_share * GRAVITY * pull
    cosine, sine = cosine_sine(track.actuators.steering)
    front_pull = (front_push - sine * driven) / (cosine * front_load)
    grip = jnp.minimum(car.tires.rear.peak_friction, car.tires.front.peak_friction)
    used = jnp.sqrt(accel_x**2 + accel_y**2) / (GRAVITY * grip)
    # Near its limit a tread gives more than in proportion: the inverse of the brush model.
    share = jnp.sqrt(pull**2 + rear_pull**2) / (friction * car.tires.rear.peak_friction)
    return Effort(pull, rear_pull, front_pull, steering.gives(share), track.rolls & (used < USED))


def correct_by_hold(car: Car, belief: Belief, work: Effort, h: Scalar) -> Belief:
    """While the rear axle holds, it creeps sideways by its tyre's slip angle and no more."""
    behind = car.body.wheelbase - car.body.front_axle
    mean = belief.mean
    stiffness = car.tires.rear.cornering_stiffness
    creep = -jnp.abs(mean[VX]) * work.gives * work.rear_pull / stiffness
    belief, _ = belief.correct(
        {VY: 1.0, RATE: -behind},
        creep - (mean[VY] - behind * mean[RATE]),
        (KEEPS + CREEPS * jnp.abs(creep)) ** 2 * 2 * MEMORY * (1 / jnp.maximum(h, 1e-6)),
        work.holds & (h > 0),
        GATE,
    )
    return belief
