"""Sensors that fail for a while: dead, stuck, or spiking."""

import math
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp

from countersteer.car.car import Car
from countersteer.car.parameter import Array, Scalar, pytree
from countersteer.errors import InputError
from countersteer.sensing.suite import POSITION, Reading, Readings

KINDS = ("dead", "stuck", "spike")
FIELDS = {
    "encoder": ("counts", "wheel_speed"),
    "gyroscope": ("gyroscope",),
    "accelerometer": ("accel_x", "accel_y"),
    "voltmeter": ("battery",),
    "line_detector": ("line_crossings", "line_speed"),
    "lidar": ("lidar",),
    "position": POSITION,
}
LARGEST_COUNT = 65535  # of a counter of 16 bits
FASTEST = 20.0  # m/s that a wheel or the lines may seem to tell
ASTRAY = 10.0  # m by which a place may seem to be off


@pytree
class Fault:
    """What happens to the readings that a sensor takes within a window of time.

    dead: there are none. stuck: each repeats the last one before the window, as a new one. spike:
    each is a number drawn evenly from all that such a sensor may tell (a place: from 10 m around).
    """

    sensor: str = field(metadata={"static": True})  # `sonar`, one as `sonar_<mount>`, or of FIELDS
    kind: str = field(metadata={"static": True})  # of KINDS
    start: Scalar  # s
    duration: Scalar  # s; inf: for good


def check(faults: tuple[Fault, ...], car: Car) -> None:
    """Raises `InputError` where the car has no such sensor, or where there is no such fault."""
    part = car.sensors
    off = {
        "line_detector": part.line_detector.lines == "none",
        "lidar": part.lidar.beams == 0,
        "position": part.position.reports == "none",
    }
    mounts = ("sonar", *(f"sonar_{mount}" for mount in part.sonar.mount_names))
    known = (*(mounts if len(mounts) > 1 else ()), *(n for n in FIELDS if not off.get(n)))
    for fault in faults:
        if fault.sensor not in known:
            raise InputError(f"fault: the car's sensors are {', '.join(known)}, not {fault.sensor}")
        if fault.kind not in KINDS:
            raise InputError(f"fault: a sensor is {', '.join(KINDS)}, not {fault.kind}")


def report(
    faults: tuple[Fault, ...],
    car: Car,
    last: Readings,
    now: Readings,
    key: jax.Array,
    tick: Scalar,
    dt: float,
) -> Readings:
    """What is reported after a tick whose readings are `now`, where `last` was reported before it.

    Only readings taken in this tick change anything. Spikes are drawn from `key` and `tick`.
    """
    key = jax.random.fold_in(jax.random.fold_in(key, tick), 8)
    time, mounts = tick * dt, car.sensors.sonar.mount_names
    cases: list[tuple[str, tuple[str, ...], Reading, Reading]] = [
        ("sonar", ("sonar", f"sonar_{mount}"), old, new)
        for mount, old, new in zip(mounts, last.sonar, now.sonar, strict=True)
    ]
    for sensor, names in FIELDS.items():
        for name in names:
            if getattr(now, name) is not None:
                cases.append((name, (sensor,), getattr(last, name), getattr(now, name)))
    told = []
    for i, (name, sensors, old, new) in enumerate(cases):
        result = new
        for j, fault in enumerate(faults):
            if fault.sensor in sensors:
                lasts = (time > fault.start - dt / 2) & (
                    time < fault.start + fault.duration - dt / 2
                )
                own = jax.random.fold_in(jax.random.fold_in(key, i), j)
                failed = {
                    "dead": old,
                    "stuck": old._replace(tick=new.tick),
                    "spike": new._replace(value=spike(car, name, new.value, own)),
                }[fault.kind]
                result = _choice(lasts, failed, result)
        told.append(_choice(new.tick == tick, result, old))
    others: dict[str, Any] = {case[0]: new for case, new in zip(cases, told, strict=True)}
    return now._replace(**others | {"sonar": tuple(told[: len(mounts)])})


def _choice(condition: Scalar, a: Reading, b: Reading) -> Reading:
    return Reading(*(jnp.where(condition, *both) for both in zip(a, b, strict=True)))


def spike(car: Car, name: str, value: Array, key: jax.Array) -> Array:
    """A reading at random in place of `value`, from the range of its field of `Readings`."""
    sensors, count = car.sensors, (0.0, float(LARGEST_COUNT))
    low, high = {
        "sonar": (sensors.sonar.nearest, sensors.sonar.reach),
        "counts": count,
        "wheel_speed": (0.0, FASTEST),
        "gyroscope": (-sensors.gyroscope.reach, sensors.gyroscope.reach),
        "accel_x": (-sensors.accelerometer.reach, sensors.accelerometer.reach),
        "accel_y": (-sensors.accelerometer.reach, sensors.accelerometer.reach),
        "battery": (0.0, 2 * car.battery.full),
        "line_crossings": count,
        "line_speed": (0.0, FASTEST),
        "lidar": (0.0, sensors.lidar.reach),
        "position_x": (value - ASTRAY, value + ASTRAY),
        "position_y": (value - ASTRAY, value + ASTRAY),
        "position_heading": (-math.pi, math.pi),
    }[name]
    drawn = jax.random.uniform(key, jnp.shape(value), value.dtype, low, high)
    return jnp.round(drawn) if name in ("counts", "line_crossings") else drawn


def read_fault(text: str) -> Fault:
    """A fault from `SENSOR KIND START DURATION` (s). Raises `InputError`."""
    words = text.split()
    try:
        sensor, kind, *window = words
        start, duration = map(float, window)
    except ValueError:
        raise InputError(
            f"--fault {text!r}: write SENSOR KIND START DURATION (s), such as "
            "'gyroscope stuck 2.0 0.5'"
        ) from None
    if not (0 <= start <= 1e6 and duration > 0):
        raise InputError(f"--fault {text!r}: START must be in [0, 1e+06] s, DURATION above 0 s")
    return Fault(sensor=sensor, kind=kind, start=start, duration=duration)


def fault_tables(faults: tuple[Fault, ...]) -> list[dict[str, Any]]:
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
