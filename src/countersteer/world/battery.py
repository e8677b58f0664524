"""The battery: open-circuit voltage, resistance, capacity and state of charge."""

import jax.numpy as jnp

from countersteer.car.car import Battery
from countersteer.signals import Scalar


def open_circuit(battery: Battery, charge: Scalar) -> Scalar:
    """Open-circuit voltage (V): full (1 - slope (1 - c) - knee exp(-c / knee_width)), at least 0.

    c is the charge, clipped to [0, 1].
    """
    left = jnp.clip(charge, 0.0, 1.0)
    drop = battery.slope * (1 - left) + battery.knee * jnp.exp(-left / battery.knee_width)
    return battery.full * jnp.maximum(1 - drop, 0.0)


def resistance(battery: Battery) -> Scalar:
    """Internal resistance at the pack's wear (ohm)."""
    return battery.resistance * (1 + battery.wear * battery.wear_resistance)


def capacity(battery: Battery) -> Scalar:
    """Charge of a full pack at its wear (C)."""
    return battery.capacity * (1 - battery.wear * battery.wear_capacity)


def drained(battery: Battery, charge: Scalar, taken: Scalar) -> Scalar:
    """State of charge (0 to 1) after `taken` more coulombs. An empty pack stays empty."""
    return jnp.maximum(charge - taken / capacity(battery), 0.0)
