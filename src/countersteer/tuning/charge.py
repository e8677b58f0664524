"""The battery's charge at a log, from its voltmeter and the pack's own voltage model.

    reading(t) = voltage(c - drained(t), duty(t), wheel speed(t)) + e    at t - lag

The voltage is `motor.drive`'s, under the current that duty and speed make. c is the charge when
the log begins, in [0, 1]. drained(t) is that current's integral over the capacity. The current is
known to `CURRENT` of itself, so e has the deviation of the voltmeter and of that part of the sag.
Readings under little current count most. The loss is soft L1.

A pack has a voltage from empty to full. Readings beyond both are of another pack, or in another
unit, and are not used.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.runs.declared import sensor_tables
from countersteer.runs.defects import readings
from countersteer.runs.run import Run
from countersteer.tuning import windows
from countersteer.tuning.windows import Measured, find_references
from countersteer.world import battery, motor

CURRENT = 0.3  # relative error of the car's motor current
PACK = 0.01  # relative error of a pack's voltage model
FEWEST, MOST = 5, 1000  # readings
BEYOND = 1.05  # of a full pack's voltage; a higher reading is of another pack
CHARGES = np.linspace(0.0, 1.0, 201)
CELLS = range(2, 9)
OFF = 0.15  # difference to a stated charge that is worth a warning


class Charge(NamedTuple):
    """The charge by a voltmeter."""

    begin: float  # 0 to 1, at the log's first command
    end: float  # at its last command
    deviation: float
    volts: float  # median error of the readings (V)


def from_voltmeter(run: Run, car: Car, measured: Measured, dt: float) -> tuple[Charge | None, str]:
    """The charge by `battery_v`, or else None and a line that says why it is not used.

    The line is empty if the log has no voltmeter.
    """
    time, volts = readings(run, "battery_v")
    finite = np.isfinite(volts)
    time, volts = time[finite], volts[finite]
    if len(time) < FEWEST:
        return None, ""
    every = math.ceil(len(time) / MOST)
    declared = sensor_tables(run.about, "voltmeter")
    at = time[::every] - declared.get("lag_s", 0.0)
    volts = volts[::every]
    first, last = run.commands["time_s"][[0, -1]]
    ticks = np.arange(int(max(last, at[-1]) / dt) + 2)
    commands = windows.asked(run.commands, ticks, dt)
    duty = windows.actuators(car, measured, commands, dt)[1]
    duty = duty[np.clip(np.rint(at / dt).astype(int), 0, len(duty) - 1)]
    shaft = shaft_speed(car, measured, at)
    usable = (at >= first) & (at <= last) & (np.isfinite(shaft) | (np.abs(duty) < 1e-3))
    if np.sum(usable) < FEWEST:
        return None, "battery_v: no reading while commands and wheel speed are known: not used"
    at, volts, duty, shaft = at[usable], volts[usable], duty[usable], np.nan_to_num(shaft[usable])
    wrong = another_pack(car, float(np.median(volts)))
    if wrong:
        return None, wrong
    now = motor.drive(car.motor, car.drivetrain, car.battery, duty, 0.6, shaft)
    current = np.asarray(now.battery_current)
    taken = np.append(0.0, np.cumsum(np.diff(at) * (current[1:] + current[:-1]) / 2))
    drained = taken / float(battery.capacity(car.battery))
    left = np.clip(CHARGES[:, None] - drained, 0.0, 1.0)
    open_circuit = np.asarray(battery.open_circuit(car.battery, jnp.asarray(left)))
    sag = np.asarray(battery.resistance(car.battery)) * current
    part = car.sensors.voltmeter
    noise = declared.get("noise_v", float(part.noise))
    spread = np.sqrt(noise**2 + float(part.resolution) ** 2 / 12 + (CURRENT * sag) ** 2 + 1e-6)
    off = open_circuit - sag - volts
    cost = np.sum(np.sqrt(1 + (off / spread) ** 2) - 1, axis=1)
    best = int(np.argmin(cost))
    begin = float(CHARGES[best])
    slope = abs(float(np.median(np.gradient(open_circuit, CHARGES, axis=0)[best])))
    by_noise = float(np.median(spread)) / math.sqrt(min(len(at), 20))
    by_pack = PACK * float(car.battery.full)
    deviation = min(math.hypot(by_noise, by_pack) / max(slope, 1e-6), 1.0)
    end = float(np.clip(begin - drained[-1], 0.0, begin))
    return Charge(begin, end, deviation, float(np.median(np.abs(off[best])))), ""


def shaft_speed(car: Car, measured: Measured, time: np.ndarray) -> np.ndarray:
    """Speed of the driven shaft at the wheels (rad/s): by the encoder, else by the car's speed."""
    radius = float(car.tires.rear.radius)
    wheel = find_references(measured).get("wheel_speed_mps")
    if wheel is not None:
        return np.asarray(wheel.undone(time)) / radius
    if measured.vx is not None:
        return measured.vx.at(time) / radius
    return np.full(len(time), math.nan)


def another_pack(car: Car, volts: float) -> str:
    """Why a typical reading cannot be of the car's pack; empty if it can."""
    full = float(car.battery.full)
    empty = float(battery.open_circuit(car.battery, 0.0))
    if empty < volts / 1000 <= BEYOND * full:
        return (
            f'battery_v reads {volts:.4g} V: in millivolts? Convert it, or write unit = "mV" '
            "under [sensors.voltmeter] of run.toml: not used"
        )
    if volts > BEYOND * full:
        return (
            f"battery_v reads {volts:.4g} V, more than a full pack of the car has "
            f"(battery.full_v {full:g}): not used"
        )
    cell = [n for n in CELLS if 0.75 * full < n * volts <= BEYOND * full]
    if volts < 0.6 * full and cell:
        return (
            f"battery_v reads {volts:.3g} V where a full pack of the car has {full:g}: if it is of "
            f"one cell, write cells = {cell[0]} under [sensors.voltmeter] of run.toml: not used"
        )
    if volts < 0.9 * empty:
        return (
            f"battery_v reads {volts:.3g} V, less than an empty pack of the car has "
            f"({empty:.3g}): not used"
        )
    return ""


def contradiction(stated: float, found: Charge) -> str:
    """A line if a stated charge is not the voltmeter's; empty if it is."""
    if abs(stated - found.begin) <= max(OFF, 3 * found.deviation):
        return ""
    return (
        f"battery_charge is stated as {stated:.2f}, but battery_v tells {found.begin:.2f} ± "
        f"{found.deviation:.2f}"
    )
