"""What the filters believe, against the truth of drives with cars that are not the nominal one."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from conftest import STEADY, stacked, varied
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.estimation import dead_reckoning, pose, spikes
from countersteer.estimation.estimate import Estimate
from countersteer.estimation.velocity import filter as velocity_filter
from countersteer.estimation.wall_angle import wall_angle
from countersteer.pilot import Pilot
from countersteer.sensing.sonar import distances, edges
from countersteer.signals import Reading
from countersteer.simulator import Simulator, scan
from countersteer.world import battery
from countersteer.world.walls import padded

CARS, TICKS, STEP, DT = 16, 4000, 5, 1e-3
COURSE = load_course("box")
NOMINAL = jax.tree.map(np.float32, load_car("rx7"))
SINGLE = np.dtype(np.float32)


class Drives(NamedTuple):
    """Arrays of (steps of the filter, cars)."""

    record: object
    cars: object
    charges: np.ndarray
    sound: np.ndarray  # where no wall was touched yet


def drawn(rng):
    """A car within what the project's cars vary by, and a charge."""

    def near(value, share):
        return value * (1 + share * rng.uniform(-1, 1))

    car, gain = load_car("rx7"), near(1.0, 0.2)
    sensors = car.sensors
    return varied(
        car,
        {
            "tires.front.friction": near(car.tires.front.friction, 0.15),
            "tires.rear.friction": near(car.tires.rear.friction, 0.15),
            "body.mass": near(car.body.mass, 0.05),
            "body.yaw_inertia": near(car.body.yaw_inertia, 0.1),
            "motor.torque_constant": near(car.motor.torque_constant, 0.05),
            "servo.gain_left": gain,
            "servo.gain_right": gain,
            "battery.wear": rng.uniform(),
            "sensors.gyroscope.bias": sensors.gyroscope.bias + 0.009 * rng.normal(),
            "sensors.gyroscope.noise": near(sensors.gyroscope.noise, 0.3),
            "sensors.accelerometer.bias_x": sensors.accelerometer.bias_x + 0.1 * rng.normal(),
            "sensors.accelerometer.bias_y": sensors.accelerometer.bias_y + 0.1 * rng.normal(),
            "sensors.accelerometer.noise": near(sensors.accelerometer.noise, 0.3),
        },
    ), rng.uniform(0.3, 1.0)


@pytest.fixture(scope="module")
def drives() -> Drives:
    rng = np.random.default_rng(5)
    driver = drift_turn(COURSE, NOMINAL, None, 1, *STEADY)
    simulators = []
    for seed in range(CARS):
        car, charge = drawn(rng)
        x, y, heading = COURSE.start
        start = (x, y + 0.03 * rng.normal(), heading + 0.02 * rng.normal())
        car = jax.tree.map(np.float32, car)
        simulators.append(Simulator.of(COURSE, car, seed=seed, charge=charge, start=start))
    pilot = Pilot.of(driver, COURSE, NOMINAL, "reckoning").typed(np.float32)
    with jax.enable_x64(False):
        begun = [(s.init(), pilot.init(s.root)) for s in simulators]
        loop, memory = jax.tree.map(lambda *leaves: jnp.stack(leaves), *begun)
        loop = loop._replace(tick=jnp.int32(0))
        axes = jax.tree.map(lambda _: 0, loop)._replace(tick=None)
        cars = stacked([s.car for s in simulators])
        seeds = np.arange(CARS, dtype=np.int32)

        def one(car, seed, loop, memory):
            world = dataclasses.replace(simulators[0].world, car=car)
            own = dataclasses.replace(simulators[0], world=world, seed=seed)
            record = scan(own, pilot, TICKS, loop, memory)[2]
            return jax.tree.map(lambda leaf: leaf[::STEP], record)

        record = jax.vmap(one, (0, 0, axes, 0), 1)(cars, seeds, loop, memory)
        record = jax.tree.map(np.asarray, record)
    sound = (record.wall_contacts == 0) & (record.rolled_over == 0)
    return Drives(record, cars, np.array([s.charge for s in simulators]), sound)


