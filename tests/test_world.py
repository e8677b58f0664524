"""Laws of the planar world, and a second implementation to check it against."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

from conftest import LANES, stacked, start, varied
from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.signals import Motion, Wheels
from countersteer.world import chassis, motor, planar, servo, tyre
from countersteer.world.walls import collide

STEPS = (1e-4, 1e-3, 1e-2)
RX7 = load_car("rx7")
BOX = np.array([[-2.0, -2, 2, -2], [2, -2, 2, 2], [2, 2, -2, 2], [-2, 2, -2, -2], [1, -2, 1, 1.0]])


# Random cars and states


def random_car(rng: np.random.Generator) -> Car:
    """A car whose parameters are all drawn; locks and shares often at an end of their range."""

    def wide(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    def part() -> float:
        return float(rng.choice([0.0, 1.0, rng.uniform(), 1 - wide(1e-6, 1e-1)]))

    wheelbase = wide(0.08, 0.5)
    length = wheelbase * rng.uniform(1.2, 1.8)
    mass = wide(0.1, 10)
    changes = {
        "body.mass": mass,
        "body.yaw_inertia": mass * wheelbase**2 * rng.uniform(0.1, 0.5),
        "body.wheelbase": wheelbase,
        "body.front_axle": wheelbase * rng.uniform(0.2, 0.8),
        "body.track": wheelbase * rng.choice([0.0, rng.uniform(0.2, 1.2)]),
        "body.cm_height": wheelbase * rng.uniform(0, 0.4),
        "body.front_roll_share": part(),
        "body.load_lag": wide(0.001, 1),
        "body.length": length,
        "body.width": length * rng.uniform(0.2, 0.7),
        "body.center": length * rng.uniform(-0.2, 0.2),
        "body.wall_restitution": part(),
        "body.wall_friction": rng.choice([0.0, wide(0.01, 10)]),
        "drivetrain.front_share": part(),
        "drivetrain.front_lock": part(),
        "drivetrain.center_lock": part(),
        "drivetrain.rear_lock": part(),
        "drivetrain.gear_ratio": wide(1, 30),
        "drivetrain.efficiency": rng.uniform(0.05, 1),
        "drivetrain.drag": rng.choice([0.0, wide(1e-3, 1)]),
        "drivetrain.drag_viscous": rng.choice([0.0, wide(1e-6, 1e-2)]),
        "motor.torque_constant": wide(1e-3, 0.1),
        "motor.resistance": wide(0.01, 10),
        "motor.rotor_inertia": rng.choice([0.0, wide(1e-7, 1e-4)]),
        "motor.current_limit": wide(1, 200),
        "motor.dead_zone": rng.uniform(0, 0.3),
        "motor.full_throttle": rng.uniform(0.4, 1),
        "motor.overrun": part(),
        "motor.neutral_brake": part(),
        "motor.brake": part(),
        "motor.reverse": part(),
        "motor.lag": wide(0.001, 1),
        "motor.delay": rng.uniform(0, 0.04),
        "battery.full": wide(1, 20),
        "battery.resistance": wide(1e-3, 1),
        "battery.wear": part(),
        "servo.gain_left": rng.uniform(0.5, 1.5),
        "servo.gain_right": rng.uniform(0.5, 1.5),
        "servo.limit_left": math.radians(rng.uniform(10, 45)),
        "servo.limit_right": math.radians(rng.uniform(10, 45)),
        "servo.softness": part(),
        "servo.trim": math.radians(rng.uniform(-5, 5)),
        "servo.rate": math.radians(wide(50, 5000)),
        "servo.lag": wide(0.001, 1),
        "servo.delay": rng.uniform(0, 0.04),
        "servo.ackermann": rng.uniform(-1, 1),
    }
    for end in ("front", "rear"):
        radius = wheelbase * rng.uniform(0.05, 0.2)
        changes |= {
            f"tires.{end}.radius": radius,
            f"tires.{end}.inertia": mass * radius**2 * wide(1e-4, 0.1),
            f"tires.{end}.friction": wide(0.01, 10),
            f"tires.{end}.sliding_ratio": part(),
            f"tires.{end}.longitudinal_stiffness": wide(0.1, 200),
            f"tires.{end}.cornering_stiffness": wide(0.1, 200),
            f"tires.{end}.creep_speed": wide(1e-3, 1),
            f"tires.{end}.cornering_drag": rng.choice([0.0, wide(0.01, 1)]),
        }
    return varied(RX7, changes)


def random_motion(car: Car, rng: np.random.Generator) -> dict[str, object]:
    """Any motion at all: wheels that spin or stand, much yaw."""
    speed = rng.choice([0.01, 1.0, 6.0])
    spins = rng.choice([0.0, 1.0, 5.0]) * speed / car.tires.front.radius
    return {
        "x": rng.uniform(-1.0, 0.4),
        "y": rng.uniform(-1.0, 1.0),
        "heading": rng.uniform(-4, 4),
        "vx": rng.normal() * speed,
        "vy": rng.normal() * speed,
        "yaw_rate": rng.normal() * rng.choice([0.01, 3.0, 15.0]),
        "wheels": Wheels(*(rng.normal(size=4) * spins)),
        "steering": rng.uniform(-0.5, 0.5),
        "load_ax": rng.normal() * 5,
        "load_ay": rng.normal() * 5,
        "charge": rng.uniform(0, 1),
    }


def random_batch(seed: int) -> tuple[list[Car], list[dict[str, object]], np.random.Generator]:
    rng = np.random.default_rng(seed)
    cars = [random_car(rng) for _ in range(LANES)]
    return cars, [random_motion(car, rng) for car in cars], rng


def starts(cars: list[Car], motions: list[dict[str, object]]) -> list:
    return [start(car, **motion) for car, motion in zip(cars, motions, strict=True)]


def initial_energy(car: Car, motion: dict[str, object]) -> float:
    velocity = planar.Vector(*(motion[name] for name in ("vx", "vy", "yaw_rate")))
    return float(planar.kinetic_energy(car, velocity, motion["wheels"]))


# Symmetry


def test_mirrored_commands_give_the_mirrored_drive(drive: Callable) -> None:
    seed = 1
    cars, motions, rng = random_batch(seed)
    cars, motions = cars[:16], motions[:16]
    states = starts(cars, motions)

    def mirrored_car(car: Car) -> Car:
        s = car.servo
        return varied(
            car,
            {
                "servo.gain_left": s.gain_right,
                "servo.gain_right": s.gain_left,
                "servo.limit_left": s.limit_right,
                "servo.limit_right": s.limit_left,
                "servo.trim": -s.trim,
            },
        )

    def mirrored(m: Motion) -> Motion:
        w = m.wheels
        odd = ("y", "heading", "vy", "yaw_rate", "steering", "load_ay")
        flipped = m._replace(**{name: -getattr(m, name) for name in odd})
        return flipped._replace(
            wheels=Wheels(w.front_right, w.front_left, w.rear_right, w.rear_left)
        )

    throttle = np.repeat(rng.uniform(-1, 1, (4, 16)), 50, axis=0)
    steering = np.repeat(rng.uniform(-0.6, 0.6, (4, 16)), 50, axis=0)
    mirror = np.array([1, -1, 1, -1.0])
    result = drive(
        cars + [mirrored_car(car) for car in cars],
        states + [state._replace(motion=mirrored(state.motion)) for state in states],
        200,
        1e-3,
        np.hstack([throttle, throttle]),
        np.hstack([steering, -steering]),
        np.array([BOX] * 16 + [BOX * mirror] * 16),
    )
    assert result.wall_contacts[-1].sum() > 0, "the walls were not tried"
    seen = jax.tree.map(lambda leaf: leaf[:, :16], result.motion)
    other = mirrored(jax.tree.map(lambda leaf: leaf[:, 16:], result.motion))
    for name, a, b in zip(Motion._fields, seen, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10, err_msg=f"{name}, seed {seed}")


# Energy


@pytest.mark.parametrize("walls", [None, BOX], ids=["open floor", "walls"])
@pytest.mark.parametrize("dt", STEPS)
def test_kinetic_energy_never_rises_while_the_motor_is_off(
    drive: Callable, dt: float, walls: np.ndarray | None
) -> None:
    for seed in range(10):
        cars, motions, rng = random_batch(seed)
        steering = np.repeat(rng.uniform(-1, 1, (4, LANES)), 50, axis=0)
        energy = drive(cars, starts(cars, motions), 200, dt, 0.0, steering, walls).energy
        first = np.array([initial_energy(c, m) for c, m in zip(cars, motions, strict=True)])
        energy = np.vstack([first, energy])
        assert np.all(np.isfinite(energy)), f"seed {seed}"
        rise = np.diff(energy, axis=0) - 1e-12 * energy[:-1]
        tick, car = np.unravel_index(np.argmax(rise), rise.shape)
        assert rise.max() <= 0, (
            f"seed {seed}, car {car}, tick {tick}: {energy[tick, car]} J becomes "
            f"{energy[tick + 1, car]} J"
        )


def test_the_guard_of_energy_does_not_make_a_drive_of_first_order(drive: Callable) -> None:
    # Energy lost to friction in a coasting slide, against the same slide at a tenth of the step.
    motion = {"vx": 2.0, "vy": -0.7, "yaw_rate": 4.0}
    motion["wheels"] = planar.initial_state(RX7, 1e-3, velocity=(2.0, -0.7, 4.0)).motion.wheels
    coarse = drive([RX7], [start(RX7, **motion)], 300, 1e-3).energy[-1, 0]
    fine = drive([RX7], [start(RX7, **motion)], 3000, 1e-4, every=10).energy[-1, 0]
    assert coarse == pytest.approx(fine, rel=1e-4)


# Rest


def test_a_car_at_rest_stays_at_rest_below_the_dead_zone(drive: Callable) -> None:
    cars, _, rng = random_batch(2)
    zone = np.array([car.motor.dead_zone for car in cars])
    throttle = zone * rng.choice([-1.0, -0.5, 0.0, 0.5, 1.0], LANES)
    result = drive(cars, [start(car) for car in cars], 300, 1e-2, throttle, rng.normal(size=LANES))
    m = result.motion
    for name in ("x", "y", "heading", "vx", "vy", "yaw_rate", "load_ax", "load_ay", "duty"):
        assert not np.any(getattr(m, name)), name
    assert not np.any(np.stack(m.wheels))
    assert np.all(m.charge == 1)


# Gradients


def _far(args: tuple, walls: jax.Array, weights: jax.Array) -> jax.Array:
    car, motion, throttle, steering = args
    line, zero = jnp.zeros(16), jnp.zeros(())
    state = planar.State(motion, line, line, *[zero] * 5)

    def tick(state: planar.State, inputs: tuple) -> tuple:
        count, *command = inputs
        return planar.step(car, walls, state, planar.Command(*command), count, 1e-3), None

    counts = jnp.arange(throttle.shape[0], dtype=jnp.int32)
    motion = jax.lax.scan(tick, state, (counts, throttle, steering))[0].motion
    return weights @ jnp.stack([motion.x, motion.y, motion.heading])


@pytest.fixture(scope="module")
def gradients() -> tuple[list[str], np.ndarray, tuple, Callable]:
    """Cases by name, the value of each, its gradient, and the same again for other cases."""
    rolling = planar.initial_state(RX7, 1e-3, velocity=(2.0, 0.0, 0.0)).motion.wheels
    drift = {"vx": 2.0, "vy": -0.8, "yaw_rate": 4.0, "wheels": rolling, "steering": -0.2}
    locked = {"vx": 2.0, "vy": 0.3, "yaw_rate": -1.0}
    far = np.array([[5.0, 5, 6, 5]])
    near = np.array([[0.22, -1, 0.22, 1]])
    cases = {
        "at rest, open floor": ({}, 0.0, 0.0, None),
        "at rest, walls far off": ({}, 0.0, 0.0, far),
        "in the dead zone": ({}, 0.03, 0.1, np.repeat(far, 8, axis=0)),
        "launch": ({}, 0.9, 0.1, np.repeat(far, 8, axis=0)),
        "drift": (drift, 0.6, -0.3, np.repeat(far, 8, axis=0)),
        "wheels locked": (locked, -1.0, 0.2, np.repeat(far, 8, axis=0)),
        "into a wall": (drift, 0.2, 0.1, np.repeat(near, 8, axis=0)),
        "friction 10": (drift, 0.6, -0.3, np.repeat(far, 8, axis=0)),
    }
    rows = []
    for name, (motion, throttle, steering, walls) in cases.items():
        car = varied(RX7, {"tires.rear.friction": 10.0}) if name == "friction 10" else RX7
        around = np.full((8, 4), np.nan)
        if walls is not None:
            around[: len(walls)] = walls
        motion = jax.tree.map(np.float64, start(car, 16, **motion).motion)
        commands = np.full(50, throttle), np.full(50, steering)
        rows.append(((car, motion, *commands), around))
    program = jax.jit(jax.vmap(jax.value_and_grad(_far), (0, 0, None)))
    weights = np.array([1.0, 2.0, 3.0])
    args, around = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    values, grads = program(args, around, weights)

    def again(shifted: tuple) -> np.ndarray:
        return np.asarray(program(shifted, around, weights)[0])

    return list(cases), np.asarray(values), (args, jax.tree.map(np.asarray, grads)), again


@pytest.mark.parametrize(
    "case",
    [
        "at rest, open floor",
        "at rest, walls far off",
        "in the dead zone",
        "launch",
        "drift",
        "wheels locked",
        "into a wall",
        "friction 10",
    ],
)
def test_gradients_of_the_pose_are_finite(gradients: tuple, case: str) -> None:
    names, values, (_, grads), _ = gradients
    row = names.index(case)
    assert np.isfinite(values[row])
    leaves = jax.tree_util.tree_leaves_with_path(grads)
    bad = [
        jax.tree_util.keystr(path) for path, leaf in leaves if not np.all(np.isfinite(leaf[row]))
    ]
    assert not bad, f"{len(bad)} of {len(leaves)} are not finite, such as {bad[:3]}"


def test_gradients_agree_with_differences(gradients: tuple) -> None:
    names, _, (args, grads), again = gradients
    car, motion, throttle, steering = args
    grad_car, grad_motion, grad_throttle, grad_steering = grads
    size = 1e-6

    def moved(by: float) -> tuple:
        shifted = varied(car, {})
        shifted = dataclasses.replace(
            shifted,
            body=dataclasses.replace(car.body, yaw_inertia=car.body.yaw_inertia * (1 + by)),
            tires=dataclasses.replace(
                car.tires,
                rear=dataclasses.replace(
                    car.tires.rear, friction=car.tires.rear.friction * (1 + by)
                ),
            ),
        )
        return (
            shifted,
            motion._replace(vx=motion.vx + by, steering=motion.steering + by),
            throttle + by,
            steering + by,
        )

    slope = (again(moved(size)) - again(moved(-size))) / (2 * size)
    told = (
        grad_car.body.yaw_inertia * car.body.yaw_inertia
        + grad_car.tires.rear.friction * car.tires.rear.friction
        + grad_motion.vx
        + grad_motion.steering
        + grad_throttle.sum(axis=1)
        + grad_steering.sum(axis=1)
    )
    for case in ("launch", "drift", "wheels locked", "friction 10"):
        row = names.index(case)
        assert told[row] == pytest.approx(slope[row], rel=1e-4, abs=1e-7), case


# Batches and precision


def test_a_batch_equals_a_loop_and_32_bits_stay_close_to_64(
    drive: Callable, drive_alone: Callable
) -> None:
    rng = np.random.default_rng(5)
    cars = [
        varied(RX7, {"body.mass": rng.uniform(1, 2), "drivetrain.rear_lock": rng.uniform()})
        for _ in range(6)
    ]
    states = []
    for car in cars:
        velocity = rng.uniform(0, 2), rng.uniform(-0.5, 0.5), rng.uniform(-3, 3)
        wheels = planar.initial_state(car, 1e-3, velocity=velocity).motion.wheels
        vx, vy, yaw_rate = velocity
        states.append(start(car, vx=vx, vy=vy, yaw_rate=yaw_rate, wheels=wheels))
    throttle = np.repeat(rng.uniform(0, 1, (5, 6)), 200, axis=0)
    steering = np.repeat(rng.uniform(-0.5, 0.5, (5, 6)), 200, axis=0)
    walls = BOX[:4]
    batch = drive(cars, states, 1000, 1e-3, throttle, steering, walls).motion
    around = np.full((8, 4), np.nan)
    around[:4] = walls
    for i, car in enumerate(cars):
        state = jax.tree.map(np.asarray, states[i])
        alone = drive_alone(car, around, state, throttle[:, i], steering[:, i], np.float64(1e-3))
        for name, a, b in zip(Motion._fields, alone, batch, strict=True):
            a, b = np.stack([a]), np.stack([b])
            np.testing.assert_allclose(a, b[..., i], rtol=1e-9, atol=1e-9, err_msg=name)

    narrow = lambda tree: jax.tree.map(np.float32, tree)  # noqa: E731  # two uses
    with jax.enable_x64(False):
        low = drive(narrow(cars), narrow(states), 1000, 1e-3, throttle, steering, walls).motion
    assert low.x.dtype == np.float32
    away = np.hypot(low.x - batch.x, low.y - batch.y)
    assert away.max() < 1e-3, "a second at 32 bits is within a millimetre of 64"
    assert np.abs(low.heading - batch.heading).max() < 5e-3


# Convergence


class Manoeuvre(NamedTuple):
    """A car, how it starts, and its commands by the time from which they hold (s)."""

    car: Car
    velocity: tuple[float, float, float]
    throttle: dict[float, float]
    steering: dict[float, float]
    duty: float = 0.0


def held(command: dict[float, float], times: np.ndarray) -> np.ndarray:
    """The command at each time."""
    values = np.array(list(command.values()))
    return values[np.searchsorted(list(command), times + 1e-9, side="right") - 1]


ODD = {
    "body.front_axle": 0.10,
    "body.track": 0.14,
    "body.cm_height": 0.05,
    "body.front_roll_share": 0.7,
    "body.load_lag": 0.05,
    "tires.front.radius": 0.029,
    "tires.rear.radius": 0.034,
    "tires.rear.inertia": 3e-5,
    "tires.front.sliding_ratio": 0.6,
    "tires.front.cornering_drag": 0.1,
    "tires.rear.cornering_drag": 0.06,
    "servo.ackermann": 0.9,
    "servo.gain_left": 1.2,
    "servo.softness": 0.5,
    "servo.trim": 0.03,
    "motor.overrun": 0.7,
    "battery.wear": 0.6,
}
MANOEUVRES = {
    "launch": Manoeuvre(RX7, (0, 0, 0), {0.0: 1.0}, {0.0: 0.0}),
    "full lock": Manoeuvre(RX7, (1.6, 0, 0), {0.0: 0.35}, {0.0: 0.0, 0.1: 0.5}),
    "drift": Manoeuvre(RX7, (1.5, -0.675, 3.3), {0.0: 0.7}, {0.0: -0.3}),
    "braking slide": Manoeuvre(RX7, (2.2, 0.5, 2.0), {0.0: -1.0, 0.6: 0.0}, {0.0: 0.15}),
    "swerve": Manoeuvre(RX7, (1.5, 0, 0), {0.0: 0.7}, {0.0: 0.35, 0.4: -0.3}),
    "rear drive": Manoeuvre(
        varied(
            RX7,
            ODD
            | {
                "drivetrain.front_share": 0,
                "drivetrain.center_lock": 0,
                "drivetrain.rear_lock": 0.6,
            },
        ),
        (2.5, -0.6, 4.0),
        {0.0: 0.9, 0.5: 0.2},
        {0.0: -0.2},
    ),
    "front drive": Manoeuvre(
        varied(
            RX7,
            ODD
            | {
                "drivetrain.front_share": 1,
                "drivetrain.center_lock": 0,
                "drivetrain.front_lock": 1,
            },
        ),
        (2.0, 0.2, -1.0),
        {0.0: 0.5, 0.3: -0.6},
        {0.0: -0.3},
    ),
    "all drive": Manoeuvre(
        varied(
            RX7,
            ODD
            | {
                "drivetrain.front_share": 0.35,
                "drivetrain.center_lock": 0.5,
                "drivetrain.rear_lock": 1,
                "motor.current_limit": 6,
            },
        ),
        (0.5, 0, 0),
        {0.0: 0.8},
        {0.0: 0.4, 0.5: -0.2},
    ),
}
CONVERGED = ("launch", "full lock", "drift", "braking slide")
SECOND = ("drift", "rear drive", "front drive", "all drive", "swerve", "braking slide")


def position_error(a: np.ndarray, b: np.ndarray) -> float:
    return float(math.dist(a[:2], b[:2]))


@pytest.fixture(scope="module")
def final(drive: Callable) -> Callable[[float], dict[str, np.ndarray]]:
    """x, y, heading of every manoeuvre each 0.1 s up to a second, at a step; each step once."""
    known: dict[float, dict[str, np.ndarray]] = {}

    def at(dt: float) -> dict[str, np.ndarray]:
        if dt not in known:
            all_of = list(MANOEUVRES.values())
            states = []
            for m in all_of:
                moving = planar.initial_state(m.car, 1e-3, velocity=m.velocity).motion
                fields = {
                    name: getattr(moving, name) for name in ("vx", "vy", "yaw_rate", "wheels")
                }
                states.append(start(m.car, **fields))
            ticks = round(1 / dt)
            times = dt * np.arange(ticks)
            motion = drive(
                [m.car for m in all_of],
                states,
                ticks,
                dt,
                np.stack([held(m.throttle, times) for m in all_of], axis=1),
                np.stack([held(m.steering, times) for m in all_of], axis=1),
                every=round(0.1 / dt),
            ).motion
            poses = np.stack([motion.x, motion.y, motion.heading, motion.vx, motion.vy], axis=1)
            known[dt] = {name: poses[:, :, i] for i, name in enumerate(MANOEUVRES)}
        return known[dt]

    return at


FINE = 5e-5


@pytest.mark.parametrize("name", CONVERGED)
def test_a_second_at_one_millisecond_is_within_a_millimetre(final: Callable, name: str) -> None:
    error = position_error(final(1e-3)[name][-1], final(FINE)[name][-1])
    if name == "drift":
        sideslip = np.arctan2(final(FINE)[name][:, 4], final(FINE)[name][:, 3])
        assert np.degrees(sideslip[:8]).max() < -20, "it no longer drifts for 0.8 s"
    assert error < 1e-3, f"{error * 1e3:.3f} mm"


def test_the_scheme_is_of_second_order_where_smooth(final: Callable) -> None:
    # Over the second as a whole: kinks (a wheel that starts to slide) cost some of it.
    exact = final(FINE)
    orders = {}
    for name in MANOEUVRES:
        coarse, fine = (
            math.fsum(
                math.dist(a[:2], b[:2]) for a, b in zip(final(dt)[name], exact[name], strict=True)
            )
            for dt in (1e-3, 2.5e-4)
        )
        orders[name] = math.log(coarse / fine) / math.log(4)
    assert np.median(list(orders.values())) > 1.7, orders
    assert min(orders.values()) > 1.3, orders


def test_nothing_diverges_at_ten_milliseconds(final: Callable) -> None:
    for name, poses in final(1e-2).items():
        exact = final(FINE)[name]
        assert np.all(np.isfinite(poses)), name
        assert np.hypot(*poses[:, 3:].T).max() < 1.1 * np.hypot(*exact[:, 3:].T).max() + 0.1, name
        assert position_error(poses[-1], exact[-1]) < 0.1, name


# A second implementation: the continuous equations, straight from first principles


def second_implementation(m: Manoeuvre, until: float) -> np.ndarray:
    """x, y, heading after `until` seconds by a stiff solver, with solid shafts as constraints."""
    car = m.car
    body, line, esc, pack, links = car.body, car.drivetrain, car.motor, car.battery, car.servo
    tires = [car.tires.front] * 2 + [car.tires.rear] * 2
    a, half = body.front_axle, body.track / 2
    hubs = [(a, half), (a, -half), (a - body.wheelbase, half), (a - body.wheelbase, -half)]
    inertias = np.array([t.inertia for t in tires])
    radii = np.array([t.radius for t in tires])
    shaft = np.array([line.front_share / 2] * 2 + [(1 - line.front_share) / 2] * 2)
    pairs = (
        (line.front_lock, np.array([1.0, -1, 0, 0])),
        (line.rear_lock, np.array([0.0, 0, 1, -1])),
        (line.center_lock, np.array([0.5, 0.5, -0.5, -0.5])),
    )
    solid = [row for lock, row in pairs if lock == 1]
    viscous = [(1e-3 * lock / (1 - lock), row) for lock, row in pairs if lock < 1]
    free = null_space(np.array(solid)) if solid else np.eye(4)
    rotor = line.gear_ratio**2 * esc.rotor_inertia
    spin_mass = free.T @ (np.diag(inertias) + rotor * np.outer(shaft, shaft)) @ free
    size = free.shape[1]

    def motor_torque(duty: float, charge: float, speed: float) -> tuple[float, float]:
        constant = esc.torque_constant * line.gear_ratio
        open_voltage = pack.full * (
            1 - pack.slope * (1 - charge) - pack.knee * math.exp(-charge / pack.knee_width)
        )
        inner = pack.resistance * (1 + pack.wear * pack.wear_resistance)
        brakes = min(max(speed / 10, 0), 1) if duty < 0 else 0.0
        applied = duty if duty >= 0 else esc.reverse * (1 - brakes) * duty
        current = (applied * open_voltage - constant * speed) / (
            esc.resistance + applied**2 * inner
        )
        current = math.copysign(min(abs(current), esc.current_limit), current)
        current *= min(abs(applied) / 0.05, 1) * (1 if current * applied >= 0 else esc.overrun)
        short = esc.neutral_brake * max(1 - abs(duty) / 0.05, 0) + esc.brake * brakes * abs(duty)
        torque = line.efficiency * constant * current - short * constant**2 / esc.resistance * speed
        return torque, applied * current

    def asked_duty(throttle: float) -> float:
        size = (abs(throttle) - esc.dead_zone) / (esc.full_throttle - esc.dead_zone)
        return math.copysign(min(max(size, 0), 1), throttle)

    def asked_angle(angle: float) -> float:
        gain, limit = (
            (links.gain_left, links.limit_left)
            if angle >= 0
            else (links.gain_right, links.limit_right)
        )
        hard = min(max(gain * angle, -limit), limit)
        soft = limit * math.tanh(gain * angle / limit)
        return (1 - links.softness) * hard + links.softness * soft + links.trim

    def rates(_: float, state: np.ndarray, duty_goal: float, angle_goal: float) -> np.ndarray:
        _, _, heading, vx, vy, turn, angle, duty, load_ax, load_ay, charge = state[:11]
        spins = free @ state[11:]
        # Loads: moments about the centre of mass; no wheel lifts in these manoeuvres.
        weight, pitch = body.mass * 9.81, body.mass * body.cm_height * load_ax / body.wheelbase
        roll = body.mass * body.cm_height * load_ay / body.track
        front = weight * (body.wheelbase - a) / body.wheelbase - pitch
        rear = weight * a / body.wheelbase + pitch
        over_front = body.front_roll_share * roll
        over_rear = roll - over_front
        loads = front / 2 + over_front * np.array([-1, 1]), rear / 2 + over_rear * np.array([-1, 1])
        loads = np.concatenate(loads)
        assert loads.min() > 0
        # Ackermann by radii: the turn's centre lies beside the rear axle, a share of it as such.
        tangent = math.tan(angle)
        angles = [0.0] * 4
        if tangent:
            radius = body.wheelbase / tangent
            for i, side in enumerate((half, -half)):
                angles[i] = math.atan(body.wheelbase / (radius - links.ackermann * side))
        force, moment, torques = np.zeros(2), 0.0, np.zeros(4)
        for i, ((x, y), tire) in enumerate(zip(hubs, tires, strict=True)):
            c, s = math.cos(angles[i]), math.sin(angles[i])
            velocity = np.array([vx - turn * y, vy + turn * x])
            rim = tire.radius * spins[i]
            slip = np.array([[c, s], [-s, c]]) @ velocity - [rim, 0]
            tread = math.hypot(rim, tire.creep_speed)
            pull = np.array([tire.longitudinal_stiffness, tire.cornering_stiffness]) * slip / tread
            if not slip.any():
                continue
            sliding = min(float(np.hypot(*pull)) / (3 * tire.friction), 1)
            shear = pull * (1 - sliding) ** 2
            shear += (
                (tire.sliding_ratio * tire.friction * sliding**2 * (3 - 2 * sliding))
                * slip
                / np.hypot(*slip)
            )
            on_car = np.array([[c, -s], [s, c]]) @ (-loads[i] * shear)
            force += on_car
            moment += x * on_car[1] - y * on_car[0]
            torques[i] = radii[i] * loads[i] * shear[0]
            torques[i] -= line.drag / 4 * spins[i] / math.hypot(spins[i], 0.5)
            torques[i] -= line.drag_viscous / 4 * spins[i]
            cornering = tire.cornering_drag * radii[i] * loads[i] * abs(shear[1])
            torques[i] -= cornering * spins[i] / math.hypot(spins[i], 0.5)
        for strength, row in viscous:
            torques -= strength * row * (row @ spins)
        torque, current = motor_torque(duty, charge, shaft @ spins)
        spun = np.linalg.solve(spin_mass, free.T @ (torques + torque * shaft))
        ax, ay = force / body.mass
        c, s = math.cos(heading), math.sin(heading)
        swing = (angle_goal - angle) / links.lag
        return np.concatenate(
            [
                [c * vx - s * vy, s * vx + c * vy, turn],
                [ax + turn * vy, ay - turn * vx, moment / body.yaw_inertia],
                [min(max(swing, -links.rate), links.rate), (duty_goal - duty) / esc.lag],
                [(ax - load_ax) / body.load_lag, (ay - load_ay) / body.load_lag],
                [-current / (pack.capacity * (1 - pack.wear * pack.wear_capacity))],
                spun,
            ]
        )

    throttle = {0.0: 0.0} | {t + esc.delay: v for t, v in m.throttle.items()}
    steering = {0.0: 0.0} | {t + links.delay: v for t, v in m.steering.items()}
    marks = sorted({t for t in (*throttle, *steering) if t < until} | {until})
    vx, vy, turn = m.velocity
    rolling = np.array([(vx - turn * y) / r for (_, y), r in zip(hubs, radii, strict=True)])
    state = np.concatenate([[0, 0, 0, vx, vy, turn], [0] * 4, [1], np.zeros(size)])
    # Wheels that a solid differential joins are brought to one speed by its impulse.
    mass = np.diag(inertias) + rotor * np.outer(shaft, shaft)
    state[11:] = np.linalg.solve(spin_mass, free.T @ mass @ rolling)
    for begin, end in itertools.pairwise(marks):
        goals = (
            asked_duty(float(held(throttle, np.array(begin)))),
            asked_angle(float(held(steering, np.array(begin)))),
        )
        solved = solve_ivp(rates, (begin, end), state, "LSODA", rtol=1e-9, atol=1e-10, args=goals)
        assert solved.success, solved.message
        state = solved.y[:, -1]
    return state[:3]


@pytest.mark.parametrize("name", SECOND)
def test_a_second_implementation_takes_the_same_path(final: Callable, name: str) -> None:
    mine = second_implementation(MANOEUVRES[name], 0.6)
    theirs = final(FINE)[name][5]
    assert position_error(mine, theirs) < 1e-4
    assert theirs[2] == pytest.approx(mine[2], abs=1e-4)


# Loads


def test_wheel_loads_are_never_negative_and_sum_to_the_weight() -> None:
    rng = np.random.default_rng(6)
    count = 4000
    wheelbase = rng.uniform(0.1, 0.5, count)
    body = dataclasses.replace(
        RX7.body,
        mass=rng.uniform(0.1, 10, count),
        wheelbase=wheelbase,
        front_axle=wheelbase * rng.uniform(0.01, 0.99, count),
        track=wheelbase * rng.choice([0.0, 0.3, 1.0], count),
        cm_height=rng.uniform(0, 0.5, count),
        front_roll_share=rng.choice([0.0, 0.3, 1.0], count),
    )
    ax, ay = rng.normal(size=(2, count)) * rng.choice([0.1, 3, 30], count)
    loads = np.stack(jax.jit(chassis.wheel_loads)(body, ax, ay))
    assert loads.min() >= 0
    np.testing.assert_allclose(loads.sum(axis=0), body.mass * 9.81, rtol=1e-12)
    # Where all four stand, the moments of the loads balance those of the acceleration.
    standing = (loads.min(axis=0) > 0) & (body.track > 0)
    assert standing.sum() > 500
    front, rear = loads[0] + loads[1], loads[2] + loads[3]
    pitch = front * body.front_axle - rear * (wheelbase - body.front_axle)
    roll = (loads[1] + loads[3] - loads[0] - loads[2]) * body.track / 2
    push = body.mass * body.cm_height
    np.testing.assert_allclose(pitch[standing], (-push * ax)[standing], atol=1e-9)
    np.testing.assert_allclose(roll[standing], (push * ay)[standing], atol=1e-9)


def test_a_car_that_is_pushed_over_is_judged_so_after_a_tenth_of_a_second(
    drive: Callable,
) -> None:
    tall = {"body.cm_height": 0.12, "tires.front.friction": 2, "tires.rear.friction": 2}
    cars = [varied(RX7, tall), varied(RX7, tall | {"body.cm_height": 0.01})]
    result = drive(cars, [start(car, vy=6.0) for car in cars], 600, 1e-3)
    up, over = result.airborne[:, 0] > 0, result.rolled_over[:, 0] > 0
    lifted = int(np.argmax(up))
    judged = int(np.argmax(over))
    assert up[lifted:judged].all()
    assert judged - lifted + 1 == pytest.approx(100, abs=1)
    assert over[judged:].all()
    assert not up[-1], "it stands again, and still counts as rolled over"
    assert not result.rolled_over[:, 1].any()


# Tyres


def brush(tire: Car, slip_x: float, slip_y: float, rim: float) -> tuple[float, float]:
    """Force per load, by adding up the bristles over the contact's length."""
    u = (np.arange(200_000) + 0.5) / 200_000  # from the leading edge
    pressure = 6 * u * (1 - u)
    tread = math.hypot(rim, tire.creep_speed)
    pull = np.array([tire.longitudinal_stiffness, tire.cornering_stiffness])
    pull = pull * [slip_x, slip_y] / tread
    ellipse = tire.longitudinal_ratio
    deflected = 2 * u * math.hypot(pull[0] / ellipse, pull[1])
    adheres = deflected <= tire.friction * pressure
    held = pull * np.mean(np.where(adheres, 2 * u, 0))
    slides = tire.sliding_ratio * tire.friction * np.mean(np.where(adheres, 0, pressure))
    along = np.array([ellipse**2 * slip_x, slip_y])  # normal to the ellipse of friction
    return tuple(-held - slides * along / math.hypot(ellipse * slip_x, slip_y))


