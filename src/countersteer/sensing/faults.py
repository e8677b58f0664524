"""Sensor faults for a limited time: dead, stuck or spike."""

import math
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp

from countersteer import random_streams
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.errors import InputError
from countersteer.random_streams import Stream
from countersteer.reading.values import shown
from countersteer.sensing.all_sensors import channels
from countersteer.signals import Array, Channel, Reading, Readings, Scalar, flat, pairs, unflat

KINDS = ("dead", "stuck", "spike")
ASTRAY = 10.0  # m, largest error of a spike in a position


@pytree
class SensorFault:
    """A fault of the readings of a sensor within a window of time.

    dead: there are no readings. stuck: each repeats the last one before the window, as a new one.
    spike: each is drawn uniformly from the channel's range (a position: within 10 m of it).
    """

    sensor: str = field(metadata={"static": True})  # as in its `Channel`; `sonar`: all sonars
    kind: str = field(metadata={"static": True})  # one of `KINDS`
    start: Scalar  # s
    duration: Scalar  # s; inf: to the end


def check(faults: tuple[SensorFault, ...], car: Car) -> None:
    """Raises `InputError` if the car lacks the sensor, or if the kind is not one of `KINDS`."""
    sensors = [channel.sensor for channel in flat(channels(car))]
    known = list(dict.fromkeys((*(["sonar"] if car.sensors.sonar.mounts else []), *sensors)))
    for fault in faults:
        if fault.sensor not in known:
            raise InputError(f"fault: the car's sensors are {', '.join(known)}, not {fault.sensor}")
        if fault.kind not in KINDS:
            raise InputError(f"fault: a sensor is {', '.join(KINDS)}, not {fault.kind}")


def report(
    faults: tuple[SensorFault, ...],
    car: Car,
    last: Readings,
    now: Readings,
    root: jax.Array,
    tick: Scalar,
    dt: float,
) -> Readings:
    """The reports after a tick with the readings `now`. `last` are the reports before it.

    Only readings of this tick change a report. Spikes are drawn from the drive's key `root`.
    """
    key = random_streams.key(root, Stream.FAULTS, tick)
    time, told = tick * dt, []
    for i, ((channel, old), new) in enumerate(
        zip(pairs(channels(car), last), flat(now), strict=True)
    ):
        result = new
        for j, fault in enumerate(faults):
            if fault.sensor == channel.sensor or fault.sensor == channel.sensor.split("_")[0]:
                lasts = (time > fault.start - dt / 2) & (
                    time < fault.start + fault.duration - dt / 2
                )
                own = jax.random.fold_in(jax.random.fold_in(key, i), j)
                failed = {
                    "dead": old,
                    "stuck": old._replace(tick=new.tick),
                    "spike": new._replace(value=spike(channel, new.value, own)),
                }[fault.kind]
                result = _choice(lasts, failed, result)
        told.append(_choice(new.tick == tick, result, old))
    return unflat(now, told)


def _choice(condition: Scalar, a: Reading, b: Reading) -> Reading:
    return Reading(*(jnp.where(condition, *both) for both in zip(a, b, strict=True)))


def spike(channel: Channel, value: Array, key: jax.Array) -> Array:
    """A random value from the channel's range. If that is infinite, from `value` ± `ASTRAY`."""
    low, high = channel.low, channel.high
    if isinstance(low, float) and math.isinf(low):  # a finite bound may be traced
        low, high = value - ASTRAY, value + ASTRAY
    drawn = jax.random.uniform(key, jnp.shape(value), value.dtype, low, high)
    return jnp.round(drawn) if channel.whole else drawn


def read_fault(text: str) -> SensorFault:
    """A fault from `SENSOR KIND START DURATION` (s). Raises `InputError`."""
    words = text.split()
    try:
        sensor, kind, *window = words
        start, duration = map(float, window)
    except ValueError:
        raise InputError(
            f"--fault {shown(text)}: write SENSOR KIND START DURATION (s), such as "
            "'gyroscope stuck 2.0 0.5'"
        ) from None
    if not (0 <= start <= 1e6 and duration > 0):
        raise InputError(
            f"--fault {shown(text)}: START must be in [0, 1e+06] s, DURATION above 0 s"
        )
    return SensorFault(sensor=sensor, kind=kind, start=start, duration=duration)


def fault_tables(faults: tuple[SensorFault, ...]) -> list[dict[str, Any]]:
    """Faults as plain data, for `run.toml`."""
    return [
        {
            "sensor": fault.sensor,
            "kind": fault.kind,
            "start_s": float(fault.start),
            "duration_s": float(fault.duration),
        }
        for fault in faults
    ]
