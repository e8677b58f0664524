"""A floor whose friction varies from place to place: its statistics, and the laws upon it."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

from conftest import LANES, start, varied, write_run
from countersteer import cli
from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.replay import Replay
from countersteer.errors import InputError
from countersteer.runs.run import read_run
from countersteer.signals import Command
from countersteer.world import floor, planar
from countersteer.world.angle import cosine
from countersteer.world.floor import Floor, Wave
from test_world import initial_energy, random_batch, starts

RX7 = load_car("rx7")
LEVEL = (0.0,) * 3


def even(factor: float) -> Floor:
    """A floor of so many times the friction everywhere."""
    waves = (Wave(*map(np.float64, LEVEL)),) * floor.WAVES
    return Floor(waves, np.float64((factor - 1) / floor.WAVES))


def draws(seed: int, count: int, deviation: float = 0.1, length: float = 0.5) -> list[Floor]:
    keys = jax.random.split(jax.random.key(seed), count)
    many = jax.vmap(lambda key: floor.draw(key, deviation, length))(keys)
    return [jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], many) for i in range(count)]


@pytest.fixture(scope="module")
def seen() -> Callable[..., np.ndarray]:
    """Friction on many floors at many places: (floors, places)."""
    program = jax.jit(
        jax.vmap(jax.vmap(floor.friction, (None, 0, 0)), (0, None, None)),
    )

    def run(seed: int, count: int, x: np.ndarray, y: np.ndarray, **about: float) -> np.ndarray:
        keys = jax.random.split(jax.random.key(seed), count)
        many = jax.vmap(lambda key: floor.draw(key, **about))(keys)
        return np.asarray(program(many, x, y))

    return run


@pytest.mark.parametrize("bearing", [0.0, 0.7, math.pi / 2])
def test_friction_has_the_deviation_and_the_correlation_that_were_asked_for(
    seen: Callable, bearing: float
) -> None:
    seed, count, deviation, length = 3, 20000, 0.1, 0.5
    away = np.array([0.0, 0.25, 0.5, 1.0, 1.5])
    x, y = 2.0 + away * math.cos(bearing), -1.0 + away * math.sin(bearing)
    found = seen(seed, count, x, y, deviation=deviation, length=length)
    assert found.mean() == pytest.approx(1, abs=2e-3)
    assert found.std(axis=0) == pytest.approx(deviation, rel=0.02)
    expected = np.exp(-(away**2) / (2 * length**2))
    np.testing.assert_allclose(np.corrcoef(found.T)[0], expected, atol=0.03)
    within = np.abs(found - 1) < deviation
    assert within.mean() == pytest.approx(0.683, abs=0.02), "close to a Gaussian"


def test_no_place_is_without_friction_up_to_the_largest_deviation(seen: Callable) -> None:
    x, y = np.random.default_rng(0).uniform(-5, 5, (2, 2000))
    found = seen(1, 200, x, y, deviation=floor.LARGEST, length=0.5)
    assert found.min() > 0.04
    assert found.max() < 1.96


def test_the_polynomial_is_the_cosine() -> None:
    angles = np.linspace(-60, 60, 20001)
    np.testing.assert_allclose(cosine(angles), np.cos(angles), atol=1e-13)
    with jax.enable_x64(False):
        narrow = np.asarray(cosine(angles.astype(np.float32)))
    np.testing.assert_allclose(narrow, np.cos(angles), atol=2e-5)


def test_each_wheel_stands_on_its_own_place() -> None:
    (ground,) = draws(5, 1)
    motion = start(RX7, x=0.4, y=-0.3, heading=0.8, vx=2.0, vy=-0.5, yaw_rate=3.0).motion
    found = floor.under_wheels(ground, RX7.body, motion, 0.01)
    nose = np.exp(1j * (0.8 + 0.03))
    middle = 0.4 - 0.3j + 0.01 * (2.0 - 0.5j) * nose
    for friction, x, y in zip(found, *planar.wheel_positions(RX7.body), strict=True):
        at = middle + (x + 1j * y) * nose
        expected = 1 + float(ground.amplitude) * sum(
            math.cos(w.x * at.real + w.y * at.imag + w.phase) for w in ground.waves
        )
        assert float(friction) == pytest.approx(expected, abs=1e-12)


def test_an_even_floor_is_tyres_of_other_friction(drive: Callable) -> None:
    seed, factor = 4, 0.85
    cars, motions, rng = random_batch(seed)
    commands = rng.uniform(-1, 1, LANES), rng.uniform(-0.5, 0.5, LANES)

    def end(car: Car) -> Car:
        front, rear = car.tires.front.friction, car.tires.rear.friction
        return varied(
            car,
            {"tires.front.friction": factor * front, "tires.rear.friction": factor * rear},
        )

    states = starts(cars, motions)
    other = [start(end(c), **m) for c, m in zip(cars, motions, strict=True)]
    on_floor = drive(cars, states, 200, 1e-3, *commands, floors=[even(factor)] * LANES).motion
    plain = drive([end(car) for car in cars], other, 200, 1e-3, *commands).motion
    for name, a, b in zip(plain._fields, on_floor, plain, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=f"{name}, seed {seed}")


def test_a_magic_formula_tyre_scales_its_peaks_and_keeps_its_slopes() -> None:
    tire = dataclasses.replace(RX7.tires.rear, law="magic-formula")
    m, less = tire.magic_formula, planar.tyre.scaled(tire, 0.8).magic_formula
    slope = jax.grad(lambda a, m: planar.tyre.magic_forces(m, 10.0, 0.0, a, 0.0)[1])
    assert slope(0.0, less) == pytest.approx(float(slope(0.0, m)))
    slips = np.linspace(0.0, 1.0, 2001)
    for part, shape in ((0, (slips, 0 * slips)), (1, (0 * slips, slips))):
        peaks = [
            np.abs(planar.tyre.magic_forces(one, 10.0, *shape, 0.0)[part]).max()
            for one in (m, less)
        ]
        assert peaks[1] == pytest.approx(0.8 * peaks[0], rel=1e-3)


def test_more_friction_on_one_side_turns_a_sliding_car_to_it(drive: Callable) -> None:
    def strip(phase: float) -> Floor:
        """A floor that is grippy on one side of the way and slippery on the other."""
        wave = Wave(np.float64(0.0), np.float64(2 * math.pi / 0.5), np.float64(phase))
        still = Wave(*map(np.float64, (0.0, 0.0, math.pi / 2)))
        return Floor((wave,) + (still,) * (floor.WAVES - 1), np.float64(0.3))

    locked = varied(RX7, {f"tires.{end}.inertia": 10.0 for end in ("front", "rear")})
    state = start(locked, vx=2.0)
    floors = [strip(-math.pi / 2), strip(math.pi / 2)]
    result = drive([locked] * 2, [state] * 2, 200, 1e-3, floors=floors)
    left, right = result.motion.yaw_rate.T
    assert left.max() > 0.5
    np.testing.assert_allclose(left, -right, atol=1e-9)
    np.testing.assert_allclose(result.motion.x[:, 0], result.motion.x[:, 1], atol=1e-10)


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_kinetic_energy_never_rises_on_an_uneven_floor(drive: Callable, dt: float) -> None:
    for seed in range(3):
        cars, motions, rng = random_batch(seed)
        floors = draws(seed, LANES, floor.LARGEST, 0.2)
        steering = np.repeat(rng.uniform(-1, 1, (4, LANES)), 50, axis=0)
        energy = drive(cars, starts(cars, motions), 200, dt, 0.0, steering, floors=floors).energy
        first = np.array([initial_energy(c, m) for c, m in zip(cars, motions, strict=True)])
        energy = np.vstack([first, energy])
        assert np.all(np.isfinite(energy)), f"seed {seed}"
        assert (np.diff(energy, axis=0) - 1e-12 * energy[:-1]).max() <= 0, f"seed {seed}"


def test_the_scheme_stays_of_second_order(drive: Callable) -> None:
    (ground,) = draws(8, 1, 0.2)
    state = planar.initial_state(RX7, 1e-3, velocity=(1.5, 0.0, 2.0), slots=512)

    def place(dt: float) -> np.ndarray:
        m = drive([RX7], [state], round(0.4 / dt), dt, floors=[ground]).motion
        return np.array([m.x[-1, 0], m.y[-1, 0], 0.1 * m.heading[-1, 0]])

    exact = place(1e-4)
    coarse, fine = (np.linalg.norm(place(dt) - exact) for dt in (4e-3, 1e-3))
    assert fine < 1e-5
    assert coarse / fine > 11, "sixteenfold for the second order, fourfold for the first"


def test_derivatives_are_finite_and_agree_with_differences() -> None:
    seed = 9
    (ground,) = draws(seed, 1)
    state = planar.initial_state(RX7, 1e-3, velocity=(2.0, -0.7, 4.0))
    walls = np.full((8, 4), np.nan)

    def far(ground: Floor) -> jax.Array:
        def tick(state: planar.State, count: jax.Array) -> tuple:
            command = planar.Command(0.5, -0.3)
            return planar.step(RX7, walls, state, command, count, 1e-3, ground), None

        last = jax.lax.scan(tick, state, np.arange(100, dtype=np.int32))[0].motion
        return last.x + 2 * last.y + 3 * last.heading

    # Along some directions in the space of all floors.
    rng = np.random.default_rng(seed)
    ways = [jax.tree.map(lambda _: rng.normal(), ground) for _ in range(4)]
    slope = jax.jit(lambda at, way: jax.jvp(far, (at,), (way,)))
    size = 1e-6
    for way in ways:
        up, down = (
            slope(jax.tree.map(lambda g, w, s=s: g + s * w, ground, way), way)[0]
            for s in (size, -size)
        )
        told = float(slope(ground, way)[1])
        assert abs(told) > 1e-6
        assert told == pytest.approx(float(up - down) / (2 * size), rel=1e-4)

    def grips(pose: tuple, ground: Floor) -> jax.Array:
        motion = state.motion._replace(x=pose[0], y=pose[1], heading=pose[2])
        return sum((i + 1) * g for i, g in enumerate(floor.under_wheels(ground, RX7.body, motion)))

    for pose in ((0.0, 0.0, 0.0), (0.3, -2.0, 1.0)):
        back = jax.grad(grips, (0, 1))(pose, ground)
        assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(back))
        moved = [grips((pose[0] + by, *pose[1:]), ground) for by in (size, -size)]
        assert float(back[0][0]) == pytest.approx(float(moved[0] - moved[1]) / 2e-6, rel=1e-5)


def test_a_drive_on_a_floor_is_replayed_on_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (ground,) = draws(2, 1, 0.2)
    course = load_course("straight")
    driver = Replay(
        times=np.array([0.0, 0.8]), commands=Command(np.array([0.8, 0.0]), np.array([0.0, -0.4]))
    )
    for name, floor_of in (("uneven", ground), ("even", None)):
        (tmp_path / name).mkdir()
        run = write_run(tmp_path / name, course, RX7, driver, 1.5, floor=floor_of)
        assert ("floor" in run.about) == (floor_of is not None)
    assert jax.tree.all(
        jax.tree.map(np.equal, floor.floor_of_run(read_run(tmp_path / "uneven").about), ground)
    )
    cli.main(["replay", str(tmp_path / "uneven"), "--json", "--out", str(tmp_path / "again")])
    json.loads(capsys.readouterr().out)
    truths = [read_run(tmp_path / name).truth for name in ("uneven", "again", "even")]
    rows = min(map(len, truths)) - 1
    paths = [np.array([t["x_m"][:rows], t["y_m"][:rows], t["heading_rad"][:rows]]) for t in truths]
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-7)
    assert np.abs(paths[2] - paths[0]).max() > 1e-3, "the floor is felt"


@pytest.mark.parametrize("table", [{}, {"amplitude": 0.1, "waves": [{"x_radpm": 1.0}]}, 3])
def test_a_floor_that_is_not_as_it_was_written_is_refused(table: object) -> None:
    assert floor.floor_of_run({}) is None
    with pytest.raises(InputError, match=r"run.toml: \[floor\]"):
        floor.floor_of_run({"floor": table})