@jax.jit
def filtered(nominal, readings, command, ticks):
    """The estimates of both filters after every step, (steps, cars)."""
    first = velocity_filter.initial_memory(nominal, COURSE.start, SINGLE)._replace(
        tick=jnp.int32(0)
    )
    axes = jax.tree.map(lambda _: 0, first)._replace(tick=None)
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (CARS, *jnp.shape(leaf))), first)
    reckoned = dead_reckoning.initial_memory(COURSE.start, SINGLE)
    reckoned = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (CARS,)), reckoned)

    def step(memories, now):
        memory, reckoned = memories
        readings, command, tick = now
        memory = jax.vmap(
            lambda m, r, c: velocity_filter.update(nominal, m, r, c, tick, DT), (axes, 0, 0), axes
        )(memory, readings, command)
        reckoned = jax.vmap(lambda m, r: dead_reckoning.update(m, r, DT))(reckoned, readings)
        estimate = jax.vmap(lambda m: velocity_filter.estimate(nominal, m, DT), (axes,))(memory)
        reckoned = jax.tree.map(lambda new, old: new.astype(old.dtype), reckoned, memories[1])
        return (memory, reckoned), (estimate, reckoned.estimate)

    return jax.lax.scan(step, (wide._replace(tick=first.tick), reckoned),
                        (readings, command, ticks))[1]  # fmt: skip


TICK = np.arange(0, TICKS, STEP, dtype=np.int32)


def believed(drives, nominal=NOMINAL, **changed):
    """Estimates with some of the readings replaced."""
    with jax.enable_x64(False):
        readings = drives.record.readings._replace(**changed)
        readings = jax.tree.map(
            lambda leaf: leaf.astype(np.int32 if leaf.dtype.kind == "i" else np.float32), readings
        )
        answer = filtered(nominal, readings, drives.record.command, TICK)
        return jax.tree.map(np.asarray, answer)


@pytest.fixture(scope="module")
def estimates(drives):
    return believed(drives)


def drifting(drives):
    motion = drives.record.motion
    return drives.sound & (np.abs(slip(motion)) > math.radians(15)) & (motion.vx > 0.5)


def slip(motion):
    return np.arctan2(motion.vy, motion.vx)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_sideslip_in_drifts_is_known_to_two_degrees(drives, estimates):
    during = drifting(drives)
    assert during.sum() > 1000
    error, reckoned = (
        math.degrees(rms((slip(e) - slip(drives.record.motion))[during])) for e in estimates
    )
    assert error < 2.0
    assert error < reckoned / 2


def test_errors_agree_with_their_covariance(drives, estimates):
    motion, estimate = drives.record.motion, estimates[0]
    c = estimate.velocity_covariance
    rows = ((c.xx, c.xy, c.xw), (c.xy, c.yy, c.yw), (c.xw, c.yw, c.ww))
    covariance = np.stack([np.stack(row, -1) for row in rows], -2).astype(float)
    assert np.linalg.eigvalsh(covariance).min() > 0
    error = np.stack(
        [estimate.vx - motion.vx, estimate.vy - motion.vy, estimate.yaw_rate - motion.yaw_rate], -1
    )
    square = np.einsum("...i,...ij,...j", error, np.linalg.inv(covariance), error)
    after = drives.sound & (TICK[:, None] > 500)
    # A car's errors hang together over a drive, so its mean counts as one draw of three.
    low, high = chi2.ppf([0.025, 0.975], 3 * CARS) / CARS
    assert low < square[after].mean() < high
    assert np.mean(square[after] < chi2.ppf(0.95, 3)) > 0.93


def test_battery_and_friction_are_felt(drives, estimates):
    estimate = estimates[0]
    cars, nominal = drives.cars, NOMINAL
    open_circuit = np.array([battery.open_circuit(nominal.battery, c) for c in drives.charges])
    voltage = estimate.battery[-1] * nominal.battery.full
    assert rms(voltage - open_circuit) < 0.05 < open_circuit.std() / 2
    resistance = np.array(jax.vmap(battery.resistance)(cars.battery))
    assert rms(estimate.battery_resistance[-1] - resistance) < 0.05 < resistance.std() / 2
    friction = cars.tires.rear.friction / nominal.tires.rear.friction
    assert rms(estimate.friction[-1] - friction) < 0.75 * rms(friction - 1)


