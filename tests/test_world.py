"""Laws of the planar world, and a second implementation to check it against."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LANES, UNFUSED, start, varied
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

from countersteer.car.car import Car, Wheels
from countersteer.car.files import load_car
from countersteer.world import battery, chassis, drivetrain, motor, planar, servo, tyre
from countersteer.world.state import Motion

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
    state = planar.State(motion, line, line, zero, zero, zero, zero)

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
    program = jax.jit(
        jax.vmap(jax.value_and_grad(_far), (0, 0, None)), compiler_options=UNFUSED
    )
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
    bad = [jax.tree_util.keystr(path) for path, leaf in leaves if not np.all(np.isfinite(leaf[row]))]
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
    "drift": Manoeuvre(RX7, (2.0, -0.7, 4.5), {0.0: 0.6}, {0.0: 0.0, 0.25: -0.2}),
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
SECOND = ("rear drive", "front drive", "all drive", "swerve", "braking slide")


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
                fields = {name: getattr(moving, name) for name in ("vx", "vy", "yaw_rate", "wheels")}
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
    assert error < 1e-3, f"{error * 1e3:.3f} mm"


def test_the_scheme_is_of_second_order_where_smooth(final: Callable) -> None:
    # Over the second as a whole: kinks (a wheel that starts to slide) cost some of it.
    exact = final(FINE)
    orders = {}
    for name in CONVERGED:
        coarse, fine = (
            np.mean([position_error(a, b) for a, b in zip(final(dt)[name], exact[name], strict=True)])
            for dt in (2e-3, 5e-4)
        )
        orders[name] = float(np.log(coarse / fine) / np.log(4))
    assert np.median(list(orders.values())) > 1.7, orders
    assert min(orders.values()) > 1.2, orders


def test_nothing_diverges_at_ten_milliseconds(final: Callable) -> None:
    for name, poses in final(1e-2).items():
        exact = final(FINE)[name]
        assert np.all(np.isfinite(poses)), name
        assert np.hypot(*poses[:, 3:].T).max() < 1.1 * np.hypot(*exact[:, 3:].T).max() + 0.1, name
        assert position_error(poses[-1], exact[-1]) < 0.1, name


# A second implementation: the continuous equations, straight from first principles


def second_implementation(m: Manoeuvre, until: float) -> np.ndarray:
    """x, y, heading after `until` seconds by a stiff solver, locked differentials as constraints."""
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
                tire.sliding_ratio * tire.friction * sliding**2 * (3 - 2 * sliding)
            ) * slip / np.hypot(*slip)
            on_car = np.array([[c, -s], [s, c]]) @ (-loads[i] * shear)
            force += on_car
            moment += x * on_car[1] - y * on_car[0]
            torques[i] = radii[i] * loads[i] * shear[0]
            torques[i] -= line.drag / 4 * spins[i] / math.hypot(spins[i], 0.5)
            torques[i] -= line.drag_viscous / 4 * spins[i]
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
    for begin, end in zip(marks, marks[1:], strict=False):
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