def force(tire: Car, load: float, slip_x: float, slip_y: float, rim: float) -> tuple:
    c = tyre.contact(tire, load, slip_x, slip_y, rim)
    return c.force_x, c.force_y


def test_the_tyre_is_the_brush_model_bristle_by_bristle() -> None:
    seed = 7
    rng = np.random.default_rng(seed)
    for _ in range(20):
        tire = dataclasses.replace(
            RX7.tires.rear,
            friction=rng.uniform(0.1, 2),
            sliding_ratio=rng.uniform(),
            longitudinal_stiffness=rng.uniform(1, 30),
            cornering_stiffness=rng.uniform(1, 30),
            longitudinal_ratio=rng.choice([1.0, rng.uniform(0.5, 1.5)]),
        )
        rim = rng.uniform(-5, 5)
        slip = rng.normal(size=2) * rng.choice([0.01, 0.1, 1]) * abs(rim)
        seen = force(tire, 4.0, *slip, rim)
        assert seen == pytest.approx(4.0 * np.array(brush(tire, *slip, rim)), abs=1e-4), seed


def test_the_tyre_is_fialas_cubic_for_one_stiffness_and_one_friction() -> None:
    tire = dataclasses.replace(
        RX7.tires.rear, sliding_ratio=1.0, longitudinal_stiffness=9.0, cornering_stiffness=9.0
    )
    rim, load, mu = 2.0, 5.0, tire.friction
    slip = np.linspace(0.001, 0.6, 50)
    z = 9.0 * slip / math.hypot(rim, tire.creep_speed)
    cubic = np.where(z < 3 * mu, z - z**2 / (3 * mu) + z**3 / (27 * mu**2), mu) * load
    x, y = force(tire, load, 0.6 * slip, -0.8 * slip, rim)
    np.testing.assert_allclose(x, -0.6 * cubic, rtol=1e-9)
    np.testing.assert_allclose(y, 0.8 * cubic, rtol=1e-9)