def test_a_weak_servo_is_felt(drives, estimates):
    """One that turns too far ends at the lock's limit, as the nominal one does."""
    gain, told = np.asarray(drives.cars.servo.gain_left), estimates[0].servo[-1]
    weak = gain < 1
    assert weak.sum() >= 4
    assert rms((told - gain)[weak]) < 0.05 < gain[weak].std()
    assert np.all(told[~weak] > 0.93)


def broken(reading, kind):
    """A reading's record from 2 s on as a broken sensor would give it."""
    after = TICK[:, None] >= 2000
    value, tick = np.array(reading.value), np.array(reading.tick)
    if kind == "dead":
        tick = np.where(after, tick[TICK.searchsorted(2000)], tick)
    if kind in ("dead", "stuck"):
        value = np.where(after, value[TICK.searchsorted(2000)], value)
    if kind == "spiking":
        rng = np.random.default_rng(0)
        value = np.where(after & (rng.uniform(size=value.shape) < 0.2), 40.0, value)
    if kind == "nan":
        value = np.where(after, np.nan, value)
    return Reading(value.astype(reading.value.dtype), tick)


@pytest.mark.parametrize("kind", ["dead", "stuck", "spiking", "nan"])
@pytest.mark.parametrize("sensor", ["gyroscope", "accel_x", "accel_y", "counts", "battery"])
def test_a_broken_sensor_never_makes_a_nan(drives, sensor, kind):
    reading = broken(getattr(drives.record.readings, sensor), kind)
    estimate = believed(drives, **{sensor: reading})[0]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(estimate))
    if sensor in ("gyroscope", "counts") and kind in ("spiking", "nan"):
        after = drives.sound & (TICK[:, None] >= 2000) & (TICK[:, None] < 2500)
        assert rms((estimate.vx - drives.record.motion.vx)[after]) < 0.3


def test_a_mirrored_drive_gives_the_mirrored_estimate(drives):
    even = jax.tree.map(
        np.float32,
        varied(
            load_car("rx7"),
            {"sensors.gyroscope.bias": 0.0, "sensors.accelerometer.bias_y": 0.0, "body.track": 0.0},
        ),
    )
    flip = lambda reading: Reading(-reading.value, reading.tick)  # noqa: E731  # used twice
    readings, command = drives.record.readings, drives.record.command
    mirrored = drives._replace(
        record=drives.record._replace(
            readings=readings._replace(
                gyroscope=flip(readings.gyroscope), accel_y=flip(readings.accel_y)
            ),
            command=command._replace(steering=-command.steering),
        )
    )
    one, other = believed(drives, even)[0], believed(mirrored, even)[0]
    np.testing.assert_allclose(other.vx, one.vx, atol=1e-3)
    np.testing.assert_allclose(other.vy, -one.vy, atol=1e-3)
    np.testing.assert_allclose(other.yaw_rate, -one.yaw_rate, atol=1e-3)


def test_a_standing_car_stays(drives):
    rng = np.random.default_rng(1)
    shape, sensors = (len(TICK), CARS), NOMINAL.sensors
    tick = np.broadcast_to(TICK[:, None], shape)

    def noisy(bias, noise):
        return Reading((bias + noise * rng.normal(size=shape)).astype(np.float32), tick)

    still = Reading(np.zeros(shape, np.float32), tick)
    accel = sensors.accelerometer
    standing = drives._replace(
        record=drives.record._replace(command=jax.tree.map(np.zeros_like, drives.record.command))
    )
    estimate = believed(
        standing,
        gyroscope=noisy(sensors.gyroscope.bias, sensors.gyroscope.noise),
        accel_x=noisy(accel.bias_x + 0.1, accel.noise),
        accel_y=noisy(accel.bias_y - 0.1, accel.noise),
        counts=still,
        wheel_speed=still,
    )[0]
    assert np.abs(estimate.vx[-1]).max() < 0.05
    assert np.abs(estimate.vy[-1]).max() < 0.05
    assert np.abs(estimate.heading[-1] - COURSE.start[2]).max() < math.radians(2)


