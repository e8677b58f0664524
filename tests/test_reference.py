"""The physics against other people's: the single-track drift model with its Magic Formula tyre.

The single-track model is our planar car with a track of zero. Its load moves with the commanded
acceleration and its motor's torque is commanded too; both are fed in here, and nowhere else.
Numbers: CommonRoad vehicle models 3.0.2 and the 1:10 car of Gym-Khana, computed by their code.
"""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import fsolve

from countersteer.car.car import GRAVITY, Body, Car, Drivetrain, MagicFormula, Servo, Tire, Tires
from countersteer.car.files import load_car, save_car
from countersteer.signals import Command, Motion, Wheels
from countersteer.world import motor, planar, tyre
from countersteer.world.chassis import Vector
from countersteer.world.planar import Tick
from countersteer.world.walls import padded

OPEN_FLOOR = padded(np.zeros((0, 4)), np.dtype(float))
BMW_TIRE = MagicFormula()
SMALL_TIRE = dataclasses.replace(BMW_TIRE, p_dx1=1.23, p_kx1=66.909, p_dy1=1.101, p_ky1=-65.76)
# torque's share of the front axle while driving, while braking
BMW = {"mass": 1093.2952334674046, "inertia": 1791.5995300122856, "front": 1.1561957064,
       "rear": 1.4227170936, "height": 0.61373004, "radius": 0.344, "wheels": 1.7,
       "driving": 0.0, "braking": 0.66, "tire": BMW_TIRE}  # fmt: skip
SMALL = {"mass": 3.74, "inertia": 0.04712, "front": 0.15875, "rear": 0.17145, "height": 0.074,
         "radius": 0.049, "wheels": 0.00017, "driving": 0.5, "braking": 0.5,
         "tire": SMALL_TIRE}  # fmt: skip
BIASED = SMALL | {"front": 0.19812, "rear": 0.13208, "driving": 0.0,
                  "tire": dataclasses.replace(SMALL_TIRE, p_dy1=1.0, p_ky1=-50.0)}  # fmt: skip


def single_track(p: dict, acceleration: float) -> Car:
    """Our car in the limit of the single-track model."""
    share = p["driving"] if acceleration > 0 else p["braking"]
    # The formula's S_vx grows with the load of a tyre, and here an axle's load rests on two.
    law = dataclasses.replace(p["tire"], p_vx1=2 * p["tire"].p_vx1)
    tire = Tire(
        law="magic-formula",
        magic_formula=law,
        radius=p["radius"],
        inertia=p["wheels"] / 2,
        creep_speed=0.1,
    )
    body = Body(
        mass=p["mass"],
        yaw_inertia=p["inertia"],
        front_axle=p["front"],
        wheelbase=p["front"] + p["rear"],
        cm_height=p["height"],
        track=0.0,
    )
    shafts = Drivetrain(
        front_share=share, center_lock=0.0, drag=0.0, drag_viscous=0.0, gear_ratio=1.0
    )
    servo = Servo(ackermann=0.0, lag=0.001, delay=0.0)
    still = dataclasses.replace(Car().motor, rotor_inertia=0.0, delay=0.0)
    car = Car(body=body, tires=Tires(front=tire, rear=tire), drivetrain=shafts, servo=servo,
              motor=still)  # fmt: skip
    return jax.tree.map(np.float64, car)


def motion_of(car: Car, x: np.ndarray, acceleration: float) -> Motion:
    """Our state for theirs: x, y, steering, speed, heading, yaw rate, sideslip, wheel speeds."""
    wheels = Wheels(x[7], x[7], x[8], x[8])
    vx, vy = x[3] * jnp.cos(x[6]), x[3] * jnp.sin(x[6])
    torque = car.body.mass * acceleration * car.tires.front.radius
    return Motion(x[0], x[1], x[4], vx, vy, x[5], wheels, x[2], torque, acceleration, 0.0, 1.0)