@pytest.mark.parametrize("ellipse", [0.5, 1.0, 1.5])
def test_a_sliding_contact_takes_out_the_most_energy_that_its_ellipse_allows(
    ellipse: float,
) -> None:
    tire = dataclasses.replace(RX7.tires.rear, sliding_ratio=1.0, longitudinal_ratio=ellipse)
    around = np.linspace(0, 2 * math.pi, 721)
    forces = tire.friction * np.stack([ellipse * np.cos(around), np.sin(around)])
    for angle in (0.0, 0.3, 1.0, math.pi / 2, 2.5):
        slip = 3.0 * np.array([math.cos(angle), math.sin(angle)])
        found = np.array(force(tire, 1.0, *slip, 0.5))
        assert -found @ slip == pytest.approx(np.max(forces.T @ slip), rel=1e-4), angle
        assert math.hypot(found[0] / ellipse, found[1]) == pytest.approx(tire.friction)


@pytest.mark.parametrize("ratio", [0.0, 0.5, 0.9, 1.0])
def test_the_largest_force_is_what_the_formula_says(ratio: float) -> None:
    tire = dataclasses.replace(RX7.tires.rear, sliding_ratio=ratio)
    _, y = force(tire, 5.0, 0.0, np.linspace(0, 2, 20001), 2.0)
    peak = 5.0 * tire.friction * (4 - 3 * ratio) / (3 - 2 * ratio) ** 2
    assert np.abs(y).max() == pytest.approx(peak, rel=1e-6)
    assert abs(y[-1]) == pytest.approx(5.0 * tire.friction * ratio, abs=1e-9)


