"""Sensors report what the real parts would: against brute force, by chance, and on the clock."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from conftest import start, varied, write_run
from countersteer.car.car import Car, Lidar, LineDetector, Mount, Position, Sonar
from countersteer.car.files import load_car
from countersteer.course.course import place
from countersteer.course.files import load_course
from countersteer.drivers.replay import Replay
from countersteer.errors import InputError
from countersteer.sensing import all_sensors, error_models, lidar, sonar
from countersteer.signals import Command, Motion

RX7 = load_car("rx7")
SCENES = 1000  # always as many, so that there is one program for each number of mounts
PLAIN = {"noise": 0.0, "resolution": 0.0, "edge_echo": 0.0, "nearest": 0.0, "reach": 3.5}


def sonars(mounts: dict[str, tuple[float, float, float]], **changes: Any) -> Sonar:
    """A set of sonars by name, each with x, y and angle."""
    leaves = Sonar(
        mount_names=tuple(mounts),
        mounts=tuple(Mount(x=x, y=y, angle=angle) for x, y, angle in mounts.values()),
        **(PLAIN | changes),
    )
    return jax.tree.map(np.float64, leaves)


@pytest.fixture(scope="module")
def ping() -> Callable:
    """What each mount reports at each of many poses in as many scenes: (scenes, mounts)."""

    @jax.jit
    def many(part: Sonar, walls, corners, poses, fires, keys) -> jax.Array:
        def one(walls, corners, pose, key):
            told = sonar.distances(part, walls, corners, tuple(pose), tuple(fires), key)
            return jnp.stack(told)

        return jax.vmap(one)(walls, corners, poses, keys)

    def run(
        part: Sonar,
        walls: np.ndarray,
        poses: np.ndarray,
        fires: tuple[float, ...] | None = None,
        seed: int = 0,
    ) -> np.ndarray:
        count = len(poses)
        around = np.full((SCENES, 8, 4), np.nan)
        around[:count, : np.shape(walls)[-2]] = walls
        if np.ndim(walls) == 2:
            corners = np.broadcast_to(sonar.edges(around[0]), (SCENES, 16, 3))
        else:
            corners = np.stack([sonar.edges(scene) for scene in around])
        placed = np.zeros((SCENES, 3))
        placed[:count] = poses
        keys = jax.random.split(jax.random.key(seed), SCENES)
        fires = (1.0,) * len(part.mounts) if fires is None else fires
        told = many(part, around, corners, placed, np.array(fires), keys)
        return np.asarray(told)[:count]

    return run


# Echoes


def cast(walls: np.ndarray, pose: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the first wall along each ray, and the angle to its normal there (rad)."""
    x, y, heading = pose
    ray = np.stack([np.cos(heading + angles), np.sin(heading + angles)], axis=1)
    a, b = walls[:, :2] - [x, y], walls[:, 2:] - [x, y]
    d = b - a
    cross = lambda p, q: p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]  # noqa: E731  # four uses
    span = cross(ray[:, None], d[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = cross(a, d)[None] / span
        at = cross(a[None], ray[:, None]) / span
    far = np.where((far > 0) & (at >= 0) & (at <= 1), far, np.inf)
    first = far.argmin(axis=1)
    along = d[first] / np.hypot(*d[first].T)[:, None]
    return far.min(axis=1), np.arcsin(np.clip(np.abs((along * ray).sum(axis=1)), 0, 1))


def crossing(walls: np.ndarray) -> bool:
    """Whether two of the walls cross: no course has such, and they hide each other in part."""
    a, d = walls[:, :2], walls[:, 2:] - walls[:, :2]
    cross = lambda p, q: p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]  # noqa: E731  # three uses
    with np.errstate(divide="ignore", invalid="ignore"):
        at = cross(a[None] - a[:, None], d[None]) / cross(d[:, None], d[None])
    return bool(np.any((at > 0) & (at < 1) & (at.T > 0) & (at.T < 1)))


def scenes(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random walls around random poses; no wall comes within 5 cm."""
    rng = np.random.default_rng(seed)
    walls, poses = [], []
    while len(walls) < count:
        middle, bearing = rng.uniform(-3, 3, (8, 2)), rng.uniform(-4, 4, 8)
        half = np.stack([np.cos(bearing), np.sin(bearing)], axis=1) * rng.uniform(0.1, 2, (8, 1))
        scene = np.hstack([middle - half, middle + half])
        pose = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-4, 4)])
        if crossing(scene):
            continue
        if cast(scene, pose, np.linspace(-math.pi, math.pi, 721))[0].min() > 0.05:
            walls.append(scene)
            poses.append(pose)
    return np.array(walls), np.array(poses)


def test_a_sonar_hears_the_nearest_echo_that_ray_casting_finds(ping: Callable) -> None:
    seed, count = 1, 300
    walls, poses = scenes(seed, count)
    part = sonars({"front": (0, 0, 0)})
    heard = ping(part, walls, poses)[:, 0]
    angles = np.linspace(-part.half_angle, part.half_angle, 4401)
    wrong = []
    for i in range(count):
        far, oblique = cast(walls[i], poses[i], angles)
        echoes = far[(oblique <= part.obliqueness) & (far <= part.reach)]
        expected = echoes.min() if echoes.size else np.inf
        if not (heard[i] == expected or abs(heard[i] - expected) < 3e-3):
            wrong.append((i, float(heard[i]), float(expected)))
    assert np.isfinite(heard).sum() > count / 3
    assert np.isinf(heard).sum() > count / 20
    assert not wrong, f"seed {seed}: {len(wrong)} of {count} scenes, such as {wrong[:3]}"


def test_a_wall_behind_a_corner_is_not_heard_by_its_end(ping: Callable) -> None:
    """The wall beside the car hides the next one but for the corner, which echoes by chance."""
    beside, hidden = [-1.0, 0.7, 2.1, 0.7], [2.1, 0.7, 2.1, 3.0]
    across = [3.5, -2.0, 3.5, 3.0]
    poses = np.array([[x, 0.0, 0.0] for x in np.linspace(-0.2, 0.4, 25)])
    for pair in ((beside, hidden), (hidden, beside)):
        heard = ping(sonars({"front": (0, 0, 0)}), np.array([*pair, across]), poses)[:, 0]
        behind = np.where(poses[:, 0] >= 0.0, 3.5 - poses[:, 0], np.inf)
        assert np.where(poses[:, 0] >= 0.0, heard, np.inf) == pytest.approx(behind, abs=2e-3)
        assert np.isinf(heard[poses[:, 0] < -0.01]).all(), "beyond the reach of 3.5 m"


def test_a_sonar_ends_at_its_reach_its_cone_and_an_oblique_wall(ping: Callable) -> None:
    part = sonars({"front": (0, 0, 0)})

    def wall(distance: float, bearing: float, half: float, slant: float = 0.0) -> np.ndarray:
        """A wall with its middle at a distance and bearing, turned from facing the sonar."""
        middle = distance * np.array([math.cos(bearing), math.sin(bearing)])
        way = bearing + slant + math.pi / 2
        step = half * np.array([math.cos(way), math.sin(way)])
        return np.array([[*(middle - step), *(middle + step)]])

    cone = part.half_angle
    cases = [
        (wall(3.49, 0, 0.1), 3.49),
        (wall(3.51, 0, 0.1), np.inf),
        (wall(1.0, cone - 0.01, 0.001), 1.0),
        (wall(1.0, cone + 0.01, 0.001), np.inf),
        (wall(1.0, 0, 1e-4, math.radians(44)), 1.0),
        (wall(1.0, 0, 1e-4, math.radians(46)), np.inf),
        (wall(-1.0, 0, 0.1), np.inf),
        (np.vstack([wall(2.0, 0, 1), wall(1.0, 0, 0.5)]), 1.0),
        # An oblique wall before it silences the wall behind.
        (np.vstack([wall(2.0, 0, 0.1), wall(1.0, 0, 0.25, math.radians(60))]), np.inf),
    ]
    walls = np.full((len(cases), 2, 4), np.nan)
    for row, (scene, _) in zip(walls, cases, strict=True):
        row[: len(scene)] = scene
    heard = ping(part, walls, np.zeros((len(cases), 3)))[:, 0]
    np.testing.assert_allclose(heard, [expected for _, expected in cases], atol=2e-3)


def test_the_edge_of_a_wall_gives_spikes_by_chance(ping: Callable) -> None:
    # A wall too oblique to echo, its near end 1 m ahead; then the same end in the midst of a wall.
    count = 1000
    slanted = np.array([[1.0, 0.0, 1.0 + math.cos(0.3), math.sin(0.3)]])
    through = np.vstack([slanted, [[1.0, 0.0, 1.0 - math.cos(0.3), -math.sin(0.3)]]])
    poses = np.zeros((count, 3))
    heard = ping(sonars({"front": (0, 0, 0)}, edge_echo=0.3), slanted, poses, seed=4)[:, 0]
    near = np.abs(heard - 1) < 1e-6
    assert 0.25 < near.mean() < 0.35
    assert np.isin(
        np.round(heard[~near], 3), [np.inf, np.round(math.hypot(*slanted[0, 2:]), 3)]
    ).all()
    assert np.isinf(ping(sonars({"front": (0, 0, 0)}), slanted, poses[:50])).all()
    part = sonars({"front": (0, 0, 0)}, edge_echo=1.0)
    assert ping(part, slanted, poses[:1])[0, 0] == pytest.approx(1)
    assert ping(part, through, poses[:1])[0, 0] != pytest.approx(1), "no edge where walls go on"


def test_neighbours_are_heard_when_they_fire_together(ping: Callable) -> None:
    # The left one faces the wall; the right one sees it only too obliquely.
    part = sonars({"left": (0, 0.05, 0.5), "right": (0, -0.05, -0.5)}, hearing=math.radians(80))
    way = 0.5
    middle = np.array([math.cos(way), 0.05 + math.sin(way)])
    step = 0.4 * np.array([-math.sin(way), math.cos(way)])
    wall = np.array([[*(middle - step), *(middle + step)]])
    pose = np.zeros((1, 3))
    together = ping(part, wall, pose, (1.0, 1.0))[0]
    assert together[0] == pytest.approx(0.95, abs=0.06)
    assert 0 < together[1] - together[0] < 0.06, "half of the way out and back"
    assert np.isinf(ping(part, wall, pose, (0.0, 1.0))[0, 1])


def test_distances_are_noisy_quantised_and_repeat_for_the_same_seed(ping: Callable) -> None:
    part = sonars(
        {"front": (0, 0, 0), "aside": (0.1, 0.5, 0)}, noise=0.008, resolution=0.01, hearing=0.01
    )
    wall, poses = np.array([[1.0, -2, 1.0, 2]]), np.zeros((1000, 3))
    heard = ping(part, wall, poses, seed=5)
    assert heard.mean(axis=0) == pytest.approx([1.0, 0.9], abs=2e-3)
    assert heard.std(axis=0) == pytest.approx(math.hypot(0.008, 0.01 / math.sqrt(12)), rel=0.1)
    np.testing.assert_allclose(heard, np.round(heard, 2), atol=1e-12)
    assert abs(np.corrcoef(heard.T)[0, 1]) < 0.15
    np.testing.assert_array_equal(heard, ping(part, wall, poses, seed=5))
    assert np.any(heard != ping(part, wall, poses, seed=6))


# The suite on the shared clock

TICKS, DT = 1500, 1e-3


@pytest.fixture(scope="module")
def listen() -> Callable[..., all_sensors.Readings]:
    """All readings after each of 1500 ticks of 1 ms, for a motion given by tick."""
    walls = np.full((8, 4), np.nan)
    walls[0] = [2.0, -5, 2.0, 5]
    corners = np.asarray(sonar.edges(walls))

    def run(
        car: Car,
        motion: Motion,
        memory: all_sensors.SensorMemory,
        key: jax.Array,
        every: all_sensors.Periods,
    ) -> all_sensors.Readings:
        def tick(memory: all_sensors.SensorMemory, now: tuple) -> tuple:
            count, motion = now
            memory = all_sensors.sense(car, walls, corners, memory, motion, key, count, every, DT)
            return memory, memory.readings

        counts = jnp.arange(1, TICKS + 1, dtype=jnp.int32)
        return jax.lax.scan(tick, memory, (counts, motion))[1]

    program = jax.jit(run, static_argnums=4)

    def told(car: Car, seed: int = 0, **changes: Any) -> all_sensors.Readings:
        motion = jax.tree.map(
            lambda leaf: np.broadcast_to(np.float64(leaf), TICKS), start(car, 4).motion
        )
        motion = motion._replace(
            **jax.tree.map(lambda leaf: np.broadcast_to(np.float64(leaf), TICKS), changes)
        )
        key = jax.random.key(seed)
        first = jax.tree.map(lambda leaf: leaf[0], motion)
        memory = jax.tree.map(jnp.asarray, all_sensors.initial_memory(car, first, DT))
        readings = program(car, motion, memory, key, all_sensors.periods(car, DT))
        return jax.tree.map(np.asarray, readings)

    return told


def fresh(reading: all_sensors.Reading) -> np.ndarray:
    """Ticks at which a sensor reported, each once."""
    ticks = np.arange(1, TICKS + 1)
    return ticks[reading.tick == ticks]


def test_each_sensor_reports_at_its_own_rate(listen: Callable) -> None:
    told = listen(RX7)
    sensors = RX7.sensors
    for reading, rate in (
        (told.sonar[0], sensors.sonar.rate),
        (told.sonar[2], sensors.sonar.rate),
        (told.wheel_speed, 1 / sensors.encoder.update),
        (told.gyroscope, sensors.gyroscope.rate),
        (told.accel_x, sensors.accelerometer.rate),
        (told.battery, sensors.voltmeter.rate),
    ):
        gaps = np.diff(fresh(reading))
        assert len(gaps) >= 20
        np.testing.assert_allclose(gaps * DT, 1 / rate, rtol=1e-9)
        assert fresh(reading)[0] * DT == pytest.approx(1 / rate)


@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2])
def test_rates_hold_at_every_step_that_is_short_enough(dt: float) -> None:
    sensors = RX7.sensors
    wanted = (
        1 / sensors.sonar.rate,
        sensors.encoder.update,
        1 / sensors.gyroscope.rate,
        1 / sensors.accelerometer.rate,
        1 / sensors.voltmeter.rate,
    )
    for name, period, ticks in zip(
        all_sensors.Periods._fields,
        (*wanted, None, None),
        all_sensors.periods(RX7, dt),
        strict=True,
    ):
        if period is None:
            assert ticks is None, f"the rx7 has no {name}"
            continue
        assert ticks * dt == pytest.approx(max(period, dt), rel=0.05), name


def test_sonars_in_turn_report_one_a_ping_and_hear_no_neighbour(listen: Callable) -> None:
    part = dataclasses.replace(RX7.sensors.sonar, firing="in-turn")
    car = dataclasses.replace(RX7, sensors=dataclasses.replace(RX7.sensors, sonar=part))
    told = listen(car)
    reports = [set(fresh(reading)) for reading in told.sonar]
    assert not reports[0] & reports[1] | reports[1] & reports[2] | reports[0] & reports[2]
    every = np.sort(np.concatenate([list(r) for r in reports]))
    np.testing.assert_allclose(np.diff(every) * DT, 1 / part.rate)
    assert np.isfinite(told.sonar[0].value[-1])
    assert np.isinf(told.sonar[1].value).all()


def test_the_encoder_steps_by_033_mps_and_does_not_tell_direction(listen: Callable) -> None:
    radius = 0.0315
    assert RX7.sensors.encoder.regions == 10
    assert RX7.sensors.encoder.update == 0.03
    wheels = start(RX7, 4).motion.wheels
    speed = 2.0 / radius

    def told(spin: object) -> all_sensors.Readings:
        return listen(RX7, wheels=wheels._replace(rear_left=spin))

    forward, backward = told(speed), told(-speed)
    step = 0.33
    values = forward.wheel_speed.value[forward.wheel_speed.tick > 0]
    np.testing.assert_allclose(values / step, np.round(values / step), atol=0.01)
    assert values.mean() == pytest.approx(2.0, rel=0.02)
    assert set(np.round(values / step)) <= {6, 7}
    assert backward.counts.value[-1] == pytest.approx(forward.counts.value[-1], abs=1)
    assert backward.wheel_speed.value.min() >= 0
    # Forward and back again: the counts go on.
    swing = np.where(np.arange(TICKS) < TICKS / 2, speed, -speed)
    assert told(swing).counts.value[-1] == pytest.approx(forward.counts.value[-1], abs=1)
    assert np.all(np.diff(forward.counts.value) >= 0)
    expected = speed * 1.5 * 20 / (2 * math.pi)
    assert forward.counts.value[-1] == pytest.approx(expected, abs=1.01)


def test_the_gyroscope_saturates_at_300_degrees_a_second(listen: Callable) -> None:
    rates = np.radians(np.repeat([-900.0, -290.0, 0.0, 150.0, 900.0], TICKS // 5))
    read = np.degrees(listen(RX7, yaw_rate=rates).gyroscope.value).reshape(5, -1)[:, 10:]
    assert np.all(read[0] == pytest.approx(-300))
    assert np.all(read[4] == pytest.approx(300))
    bias = math.degrees(RX7.sensors.gyroscope.bias)
    assert read[3].mean() == pytest.approx(150 + bias, abs=0.8)
    assert read[2].mean() == pytest.approx(bias, abs=0.8)
    assert np.abs(read).max() <= 300 + 1e-9


def test_the_accelerometer_feels_what_turns_the_velocity(listen: Callable) -> None:
    quiet = varied(RX7, {"sensors.accelerometer.noise": 0.0, "sensors.accelerometer.resolution": 0})
    times = DT * np.arange(1, TICKS + 1)
    # A steady circle, and a straight launch.
    told = listen(quiet, vx=2.0, yaw_rate=3.0, vy=-0.5)
    part = quiet.sensors.accelerometer
    assert told.accel_x.value[-1] == pytest.approx(3.0 * 0.5 + part.bias_x)
    assert told.accel_y.value[-1] == pytest.approx(3.0 * 2.0 + part.bias_y)
    told = listen(quiet, vx=4 * times)
    assert told.accel_x.value[-1] == pytest.approx(4 + part.bias_x, rel=1e-6)
    told = listen(quiet, vx=100 * times)
    assert told.accel_x.value[-1] == pytest.approx(part.reach)


def test_noise_is_drawn_once_a_reading_and_is_the_same_for_the_same_seed(
    listen: Callable,
) -> None:
    told, again, other = listen(RX7, 1), listen(RX7, 1), listen(RX7, 2)
    for name in ("gyroscope", "accel_x", "accel_y", "battery"):
        reading = getattr(told, name)
        changes = np.flatnonzero(np.diff(reading.value)) + 2  # the tick of the later value
        assert len(changes) > 5, name
        assert set(changes) <= set(fresh(reading)), name
        np.testing.assert_array_equal(reading.value, getattr(again, name).value)
        assert np.any(reading.value != getattr(other, name).value), name


def test_the_noise_of_different_sensors_is_independent(listen: Callable) -> None:
    # Where sensors report at the same tick, what one reads must not tell what another reads.
    fine = varied(
        RX7,
        {
            "sensors.gyroscope.resolution": 0,
            "sensors.accelerometer.resolution": 0,
            "sensors.voltmeter.resolution": 0,
            "sensors.voltmeter.rate": 40,
            "sensors.sonar.resolution": 0,
            "sensors.sonar.edge_echo": 0,
        },
    )
    mounts = tuple(
        dataclasses.replace(mount, angle=np.float64(0)) for mount in fine.sensors.sonar.mounts
    )
    part = dataclasses.replace(fine.sensors.sonar, mounts=mounts, hearing=np.float64(0.01))
    fine = dataclasses.replace(fine, sensors=dataclasses.replace(fine.sensors, sonar=part))
    readings = [listen(fine, seed) for seed in range(4)]
    at = np.arange(25, TICKS + 1, 25) - 1
    columns = {
        name: np.concatenate([pick(told).value[at] for told in readings])
        for name, pick in {
            "sonar front": lambda t: t.sonar[0],
            "sonar left": lambda t: t.sonar[1],
            "sonar right": lambda t: t.sonar[2],
            "gyroscope": lambda t: t.gyroscope,
            "accelerometer x": lambda t: t.accel_x,
            "accelerometer y": lambda t: t.accel_y,
            "voltmeter": lambda t: t.battery,
        }.items()
    }
    related = np.abs(np.corrcoef(list(columns.values()))) - np.eye(len(columns))
    i, j = np.unravel_index(np.argmax(related), related.shape)
    names = list(columns)
    assert related.max() < 0.3, f"{names[i]} and {names[j]}: {related.max():.3f}"


def test_quantising_by_nothing_changes_nothing() -> None:
    assert float(error_models.quantised(0.123456789, 0.0)) == 0.123456789
    assert float(error_models.quantised(0.26, 0.5)) == 0.5


# The line detector


LINED = dataclasses.replace(
    RX7,
    sensors=dataclasses.replace(
        RX7.sensors,
        line_detector=jax.tree.map(
            np.float64, LineDetector(lines="across-x", spacing=0.1, width=0.02, x=0.06)
        ),
    ),
)


def test_lines_are_counted_where_the_eye_enters_them_and_give_the_speed(listen: Callable) -> None:
    x = 1.713 * DT * np.arange(1, TICKS + 1)
    told = listen(LINED, x=x, vx=1.713)
    # The eye starts at 0.06 m; each line is entered 0.01 m before its middle.
    edges = np.arange(0.09, 0.06 + x[-1], 0.1)
    ticks = np.ceil((edges - 0.06) / 1.713 / DT)
    entered = np.flatnonzero(np.diff(told.line_crossings.value, prepend=0)) + 1
    np.testing.assert_array_equal(entered, ticks)
    assert told.line_crossings.value[-1] == len(edges)
    np.testing.assert_array_equal(fresh(told.line_speed), ticks[1:])
    speed = told.line_speed.value[told.line_speed.tick > 0]
    assert speed == pytest.approx(1.713, rel=1.713 * DT / 0.1)
    assert np.mean(speed) == pytest.approx(1.713, rel=2e-3)


def test_a_line_is_entered_from_both_sides_and_not_by_turning_on_it(listen: Callable) -> None:
    # On to the line at 0.1 m and off it again; then over it, and back over the whole of it.
    way = [0.0, 0.1, 0.05, 0.15, 0.05]
    x = np.interp(np.arange(TICKS), np.linspace(0, TICKS - 1, len(way)), way) - 0.06
    counts = listen(LINED, x=x).line_crossings.value
    ends = np.linspace(0, TICKS - 1, len(way)).astype(int)
    np.testing.assert_array_equal(np.diff(counts[ends], prepend=0), [0, 1, 0, 1, 1])


def test_the_eye_turns_with_the_car(listen: Callable) -> None:
    heading = np.linspace(0, 2 * math.pi, TICKS)
    told = listen(LINED, heading=heading, x=0.0)  # from 0.06 to -0.06 m and back
    assert told.line_crossings.value[-1] == 2


def test_without_lines_the_detector_is_not_there(listen: Callable) -> None:
    told = listen(RX7)
    assert told.line_crossings is told.line_speed is None
    assert all_sensors.initial_memory(RX7, start(RX7, 4).motion, DT).eye is None


@pytest.mark.parametrize("name", ["box", "ess"])
def test_the_nearest_walls_in_the_cone_are_all_that_a_ping_needs(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    course, seed = load_course(name), 5
    walls = []
    for a, b in zip(course.walls[:, :2], course.walls[:, 2:], strict=True):
        count = math.ceil(np.hypot(*(b - a)) / 0.9)
        cuts = a + (b - a) * np.linspace(0, 1, count + 1)[:, None]
        walls.append(np.hstack([cuts[:-1], cuts[1:]]))
    around = np.full((64, 4), np.nan)
    around[: sum(map(len, walls))] = np.concatenate(walls)
    around, corners = jnp.asarray(around), jnp.asarray(sonar.edges(around))
    rng = np.random.default_rng(seed)
    places = [place(course, d) for d in rng.uniform(0, course.length, 40)]
    spread = rng.uniform([-0.5, -0.5, -4], [0.5, 0.5, 4], (40, 3))
    poses, keys = np.array(places) + spread, jax.random.split(jax.random.key(seed), 40)
    part = dataclasses.replace(RX7.sensors.sonar, edge_echo=np.float64(0.3))

    def heard(most: int) -> np.ndarray:
        monkeypatch.setattr(sonar, "MOST_WALLS", most)

        def one(scene: tuple) -> jax.Array:
            pose, key = scene
            told = sonar.distances(part, around, corners, tuple(pose), (1.0, 1.0, 1.0), key)
            return jnp.stack(told)

        return np.asarray(jax.jit(lambda scenes: jax.lax.map(one, scenes))((poses, keys)))

    few, all_of_them = heard(24), heard(64)
    assert np.isfinite(few).mean() > 0.5
    assert np.array_equal(few, all_of_them)


# Lidar and position: what better sensing would bring


def with_part(**part: Any) -> Car:
    """The rx7 with a sensor that it has not by itself."""
    parts = jax.tree.map(np.float64, part)
    return dataclasses.replace(RX7, sensors=dataclasses.replace(RX7.sensors, **parts))


EXACT = Lidar(beams=37, noise=0.0, resolution=0.0, reach=3.0, x=0.1, y=-0.05, angle=0.4)


def test_a_lidars_ranges_are_those_of_a_geometry_library() -> None:
    seed, count = 7, 200
    walls, poses = scenes(seed, count)
    padded = np.full((count, 16, 4), np.nan)
    padded[:, 3:11] = walls
    program = jax.jit(jax.vmap(lambda w, p: lidar.ranges(EXACT, w, tuple(p), np.zeros(37))))
    told = np.asarray(program(padded, poses))
    bearings = 0.4 + math.radians(270) * ((np.arange(37) + 0.5) / 37 - 0.5)
    np.testing.assert_allclose(lidar.bearings(EXACT), bearings)
    expected = np.full(told.shape, np.inf)
    for i, (scene, (x, y, heading)) in enumerate(zip(walls, poses, strict=True)):
        lines = shapely.MultiLineString([wall.reshape(2, 2) for wall in scene])
        eye = complex(x, y) + (0.1 - 0.05j) * np.exp(1j * heading)
        for j, bearing in enumerate(heading + bearings):
            end = eye + 3.0 * np.exp(1j * bearing)
            met = shapely.LineString([(eye.real, eye.imag), (end.real, end.imag)])
            met = met.intersection(lines)
            if not met.is_empty:
                expected[i, j] = met.distance(shapely.Point(eye.real, eye.imag))
    assert 0.3 < np.isfinite(expected).mean() < 0.95
    np.testing.assert_allclose(told, expected, atol=1e-4, err_msg=f"seed {seed}")


def test_no_beam_slips_between_two_walls() -> None:
    corner = np.array([[1.0, -3, 1.0, 1 / 3], [1.0, 1 / 3, -3.0, 1 / 3]], np.float32)
    part = jax.tree.map(np.float32, dataclasses.replace(EXACT, beams=2000, reach=50.0, x=0, y=0))
    toward = np.arctan2(1 / 3, 1.0) - part.angle
    told = lidar.ranges(part, corner, (0.0, 0.0, np.float32(toward)), np.zeros(2000, np.float32))
    away = np.asarray(lidar.bearings(part)) + toward
    faces = (away > -1.2) & (away < 2.5)
    assert faces.sum() > 1000
    assert np.all(np.isfinite(np.asarray(told)[faces]))


def test_a_lidar_reports_at_its_rate_with_its_noise_and_step(listen: Callable) -> None:
    part = Lidar(beams=5, field=math.radians(10), rate=100.0, noise=0.02, resolution=0.005)
    told = listen(with_part(lidar=part)).lidar
    ticks = np.arange(1, TICKS + 1)
    fresh_ticks = ticks[told.tick == ticks]
    np.testing.assert_array_equal(fresh_ticks, np.arange(10, TICKS + 1, 10))
    read = told.value[fresh_ticks - 1]
    angles = np.radians(10) * ((np.arange(5) + 0.5) / 5 - 0.5)
    np.testing.assert_allclose(read.mean(axis=0), 2.0 / np.cos(angles), atol=6e-3)
    assert read.std(axis=0) == pytest.approx(0.02, rel=0.2)
    np.testing.assert_allclose(read / 0.005, np.round(read / 0.005), atol=1e-9)
    related = np.abs(np.corrcoef(read.T)) - np.eye(5)
    assert related.max() < 0.35, "each beam's noise is its own"
    assert np.isinf(told.value[0]).all()


@pytest.mark.parametrize("delay", [0.0, 0.04])
def test_a_position_tells_where_the_car_was_with_its_noise(listen: Callable, delay: float) -> None:
    time = DT * np.arange(1, TICKS + 1)
    x, y, heading = 3.0 * time, 1.0 - time**2, 4.0 * time
    part = Position(
        reports="pose", rate=250.0, noise=0.02, heading_noise=math.radians(2), delay=delay
    )
    told = listen(with_part(position=part), x=x, y=y, heading=heading)
    ticks = fresh(told.position_x)
    late = round(delay / DT)
    np.testing.assert_array_equal(ticks, np.arange(4, TICKS + 1, 4)[late // 4 - (late > 0) :])
    ticks = ticks[ticks > late]
    then = DT * (ticks - late)
    off = [
        told.position_x.value[ticks - 1] - 3.0 * then,
        told.position_y.value[ticks - 1] - (1.0 - then**2),
        (told.position_heading.value[ticks - 1] - 4.0 * then + math.pi) % (2 * math.pi) - math.pi,
    ]
    assert np.abs(told.position_heading.value).max() <= math.pi
    for error, deviation in zip(off, (0.02, 0.02, math.radians(2)), strict=True):
        assert abs(error.mean()) < 4 * deviation / math.sqrt(len(error))
        assert error.std() == pytest.approx(deviation, rel=0.15)
    assert np.abs(np.corrcoef(off) - np.eye(3)).max() < 0.25


def test_a_position_without_heading_and_parts_that_are_off_are_not_there(listen: Callable) -> None:
    told = listen(with_part(position=Position(reports="place")))
    assert told.position_heading is None
    assert told.position_y is not None
    none = listen(RX7)
    assert none.lidar is none.position_x is none.position_y is none.position_heading is None
    assert all_sensors.initial_memory(RX7, start(RX7, 4).motion, DT).poses is None


def test_sensors_begin_for_cars_of_a_batch_too() -> None:
    """Where a car's numbers are traced, how many poses are kept comes from outside."""
    car = with_part(position=Position(reports="pose"))
    slots = all_sensors.position_slots(car, DT)
    begun = jax.eval_shape(
        lambda car, motion: all_sensors.initial_memory(car, motion, DT, slots),
        car,
        start(car, 4).motion,
    )
    assert begun.poses.shape == (slots, 3)


def test_better_sensors_are_switched_on_and_written(tmp_path: Path) -> None:
    wanted = ("sensors.lidar.beams=12", "sensors.lidar.rate_hz=20", "sensors.position.reports=pose")
    car = load_car("rx7", wanted)
    driver = Replay(times=np.zeros(1), commands=Command(np.ones(1), np.zeros(1)))
    run = write_run(tmp_path, None, car, driver, 0.5)
    assert run.about["rates"]["lidar_s"] == pytest.approx(0.05)
    assert run.car.sensors.lidar.beams == 12
    told = run.telemetry
    assert [name for name in told if name.startswith(("lidar", "position"))] == [
        *(f"lidar_{i:02}_m" for i in range(12)),
        *("position_x_m", "position_y_m", "position_heading_rad"),
    ]
    assert np.isinf(told["lidar_07_m"]).sum() == 9, "open floor: no echo, twenty a second"
    heard = np.isfinite(told["position_x_m"])
    assert heard.sum() == pytest.approx(48, abs=3)
    late = np.interp(told["time_s"][heard] - 0.01, run.truth["time_s"], run.truth["x_m"])
    np.testing.assert_allclose(told["position_x_m"][heard], late, atol=8e-3)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("sensors.lidar.beams=2.5", "sensors.lidar.beams must be a whole number, not 2.5"),
        ("sensors.lidar.beams=-1", "outside its range"),
        ("sensors.position.reports=yes", "must be one of none, place, pose"),
    ],
)
def test_what_cannot_be_switched_on_is_refused(override: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        load_car("rx7", [override])