def right_hand_side(car: Car, x: np.ndarray, rate: float, acceleration: float) -> np.ndarray:
    """The time derivative of their state, by our contacts and elimination.

    A step of length h ends at v + h dv/dt + ..., so its derivative at h = 0 is the acceleration.
    """
    motion = motion_of(car, x, acceleration)
    held = planar.grip.__wrapped__(car, motion)
    held = held._replace(drive=motor.Drive(motion.duty, 0.0, 0.0, 0.0))
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)

    def stepped(h: float) -> tuple:
        return planar.implicit.__wrapped__(car, held, planar.TANGENT, velocity, motion.wheels, h)

    _, (body, wheels) = jax.jvp(stepped, (0.0,), (1.0,))
    ax, ay = body.x + motion.yaw_rate * motion.vy, body.y - motion.yaw_rate * motion.vx
    cosine, sine = jnp.cos(x[6]), jnp.sin(x[6])
    return jnp.stack(
        [
            x[3] * jnp.cos(x[4] + x[6]),
            x[3] * jnp.sin(x[4] + x[6]),
            jnp.asarray(rate),
            ax * cosine + ay * sine,
            x[5],
            body.yaw,
            (ay * cosine - ax * sine) / x[3],
            wheels.front_left,
            wheels.rear_left,
        ]
    )


# Inputs are the steering rate and the acceleration, the BMW's as its limit of power clips it.
RIGHT_HAND_SIDES = {
    "A": (SMALL, [0, 0, 0.1, 3.0, 0.2, 0.5, -0.05, 62, 65], (0.2, 1.0),
          [2.9663132338081266, 0.4483143974207977, 0.2, 5.804773458155172, 0.5,
           0.9180329068532542, 2.9478179563269387, -2018.0012090916564, -4265.827774001931]),
    "A2": (BIASED, [0, 0, -0.2, 3.0, 0, 2.5, -0.5, 55, 75], (0.0, 2.0),
           [2.6327476856711183, -1.438276615812609, 0.0, -2.3937822609919968, 2.5,
            5.71720671243936, 0.23340078984150114, 1682.2284478216193, -756.8727224781285]),
    "BMW": (BMW, [2.0233348142065677, 0.0041907137716636, 0.0197545248559617, 15.7216236334290116,
                  0.0025857914776859, 0.0529001056654038, 0.0033012170610298,
                  53.6551710641082451, 56.7917911784219598],
            (0.15, 11.5 * 7.319 / 15.7216236334290116),
            [15.72135120308624, 0.09255279797193551, 0.15, 11.340113304616798, 0.0529001056654038,
             0.466681022626497, -0.02037000180254231, -1072.4665253469798, -253.94486828306555]),
}  # fmt: skip


@pytest.mark.parametrize("case", RIGHT_HAND_SIDES)
def test_the_derivative_is_that_of_the_single_track_drift_model(case: str) -> None:
    p, x, (rate, acceleration), expected = RIGHT_HAND_SIDES[case]
    with jax.enable_x64(True):
        car = single_track(p, acceleration)
        found = right_hand_side(car, np.array(x, float), rate, acceleration)
    np.testing.assert_allclose(found, expected, rtol=2e-12, atol=1e-12)


TRAJECTORIES = {
    "B1": (0.5, 0.0, [1.422691036239, 0.353687607565, 0.25, 2.971619410249, 0.561700575489,
                      2.249186906067, 0.117276062398, 61.83846001388, 60.155654240187]),
    "B4": (0.0, -3.0, [1.138924922692, 3.209536274711e-05, 0, 1.555056253327, -5.504126399001e-05,
                       -7.627116836114e-05, 5.570692637326e-05, 31.57624880653, 31.52208455827]),
}  # fmt: skip