@pytest.fixture(scope="module")
def corners(drive: Callable) -> Callable[[], Motion]:
    """Two slow ramps of steering and one small angle held, in one batch."""
    plain = {
        "body.cm_height": 0,
        "drivetrain.front_share": 0,
        "drivetrain.center_lock": 0,
        "drivetrain.drag": 0,
        "drivetrain.drag_viscous": 0,
        "motor.neutral_brake": 0,
        "servo.limit_left": 0.6,
        "tires.front.sliding_ratio": 1,
        "tires.rear.sliding_ratio": 1,
        "servo.ackermann": 0,
    }
    front = varied(RX7, plain | {"tires.front.friction": 0.4, "tires.rear.friction": 0.9})
    grippy = varied(
        RX7,
        plain
        | {
            "tires.front.friction": 3,
            "tires.rear.friction": 3,
            "tires.front.cornering_stiffness": 7,
            "tires.rear.cornering_stiffness": 11,
            "tires.front.creep_speed": 1e-3,
            "tires.rear.creep_speed": 1e-3,
        },
    )
    cars = [front, front, grippy]
    moving = [planar.initial_state(car, 1e-3, velocity=(2.0, 0.0, 0.0)).motion for car in cars]
    states = [start(car, vx=2.0, wheels=m.wheels) for car, m in zip(cars, moving, strict=True)]
    ramp = 0.3 * 1e-3 * np.arange(2000)
    steering = np.stack([ramp, -ramp, np.full(2000, 0.02)], axis=1)
    return drive(cars, states, 2000, 1e-3, [0.25, 0.25, 0.0], steering).motion


