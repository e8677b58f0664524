"""A position sensor: where the car was, and perhaps its heading, as told from outside.

A reading is of an instant before, by the sensor's delay. It is compared with where the car was
then.
"""

import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.estimation.velocity.soundness import Heard
from countersteer.estimation.velocity.states import (
    HEADING,
    RATE,
    VX,
    VY,
    Belief,
    VelocityMemory,
    X,
    Y,
    seconds,
)
from countersteer.signals import Readings, Scalar
from countersteer.world.angle import cosine_sine

GATE = 4.0  # standard deviations beyond which a reading is rejected


def correct_by_position(
    car: Car,
    memory: VelocityMemory,
    belief: Belief,
    position: Heard,
    readings: Readings,
    settled: Scalar,
    heading: Scalar,
    tick: Scalar,
    dt: float,
) -> Belief:
    """With x, y and heading, where they are new; `heading` is that of the velocity's prediction."""
    part = car.sensors.position
    valid = position.fresh & position.sound
    late = seconds(settled - position.sense.tick, dt, memory) + part.delay
    cosine, sine = cosine_sine(heading)
    for state, reading, row in (
        (X, readings.position_x, {VX: -late * cosine, VY: late * sine}),
        (Y, readings.position_y, {VX: -late * sine, VY: -late * cosine}),
    ):
        if reading is None:
            continue
        then = belief.mean[state] + sum(slope * belief.mean[i] for i, slope in row.items())
        belief, _ = belief.correct(
            {state: 1.0, **row},
            reading.value - then,
            part.noise**2 + 1e-8,
            valid & jnp.isfinite(reading.value),
            GATE,
        )
    if readings.position_heading is not None:
        late = seconds(tick - position.sense.tick, dt, memory) + part.delay
        mean = belief.mean
        off = readings.position_heading.value - (mean[HEADING] - late * mean[RATE])
        off = off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi))
        noise = part.heading_noise**2 + 1e-8
        belief, _ = belief.correct({HEADING: 1.0, RATE: -late}, off, noise, valid, GATE)
    return belief
