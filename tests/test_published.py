"""The published models that ours is compared with, and the page that compares them."""

import math

import numpy as np
import pytest

from countersteer.tuning.compare import Compared
from studies import how_true
from studies.how_true import OURS, PUBLISHED, Judged
from studies.published import Dart, Eth, Velocity, lagged, magic, predict

STEP = 0.01  # s


def driven(model, begin, throttle, steering, seconds):
    """The last velocity of a model under constant commands."""
    drive, turn = (np.full((1, round(seconds / STEP)), one) for one in (throttle, steering))
    found = predict(model, Velocity(*(np.array([one]) for one in begin)), drive, turn, STEP)
    return [series[0, -1] for series in found.values()]


@pytest.mark.parametrize(("throttle", "begin"), [(0.35, 2.7), (0.9, 4.6)])
def test_dart_settles_where_drive_and_resistance_balance(throttle, begin):
    model = Dart()
    ahead = model.steering_zero
    vx, vy, yaw_rate, wheels = driven(model, (begin, 0.0, 0.0), throttle, ahead, 8.0)
    force = (25.36 - 4.815 * vx) * (throttle - 0.164)
    resistance = 1.266 * math.tanh(7.666 * vx) + 0.7393 * vx - 0.1123 * vx**2
    steered = (0.7793 + 0.2262 * (vx - 0.5)) * -0.1183
    assert force == pytest.approx(resistance + steered, rel=1e-3)
    assert (vy, yaw_rate) == (0.0, 0.0)
    assert wheels == vx


def test_dart_steers_farther_to_the_right():
    model = Dart()
    assert model.angle(np.array(1.0)) == pytest.approx(0.3658 * math.tanh(1.3929 * 0.973))
    assert model.angle(np.array(-1.0)) == pytest.approx(-0.5148 * math.tanh(1.0230 * 1.027))
    assert model.angle(np.array(model.steering_zero)) == pytest.approx(0.0)


def test_dart_turns_to_the_side_that_it_steers_to_within_its_grip():
    for steering, side in ((0.6, 1), (-0.6, -1)):
        vx, _, yaw_rate, _ = driven(Dart(), (2.0, 0.0, 0.0), 0.35, steering, 3.0)
        assert 1.0 < side * yaw_rate * vx < 0.85 * 9.81


def test_dart_does_not_drive_below_its_dead_zone():
    vx, *_ = driven(Dart(), (1.0, 0.0, 0.0), 0.16, 0.0, 3.0)
    assert abs(vx) < 0.1


def test_eth_settles_where_drive_and_drag_balance():
    vx, vy, yaw_rate, _ = driven(Eth(), (1.0, 0.0, 0.0), 0.6, 0.0, 8.0)
    assert vx == pytest.approx(11.10 * 0.6 / 1.734, rel=1e-3)
    assert (vy, yaw_rate) == (0.0, 0.0)


def test_eth_is_the_same_to_both_hands():
    left = driven(Eth(), (2.0, 0.1, 0.3), 0.5, 0.4, 1.0)
    right = driven(Eth(), (2.0, -0.1, -0.3), 0.5, -0.4, 1.0)
    assert np.array(left) * [1, -1, -1, 1] == pytest.approx(np.array(right))
    assert left[2] > 0.5


def test_eth_follows_its_wheels_in_reverse():
    vx, vy, yaw_rate, _ = driven(Eth(), (-1.0, 0.0, 0.0), -0.3, 0.5, 2.0)
    turn = vx * math.tan(0.634 * 0.5) / 0.30
    assert yaw_rate == pytest.approx(turn, rel=1e-2)
    assert vy == pytest.approx(0.17 * turn, rel=1e-2)


def test_a_tyre_peaks_at_its_friction():
    slip = np.linspace(0, 1.5, 500)
    force = magic(slip, 6.29, 1.19, 0.427)
    assert np.max(force) == pytest.approx(0.427, rel=1e-2)
    assert force[1] / slip[1] == pytest.approx(6.29 * 1.19 * 0.427, rel=1e-2)


def test_a_lag_reaches_63_percent_after_its_time():
    answer = lagged(np.ones(500), 0.1, 0.002)
    assert answer[0] == 0.0
    assert answer[50] == pytest.approx(1 - math.exp(-1))


def test_a_prediction_is_converged_at_the_step_of_the_study():
    ends = []
    for halves in (1, 2):
        drive, turn = (np.full((1, 250 * halves), one) for one in (0.5, 0.5))
        begin = Velocity(*(np.array([one]) for one in (0.25, 0.0, 0.0)))
        found = predict(Dart(), begin, drive, turn, 0.002 / halves)
        ends.append([series[0, -1] for series in found.values()])
    assert ends[0] == pytest.approx(ends[1], abs=1e-4)


# -------------------------------------------------------------------------------------------------
# The page
# -------------------------------------------------------------------------------------------------


def window(error):
    """Forward velocity rises from 1 to 2 m/s, and is predicted with an error."""
    time, measured = np.array([0.5, 1.0]), np.array([1.5, 2.0])
    return {"vx_mps": Compared(time, measured, measured + error, np.ones(2))}


def judged(ours, published):
    windows = {OURS: [window(e) for e in ours], PUBLISHED: [window(e) for e in published]}
    return Judged("drift", "log-1", "mycar", False, 0.8, windows)


def test_the_table_has_median_errors_and_marks_the_least():
    lines = how_true.rows("drift", [judged([0.1, 0.2, 0.3], [0.4, 0.5, 0.6])])
    assert lines == ["| drift | mycar | held out | 3 | 1.000 · 0.500 · **0.200** |  |  |"]


def test_a_log_worse_than_doing_nothing_is_listed():
    found = "\n".join(how_true.worse([judged([1.3] * 6, [0.0] * 6)]))
    assert "| `drift`: log-1 | mycar | 0.80 | forward 1.000 · 1.300; forward (trans" in found
    assert how_true.worse([judged([1.1] * 6, [0.0] * 6)]) == ["On no log."]


def test_a_car_says_which_logs_its_fit_has_seen(tmp_path):
    car = tmp_path / "car.toml"
    car.write_text('base = "rx7"\n[source]\nlogs = "A lab: train_1, 30 s; to validate: train_2"\n')
    assert how_true.has_seen(str(car), "train_1")
    assert not how_true.has_seen(str(car), "train_2")
    assert not how_true.has_seen("rx7", "train_1")
