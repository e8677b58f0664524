"""The velocity from one step to the next: single track, gyroscope and accelerometer."""

from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.estimation import battery, kalman, single_track
from countersteer.estimation.battery import Pack
from countersteer.estimation.kalman import entry
from countersteer.estimation.single_track import Actuators
from countersteer.estimation.velocity.soundness import Heard, HeardSenses
from countersteer.estimation.velocity.states import (
    AX,
    AY,
    GYRO,
    HEADING,
    RATE,
    ROLLED,
    VX,
    VY,
    Belief,
    VelocityMemory,
    X,
    Y,
    seconds,
)
from countersteer.signals import Command, Readings, Scalar
from countersteer.world import motor
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Vector
from countersteer.world.planar import rotated

ADHERES = 0.12  # rad of slip angle up to which an axle holds
SMOOTH = 0.01  # s: time constant of the smoothed accelerations
BLIND = 2.0  # m/s²: error of the single track's acceleration
BLIND_RATE = 1.0  # rad/s: error of its yaw rate
WANDER = 0.001  # rad/s per root second: walk of the gyroscope's bias
JERK = 1.5  # rad/s per root second: walk of the yaw rate
GYRO_GATE = 6.0  # standard deviations; wider than elsewhere, as a yaw rate changes by jerks
LATE = 2.5  # periods of the accelerometer after which the single track takes over
STRAYS = 0.01  # m per root second: walk of the place, beside what the velocity's error makes


class Track(NamedTuple):
    """What the nominal car's single track makes of the command."""

    actuators: Actuators
    rolls: Scalar  # the rear axle's slip angle is small
    wheel: Scalar  # speed of the encoder's rim, m/s
    ahead: Vector  # velocity at this tick
    pack: Pack


class Yaw(NamedTuple):
    """Yaw rate and heading at this tick."""

    belief: Belief
    acceleration: Scalar  # smoothed, rad/s²


class Push(NamedTuple):
    """Acceleration over the time from `settled` before to `settled` now."""

    settled: Scalar  # tick
    h: Scalar  # s
    measured: Scalar  # by the accelerometer; otherwise by the single track
    forward: Scalar  # m/s²
    left: Scalar
    noise: Scalar  # variance that it adds to the velocity, (m/s)²
    accel_x: Scalar  # smoothed, m/s²
    accel_y: Scalar


class Rolling(NamedTuple):
    """How the encoder's wheel rolls: at `stretch` vx - `arm` r."""

    stretch: Scalar
    arm: Scalar  # m to the left of the car's middle
    noise: Scalar  # variance over the step, m²
    doubt: Scalar  # variance that vx gains, as reports keep being rejected, (m/s)²


def follow_track(
    car: Car,
    memory: VelocityMemory,
    readings: Readings,
    command: Command,
    heard: HeardSenses,
    h: Scalar,
) -> Track:
    """The single track, h seconds later; between readings the accelerometer's last one is held."""
    actuators = single_track.follow(car, memory.actuators, command, memory.ahead.x, h)
    behind = car.body.wheelbase - car.body.front_axle
    slip_speed = memory.ahead.y - behind * memory.ahead.yaw
    slip = jnp.abs(slip_speed) / (jnp.abs(memory.ahead.x) + 0.3)
    rolls = slip < ADHERES
    wheel = readings.wheel_speed.value
    wheel = jnp.where(jnp.isfinite(wheel) & heard.rolling, wheel, memory.ahead.x)
    rim = jnp.where(rolls, memory.ahead.x, wheel)
    drive = motor.drive(
        car.motor,
        car.drivetrain,
        battery.as_believed(car, memory.pack),
        actuators.duty,
        1.0,
        rim / car.tires.rear.radius,
    )
    guess = single_track.step(car, memory.ahead, actuators, drive, memory.friction, h)
    # Holding the last reading was measured to be the better guess.
    held = rotated(memory.ahead, h * memory.ahead.yaw)
    accel_sound, gyro_sound = heard.accelerometer.sound, heard.gyroscope.sound
    ahead = Vector(
        jnp.where(accel_sound, held.x + h * memory.accel_x, guess.x),
        jnp.where(accel_sound, held.y + h * memory.accel_y, guess.y),
        jnp.where(gyro_sound, held.yaw, guess.yaw),
    )
    probed = heard.voltmeter.fresh & heard.voltmeter.sound
    pack = battery.update(
        car, memory.pack, readings.battery.value, drive.battery_current, probed, h
    )
    return Track(actuators, rolls, wheel, ahead, pack)


