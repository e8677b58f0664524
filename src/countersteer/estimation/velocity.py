"""The car's velocity: an extended Kalman filter over what gyroscope, accelerometer and encoder say.

Between two steps the accelerometer carries the velocity on: it feels whatever the tyres do, so a
drift needs no tyre model. Its bias would let sideways speed run away within seconds; while the
tyres hold, the rear axle hardly moves sideways and the encoder's wheel rolls, and both say so.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.car.parameter import Scalar
from countersteer.estimation import kalman
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.kalman import Covariance, correct, entry, predict
from countersteer.sensing.suite import Reading, Readings
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Symmetric
from countersteer.world.planar import Command

# What the nominal car's declaration does not tell: how far the real one may be from it.
GYRO_BIAS = 0.01  # rad/s, standard deviation
ACCEL_BIAS = 0.1  # m/s²
WANDER = 0.003  # of the gyroscope's bias, rad/s per root second
START = 0.02  # heading at the start, rad
YAW_JERK = 2.0  # by which the yaw rate changes, rad/s per root second
HOLDS = 0.02  # m/s: how well a wheel that holds is known to roll, and an axle not to slide
MEMORY = 0.2  # s for which that error stays the same
SLIDES = 1.5  # m/s: the same where the axle slides
ADHERES = 0.12  # rad of slip angle up to which an axle holds
USED = 0.6  # part of the nominal friction up to which it does
SMOOTH = 0.03  # s over which accelerations are looked at
STALE = 0.05  # s after which a reading tells nothing
REPEATS = 20  # equal readings after which a sensor counts as stuck
BLIND = 3.0  # m/s² by which a car accelerates that nothing measures
FRICTION = 0.1  # standard deviation of the friction scale at the start
FORGETS = 0.05  # of the friction scale, per root second
GATE = 4.0  # standard deviations beyond which a reading is not believed

VX, VY, RATE, HEADING, GYRO, AX, AY, ROLLED = range(8)


class Sense(NamedTuple):
    """How a sensor is doing."""

    value: Scalar
    tick: Scalar
    repeats: Scalar  # readings in a row that were equal


class Memory(NamedTuple):
    """The filter between two steps."""

    mean: tuple[Scalar, ...]  # vx, vy, yaw rate, heading, biases (gyro, accel x, y), rolled
    covariance: Covariance
    x: Scalar
    y: Scalar
    friction: Scalar
    friction_variance: Scalar
    accel_x: Scalar  # smoothed, m/s²
    accel_y: Scalar
    yaw_acceleration: Scalar
    tick: Scalar
    gyroscope: Sense
    accelerometer: Sense
    encoder: Sense
    lost: Scalar  # reports of the encoder in a row that were not believed


def initial_memory(car: Car, pose: tuple[float, float, float], dtype: np.dtype) -> Memory:
    """At rest at a known pose."""
    gyro, accel = car.sensors.gyroscope, car.sensors.accelerometer
    x, y, heading = pose
    zero, none = dtype.type(0), np.int32(0)
    mean = (0, 0, 0, heading, gyro.bias, accel.bias_x, accel.bias_y, 0)
    spread = (0.1, 0.05, 0.05, START, GYRO_BIAS, ACCEL_BIAS, ACCEL_BIAS, 0.01)
    quiet = Sense(zero, none, none)
    return Memory(
        tuple(jnp.asarray(value, dtype) for value in mean),
        kalman.diagonal([dtype.type(s) for s in spread]),
        jnp.asarray(x, dtype),
        jnp.asarray(y, dtype),
        dtype.type(1),
        dtype.type(FRICTION**2),
        zero,
        zero,
        zero,
        none,
        quiet,
        quiet,
        quiet,
        none,
    )


def heard(sense: Sense, reading: Reading, tick: Scalar, dt: float) -> tuple[Sense, Scalar, Scalar]:
    """A sensor with what it last said, whether that is new, and whether it is to be believed."""
    fresh = reading.tick > sense.tick
    same = reading.value == sense.value
    repeats = jnp.where(fresh, jnp.where(same, sense.repeats + 1, 0), sense.repeats)
    sound = ((tick - reading.tick) * dt < STALE) & (reading.tick > 0) & (repeats < REPEATS)
    sound = sound & jnp.isfinite(reading.value)
    return Sense(reading.value, jnp.maximum(reading.tick, sense.tick), repeats), fresh, sound


def update(
    car: Car, memory: Memory, readings: Readings, command: Command, tick: Scalar, dt: float
) -> Memory:
    """One step of the filter to `tick`, for the nominal car. The first one is at tick 0."""
    sensors, body = car.sensors, car.body
    mean, covariance = memory.mean, memory.covariance
    dtype = jnp.result_type(mean[0])
    h = ((tick - memory.tick) * dt).astype(dtype)
    blend = -jnp.expm1(-h / SMOOTH)
    behind = body.wheelbase - body.front_axle
    gyroscope, turned, gyro_sound = heard(memory.gyroscope, readings.gyroscope, tick, dt)
    accelerometer, _, accel_sound = heard(memory.accelerometer, readings.accel_x, tick, dt)
    accel_sound = accel_sound & jnp.isfinite(readings.accel_y.value)
    encoder, counted, _ = heard(memory.encoder, readings.counts, tick, dt)

    # The yaw rate, by the gyroscope.
    rate_before = mean[RATE]
    covariance = predict(covariance, {}, {RATE: YAW_JERK**2 * h, GYRO: WANDER**2 * h})
    gyro = sensors.gyroscope
    saturated = jnp.abs(gyroscope.value) > 0.99 * gyro.reach
    mean, covariance, _ = correct(
        mean,
        covariance,
        {RATE: 1.0, GYRO: 1.0},
        gyroscope.value - mean[RATE] - mean[GYRO],
        gyro.noise**2 + gyro.resolution**2 / 12 + 1e-8 + jnp.where(saturated, 0.1, 0.0),
        turned & gyro_sound,
        GATE,
    )

    # Velocity and heading, carried on.
    vx, vy, rate, heading, _, bias_x, bias_y, rolled = mean
    part = sensors.accelerometer
    reach = 0.99 * part.reach
    hit = (jnp.abs(readings.accel_x.value) > reach) | (jnp.abs(readings.accel_y.value) > reach)
    # What is not measured: a velocity that stays as it is.
    forward = jnp.where(accel_sound, readings.accel_x.value - bias_x, -rate * vy)
    left = jnp.where(accel_sound, readings.accel_y.value - bias_y, rate * vx)
    measured = jnp.where(accel_sound, 1.0, 0.0)
    shaken = part.noise**2 + part.resolution**2 / 12
    shaken = jnp.where(accel_sound, shaken * h**2, BLIND**2 * h * SMOOTH)
    shaken = shaken + jnp.where(hit, 1.0, 0.0)
    accel_x = memory.accel_x + blend * (forward - memory.accel_x)
    accel_y = memory.accel_y + blend * (left - memory.accel_y)
    turning = (rate - rate_before) / jnp.maximum(h, 1e-6)
    yaw_acceleration = memory.yaw_acceleration + blend * (turning - memory.yaw_acceleration)

    # How hard the axles work, and whether the rear one slides.
    lever = body.yaw_inertia * yaw_acceleration / body.mass
    rear_load = body.front_axle / body.wheelbase  # part of the weight
    rear_pull = (accel_y * body.front_axle - lever) / (body.wheelbase * rear_load * GRAVITY)
    slip_speed = vy - behind * rate
    slip = jnp.abs(slip_speed) / (jnp.abs(vx) + 0.3)
    grip = jnp.minimum(car.tires.rear.peak_friction, car.tires.front.peak_friction)
    used = jnp.sqrt(accel_x**2 + accel_y**2) / (GRAVITY * grip)
    holds = (slip < ADHERES) & (used < USED)

    # The encoder's wheel: `rolled` is what it has rolled since the regions counted so far.
    side = {"rear-left": 1.0, "front-left": 1.0, "rear-right": -1.0, "front-right": -1.0}
    arm = side.get(sensors.encoder.on, 0.0) * body.track / 2
    tire = car.tires.rear if "rear" in sensors.encoder.on else car.tires.front
    stretch = 1 + accel_x / (GRAVITY * tire.longitudinal_stiffness)
    turn = h * (rate + rate_before) / 2
    known = jnp.where(holds, HOLDS, SLIDES) ** 2 * 2 * MEMORY * h
    covariance = predict(
        covariance,
        {
            VX: {VY: turn, RATE: h * vy, AX: -h * measured},
            VY: {VX: -turn, RATE: -h * vx, AY: -h * measured},
            HEADING: {RATE: h},
            ROLLED: {VX: h * stretch, RATE: -h * arm},
        },
        {VX: shaken, VY: shaken, ROLLED: known},
    )
    cosine, sine = cosine_sine(turn / 2)
    # Half the turn before the push and half after it: the velocity's length is kept.
    vx, vy = cosine * vx + sine * vy + h * forward, cosine * vy - sine * vx + h * left
    vx, vy = cosine * vx + sine * vy, cosine * vy - sine * vx
    heading = heading + turn
    rolled = rolled + h * (stretch * vx - arm * rate)
    mean = (vx, vy, rate, heading, *mean[4:7], rolled)

    # The regions that were counted since: what is left of `rolled` is within one of them.
    region = jnp.pi * tire.radius / sensors.encoder.regions
    passed = jnp.where(counted, encoder.value - memory.encoder.value, 0.0)
    backwards = jnp.where(vx < 0, -1.0, 1.0)
    mean = (*mean[:ROLLED], mean[ROLLED] - backwards * passed * region)
    # A standing disc says nothing of which way it was coming.
    mean, covariance, taken = correct(
        mean,
        covariance,
        {ROLLED: 1.0},
        backwards * region / 2 - mean[ROLLED],
        region**2 / 12,
        counted,
        GATE,
    )
    # A wheel that slid or a lost report: begin anew within the region.
    failed = counted & ~taken
    mean = (*mean[:ROLLED], jnp.where(failed, backwards * region / 2, mean[ROLLED]))
    fresh_start = region**2 / 12
    covariance = tuple(
        tuple(
            jnp.where(failed, fresh_start if i == ROLLED else 0.0, value)
            if i + j == ROLLED
            else value
            for j, value in enumerate(row)
        )
        for i, row in enumerate(covariance)
    )
    lost = jnp.where(counted, jnp.where(taken | (passed == 0), 0, memory.lost + 1), memory.lost)

    # The rear axle's tread drifts sideways by the slip angle that its pull takes.
    creep = -jnp.abs(vx) * rear_pull / car.tires.rear.cornering_stiffness
    mean, covariance, _ = correct(
        mean,
        covariance,
        {VY: 1.0, RATE: -behind},
        creep - (mean[VY] - behind * mean[RATE]),
        ((HOLDS + 0.5 * jnp.abs(creep)) ** 2) * 2 * MEMORY / jnp.maximum(h, 1e-6),
        holds & (h > 0),
        GATE,
    )

    cosine, sine = cosine_sine(mean[HEADING])
    return memory._replace(
        mean=mean,
        covariance=covariance,
        x=memory.x + h * (cosine * mean[VX] - sine * mean[VY]),
        y=memory.y + h * (sine * mean[VX] + cosine * mean[VY]),
        accel_x=accel_x,
        accel_y=accel_y,
        yaw_acceleration=yaw_acceleration,
        tick=tick,
        gyroscope=gyroscope,
        accelerometer=accelerometer,
        encoder=encoder,
        lost=lost,
    )


def estimate(memory: Memory) -> Estimate:
    """What the filter believes."""
    vx, vy, rate, heading, gyro_bias, *_ = memory.mean
    p = memory.covariance
    return Estimate(
        memory.x,
        memory.y,
        heading,
        vx,
        vy,
        rate,
        gyro_bias,
        velocity_covariance=Symmetric(
            entry(p, VX, VX),
            entry(p, VY, VY),
            entry(p, RATE, RATE),
            entry(p, VX, VY),
            entry(p, VX, RATE),
            entry(p, VY, RATE),
        ),
    )