def test_a_start_that_was_not_at_rest_is_found_out(drives):
    """The same readings from 0.6 s on, when the cars are under way."""
    late = 120

    def later(leaf):
        moved = np.roll(leaf, -late, axis=0)
        return moved - late * STEP if leaf.dtype.kind == "i" else moved

    readings = jax.tree.map(later, drives.record.readings)
    estimate = believed(drives, **readings._asdict())[0]
    truth = np.roll(drives.record.motion.vx, -late, axis=0)
    assert np.abs(estimate.vx[0] - truth[0]).min() > 0.8
    assert rms(estimate.vx[80:90] - truth[80:90]) < 0.2


@pytest.mark.parametrize("left", ["sound", "dead", "stuck"])
def test_the_angle_to_the_wall_is_known_on_straights(drives, estimates, left):
    locator = jax.tree.map(np.float32, wall_angle(NOMINAL, COURSE.width))
    record, estimate = drives.record, estimates[0]
    sonar = list(record.readings.sonar)
    if left != "sound":
        worth = np.inf if left == "dead" else 0.4
        sonar[1] = Reading(np.full_like(sonar[1].value, worth), sonar[1].tick)
    turned = np.diff(record.status.turn, axis=0, prepend=0) > 0
    ages = [np.float32(DT) * (TICK[:, None] - reading.tick).astype(np.float32) for reading in sonar]
    with jax.enable_x64(False):
        memory = locator.initial_memory(heading=COURSE.start[2], dtype=np.float32)
        memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (CARS,)), memory)

        def one(memory, now):
            sonar, ages, estimate, time, turned = now
            beyond = locator.turned(memory, -np.float32(math.pi / 2))
            memory = jax.tree.map(lambda new, old: jnp.where(turned, new, old), beyond, memory)
            return locator.update(memory, sonar, ages, estimate, time)

        def step(memory, now):
            memory = jax.vmap(one)(memory, now)
            return memory, (memory.offset, memory.angle)

        time = np.broadcast_to(np.float32(DT) * TICK[:, None], (len(TICK), CARS))
        inputs = (tuple(sonar), tuple(ages), estimate, time, turned)
        offset, angle = jax.jit(lambda m, xs: jax.lax.scan(step, m, xs)[1])(memory, inputs)
    motion = record.motion
    bearing = COURSE.start[2] - record.status.turn * math.pi / 2
    along = np.cos(bearing), np.sin(bearing)
    corner = COURSE.line[record.status.turn.astype(int) % 4]
    true_offset = along[0] * (motion.y - corner[..., 1]) - along[1] * (motion.x - corner[..., 0])
    true_angle = motion.heading - bearing
    since = (np.cumsum(record.status.turn >= 1, axis=0) * STEP * DT > 1.5) & (
        record.status.turn == 1
    )
    straight = (since | (record.status.turn == 0)) & (np.abs(true_angle) < 0.2) & drives.sound
    straight = straight & (TICK[:, None] > 800)
    assert straight.sum() > 500
    assert math.degrees(rms((angle - true_angle)[straight])) < 2.0
    assert np.median(np.abs(offset - true_offset)[straight]) < 0.01


def test_a_wall_ahead_is_seen_at_once_and_a_spike_never():
    memory = spikes.initial_memory(np.dtype(np.float64))
    noise, driven = 0.01, 0.05
    wall = 2.0
    for tick in range(1, 30):
        wall -= driven
        spiked = tick % 7 == 3
        value = 0.3 * wall if spiked else wall
        memory = spikes.update(memory, Reading(value, tick), driven, noise)
        if tick > 3:
            assert memory.believed == pytest.approx(wall, abs=0.05)
    # What comes into view at once is believed with its second ping.
    for ping in (1, 2):
        memory = spikes.update(memory, Reading(0.2 - 0.05 * ping, 30 + ping), driven, noise)
        assert (memory.believed < 0.2) == (ping == 2)


