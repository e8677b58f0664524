"""Policies: a driver's numbers as plain data."""

import dataclasses
import math

import jax
import numpy as np
import pytest
import tomli_w

from countersteer.drivers.policy import LIBRARY, TABLES, load_policy, policy_tables, save_policy
from countersteer.drivers.registry import make_driver
from countersteer.drivers.stop_angle import StopAngle
from countersteer.errors import InputError
from countersteer.runs.files import read_commands
from test_open_turns import TURNING

STOPS = StopAngle(
    speeds=np.array([1.0, 1.6, 2.2]),
    offset=np.zeros(3),
    slope=np.full(3, 0.12),
    deviation=np.full(3, 0.1),
)
WHOLE = tomli_w.dumps({"kind": "drift-turn", **policy_tables(TURNING, STOPS)})


def test_every_number_of_the_driver_stands_in_the_file():
    for made, entries in TABLES.values():
        assert [field.name for field in dataclasses.fields(made)] == list(entries)


def test_the_library_is_in_si_units_inside():
    policy = load_policy("drift-turn")
    assert 0.1 < policy.turning.lock[0] < math.radians(45)
    assert 1 < policy.turning.rate[0] < 8
    assert np.all(policy.stop_angle.slope > 0)


def test_what_is_written_reads_back(tmp_path):
    policy = load_policy("drift-turn")
    path = tmp_path / "p.toml"
    save_policy(path, {"all": "the library"}, *policy)
    for old, new in zip(
        jax.tree.leaves(policy), jax.tree.leaves(load_policy(str(path))), strict=True
    ):
        np.testing.assert_allclose(new, old, rtol=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('kind = "drift-turn"', 'kind = "other"'), "kind must be \"drift-turn\", not 'other'"),
        (("[turning]", "[turns]"), "unknown key turns; did you mean turning?"),
        (("hold_p =", "hold_q ="), r"unknown key turning.hold_q; did you mean turning.hold_p"),
        (("hold_p = 0.9\n", ""), "turning.hold_p is missing"),
        (("hold_p = 0.9", 'hold_p = "a"'), r"turning.hold_p must be a number in \[-100, 100\]"),
        (("hold_throttle = ", "hold_throttle = 5"), "turning.hold_throttle = .* outside its range"),
        (("slope_s = [", "slope_s = [0.1, "), "stop_angle.slope_s must hold 3 numbers"),
        (("slope_s = [", "slope_s = [9.0, "), r"stop_angle.slope_s\[0\] = 9 is outside its range"),
        (("    1.4,\n", "    2.0,\n"), "turning.speed_mps must rise"),
        (("kind", "kind ="), "not valid TOML"),
    ],
)
def test_a_policy_that_is_wrong_is_told_by_key_and_range(tmp_path, change, message):
    path = tmp_path / "p.toml"
    assert change[0] in WHOLE
    path.write_text(WHOLE.replace(change[0], change[1], 1))
    with pytest.raises(InputError, match=message) as error:
        load_policy(str(path))
    assert "p.toml" in str(error.value)


def test_a_policy_without_numbers_is_none(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text('kind = "drift-turn"\n')
    with pytest.raises(InputError, match="holds no number"):
        load_policy(str(path))


def test_a_policy_drives_by_its_own_numbers(tmp_path):
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course

    path = tmp_path / "p.toml"
    path.write_text(WHOLE.replace("hold_p = 0.9", "hold_p = 1.9"))
    course, car = load_course("box"), load_car("rx7")
    driver, _ = make_driver(str(path), course, car, None, 1, read_commands)
    assert driver.turning.hold_p == 1.9
    own = make_driver("drift-turn", course, car, None, 1, read_commands)[0].turning
    assert own.hold_p == load_policy("drift-turn").turning.hold_p != 1.9
    with pytest.raises(InputError, match="cannot be read"):
        make_driver("none.toml", course, car, None, 1, read_commands)


def test_a_single_number_holds_at_all_speeds(tmp_path):
    """Files from before a number went by speed still read."""
    text = (LIBRARY / "drift-turn.toml").read_text()
    begin = text.index("slip_aim_deg = ")
    old = text[:begin] + "slip_aim_deg = 30.0\n" + text[text.index("]", begin) + 2 :]
    (tmp_path / "old.toml").write_text(old)
    read = load_policy(str(tmp_path / "old.toml")).turning
    assert read.slip_aim == pytest.approx(np.full(len(read.speeds), math.radians(30)))