def test_the_front_axles_friction_limits_a_car_that_understeers(corners: Motion) -> None:
    # In a steady turn each axle carries its share of the mass, so the weaker axle gives the limit.
    for car, side in ((0, 1), (1, -1)):
        most = (side * corners.load_ay[:, car] / np.cos(corners.steering[:, car])).max()
        assert most == pytest.approx(0.4 * 9.81, rel=0.03)


def test_a_gentle_turn_follows_the_understeer_gradient(corners: Motion) -> None:
    # steering = wheelbase / radius + (1 / c_front - 1 / c_rear) ay / g, c the stiffness over load.
    vx, yaw_rate = corners.vx[600, 2], corners.yaw_rate[600, 2]
    gradient = (1 / 7 - 1 / 11) / 9.81
    assert yaw_rate == pytest.approx(0.02 * vx / (0.25 + gradient * vx**2), rel=0.01)


# Drivetrain

FLOATING = {  # wheels that the floor hardly holds
    "body.mass": 0.02,
    "tires.front.friction": 0.01,
    "tires.rear.friction": 0.01,
    "tires.front.longitudinal_stiffness": 0.1,
    "tires.rear.longitudinal_stiffness": 0.1,
    "drivetrain.drag": 0,
    "drivetrain.drag_viscous": 0,
    "motor.neutral_brake": 0,
    "motor.delay": 0,
    "motor.current_limit": 2000,
    "battery.resistance": 1e-4,
    "battery.capacity": 3.6e6,
}
REAR = {"drivetrain.front_share": 0, "drivetrain.center_lock": 0}
FRONT = {"drivetrain.front_share": 1, "drivetrain.center_lock": 0}


