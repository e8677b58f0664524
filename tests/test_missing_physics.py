"""The laws on trial of `studies.missing_physics`: at 0 they do nothing."""

import jax
import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.car.parameter import changed
from countersteer.signals import Motion, Wheels
from countersteer.world import chassis, planar, tyre
from studies.missing_physics import (
    CENTRES,
    MIRRORED,
    REACH,
    RESIDUAL,
    grip,
    residual,
    widened,
)

MOTION = Motion(0.0, 0.0, 0.0, 1.8, -0.4, 2.0, Wheels(*[60.0] * 4), 0.2, 0.5, 0.3, 3.0, 1.0)


@pytest.fixture(scope="module")
def car():
    return load_car("jetracer")


def test_laws_whose_numbers_are_0_change_nothing(car):
    plain, wide = planar.grip(car, MOTION), grip(planar.grip, widened(car), MOTION)
    for a, b in zip(*map(jax.tree.leaves, (plain, wide)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    nothing = residual(np.zeros((CENTRES, 5)), np.zeros((CENTRES, 3)), MOTION)
    assert np.all(np.asarray(nothing) == 0)


def test_friction_falls_where_the_load_is_above_that_at_rest(car):
    wide = changed(widened(car), "extra.load_front", 0.2)
    seen = []

    def plain(_, motion, friction):
        seen.append(friction)
        return motion

    grip(plain, wide, MOTION)  # a turn to the left: the right wheels carry more
    (friction,) = seen
    assert friction.front_right < 1 < friction.front_left
    assert friction.rear_left == friction.rear_right == 1
    loads = chassis.wheel_loads(car.body, MOTION.load_ax, MOTION.load_ay)
    rest = chassis.wheel_loads(car.body, 0.0, 0.0)
    assert friction.front_right == pytest.approx((loads.front_right / rest.front_right) ** -0.2)
    # So the axle holds less than without the law.
    holds = [
        sum(
            tyre.limit(tyre.scaled(car.tires.front, factor), load)
            for factor, load in zip(factors, loads[:2], strict=True)
        )
        for factors in ((1.0, 1.0), friction[:2])
    ]
    assert holds[1] < holds[0]


def test_steering_gives_way_to_lateral_acceleration(car):
    wide = changed(widened(car), "extra.compliance", 0.01)
    bent = grip(lambda _, motion, __: motion, wide, MOTION)
    assert float(bent.steering) == pytest.approx(0.2 - 0.01 * 3.0)


def test_the_residual_is_mirrored_and_ends_where_there_was_no_data():
    rng = np.random.default_rng(1)
    centres, weights = rng.normal(size=(CENTRES, 5)), rng.normal(size=(CENTRES, 3))
    assert len(RESIDUAL) == weights.size

    def at(z: np.ndarray) -> np.ndarray:
        vx, vy, yaw_rate, steering, duty = z * REACH
        motion = MOTION._replace(vx=vx, vy=vy, yaw_rate=yaw_rate, steering=steering, duty=duty)
        return np.asarray(residual(centres, weights, motion))

    z = rng.normal(size=5)
    np.testing.assert_allclose(at(z * MIRRORED), MIRRORED[:3] * at(z), rtol=1e-5)
    assert np.abs(at(z)).max() > 1e-3
    assert np.abs(at(z + 20)).max() < 1e-9
