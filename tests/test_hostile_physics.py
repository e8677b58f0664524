"""A small part of `studies.fuzz_physics`, and the cases that it or a trial before it found."""

import jax
import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.car.parameter import changed
from countersteer.course.files import load_course
from countersteer.signals import Command, Motion, Wheels
from countersteer.world import planar, tyre
from countersteer.world.walls import clear_way, collide, padded
from studies import fuzz_physics

BOX = load_course("box").walls


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("law", fuzz_physics.LAWS)
def test_no_drive_breaks_a_law(law: str, bits: int) -> None:
    # 500 cars are enough to find each fault that this held at first, but for NaN at rest.
    start = fuzz_physics.draw(law, BOX, np.random.default_rng(7), 512)
    motion = fuzz_physics.run(start, BOX, bits)
    for kind, ticks in fuzz_physics.failures(start, motion, BOX, bits).items():
        assert not ticks.any(), f"{kind} in lanes {np.nonzero(ticks)[0][:5]} of seed 7"
    assert np.mean(np.abs(np.diff(motion.x, axis=0)) > 1e-6) > 0.3, "the cars hardly move"


def test_the_checks_of_the_study_find_what_they_look_for() -> None:
    start = fuzz_physics.draw("brush", BOX, np.random.default_rng(0), 4)
    still = jax.tree.map(lambda leaf: np.stack([leaf] * 3), start.motion)
    start = start._replace(throttle=np.zeros_like(start.throttle))
    x = still.x.copy()
    x[:, 0], x[:, 1] = [0.0, np.nan, 0.0], [-1.4, -0.6, -0.6]
    y, heading = np.zeros_like(x), np.zeros_like(x)
    vx = still.vx.copy()
    vx[:, 2], vx[:, 3] = [1.0, 1.0, 1.1], [1.0, 0.9, 0.9]
    vy, yaw_rate = np.zeros_like(x), np.zeros_like(x)
    moved = still._replace(x=x, y=y, heading=heading, vx=vx, vy=vy, yaw_rate=yaw_rate)
    body = changed(start.car, "body.center", np.zeros(4))
    found = fuzz_physics.failures(start._replace(car=body), moved, BOX, 64)
    assert found["not finite"].tolist() == [1, 0, 0, 0]
    assert found["wall passed"].tolist()[1:] == [1, 0, 0]
    assert found["energy gained"].tolist()[2:] == [2, 0]


def test_a_car_all_but_at_rest_stays_there_in_32_bits() -> None:
    car = jax.tree.map(np.float32, load_car("rx7"))
    numbers = [
        1.8395332, -2.4648917, 0.4595595, 8.9725037e-20, -3.6630123e-20, -3.0541005e-19,
        4.7865257e-18, 5.449195e-18, 4.7587006e-18, 5.4762640e-18,
        0.3131913, 5.3586285e-10, 6.0933094e-06, 3.4282308e-05, 0.6516787,
    ]  # fmt: skip
    values = [np.float32(number) for number in numbers]
    motion = Motion(*values[:6], Wheels(*values[6:10]), *values[10:])
    state = planar.initial_state(car, 0.002)._replace(motion=motion)
    command = Command(np.float32(0), np.float32(0.31319317))
    walls = padded(BOX, np.dtype(np.float32))
    for tick in range(3):
        state = jax.jit(planar.step, static_argnums=5)(car, walls, state, command, tick, 0.002)
        after = np.array(jax.tree.leaves(state.motion), float)
        assert np.all(np.isfinite(after))
        np.testing.assert_allclose(after[:3], numbers[:3], rtol=1e-6)
        assert np.abs(after[3:10]).max() < 1e-17


def tiny(rng: np.random.Generator, count: int) -> list[np.ndarray]:
    """Seven speeds each of `count` cars, from 1e-2 down to less than 32 bits hold.

    Those of a car are of one size, or each of its own. Some are 0. Half of the cars are where
    squares begin to underflow.
    """
    exponents = rng.uniform(-46, -2, (7, count))
    exponents = np.where(rng.random(count) < 0.5, exponents[:1], exponents)
    nearly = rng.uniform(-23, -17, count) + rng.normal(0, 0.5, (7, count))
    exponents = np.where(rng.random(count) < 0.5, nearly, exponents)
    return list(rng.choice((-1, 0, 1), (7, count), p=(0.45, 0.1, 0.45)) * 10.0**exponents)