def test_differentials_share_torque_when_open_and_speed_when_locked(drive: Callable) -> None:
    light = FLOATING | {"motor.rotor_inertia": 0}
    cars = [
        varied(RX7, light | REAR),
        varied(RX7, light | REAR | {"drivetrain.rear_lock": 1}),
        varied(RX7, light | FRONT),
        varied(RX7, light | FRONT | {"drivetrain.front_lock": 1}),
        varied(RX7, light | REAR | {"drivetrain.rear_lock": 0.2}),
        varied(RX7, light | {"drivetrain.center_lock": 1}),
    ]
    speeds = np.array([10.0, 30.0, 50.0, 110.0])
    states = [start(car, wheels=Wheels(*speeds), duty=0.8) for car in cars]
    throttle = 0.05 + 0.95 * 0.8  # the duty that they have
    result = drive(cars, states, 100, 1e-4, throttle)
    after = np.stack(result.motion.wheels)[:, 19]
    gained = after - speeds[:, None]
    near = {"abs": 0.05}
    assert gained[2, 0] == pytest.approx(gained[3, 0], **near)
    assert gained[2, 0] > 3
    assert gained[:2, 0] == pytest.approx(0, **near)
    assert after[2, 1] == pytest.approx(after[3, 1], abs=1e-3)
    assert gained[2:, 1].sum() == pytest.approx(gained[2:, 0].sum(), **near)
    assert gained[0, 2] == pytest.approx(gained[1, 2], **near)
    assert gained[2:, 2] == pytest.approx(0, **near)
    assert after[0, 3] == pytest.approx(after[1, 3], abs=1e-3)
    coupling = 1e-3 * 0.2 / 0.8  # 1e-3 N m s when locked by half
    decay = math.exp(-2 * coupling * 20e-4 / 10 / RX7.tires.rear.inertia * 10)
    assert after[3, 4] - after[2, 4] == pytest.approx(60 * decay, rel=2e-3)
    assert after[:2, 5].sum() == pytest.approx(after[2:, 5].sum(), abs=2e-3)
    assert after[1, 5] - after[0, 5] == pytest.approx(20, **near)


def test_a_free_spin_up_is_the_exponential_of_motor_and_inertias(drive: Callable) -> None:
    cars = [
        varied(RX7, FLOATING | axles | {"motor.rotor_inertia": rotor})
        for axles in (REAR, {})
        for rotor in (0.0, 1.2e-6, 1e-5)
    ]
    motion = drive(cars, [start(car, duty=1.0) for car in cars], 200, 1e-3, 1.0).motion
    times = 1e-3 * np.arange(1, 201)
    for i, car in enumerate(cars):
        constant = car.motor.torque_constant * car.drivetrain.gear_ratio
        path = car.motor.resistance + car.battery.resistance
        slope = car.drivetrain.efficiency * constant**2 / path
        top = 9.6 * (1 - 0.5 * math.exp(-1 / 0.06)) / constant
        driven = 2 if i < 3 else 4
        inertia = driven * 2e-5 + car.drivetrain.gear_ratio**2 * car.motor.rotor_inertia
        expected = top * -np.expm1(-times * slope / inertia)
        np.testing.assert_allclose(motion.wheels.rear_left[:, i], expected, atol=2e-3 * top)


def test_the_motors_work_becomes_kinetic_energy_and_heat(drive: Callable) -> None:
    # A car in the air but for drag: work of the torque = energy of the wheels + work of the drag.
    car = varied(RX7, FLOATING | {"drivetrain.drag_viscous": 4e-4, "drivetrain.drag": 0.02})
    result = drive([car], [start(car, duty=1.0)], 2000, 1e-4, 1.0)
    speed = np.concatenate([[0], result.motion.wheels.rear_left[:, 0]])
    constant = car.motor.torque_constant * car.drivetrain.gear_ratio
    path = car.motor.resistance + car.battery.resistance
    volts = 9.6 * (1 - 0.5 * math.exp(-1 / 0.06))
    torque = car.drivetrain.efficiency * constant * (volts - constant * speed) / path
    power = torque * speed - 0.02 * speed**2 / np.hypot(speed, 0.5) - 4e-4 * speed**2
    assert result.energy[-1, 0] == pytest.approx(np.trapezoid(power, dx=1e-4), rel=2e-3)


# Battery