@pytest.fixture
def commanded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torque and load transfer as commanded: the duty is the torque, loads stay as they are."""
    monkeypatch.setattr(motor, "duty", lambda _, throttle: throttle)
    monkeypatch.setattr(motor, "drive", lambda *given: motor.Drive(given[3], 0.0, 0.0, 0.0))
    monkeypatch.setattr(planar, "loaded", lambda *given: given[1])
    for name in ("grip", "implicit"):  # traced anew, and not kept for others
        monkeypatch.setattr(planar, name, getattr(planar, name).__wrapped__)


@pytest.mark.usefixtures("commanded")
@pytest.mark.parametrize("case", TRAJECTORIES)
def test_a_drive_is_that_of_the_single_track_drift_model(case: str) -> None:
    rate, acceleration, expected = TRAJECTORIES[case]
    with jax.enable_x64(True):
        car = single_track(SMALL, acceleration)
        if rate:
            servo = dataclasses.replace(car.servo, rate=np.float64(rate), limit_left=np.float64(1))
            car = dataclasses.replace(car, servo=servo)
        x = np.array([0, 0, 0, 3, 0, 0, 0, 3 / 0.049, 3 / 0.049])
        motion = motion_of(car, x, acceleration)
        command = Command(motion.duty, 1.0 if rate else 0.0)

        def move(motion: Motion, _: None) -> tuple[Motion, None]:
            tick = Tick(car, OPEN_FLOOR, command, command, 0, 1e-3)
            state, _ = planar.move(planar.initial_state(car, 1e-3)._replace(motion=motion), tick)
            return state.motion, None

        start = jax.tree.map(jnp.float64, motion)
        end, _ = jax.jit(lambda m: jax.lax.scan(move, m, None, length=500))(start)
    found = SimpleNamespace(**end._asdict())
    assert math.hypot(found.x - expected[0], found.y - expected[1]) < 1e-3
    assert found.steering == pytest.approx(expected[2], abs=1e-9)
    assert math.hypot(found.vx, found.vy) == pytest.approx(expected[3], abs=2e-3)
    assert found.heading == pytest.approx(expected[4], abs=1e-3)
    assert found.yaw_rate == pytest.approx(expected[5], abs=0.01)
    assert math.atan2(found.vy, found.vx) == pytest.approx(expected[6], abs=1e-3)
    assert found.wheels.front_left == pytest.approx(expected[7], abs=0.02)
    assert found.wheels.rear_left == pytest.approx(expected[8], abs=0.02)


# speed, sideslip -> steering, yaw rate, wheel speeds, acceleration asked for; growth of deviations
EQUILIBRIA = {
    (2.0, -0.4): ([0.313834300, 3.609599172, 35.313351967, 63.619906724, 3.674531058], [4.39]),
    (3.0, -0.5): (
        [-0.276972830, 2.857665159, 56.479208900, 82.667909676, 3.254600395],
        [7.57, 0.72],
    ),
}


@pytest.mark.parametrize("point", EQUILIBRIA)
def test_the_drift_equilibria_are_those_of_the_single_track_drift_model(
    point: tuple[float, float],
) -> None:
    (speed, sideslip), (expected, unstable) = point, EQUILIBRIA[point]
    with jax.enable_x64(True):

        def rates(unknown: jax.Array) -> jax.Array:
            steering, yaw_rate, front, rear, acceleration = unknown
            car = single_track(BIASED, 1.0)
            x = jnp.stack([0, 0, steering, speed, 0, yaw_rate, sideslip, front, rear])
            return right_hand_side(car, x, 0.0, acceleration)[jnp.array([3, 5, 6, 7, 8])]

        compiled = jax.jit(rates)
        guess = np.array(expected) * 1.01
        found = fsolve(compiled, guess, fprime=jax.jit(jax.jacfwd(rates)), xtol=1e-12)
        np.testing.assert_allclose(found, expected, rtol=1e-6)

        def free(y: jax.Array) -> jax.Array:  # speed, yaw rate, sideslip and wheels left free
            car = single_track(BIASED, 1.0)
            x = jnp.stack([0, 0, found[0], y[0], 0, y[1], y[2], y[3], y[4]])
            return right_hand_side(car, x, 0.0, found[4])[jnp.array([3, 5, 6, 7, 8])]

        at = jnp.array([speed, found[1], sideslip, found[2], found[3]])
        growth = np.linalg.eigvals(jax.jacfwd(free)(at)).real
    assert sorted(growth[growth > 0], reverse=True) == pytest.approx(unstable, abs=0.01)


def published_forces(
    p: MagicFormula, load: float, slip: float, angle: float
) -> tuple[float, float]:
    """Section by section as published, in NumPy; the second implementation."""
    kappa = -slip + p.p_hx1
    k_x, d_x = p.p_kx1 * load, p.p_dx1 * load
    b = k_x / (p.p_cx1 * d_x) * kappa
    f_x0 = d_x * np.sin(p.p_cx1 * np.arctan(b - p.p_ex1 * (b - np.arctan(b))) + load * p.p_vx1)
    k_y, d_y = p.p_ky1 * load, p.p_dy1 * load
    b = k_y / (p.p_cy1 * d_y) * angle
    f_y0 = d_y * np.sin(p.p_cy1 * np.arctan(b - p.p_ey1 * (b - np.arctan(b))))

    def weight(b: float, c: float, e: float, value: float) -> float:
        return np.cos(c * np.arctan(b * value - e * (b * value - np.arctan(b * value))))

    b_x = p.r_bx1 * np.cos(np.arctan(p.r_bx2 * slip))
    f_x = f_x0 / weight(b_x, p.r_cx1, p.r_ex1, p.r_hx1)
    f_x *= weight(b_x, p.r_cx1, p.r_ex1, angle + p.r_hx1)
    b_y = p.r_by1 * np.cos(np.arctan(p.r_by2 * (angle - p.r_by3)))
    f_y = f_y0 / weight(b_y, p.r_cy1, p.r_ey1, p.r_hy1)
    f_y *= weight(b_y, p.r_cy1, p.r_ey1, slip + p.r_hy1)
    shift = d_y * p.r_vy1 * np.cos(np.arctan(p.r_vy4 * angle))
    return f_x, f_y + shift * np.sin(p.r_vy5 * np.arctan(p.r_vy6 * slip))


@pytest.mark.parametrize("p", [BMW_TIRE, SMALL_TIRE, BIASED["tire"]], ids=["BMW", "1:10", "biased"])
def test_the_magic_formula_is_the_published_one(p: MagicFormula) -> None:
    rng = np.random.default_rng(1)
    tire = Tire(law="magic-formula", magic_formula=p, creep_speed=0.1)
    with jax.enable_x64(True):
        contact = jax.jit(tyre.contact)
        for _ in range(200):
            load, hub = 10 ** rng.uniform(-1, 4), rng.uniform(0.1, 20)
            slip, angle = rng.uniform(-3, 2), rng.uniform(-1.5, 1.5)
            c = contact(tire, load, slip * hub, hub * math.tan(angle), hub - slip * hub)
            expected = published_forces(p, load, slip, angle)
            np.testing.assert_allclose((c.force_x, c.force_y), expected, atol=1e-11 * load)
            assert c.k_x >= 0
            assert c.k_y >= 0


def test_a_magic_formula_contact_at_rest_pushes_nothing_and_has_finite_slopes() -> None:
    with jax.enable_x64(True):
        tire = jax.tree.map(np.float64, Tire(law="magic-formula"))
        slopes = jax.jacfwd(lambda v: tyre.contact(tire, 5.0, *v))(jnp.zeros(3))
        still = tyre.contact(tire, 5.0, 0.0, 0.0, 0.0)
    assert (still.force_x, still.force_y) == (0, 0)
    assert all(np.all(np.isfinite(s)) for s in slopes)


def test_a_car_with_the_magic_formula_is_written_and_read_in_full(tmp_path) -> None:
    car = load_car("rx7", ["tires.rear.law=magic-formula", "tires.rear.magic_formula.p_dy1=0.4"])
    assert car.tires.rear.peak_friction == 0.4
    save_car(car, tmp_path / "magic.toml", {})
    assert load_car(str(tmp_path / "magic.toml")) == car
    assert "magic_formula" in (tmp_path / "magic.toml").read_text()


def test_weight_rests_as_in_the_single_track_model() -> None:
    car = single_track(SMALL, 1.0)
    loads = planar.chassis.wheel_loads(car.body, 1.0, 3.0)
    front = 3.74 * (GRAVITY * 0.17145 - 0.074) / 0.3302
    assert loads.front_left + loads.front_right == pytest.approx(front, rel=1e-12)
    assert loads.front_left == loads.front_right
