"""The car's velocity: an extended Kalman filter on gyroscope, accelerometer and encoder.

The accelerometer carries the velocity from one of its readings to the next. It feels whatever the
tyres do, so a drift needs no tyre model. Its bias alone would let the sideways speed run away
within seconds. While the tyres hold, two facts prevent that: the rear axle hardly moves sideways
(`hold.py`), and the encoder's wheel rolls (`encoder.py`). Between readings, and where a sensor has
died or is stuck, the nominal car's single track carries on (`predict.py`). The filter also
estimates friction (where the rear axle slides), the battery (from current and voltage) and the
servo (where the front tyres hold).

A car with a position sensor has its place among the states (`position.py`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.estimation import battery, kalman, steering
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.kalman import entry
from countersteer.estimation.single_track import Actuators
from countersteer.estimation.velocity import encoder, friction, hold, position, predict, soundness
from countersteer.estimation.velocity.states import (
    GYRO,
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
from countersteer.signals import Command, Readings, Scalar
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Symmetric, Vector

# Standard deviations at the start: how far the real car may be from the nominal one.
VELOCITY = (0.1, 0.05, 0.05)  # vx, vy (m/s), yaw rate (rad/s)
START = 0.02  # heading, rad
GYRO_BIAS = 0.005  # rad/s
ACCEL_BIAS = 0.06  # m/s²
ROLLED_WAY = 0.01  # m
PLACE = 0.1  # m
PERIOD = 0.005  # s between two steps


def initial_memory(car: Car, pose: tuple[float, float, float], dtype: np.dtype) -> VelocityMemory:
    """At rest at a known pose, for the nominal car."""
    gyro, accel = car.sensors.gyroscope, car.sensors.accelerometer
    x, y, heading = (jnp.asarray(value, dtype) for value in pose)
    zero, one, none = dtype.type(0), dtype.type(1), np.int32(0)
    spread: tuple[float, ...] = (
        *VELOCITY, START, GYRO_BIAS, ACCEL_BIAS, ACCEL_BIAS, ROLLED_WAY
    )  # fmt: skip
    biases = (gyro.bias, accel.bias_x, accel.bias_y)
    mean: tuple[Scalar, ...] = (zero, zero, zero, heading, *biases, zero)
    if car.sensors.position.reports != "none":
        mean, spread = (*mean, x, y), (*spread, PLACE, PLACE)
    memory = VelocityMemory(
        Belief(mean, kalman.diagonal([one * s for s in spread])),
        tick=none,
        settled=none,
        settled_heading=heading,
        ahead=Vector(zero, zero, zero),
        x=x,
        y=y,
        accel_x=zero,
        accel_y=zero,
        yaw_acceleration=zero,
        friction=one,
        friction_variance=one * friction.FRICTION**2,
        pack=battery.initial(car),
        servo=steering.initial(),
        actuators=Actuators(zero, zero),
        senses=soundness.initial_senses(car, dtype),
        lost=none,
    )
    return typed(memory, dtype)


def typed(memory: VelocityMemory, dtype: np.dtype) -> VelocityMemory:
    """Every number that is not a count in the precision of the car."""

    def leaf(value: Scalar) -> Scalar:
        whole = jnp.issubdtype(jnp.result_type(value), jnp.integer)
        return jnp.asarray(value, np.int32 if whole else dtype)

    typed: VelocityMemory = jax.tree.map(leaf, memory)
    return typed


def update(
    car: Car,
    memory: VelocityMemory,
    readings: Readings,
    command: Command,
    tick: Scalar,
    dt: float,
) -> VelocityMemory:
    """The filter at `tick`, with what is new in the readings, for the nominal car.

    `command` is what the driver has asked for since the step before.
    """
    heard = soundness.listen_to_all(car, memory.senses, readings, tick, dt)
    h = seconds(tick - memory.tick, dt, memory)
    track = predict.follow_track(car, memory, readings, command, heard, h)
    belief, yaw_acceleration = predict.predict_yaw(car, memory, heard.gyroscope, track.ahead, h, dt)
    push = predict.measure_push(
        car, memory, readings, heard.accelerometer, belief, track.ahead, tick, dt
    )
    work = hold.effort(car, track, push, yaw_acceleration, memory.friction)
    rolling = encoder.rolling(car, work, memory.lost, push.h)
    heading = belief.mean[HEADING]

    belief = predict.predict_velocity(memory, belief, push, rolling)
    age = seconds(push.settled - heard.encoder.sense.tick, dt, memory)
    belief, lost = encoder.correct_by_encoder(
        car, belief, heard, memory.senses.encoder.value, memory.lost, age
    )
    belief = hold.correct_by_hold(car, belief, work, push.h)
    if heard.position is not None:
        belief = position.correct_by_position(
            car, memory, belief, heard.position, readings, push.settled, heading, tick, dt
        )
    scale, scale_variance = friction.update_friction(car, memory, belief, track, push, work)
    mean = belief.mean
    steered = track.actuators.steering
    servo = steering.update(
        memory.servo,
        steered,
        (steered - memory.actuators.steering) / jnp.maximum(h, 1e-6),
        jnp.arctan2(mean[VY] + car.body.front_axle * mean[RATE], mean[VX]),
        work.front_pull,
        car.tires.front.peak_friction,
        car.tires.front.cornering_stiffness,
        jnp.minimum(car.servo.limit_left, car.servo.limit_right),
        mean[VX],
        push.measured,
        push.h,
    )

    stands = push.h > 0
    ahead = Vector(
        jnp.where(stands, mean[VX], track.ahead.x),
        jnp.where(stands, mean[VY], track.ahead.y),
        mean[RATE],
    )
    cosine, sine = cosine_sine(mean[HEADING])
    since, x, y = h, memory.x, memory.y
    if len(mean) > X:
        since, x, y = seconds(tick - push.settled, dt, memory), mean[X], mean[Y]
    return typed(
        VelocityMemory(
            belief,
            tick=tick,
            settled=push.settled,
            settled_heading=jnp.where(stands, mean[HEADING], memory.settled_heading),
            ahead=ahead,
            x=x + since * (cosine * ahead.x - sine * ahead.y),
            y=y + since * (sine * ahead.x + cosine * ahead.y),
            accel_x=push.accel_x,
            accel_y=push.accel_y,
            yaw_acceleration=yaw_acceleration,
            friction=scale,
            friction_variance=scale_variance,
            pack=track.pack,
            servo=servo,
            actuators=track.actuators,
            senses=heard.senses,
            lost=lost,
        ),
        jnp.result_type(memory.x),
    )


def estimate(car: Car, memory: VelocityMemory, dt: float) -> Estimate:
    """What the filter believes."""
    mean, p = memory.belief
    astray = predict.BLIND**2 * predict.SMOOTH * seconds(memory.tick - memory.settled, dt, memory)
    voltage, resistance = memory.pack.mean
    servo = memory.servo
    pose = Symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if len(mean) > X:
        at = ((X, X), (Y, Y), (HEADING, HEADING), (X, Y), (X, HEADING), (Y, HEADING))
        pose = Symmetric(*(entry(p, i, j) for i, j in at))
    return Estimate(
        memory.x,
        memory.y,
        mean[HEADING],
        memory.ahead.x,
        memory.ahead.y,
        memory.ahead.yaw,
        mean[GYRO],
        memory.friction,
        jnp.sqrt(memory.friction_variance),
        voltage / car.battery.full,
        resistance,
        servo.mean[0],
        jnp.sqrt(entry(servo.covariance, 0, 0)),
        Symmetric(
            entry(p, VX, VX) + astray,
            entry(p, VY, VY) + astray,
            entry(p, RATE, RATE),
            entry(p, VX, VY),
            entry(p, VX, RATE),
            entry(p, VY, RATE),
        ),
        pose,
    )


@pytree
class VelocityFilter:
    """The filter as an `Estimator`, for the nominal car at a known start."""

    car: Car
    start: tuple[Scalar, Scalar, Scalar]  # x, y, heading
    dt: float = dataclasses.field(metadata={"static": True})
    name = "filter"
    takes_truth = False
    period = PERIOD

    def init(self, key: jax.Array) -> VelocityMemory:
        """At rest at the start."""
        del key
        return initial_memory(self.car, self.start, jnp.result_type(self.car.body.mass))

    def update(
        self, memory: VelocityMemory, readings: Readings, command: Command, tick: Scalar
    ) -> VelocityMemory:
        """The filter at `tick`, with what is new in the readings."""
        return update(self.car, memory, readings, command, tick, self.dt)

    def estimate(self, memory: VelocityMemory) -> Estimate:
        """What the filter believes."""
        return estimate(self.car, memory, self.dt)