def test_the_battery_sags_with_current_and_with_age() -> None:
    def voltage(wear: float, duty: float, charge: float = 1.0) -> float:
        pack = dataclasses.replace(RX7.battery, wear=wear)
        return float(
            motor.drive(RX7.motor, RX7.drivetrain, pack, duty, charge, 0.0).battery_voltage
        )

    assert voltage(0, 0) == pytest.approx(9.6, abs=1e-5)
    assert voltage(1, 0) == voltage(0, 0)
    # A standing motor at half duty: I = d U / (R + d² r) in the windings, half of it from the pack.
    current = 0.5 * 9.6 / (RX7.motor.resistance + 0.25 * RX7.battery.resistance)
    assert voltage(0, 0.5) == pytest.approx(9.6 - RX7.battery.resistance * 0.5 * current, rel=1e-5)
    assert voltage(1, 0.5) < voltage(0.5, 0.5) < voltage(0, 0.5)
    assert voltage(0, 1.0) < voltage(0, 0.5) < voltage(0, 0.2)
    assert voltage(0, 0.5, 0.0) < voltage(0, 0.5, 0.2) < voltage(0, 0.5, 0.9)


def test_the_battery_runs_down_and_never_below_empty(drive: Callable) -> None:
    grip = {"tires.front.friction": 3, "tires.rear.friction": 3}
    cars = [
        varied(RX7, grip | {"battery.capacity": capacity, "battery.wear": wear})
        for capacity in (36.0, 3600.0)
        for wear in (0.0, 1.0)
    ]
    # Against a wall, so that the current is all but that of a standing motor.
    wall = np.array([[0.21, -5, 0.21, 5]])
    charge = drive(cars, [start(car) for car in cars], 1000, 1e-2, 1.0, 0.0, wall).motion.charge
    assert np.all(np.diff(charge, axis=0) <= 0)
    assert charge[-1, 3] < charge[-1, 2] < 1, "a worn pack holds less"
    spent = (1 - charge[-1, 2]) * 3600
    assert spent > 36, "enough to empty the small packs"
    assert charge.min() >= 0


# Servo and delays


def test_the_servo_lags_keeps_its_rate_and_stops_at_its_limits(drive: Callable) -> None:
    base = {"servo.delay": 0, "servo.trim": 0, "servo.rate": 1000.0, "servo.lag": 0.05}
    sides = {"servo.limit_left": 0.5, "servo.limit_right": 0.3, "servo.gain_right": 2.0}
    cars = [
        varied(RX7, base),
        varied(RX7, base | {"servo.rate": 2.0, "servo.lag": 0.001}),
        varied(RX7, base | sides),
        varied(RX7, base | sides),
        varied(RX7, base | sides | {"servo.softness": 1.0}),
        varied(RX7, base | sides | {"servo.trim": 0.05}),
    ]
    asked = [0.3, 0.4, 1.0, -0.1, 0.4, 1.0]
    steering = drive(cars, [start(car) for car in cars], 600, 1e-3, 0.0, asked).motion.steering
    times = 1e-3 * np.arange(1, 601)
    np.testing.assert_allclose(steering[:, 0], 0.3 * -np.expm1(-times / 0.05), rtol=1e-9)
    np.testing.assert_allclose(steering[:150, 1], 2 * times[:150], rtol=1e-9)
    assert np.abs(np.diff(steering[:, 1])).max() <= 2e-3 * (1 + 1e-9)
    assert steering[-1, 1] == pytest.approx(0.4)
    assert steering[-1, 2] == pytest.approx(0.5, rel=1e-4)
    assert steering[-1, 3] == pytest.approx(-0.2, rel=1e-4)
    assert steering[-1, 4] == pytest.approx(0.5 * math.tanh(0.4 / 0.5), rel=1e-4)
    assert steering[-1, 5] == pytest.approx(0.55, rel=1e-4)


def test_ackermann_points_both_front_wheels_at_one_centre_beside_the_rear_axle() -> None:
    full = dataclasses.replace(RX7.servo, ackermann=1.0)
    for angle in (0.4, -0.3, 0.05):
        sides = servo.directions(RX7.body, full, angle)
        for (cosine, sine), y in zip(sides, (RX7.body.track / 2, -RX7.body.track / 2), strict=True):
            # The wheel's axis meets the rear axle's line at y + wheelbase / tan(angle).
            assert y + RX7.body.wheelbase * cosine / sine == pytest.approx(
                RX7.body.wheelbase / math.tan(angle)
            )


def test_a_pure_delay_is_exact_to_fractions_of_a_tick(drive: Callable) -> None:
    delays = np.array([0.0, 0.001, 0.0025, 0.00725, 0.02, 0.0999])
    plain = {"servo.rate": 1e4, "servo.lag": 0.001, "servo.limit_left": 1.0, "motor.lag": 0.001}
    zone = {"motor.dead_zone": 0.0}
    cars = [varied(RX7, plain | zone | {"servo.delay": d, "motor.delay": d}) for d in delays]
    ramp = np.repeat(1e-3 * np.arange(200)[:, None], len(delays), axis=1)  # the time itself
    motion = drive(cars, [start(car) for car in cars], 200, 1e-3, ramp, ramp).motion
    for name in ("steering", "duty"):
        followed = np.asarray(getattr(motion, name))
        # Undo the lag: what was asked for in each tick.
        before = np.vstack([np.zeros(len(delays)), followed[:-1]])
        asked = before + (followed - before) / -math.expm1(-1)
        expected = np.maximum(ramp - delays, 0)
        np.testing.assert_allclose(asked[105:], expected[105:], atol=1e-9, err_msg=name)


# Walls

SLIPPERY = {
    "tires.front.friction": 0.01,
    "tires.rear.friction": 0.01,
    "drivetrain.drag": 0,
    "motor.neutral_brake": 0,
}


def outline(car: Car, motion: Motion) -> np.ndarray:
    """The rectangle's corners, (ticks, cars, 4, 2)."""
    points = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    points = points * [car.body.length, car.body.width] + [car.body.center, 0]
    c, s = np.cos(motion.heading)[..., None], np.sin(motion.heading)[..., None]
    return np.stack(
        [
            motion.x[..., None] + c * points[:, 0] - s * points[:, 1],
            motion.y[..., None] + s * points[:, 0] + c * points[:, 1],
        ],
        axis=-1,
    )


