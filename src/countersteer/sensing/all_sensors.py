"""All sensors of a car on the shared clock."""

import math
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer import random_streams
from countersteer.car.car import Car
from countersteer.random_streams import Stream
from countersteer.sensing import error_models, lidar, sonar
from countersteer.signals import Array, Channel, Motion, Reading, Readings, Scalar
from countersteer.world import drivetrain, motor
from countersteer.world.chassis import Vector

POSITION = ("position_x", "position_y", "position_heading")
LARGEST_COUNT = 65535.0  # of a counter of 16 bits
FASTEST = 20.0  # m/s, largest declared speed of a wheel and of the line detector


def channels(car: Car) -> Readings:
    """The car's channels: a `Channel` in place of each reading. The car may be traced."""
    part, inf, pi = car.sensors, math.inf, math.pi
    near, far, volts = part.sonar.nearest, part.sonar.reach, 2 * car.battery.full
    spin, push = part.gyroscope.reach, part.accelerometer.reach
    found: dict[str, Any] = {
        "sonar": tuple(
            Channel(f"sonar_{name}_m", "m", near, far, "distance; inf: no echo", f"sonar_{name}")
            for name in part.sonar.mount_names
        )
    }

    def add(field: str, sensor: str, *about: Any, **more: Any) -> None:
        found[field] = Channel(*(*about, sensor), **more)

    counts, meaning = (0.0, LARGEST_COUNT), "regions of the disc passed, blind to direction"
    add("counts", "encoder", "encoder_counts", "1", *counts, meaning, whole=True)
    add("wheel_speed", "encoder", "wheel_speed_mps", "m/s", 0.0, FASTEST, "speed of the wheel")
    add("gyroscope", "gyroscope", "gyro_radps", "rad/s", -spin, spin, "yaw rate")
    for axis, way in (("x", "forward"), ("y", "to the left")):
        about = (f"accel_{axis}_mps2", "m/s2", -push, push, f"acceleration {way}")
        add(f"accel_{axis}", "accelerometer", *about)
    add("battery", "voltmeter", "battery_v", "V", 0.0, volts, "voltage under load")
    if part.line_detector.lines != "none":
        add("line_crossings", "line_detector", "line_crossings", "1", *counts, "lines", whole=True)
        about = ("line_speed_mps", "m/s", 0.0, FASTEST, "speed from line to line")
        add("line_speed", "line_detector", *about)
    if part.lidar.beams:
        about = ("lidar_m", "m", 0.0, part.lidar.reach, "distances, right to left; inf: no echo")
        add("lidar", "lidar", *about, shape=(part.lidar.beams,))
    if part.position.reports != "none":
        for axis in ("x", "y"):
            about = (f"position_{axis}_m", "m", -inf, inf, f"place along the world's {axis}")
            add(f"position_{axis}", "position", *about)
    if part.position.reports == "pose":
        add("position_heading", "position", "position_heading_rad", "rad", -pi, pi, "heading")
    return Readings(**found)


class Periods(NamedTuple):
    """Ticks between two reports, as fractions: a period need not be a whole number of ticks."""

    sonar: Fraction
    encoder: Fraction
    gyroscope: Fraction
    accelerometer: Fraction
    voltmeter: Fraction
    lidar: Fraction | None = None  # None: the car has none
    position: Fraction | None = None


def number(every: Fraction, tick: Scalar) -> Scalar:
    """Number of reports that are due up to this tick."""
    return tick * every.denominator // every.numerator


def due(every: Fraction, tick: Scalar) -> Scalar:
    """Whether a report is due at this tick."""
    return number(every, tick) != number(every, tick - 1)


class SensorMemory(NamedTuple):
    """The state of the sensors between two ticks."""

    readings: Readings
    disc: Scalar  # position of the eye within a region of the encoder's disc, 0 to 1
    counts: Scalar
    counts_before: Scalar  # at the last report
    velocity: Vector  # at the accelerometer's last report
    eye: Scalar | None  # `error_models.eye` of the line detector (m)
    poses: Array | None = None  # (delay in ticks + 1, 3), one slot a tick, for `position`


def periods(car: Car, dt: float) -> Periods:
    """Each sensor's period, at least one tick."""
    sensors = car.sensors
    times = (
        1 / sensors.sonar.rate,
        sensors.encoder.update,
        1 / sensors.gyroscope.rate,
        1 / sensors.accelerometer.rate,
        1 / sensors.voltmeter.rate,
        1 / sensors.lidar.rate if sensors.lidar.beams else None,
        1 / sensors.position.rate if sensors.position.reports != "none" else None,
    )

    def period(time: Scalar) -> Fraction:
        return max(Fraction(1), Fraction(float(time) / dt).limit_denominator(100))

    found: list[Any] = [None if time is None else period(time) for time in times]
    return Periods(*found)


