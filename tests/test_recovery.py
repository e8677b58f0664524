"""The study of known cars found again: its logs, its page, and one car of it."""

import dataclasses

import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.tuning import fit
from studies import recovery
from studies.recovery import Case


@pytest.mark.parametrize(("seed", "what"), [(0, "handling"), (1, "all")])
def test_what_is_determined_of_a_known_car_lies_within_three_deviations(seed, what):
    cases = recovery.recovered(seed, what)
    determined = [case for case in cases if case.determined]
    assert len(determined) >= 4
    for case in determined:
        assert case.off < 3, (seed, case)
        declared = fit.declaration(case.path)
        before = fit.value_of(load_car(recovery.BASE), case.path)
        assert case.found != before or before in (declared.low, declared.high), (seed, case)


def test_a_random_car_differs_in_everything_and_keeps_its_ranges():
    base = load_car(recovery.BASE)
    for seed in range(20):
        car = recovery.random_car(base, fit.PARAMETERS, np.random.default_rng(seed))
        for path in fit.PARAMETERS:
            value, declared = fit.value_of(car, path), fit.declaration(path)
            assert declared.low <= value <= declared.high, (seed, path)
    free = ("body.yaw_inertia", "motor.torque_constant", "servo.trim")
    assert all(fit.value_of(car, path) != fit.value_of(base, path) for path in free)
    freed = {"yaw_inertia": base.body.yaw_inertia, "front_roll_share": base.body.front_roll_share}
    assert dataclasses.replace(car.body, **freed) == base.body


def test_the_page_counts_what_is_within_how_many_deviations():
    cases = [
        Case("body.yaw_inertia", 1.0, 1.05, 0.1, True),
        Case("body.yaw_inertia", 1.0, 1.25, 0.1, True),
        Case("servo.trim", 0.0, 0.5, 0.1, False),
        Case("servo.trim", 0.0, 0.35, 0.1, True),
    ]
    page = recovery.page(cases, 2, "all")
    assert "| body.yaw_inertia | 2 of 2 | 1 | 1 | 2 | 2.5 |" in page
    assert "| servo.trim | 1 of 2 | 0 | 0 | 0 | 3.5 |" in page
    assert "| all | 3 of 4 | 1 | 1 | 2 | 3.5 |" in page
    assert "33.3 %, 33.3 %, 66.7 %" in page