def test_cars_all_but_at_rest_come_to_rest_in_32_bits() -> None:
    """Squares of speeds below 1e-19 underflow: energies are 0 there, and a quotient is 0/0."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        start = fuzz_physics.draw("brush", BOX, rng, 512)
        vx, vy, yaw_rate, *wheels = tiny(rng, 512)
        motion = start.motion._replace(vx=vx, vy=vy, yaw_rate=yaw_rate, wheels=Wheels(*wheels))
        start = start._replace(motion=motion, throttle=0 * start.throttle)
        seen = fuzz_physics.run(start, BOX, 32)
        finite = np.all([np.isfinite(leaf) for leaf in jax.tree.leaves(seen)], axis=(0, 1))
        assert np.all(finite), f"lanes {np.nonzero(~finite)[0][:5]} of seed {seed}"
        energy, _ = fuzz_physics.energies(start, seen, 32)
        assert np.all(energy.max(axis=0) < np.maximum(1.00002 * energy[0], 1e-25))
        # Few have so little friction that they still roll after 200 ticks.
        assert np.mean(np.hypot(seen.vx[-1], seen.vy[-1]) < 1e-6) > 0.85


def test_a_guarded_tick_adds_no_energy_where_the_change_dwarfs_the_motion() -> None:
    car = jax.tree.map(np.float32, load_car("rx7"))
    small, large = np.float32(1e-6), np.float32(1e3)
    before = planar.Vector(small, small, small), Wheels(*[small] * 4)
    after = planar.Vector(large, -large, large), Wheels(*[large] * 4)
    motion = planar.initial_state(car, 0.001).motion
    held = planar.grip(car, motion)
    limited, flag = planar.guarded(car, held, before, after, np.float32(0.001))
    energy = [float(planar.kinetic_energy(car, *which)) for which in (before, limited)]
    assert flag == 1
    assert energy[1] <= energy[0] * (1 + 1e-6)


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_the_chord_of_a_magic_formula_only_removes_energy(shift: float) -> None:
    rng = np.random.default_rng(3)
    tire = load_car("rx7", ["tires.rear.law=magic-formula"]).tires.rear
    tire = changed(tire, "magic_formula.p_hx1", np.float64(0.1 * shift))
    slip_x, slip_y, rim = rng.normal(size=(3, 500)) * 10.0 ** rng.uniform(-6, 1, (3, 500))
    found = jax.vmap(lambda x, y, r: tyre.contact(tire, 5.0, x, y, r))(slip_x, slip_y, rim)
    assert np.all(found.k_x >= 0)
    assert np.array_equal(found.k_x, found.k_y)
    power = found.force_x * slip_x + found.force_y * slip_y
    chord = -found.k_x * (slip_x**2 + slip_y**2)
    np.testing.assert_allclose(chord, np.minimum(power, 0.0), rtol=1e-3, atol=1e-9)


def test_a_combined_loss_without_a_peak_at_zero_stays_finite() -> None:
    # cos(c atan(b)) is 0 at pure slip: the published form divides by it.
    overrides = ["law=magic-formula", "magic_formula.r_hx1=0.2", "magic_formula.r_bx1=200"]
    car = load_car("rx7", [f"tires.rear.{o}" for o in (*overrides, "magic_formula.r_cx1=1.026")])
    tire = jax.tree.map(np.float32, car.tires.rear)
    found = tyre.contact(tire, *map(np.float32, (5.0, 0.3, 0.2, 2.0)))
    assert np.all(np.isfinite(np.array(jax.tree.leaves(found), float)))


def test_a_wheel_that_ackermann_turns_beyond_90_degrees_has_a_direction() -> None:
    servo = changed(load_car("rx7").servo, "ackermann", np.float64(1.5))
    body = changed(load_car("rx7").body, "track", np.float64(3.0))
    for steering in np.linspace(-1.3, 1.3, 101):
        for cosine, sine in planar.servo.directions(body, servo, steering):
            assert np.hypot(cosine, sine) == pytest.approx(1.0)
            assert sine == 0 or np.sign(sine) == np.sign(steering)


@pytest.mark.parametrize(("speed", "dt"), [(10, 0.02), (35, 0.005), (50, 0.01), (500, 0.02)])
def test_no_wall_is_passed_at_any_speed_and_step(speed: float, dt: float) -> None:
    car, count = load_car("rx7"), 400
    rng = np.random.default_rng(int(speed))
    start = fuzz_physics.draw("brush", BOX, rng, count)
    bearing = rng.uniform(-np.pi, np.pi, count)
    motion = start.motion._replace(vx=speed * np.cos(bearing), vy=speed * np.sin(bearing))
    cars = jax.tree.map(lambda leaf: np.full(count, leaf), car)
    start = start._replace(car=cars, motion=motion, dt=np.full(count, dt))
    seen = fuzz_physics.run(start, BOX, 64)
    assert not fuzz_physics.crossings(cars, seen, BOX).any()
    # Nothing stays within a wall: the centre ends half a width away, but for corners.
    assert np.quantile(distance(seen, BOX), 0.02) > car.body.width / 2 - 0.01


def distance(motion: Motion, walls: np.ndarray) -> np.ndarray:
    """From the last places to the nearest wall (m)."""
    points = np.stack([motion.x[-1], motion.y[-1]], axis=-1)[:, None]
    ends, ways = walls[:, :2], walls[:, 2:] - walls[:, :2]
    part = np.sum((points - ends) * ways, axis=-1) / np.sum(ways**2, axis=-1)
    foot = ends + np.clip(part, 0, 1)[..., None] * ways
    return np.linalg.norm(points - foot, axis=-1).min(axis=1)


def test_a_way_ends_before_the_first_wall_that_it_meets() -> None:
    walls = padded(np.array([[1.0, -1.0, 1.0, 1.0], [2.0, -1.0, 2.0, 1.0]]), np.dtype(float))
    rows = planar.walls._segments(walls)  # the form that a contact uses
    for x, y, dx, dy, part in (
        (0.0, 0.0, 4.0, 0.0, 0.999 / 4),
        (3.0, 0.0, -4.0, 0.0, 0.999 / 4),
        (0.0, 0.0, 0.5, 0.0, 1.0),
        (0.0, 3.0, 4.0, 0.0, 1.0),  # beside the walls' ends
        (0.9995, 0.0, 0.5, 0.0, 0.0),  # within the clearance: no way leads nearer ...
        (0.9995, 0.0, -0.5, 0.1, 1.0),  # ... and any leads away
        (0.0, 1.0005, 2.0, 0.0, (1 - 0.001) / 2),  # around an end too
        (0.0, 0.0, 0.0, 0.0, 1.0),
    ):
        found = float(clear_way(rows, *map(np.float64, (x, y, dx, dy))))
        assert found == pytest.approx(part), (x, y, dx, dy)


def test_a_hit_of_a_heavy_car_with_little_yaw_inertia_adds_no_energy_in_32_bits() -> None:
    rng = np.random.default_rng(1)
    count = 2000
    body = jax.tree.map(lambda leaf: np.full(count, leaf, np.float32), load_car("rx7").body)
    for name, values in {
        "mass": 10 ** rng.uniform(-1.7, 3.4, count),
        "yaw_inertia": 10 ** rng.uniform(-6, 4, count),
        "length": rng.uniform(0.03, 10, count),
        "wall_friction": rng.uniform(0, 10, count),
        "wall_restitution": rng.uniform(0, 1, count),
    }.items():
        body = changed(body, name, values.astype(np.float32))
    start = fuzz_physics.draw("brush", BOX, rng, count).motion
    start = jax.tree.map(np.float32, start)
    walls = padded(BOX, np.dtype(np.float32))
    after, touched = jax.jit(jax.vmap(collide, in_axes=(0, None, 0, 0)))(body, walls, start, start)
    energy = [
        body.mass.astype(float) * (np.float64(m.vx) ** 2 + np.float64(m.vy) ** 2)
        + body.yaw_inertia.astype(float) * np.float64(m.yaw_rate) ** 2
        for m in (start, after)
    ]
    assert touched.sum() > 500
    known = energy[0] > 1e-25  # J; below, squares underflow
    assert np.max(energy[1][known] / energy[0][known]) < 1 + 2e-6
    assert np.max(energy[1][~known]) < 1e-25