def position_slots(car: Car, dt: float) -> int:
    """Number of poses to keep for the position's delay. In a batch, for the longest delay."""
    return round(float(np.max(car.sensors.position.delay)) / dt) + 1


def initial_memory(car: Car, motion: Motion, dt: float, slots: int | None = None) -> SensorMemory:
    """Sensors before their first report. `slots` defaults to the car's `position_slots`."""
    dtype = jnp.result_type(motion.x).type
    zero, none = dtype(0), Reading(dtype(0), np.int32(-1))
    no_echo = none._replace(value=dtype(np.inf))
    sensors = car.sensors
    silent: Any = (tuple(no_echo for _ in sensors.sonar.mounts), *[none] * 6)
    readings = Readings(*silent)
    eye, poses, part = None, None, sensors.line_detector
    if part.lines != "none":
        readings = readings._replace(line_crossings=none, line_speed=none)
        eye = error_models.eye(part, motion.x, motion.heading)
    if sensors.lidar.beams:
        no_echoes = np.full(sensors.lidar.beams, np.inf, dtype)
        readings = readings._replace(lidar=none._replace(value=no_echoes))
    if sensors.position.reports != "none":
        readings = readings._replace(position_x=none, position_y=none)
        if sensors.position.reports == "pose":
            readings = readings._replace(position_heading=none)
        slots = position_slots(car, dt) if slots is None else slots
        pose = jnp.stack([motion.x, motion.y, motion.heading]).astype(dtype)
        poses = jnp.tile(pose, (slots, 1))
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)
    return SensorMemory(readings, zero, zero, zero, velocity, eye, poses)


class Now(NamedTuple):
    """The input of a sensor's report."""

    car: Car
    walls: jax.Array
    corners: jax.Array
    memory: SensorMemory
    motion: Motion
    shaft: Scalar  # speed of the driven shaft, seen from the wheels (rad/s)
    root: jax.Array
    tick: Scalar
    dt: float

    def noise(self, stream: Stream, shape: tuple[int, ...] = ()) -> jax.Array:
        """Standard normal noise of a sensor at this tick."""
        key = random_streams.key(self.root, stream, tick=self.tick)
        return jax.random.normal(key, shape, jnp.result_type(self.motion.x))

    @property
    def pose(self) -> tuple[Scalar, Scalar, Scalar]:
        """x, y (m), heading (rad)."""
        return self.motion.x, self.motion.y, self.motion.heading

    def since(self, last: Reading) -> Scalar:
        """Time since a reading (s)."""
        return (self.tick - jnp.maximum(last.tick, 0)) * self.dt


def sense(
    car: Car,
    walls: jax.Array,
    corners: jax.Array,
    memory: SensorMemory,
    motion: Motion,
    root: jax.Array,
    tick: Scalar,
    every: Periods,
    dt: float,
) -> SensorMemory:
    """The sensors after a tick. Noise is drawn once per reading, from the drive's key `root`."""
    sensors = car.sensors
    shaft = drivetrain.driven_speed(car, motion.wheels)
    speed = error_models.disc_speed(sensors.encoder, motion.wheels, shaft)
    turned = memory.disc + dt * error_models.regions_per_second(sensors.encoder, speed)
    passed = jnp.floor(turned)
    memory = memory._replace(disc=turned - passed, counts=memory.counts + jnp.abs(passed))
    slots = 0 if memory.poses is None else len(memory.poses)
    if memory.poses is not None:
        pose = jnp.stack([motion.x, motion.y, motion.heading])
        memory = memory._replace(poses=memory.poses.at[tick % slots].set(pose))

    counted, weighed = due(every.encoder, tick), due(every.accelerometer, tick)
    reports = [
        (due(every.gyroscope, tick), report_gyroscope),
        (weighed, report_accelerometer),
        (counted, report_encoder),
        (due(every.voltmeter, tick), report_voltmeter),
    ]
    if sensors.sonar.mounts:
        turn = number(every.sonar, tick) % len(sensors.sonar.mounts)
        reports.append((due(every.sonar, tick), partial(report_sonar, turn)))
    if every.lidar is not None:
        reports.append((due(every.lidar, tick), report_lidar))
    if every.position is not None and memory.poses is not None:
        reports.append((due(every.position, tick) & (tick >= slots - 1), report_position))
    now = Now(car, walls, corners, memory, motion, shaft, root, tick, dt)
    readings = memory.readings
    for is_due, report in reports:
        readings = jax.lax.cond(is_due, partial(report, now), lambda same: same, readings)
    if memory.eye is not None:
        eye = error_models.eye(sensors.line_detector, motion.x, motion.heading)
        readings = cross(car, readings, memory.eye, eye, tick, dt)
        memory = memory._replace(eye=eye)
    moves = Vector(motion.vx, motion.vy, motion.yaw_rate)
    return memory._replace(
        readings=readings,
        counts_before=jnp.where(counted, memory.counts, memory.counts_before),
        velocity=jax.tree.map(partial(jnp.where, weighed), moves, memory.velocity),
    )