def test_the_pose_settles_from_anywhere_within_two_turns(drives, estimates):
    """Up to the box's own symmetry: its four corners are alike to every sensor."""
    record, every = drives.record, 5
    thin = lambda tree: jax.tree.map(lambda leaf: leaf[::every], tree)  # noqa: E731  # used thrice
    walls = jnp.asarray(padded(COURSE.walls, SINGLE))
    place = pose.PoseFilter(walls=walls, sonar=NOMINAL.sensors.sonar)
    h = np.float32(every * STEP * DT)

    @jax.jit
    def locate(key, estimate, sonar):
        first = jax.tree.map(lambda leaf: leaf[0], estimate)
        cloud = place.uniform(COURSE, key, 2000, first)

        def step(cloud, now):
            return place.update(cloud, now[1], now[0], h), None

        cloud = jax.lax.scan(step, cloud, (estimate, sonar))[0]
        return pose.best(cloud)

    settled, trials, errors = 0, 0, []
    with jax.enable_x64(False):
        for car in np.nonzero(drives.sound[-1] & (record.status.turn[-1] >= 2))[0]:
            own = [jax.tree.map(lambda leaf, i=car: leaf[:, i], thin(t))
                   for t in (estimates[0], record.readings.sonar)]  # fmt: skip
            found = jax.tree.map(float, locate(jax.random.key(int(car)), *own))
            motion = jax.tree.map(lambda leaf, i=car: leaf[-1, i], thin(record.motion))
            middle = COURSE.line[:4].mean(axis=0)
            misses = []
            for quarter in range(4):
                c, s = math.cos(quarter * math.pi / 2), math.sin(quarter * math.pi / 2)
                dx, dy = motion.x - middle[0], motion.y - middle[1]
                x, y = middle[0] + c * dx - s * dy, middle[1] + s * dx + c * dy
                turned = math.remainder(
                    found.heading - motion.heading - quarter * math.pi / 2, 2 * math.pi
                )
                misses.append((math.hypot(found.x - x, found.y - y), abs(turned)))
            distance, angle = min(misses)
            trials += 1
            settled += distance < 0.3 and angle < math.radians(15)
            errors.append(distance)
            assert found.share < 1 + 1e-5
            assert min(found.covariance.xx, found.covariance.yy, found.covariance.ww) > 0
    assert trials >= 8
    assert settled >= 0.95 * trials
    assert np.median(errors) < 0.1


@pytest.mark.parametrize("name", ["box", "ess"])
def test_the_pose_filter_expects_what_a_sonar_reports(name):
    """Without noise and chance, anywhere in the corridor: the echo of the same wall, or none."""
    course = load_course(name)
    sonar = varied(NOMINAL, {
        "sensors.sonar.noise": 0.0, "sensors.sonar.resolution": 0.0,
        "sensors.sonar.edge_echo": 0.0, "sensors.sonar.hearing": 0.0,
    }).sensors.sonar  # fmt: skip
    walls = jnp.asarray(padded(course.walls, SINGLE))
    corners = jnp.asarray(edges(padded(course.walls, SINGLE)))
    place = pose.PoseFilter(walls=walls, sonar=sonar)
    with jax.enable_x64(False):
        still = Estimate(*jnp.zeros(6, SINGLE))
        cloud = place.uniform(course, jax.random.key(1), 4000, still)

        @jax.jit
        @jax.vmap
        def told(x, y, heading):
            fires = (np.float32(1),) * 3
            return distances(sonar, walls, corners, (x, y, heading), fires, jax.random.key(0))

        reported = np.stack(told(cloud.x, cloud.y, cloud.heading))
        expected = np.stack(jax.jit(place.expected)(cloud.x, cloud.y, cloud.heading))
    expected = np.where(expected <= sonar.reach, np.maximum(expected, sonar.nearest), 99.0)
    reported = np.where(np.isfinite(reported), reported, 99.0)
    assert np.mean(reported < 99) > 0.5
    assert np.mean(np.abs(expected - reported) < 0.01) > 0.99
