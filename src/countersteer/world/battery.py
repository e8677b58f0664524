"""The battery: what it gives with no load, and what stands in the current's way."""

import jax.numpy as jnp

from countersteer.car.car import Battery
from countersteer.signals import Scalar


def open_circuit(battery: Battery, charge: Scalar) -> Scalar:
    """Voltage at no current: full (1 - slope (1 - c) - knee exp(-c / width)), never negative."""
    left = jnp.clip(charge, 0.0, 1.0)
    drop = battery.slope * (1 - left) + battery.knee * jnp.exp(-left / battery.knee_width)
    return battery.full * jnp.maximum(1 - drop, 0.0)


def resistance(battery: Battery) -> Scalar:
    """Internal resistance at the pack's wear (ohm)."""
    return battery.resistance * (1 + battery.wear * battery.wear_resistance)


def capacity(battery: Battery) -> Scalar:
    """Charge that a full pack of this wear holds (C)."""
    return battery.capacity * (1 - battery.wear * battery.wear_capacity)


def drained(battery: Battery, charge: Scalar, taken: Scalar) -> Scalar:
    """State of charge (0 to 1) after so many coulombs more; an empty pack stays empty."""
    return jnp.maximum(charge - taken / capacity(battery), 0.0)
