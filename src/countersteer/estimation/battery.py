"""The battery: a Kalman filter of its open-circuit voltage and inner resistance."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Battery, Car
from countersteer.estimation.kalman import Covariance, correct, diagonal, predict
from countersteer.signals import Scalar
from countersteer.world import battery as pack

CHARGES = 0.07  # standard deviation of the voltage at the start, over a full pack's
WEARS = 0.6  # the same of the resistance, over what full wear adds
DRIFTS = 0.002  # random walk of the voltage, over a full pack's, per root second
CURRENT = 0.15  # relative error of the nominal motor's current
GATE = 5.0  # standard deviations beyond which a reading is rejected


class Pack(NamedTuple):
    """Estimate of the pack: open-circuit voltage (V), inner resistance (ohm)."""

    mean: tuple[Scalar, ...]
    covariance: Covariance


def initial(car: Car) -> Pack:
    """A pack at charge 0.65, with a resistance halfway from the nominal to a worn pack's."""
    nominal = car.battery
    worn = nominal.resistance * nominal.wear_resistance
    voltage = pack.open_circuit(nominal, 0.65)
    return Pack(
        (voltage, pack.resistance(nominal) + 0.5 * (1 - nominal.wear) * worn),
        diagonal([CHARGES * nominal.full, WEARS * worn + 1e-3]),
    )


def update(
    car: Car, believed: Pack, voltage: Scalar, current: Scalar, valid: Scalar, h: Scalar
) -> Pack:
    """The estimate after a voltmeter reading under a current I (A): V = U - R I.

    `h` is the time since the last step (s). Different currents separate U from R. Until then only
    U - R I is known.
    """
    part = car.sensors.voltmeter
    mean, covariance = believed
    covariance = predict(covariance, {}, {0: (DRIFTS * car.battery.full) ** 2 * h})
    noise = part.noise**2 + part.resolution**2 / 12 + (CURRENT * mean[1] * current) ** 2
    mean, covariance, _ = correct(
        mean,
        covariance,
        {0: 1.0, 1: -current},
        voltage - (mean[0] - mean[1] * current),
        noise + 1e-6,
        valid,
        GATE,
    )
    return Pack((mean[0], jnp.maximum(mean[1], 0.0)), covariance)


def as_believed(car: Car, believed: Pack) -> Battery:
    """The nominal car's battery with the estimated voltage and resistance, at any charge."""
    voltage, resistance = believed.mean
    return dataclasses.replace(
        car.battery, full=voltage, slope=0.0, knee=0.0, resistance=resistance, wear=0.0
    )
