"""Which readings are new, and which are to be believed.

A reading is not believed if it is late, if the sensor repeats itself, if it is not a number, or if
it follows a leap that no car can make. After a leap, several steady readings must come first:
otherwise a burst of spikes that happen to lie near the expected value would pass one by one.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Tire
from countersteer.signals import Reading, Readings, Scalar

LATE = 2.5  # periods of a sensor after which its last reading says nothing
REPEATS = 20  # equal readings in a row from which a sensor counts as stuck
SAME = 4  # the same of the voltmeter
STEADY = 4  # readings without a leap, after a leap, until they are believed again
LEAP = 6.0  # standard deviations of noise by which two readings may differ, beside these:
SWING = 60.0  # rad/s², the greatest yaw acceleration
JOLT = 500.0  # m/s³, the greatest jerk
FASTEST = 20.0  # m/s, the greatest wheel speed
SAGS = 0.3  # of a full pack's voltage: the greatest sag


class Sense(NamedTuple):
    """How a sensor is doing."""

    value: Scalar
    tick: Scalar
    repeats: Scalar  # equal readings in a row
    steady: Scalar  # readings in a row without a leap


class Heard(NamedTuple):
    """A sensor at this step."""

    sense: Sense
    fresh: Scalar  # its reading is new
    sound: Scalar  # its last reading is to be believed


class Senses(NamedTuple):
    """Every sensor of the filter."""

    gyroscope: Sense
    accelerometer: Sense  # forward,
    sideways: Sense  # and to the left
    encoder: Sense
    voltmeter: Sense
    position: Sense | None  # None: the car has no such sensor


class HeardSenses(NamedTuple):
    """The same at this step."""

    gyroscope: Heard
    accelerometer: Heard  # sound: both of its axes are
    sideways: Sense
    encoder: Heard
    rolling: Scalar  # the encoder is believed; a wheel at rest repeats itself, which is no fault
    voltmeter: Heard
    position: Heard | None

    @property
    def senses(self) -> Senses:
        """What is kept until the next step."""
        return Senses(
            self.gyroscope.sense,
            self.accelerometer.sense,
            self.sideways,
            self.encoder.sense,
            self.voltmeter.sense,
            None if self.position is None else self.position.sense,
        )


def initial_senses(car: Car, dtype: np.dtype) -> Senses:
    """Nothing heard yet."""
    none = np.int32(0)
    quiet = Sense(dtype.type(0), none, none, np.int32(STEADY))
    told = car.sensors.position.reports != "none"
    return Senses(quiet, quiet, quiet, quiet, quiet, quiet if told else None)


def encoder_tire(car: Car) -> Tire:
    """The tyre of the wheel that the encoder sits on."""
    return car.tires.rear if "rear" in car.sensors.encoder.on else car.tires.front


def encoder_region(car: Car) -> Scalar:
    """Way of the rim from one encoder count to the next (m)."""
    return jnp.pi * encoder_tire(car).radius / car.sensors.encoder.regions


def listen(
    sense: Sense,
    reading: Reading,
    rate: Scalar,
    tick: Scalar,
    dt: float,
    leap: Scalar = math.inf,
) -> Heard:
    """A sensor of this rate (Hz), whose readings in a row differ by no more than `leap`."""
    fresh = reading.tick > sense.tick
    same = reading.value == sense.value
    repeats = jnp.where(fresh, jnp.where(same, sense.repeats + 1, 0), sense.repeats)
    follows = jnp.abs(reading.value - sense.value) <= leap
    steady = jnp.where(fresh, jnp.where(follows, sense.steady + 1, 0), sense.steady)
    timely = (tick - reading.tick) * dt * rate < LATE
    sound = timely & (reading.tick > 0) & (repeats < REPEATS) & jnp.isfinite(reading.value)
    sense = Sense(reading.value, jnp.maximum(reading.tick, sense.tick), repeats, steady)
    return Heard(sense, fresh, sound & (steady >= STEADY))


def listen_to_all(
    car: Car, senses: Senses, readings: Readings, tick: Scalar, dt: float
) -> HeardSenses:
    """Every sensor at this tick."""
    gyro, accel = car.sensors.gyroscope, car.sensors.accelerometer
    encoder, voltmeter = car.sensors.encoder, car.sensors.voltmeter
    swing = SWING / gyro.rate + LEAP * gyro.noise
    jolt = JOLT / accel.rate + LEAP * accel.noise
    counts = FASTEST * encoder.update / encoder_region(car)
    forward = listen(senses.accelerometer, readings.accel_x, accel.rate, tick, dt, jolt)
    sideways = listen(senses.sideways, readings.accel_y, accel.rate, tick, dt, jolt)
    counted = listen(senses.encoder, readings.counts, 1 / encoder.update, tick, dt, counts)
    volts = listen(
        senses.voltmeter, readings.battery, voltmeter.rate, tick, dt, SAGS * car.battery.full
    )
    placed = None
    if senses.position is not None and readings.position_x is not None:
        placed = listen(senses.position, readings.position_x, car.sensors.position.rate, tick, dt)
    return HeardSenses(
        gyroscope=listen(senses.gyroscope, readings.gyroscope, gyro.rate, tick, dt, swing),
        accelerometer=forward._replace(sound=forward.sound & sideways.sound),
        sideways=sideways.sense,
        encoder=counted,
        rolling=counted.sense.steady >= STEADY,
        voltmeter=volts._replace(sound=volts.sound & (volts.sense.repeats < SAME)),
        position=placed,
    )