def predict_yaw(
    car: Car, memory: VelocityMemory, gyroscope: Heard, ahead: Vector, h: Scalar, dt: float
) -> Yaw:
    """Yaw rate and heading, h seconds later, with the gyroscope's reading where it is new."""
    gyro = car.sensors.gyroscope
    mean, covariance = memory.belief
    restless = jnp.where(entry(covariance, RATE, RATE) < BLIND_RATE**2, JERK**2 * h, 0.0)
    covariance = kalman.predict(
        covariance, {HEADING: {RATE: h}}, {RATE: restless, GYRO: WANDER**2 * h}
    )
    heading = mean[HEADING] + h * (memory.ahead.yaw + ahead.yaw) / 2
    belief = Belief(mean, covariance).replace({RATE: ahead.yaw, HEADING: heading})
    reading = gyroscope.sense
    saturated = jnp.abs(reading.value) > 0.99 * gyro.reach
    belief, _ = belief.correct(
        {RATE: 1.0, GYRO: 1.0},
        reading.value - belief.mean[RATE] - belief.mean[GYRO],
        gyro.noise**2 + gyro.resolution**2 / 12 + 1e-8 + jnp.where(saturated, 0.1, 0.0),
        gyroscope.fresh & gyroscope.sound,
        GYRO_GATE,
    )
    rate = belief.mean[RATE]
    # The single track's yaw rate was wrong by this at the end, so by half of it on the way.
    elapsed = seconds(reading.tick - memory.senses.gyroscope.tick, dt, memory)
    since = jnp.where(gyroscope.fresh, elapsed, 0.0)
    heading = belief.mean[HEADING] + jnp.minimum(since, 0.2) * (rate - ahead.yaw) / 2
    turning = (rate - memory.ahead.yaw) / jnp.maximum(h, 1e-6)
    blend = -jnp.expm1(-h / SMOOTH)
    return Yaw(
        belief.replace({HEADING: heading}),
        memory.yaw_acceleration + blend * (turning - memory.yaw_acceleration),
    )


def measure_push(
    car: Car,
    memory: VelocityMemory,
    readings: Readings,
    accelerometer: Heard,
    belief: Belief,
    ahead: Vector,
    tick: Scalar,
    dt: float,
) -> Push:
    """The accelerometer's reading where it is new; what the single track says if none comes."""
    accel = car.sensors.accelerometer
    measured = accelerometer.fresh & accelerometer.sound
    blind = ~measured & (seconds(tick - memory.settled, dt, memory) * accel.rate > LATE)
    settled = jnp.where(measured, accelerometer.sense.tick, jnp.where(blind, tick, memory.settled))
    h = seconds(settled - memory.settled, dt, memory)
    per = 1 / jnp.maximum(h, 1e-6)
    vx, vy, rate, _, _, bias_x, bias_y, *_ = belief.mean
    forward = jnp.where(measured, readings.accel_x.value - bias_x, (ahead.x - vx) * per - rate * vy)
    left = jnp.where(measured, readings.accel_y.value - bias_y, (ahead.y - vy) * per + rate * vx)
    reach = 0.99 * accel.reach
    hit = (jnp.abs(readings.accel_x.value) > reach) | (jnp.abs(readings.accel_y.value) > reach)
    noise = (accel.noise**2 + accel.resolution**2 / 12) * h**2 + jnp.where(hit, 1.0, 0.0)
    blend = -jnp.expm1(-h / SMOOTH)
    return Push(
        settled,
        h,
        measured,
        forward,
        left,
        jnp.where(measured, noise, BLIND**2 * SMOOTH * h),
        memory.accel_x + blend * (forward - memory.accel_x),
        memory.accel_y + blend * (left - memory.accel_y),
    )


def predict_velocity(
    memory: VelocityMemory, belief: Belief, push: Push, rolling: Rolling
) -> Belief:
    """Velocity, rolled way and place at `push.settled`; `rolling` is the encoder's wheel."""
    stretch, arm = rolling.stretch, rolling.arm
    h = push.h
    vx, vy, rate, heading, _, _, _, rolled, *place = belief.mean
    turn = jnp.where(h > 0, heading - memory.settled_heading, 0.0)
    in_play = jnp.where(push.measured, h, 0.0)  # the biases matter to the accelerometer only
    cosine, sine = cosine_sine(heading)
    onward = Vector(cosine * vx - sine * vy, sine * vx + cosine * vy, rate)  # in the world's axes
    moves: dict[int, kalman.Row] = {}
    if place:
        moves = {
            X: {VX: h * cosine, VY: -h * sine, HEADING: -h * onward.y},
            Y: {VX: h * sine, VY: h * cosine, HEADING: h * onward.x},
        }
    covariance = kalman.predict(
        belief.covariance,
        {
            VX: {VY: turn, RATE: h * vy, AX: -in_play},
            VY: {VX: -turn, RATE: -h * vx, AY: -in_play},
            ROLLED: {VX: h * stretch, RATE: -h * arm},
            **moves,
        },
        {
            VX: push.noise + rolling.doubt,
            VY: push.noise,
            ROLLED: rolling.noise,
            **dict.fromkeys(moves, STRAYS**2 * h),
        },
    )
    # Half the turn before the push and half after it: a free velocity keeps its length.
    halfway = rotated(Vector(vx, vy, rate), turn / 2)
    after = rotated(Vector(halfway.x + h * push.forward, halfway.y + h * push.left, rate), turn / 2)
    values = {
        VX: after.x,
        VY: after.y,
        ROLLED: rolled + h * (stretch * (vx + after.x) / 2 - arm * rate),
    }
    if place:
        values |= {X: place[0] + h * onward.x, Y: place[1] + h * onward.y}
    return Belief(belief.mean, covariance).replace(values)
