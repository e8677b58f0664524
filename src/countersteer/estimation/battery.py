"""The battery as it is felt: a Kalman filter of its open-circuit voltage and inner resistance."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from countersteer.car.car import Battery, Car
from countersteer.estimation.kalman import Covariance, correct, diagonal, predict
from countersteer.signals import Scalar
from countersteer.world import battery as pack

CHARGES = 0.07  # of a full pack's voltage: deviation of the open-circuit voltage at the start
WEARS = 0.6  # of a worn pack's further resistance: the same of the resistance
DRIFTS = 0.002  # of a full pack's voltage, per root second
CURRENT = 0.15  # part by which the nominal motor errs in the current
GATE = 5.0


class Pack(NamedTuple):
    """What is believed of the pack: open-circuit voltage (V), inner resistance (ohm)."""

    mean: tuple[Scalar, ...]
    covariance: Covariance


def initial(car: Car) -> Pack:
    """Somewhere between full and near empty, new and worn."""
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
    """A reading of the voltmeter under a current (A): V = U - R I.

    `h` is the time since the last step. The pack is told apart from its resistance by currents
    that differ; until then the two are known by their sum.
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
    """The nominal car's battery with the voltage and resistance believed, whatever its charge."""
    voltage, resistance = believed.mean
    return dataclasses.replace(
        car.battery, full=voltage, slope=0.0, knee=0.0, resistance=resistance, wear=0.0
    )