@pytest.mark.parametrize("dt", [1e-3, 1e-2])
def test_no_wall_is_passed_through(drive: Callable, dt: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        cars = [
            varied(
                RX7,
                SLIPPERY
                | {
                    "body.wall_restitution": rng.choice([0, 0.2, 1]),
                    "body.wall_friction": rng.choice([0, 0.4, 3]),
                },
            )
            for _ in range(LANES)
        ]
        bearing, heading = rng.uniform(-math.pi, math.pi, (2, LANES))
        states = [
            start(
                car,
                heading=h,
                vx=6 * math.cos(b),
                vy=6 * math.sin(b),
                yaw_rate=rng.normal() * 5,
                charge=1.0,
            )
            for car, b, h in zip(cars, bearing, heading, strict=True)
        ]
        square = BOX[:4] / 2
        result = drive(cars, states, round(1 / dt), dt, 0.8, 0.2, square)
        assert np.all(result.wall_contacts[-1] > 0)
        corners = np.abs(outline(RX7, result.motion)).max(axis=(2, 3))
        centres = np.maximum(np.abs(result.motion.x), np.abs(result.motion.y))
        assert centres.max() < 1 - RX7.body.width / 4, f"seed {seed}"
        # What one contact a tick leaves of an overlap in a corner is gone a little later.
        assert np.quantile(corners, 0.99) < 1 + 0.005, f"seed {seed}"
        assert corners.max() < 1 + 6 * dt + 0.01, f"seed {seed}"


def test_a_contacts_impulse_keeps_coulombs_law_and_adds_no_energy() -> None:
    seed, count = 9, 3000
    rng = np.random.default_rng(seed)
    cars = [
        varied(
            RX7,
            {
                "body.wall_friction": rng.choice([0, 0.1, 0.4, 2, 10]),
                "body.wall_restitution": rng.choice([0, 0.3, 1]),
                "body.center": rng.uniform(-0.05, 0.05),
            },
        )
        for _ in range(30)
    ] * (count // 30)
    motions = [
        start(
            car,
            16,
            heading=h,
            vx=v[0] * rng.choice([1e-3, 1]),
            vy=v[1] * rng.choice([1e-3, 1]),
            yaw_rate=v[2] * rng.choice([0, 10]),
        ).motion
        for car, h, v in zip(
            cars, rng.uniform(-4, 4, count), rng.normal(size=(count, 3)) * 2, strict=True
        )
    ]
    end = rng.uniform(-0.2, 0.2, (count, 2))
    bearing = rng.uniform(-4, 4, count)
    way = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    wall = np.hstack([end, end + way * rng.choice([0.05, 2], (count, 1))])[:, None]
    bodies = stacked([car.body for car in cars])
    before = stacked(motions)
    after, touched = jax.jit(jax.vmap(collide))(bodies, wall, before, before)
    after = jax.tree.map(np.asarray, after)
    out = np.stack([after.x - before.x, after.y - before.y])
    # A centre within a millimetre of the wall is not moved across it.
    touched = (np.asarray(touched) > 0) & np.any(out != 0, axis=0)
    assert touched.sum() > 500
    out = np.where(touched, out, [[1], [0]])
    normal = out / np.hypot(*out)
    c, s = np.cos(before.heading), np.sin(before.heading)
    dvx, dvy = after.vx - before.vx, after.vy - before.vy
    push = bodies.mass * np.stack([c * dvx - s * dvy, s * dvx + c * dvy])
    across = push[1] * normal[0] - push[0] * normal[1]
    along = (push * normal).sum(axis=0)
    energy = lambda m: (  # noqa: E731  # two uses
        bodies.mass * (m.vx**2 + m.vy**2) + bodies.yaw_inertia * m.yaw_rate**2
    )
    assert np.all(energy(after) <= energy(before) * (1 + 1e-12))
    assert along.min() > -1e-12, "a wall does not pull"
    excess = np.abs(across) - bodies.wall_friction * along
    worst = int(np.argmax(excess))
    assert excess[worst] < 1e-9, (
        f"seed {seed}: {np.sum(excess > 1e-9)} of {touched.sum()} contacts; in {worst} friction "
        f"{bodies.wall_friction[worst]} gives {across[worst]} N s across {along[worst]} N s"
    )


def test_a_head_on_hit_without_loss_reverses_the_speed(drive: Callable) -> None:
    car = varied(RX7, SLIPPERY | {"body.wall_restitution": 1, "body.wall_friction": 0})
    cars = [car] * 4
    walls = np.array([[[0.5, -1, 0.5, 1]], [[-0.5, -1, -0.5, 1]], [[-1, 0.4, 1, 0.4]]] * 2)[:4]
    states = [start(car, vx=5.0), start(car, vx=-5.0), start(car, vy=5.0), start(car, vx=1.0)]
    motion = drive(cars, states, 400, 1e-3, 0.0, 0.0, walls).motion
    for lane, speed in ((0, motion.vx), (1, -motion.vx), (2, motion.vy), (3, motion.vx)):
        before, after = np.abs(speed[:, lane]).max(), speed[:, lane].min()
        assert after == pytest.approx(-before, rel=0.05), lane
    np.testing.assert_allclose(motion.yaw_rate, 0, atol=1e-9)


def test_friction_with_a_wall_stops_the_slip_and_never_reverses_it(drive: Callable) -> None:
    # The flat side hits; the body slides along. Whatever the restitution, it must not come back.
    cars = [
        varied(RX7, SLIPPERY | {"body.wall_restitution": e, "body.wall_friction": mu})
        for e in (0.0, 0.5, 1.0)
        for mu in (0.1, 1.0, 10.0)
    ]
    wall = np.array([[-9.0, 0.2, 9, 0.2]])
    result = drive(cars, [start(car, vx=1.0, vy=2.0) for car in cars], 100, 1e-3, walls=wall)
    first = np.argmax(result.wall_contacts > 0, axis=0)
    along = result.motion.vx[first, np.arange(len(cars))]
    assert np.all(result.wall_contacts[-1] > 0)
    assert along.min() > -1e-9, along


def test_the_end_of_a_wall_hits_the_side_of_the_car(drive: Callable) -> None:
    car = varied(RX7, SLIPPERY)
    walls = np.array([[[x, 0.15, x, 1.0]] for x in (0.1, -0.1, 0.0)])
    result = drive([car] * 3, [start(car, vy=2.0) for _ in walls], 200, 1e-3, walls=walls)
    assert np.all(result.wall_contacts[-1] > 0)
    hit = int(np.argmax(result.wall_contacts[:, 0] > 0))
    turned = result.motion.yaw_rate[hit]
    assert turned[0] < -1
    assert turned[1] == pytest.approx(-turned[0], rel=0.02)
    assert turned[2] == pytest.approx(0, abs=1e-9)
    # No end is inside the outline at any time.
    m = result.motion
    dx, dy = walls[:, 0, 0] - m.x, walls[:, 0, 1] - m.y
    c, s = np.cos(m.heading), np.sin(m.heading)
    inside = np.minimum(
        car.body.length / 2 - np.abs(c * dx + s * dy), car.body.width / 2 - np.abs(c * dy - s * dx)
    )
    assert inside.max() < 1e-9


def test_a_wall_that_covers_half_the_bumper_turns_the_car(drive: Callable) -> None:
    car = varied(RX7, SLIPPERY | {"body.wall_friction": 0.0})
    # Parallel to the bumper, and not quite.
    walls = np.array(
        [[[0.4, 0.03, 0.4 + tilt, 0.5]] for tilt in (0.0, 1e-4, -1e-4)]
        + [[[0.4, -0.03, 0.4 + tilt, -0.5]] for tilt in (0.0, 1e-4, -1e-4)]
    )
    result = drive([car] * 6, [start(car, vx=2.0) for _ in walls], 200, 1e-3, walls=walls)
    assert np.all(result.wall_contacts[-1] > 0)
    hit = np.argmax(result.wall_contacts > 0, axis=0)
    turned = result.motion.yaw_rate[hit, np.arange(6)]
    assert np.all(turned[:3] > 1), turned
    assert np.all(turned[3:] < -1), turned


def test_a_wall_in_pieces_is_one_wall(drive: Callable) -> None:
    rng = np.random.default_rng(8)
    ends = np.array([-3, -0.5, 0.11, 0.31, 0.7, 1.3, 9.0])
    pieces = np.array([[a, 0.3, b, 0.3] for a, b in itertools.pairwise(ends)])
    whole = np.full_like(pieces, np.nan)
    whole[0] = [-3, 0.3, 9, 0.3]
    cars = [varied(RX7, {"body.wall_friction": f}) for f in (0.0, 0.4, 0.4, 2.0)] * 2
    heading = np.tile(rng.uniform(0.05, 0.8, 4), 2)
    states = [start(car, heading=h, vx=2.5) for car, h in zip(cars, heading, strict=True)]
    walls = np.stack([pieces] * 4 + [whole] * 4)
    result = drive(cars, states, 500, 1e-3, 0.6, 0.3, walls)
    assert np.all(result.wall_contacts[-1] > 0)
    for name in ("x", "y", "heading", "vx"):
        values = getattr(result.motion, name)
        # With a side all but flat on the wall, a seam right at the corner may be the least overlap
        # by a hair, and the car is pushed along its own side's normal: rounding decides which.
        np.testing.assert_allclose(values[:, :4], values[:, 4:], atol=1e-4, err_msg=name)