def report_sonar(turn: Scalar, now: Now, readings: Readings) -> Readings:
    """A ping of all mounts. If they fire in turn, only of the mount with index `turn`."""
    part, dtype = now.car.sensors.sonar, jnp.result_type(now.motion.x)
    fires: tuple[jax.Array, ...] = (jnp.asarray(1.0),) * len(part.mounts)
    if part.firing == "in-turn":
        fires = tuple(jnp.where(turn == i, 1.0, 0.0) for i in range(len(part.mounts)))
    key = random_streams.key(now.root, Stream.SONAR, tick=now.tick)
    found = sonar.distances(part, now.walls, now.corners, now.pose, fires, key)
    return readings._replace(
        sonar=tuple(
            Reading(
                jnp.where(f > 0, d, old.value).astype(dtype), jnp.where(f > 0, now.tick, old.tick)
            )
            for f, d, old in zip(fires, found, readings.sonar, strict=True)
        )
    )


def report_gyroscope(now: Now, readings: Readings) -> Readings:
    """The yaw rate."""
    part, noise = now.car.sensors.gyroscope, now.noise(Stream.GYROSCOPE)
    rate = error_models.gyroscope(part, now.motion.yaw_rate, noise)
    return readings._replace(gyroscope=Reading(rate, now.tick))


def report_accelerometer(now: Now, readings: Readings) -> Readings:
    """The mean acceleration since the last report, with the part from the yaw rate.

    That part is averaged too. With its latest value, the start of a turn would show early.
    """
    before, motion, time = now.memory.velocity, now.motion, now.since(readings.accel_x)
    ax = (motion.vx - before.x) / time - (before.yaw * before.y + motion.yaw_rate * motion.vy) / 2
    ay = (motion.vy - before.y) / time + (before.yaw * before.x + motion.yaw_rate * motion.vx) / 2
    noise = now.noise(Stream.ACCELEROMETER, (2,))
    x, y = error_models.accelerometer(now.car.sensors.accelerometer, ax, ay, noise)
    return readings._replace(accel_x=Reading(x, now.tick), accel_y=Reading(y, now.tick))


def report_encoder(now: Now, readings: Readings) -> Readings:
    """Counts, and the wheel speed from the counts since the last report."""
    part, tires, memory = now.car.sensors.encoder, now.car.tires, now.memory
    radius = tires.rear.radius if "rear" in part.on else tires.front.radius
    time = now.since(readings.wheel_speed)
    speed = error_models.wheel_speed(part, radius, memory.counts - memory.counts_before, time)
    return readings._replace(
        counts=Reading(memory.counts, now.tick), wheel_speed=Reading(speed, now.tick)
    )


def report_voltmeter(now: Now, readings: Readings) -> Readings:
    """The battery's voltage under load."""
    car, motion = now.car, now.motion
    noise = now.noise(Stream.VOLTMETER)
    voltage = motor.drive(
        car.motor, car.drivetrain, car.battery, motion.duty, motion.charge, now.shaft
    ).battery_voltage
    volts = error_models.voltmeter(car.sensors.voltmeter, voltage, noise)
    return readings._replace(battery=Reading(volts, now.tick))


def report_lidar(now: Now, readings: Readings) -> Readings:
    """One scan of the lidar."""
    part = now.car.sensors.lidar
    noise = now.noise(Stream.LIDAR, (part.beams,))
    return readings._replace(
        lidar=Reading(lidar.ranges(part, now.walls, now.pose, noise), now.tick)
    )


def report_position(now: Now, readings: Readings) -> Readings:
    """The pose at one `delay` before this tick."""
    poses = now.memory.poses
    assert poses is not None
    noise = now.noise(Stream.POSITION, (3,))
    then = error_models.position(
        now.car.sensors.position, poses[(now.tick + 1) % len(poses)], noise
    )
    new: dict[str, Any] = {
        name: Reading(value, now.tick)
        for name, value in zip(POSITION, then, strict=True)
        if getattr(readings, name) is not None
    }
    return readings._replace(**new)


def cross(
    car: Car, readings: Readings, before: Scalar, eye: Scalar, tick: Scalar, dt: float
) -> Readings:
    """The line detector after a tick. It checks every tick, and reports when it enters a line.

    The first line gives no speed. The speed has no sign. It is wrong if the car turned back.
    """
    part, last, speed = car.sensors.line_detector, readings.line_crossings, readings.line_speed
    assert last is not None
    assert speed is not None
    entered = error_models.lines_entered(part, before, eye)
    again = (entered > 0) & (last.tick >= 0)
    between = jnp.maximum(tick - last.tick, 1) * dt
    return readings._replace(
        line_crossings=Reading(last.value + entered, jnp.where(entered > 0, tick, last.tick)),
        line_speed=Reading(
            jnp.where(again, entered * part.spacing / between, speed.value),
            jnp.where(again, tick, speed.tick),
        ),
    )
