"""The numbers of a turn, learned by driving."""

import numpy as np
import pytest

from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.cli import main
from countersteer.course.files import load_course
from countersteer.drivers import policy
from countersteer.drivers.policy import load_policy
from countersteer.learning import turning
from countersteer.task.judge import Outcome, Score
from countersteer.task.turns import Turns


def score(slip, error, outcome=(Outcome.REACHED.code,), ended=(1.0,)):
    turns = {name: np.zeros((1, 1)) for name in Turns._fields}
    turns |= {
        "peak_sideslip": np.radians([[slip]]),
        "error": np.radians([[error]]),
        "end": np.array([ended]),
    }
    others = dict.fromkeys(Score._fields, 0)
    return Score(**others)._replace(outcome=np.array(outcome), turns=Turns(**turns))


def test_numbers_go_into_a_row_and_come_back():
    begin = policy.library()
    numbers = turning.flat(begin)
    again = turning.shaped(begin, numbers)
    assert turning.flat(again) == pytest.approx(numbers)
    changed = turning.shaped(begin, numbers + 0.01)
    assert changed.turning.lead == pytest.approx(begin.turning.lead + 0.01)
    assert changed.turning.hold_p == pytest.approx(begin.turning.hold_p + 0.01)
    assert changed.stop_angle.slope == pytest.approx(begin.stop_angle.slope + 0.01)
    assert np.array_equal(changed.turning.speeds, begin.turning.speeds)


def test_a_good_drift_costs_nothing_and_each_fault_its_own():
    assert turning.cost(score(40.0, 0.0)) == pytest.approx([0.0])
    assert turning.cost(score(40.0, 3.0)) == pytest.approx([0.35])
    assert turning.cost(score(32.0, 0.0)) == pytest.approx([0.5])
    assert turning.cost(score(20.0, 0.0)) == pytest.approx([1.7 + 1.2])
    failed = turning.cost(score(40.0, 0.0, (Outcome.TOUCHED.code,), (np.inf,)))
    assert failed == pytest.approx([8.0])


def test_a_search_finds_its_way_back_from_a_spoilt_policy(tmp_path):
    """Wheels that hardly go over: no candidate drifts like that, and the search leaves it."""
    begin = policy.library()
    spoilt = turning.shaped(begin, turning.flat(begin))
    spoilt.turning.lead[:] = 0.3
    course, car = load_course("box"), load_car("rx7")
    costs = []
    found = turning.search(
        [course], car, load_population("around"), spoilt, 4, 8, 2, 1.0,
        report=lambda _, generation: costs.append(generation.cost),
    )  # fmt: skip
    assert len(costs) == 4
    assert min(costs[1:]) < costs[0]
    assert np.mean(found.turning.lead) > 0.3
    policy.save_policy(tmp_path / "found.toml", {"turning": "a test"}, *found)
    read = load_policy(str(tmp_path / "found.toml"))
    assert turning.flat(read) == pytest.approx(turning.flat(found), rel=1e-6)


def test_wrong_files_are_told_in_one_line(capsys):
    assert main(["learn", "turn", "box", "--out", "policy.txt"]) == 2
    assert "name a .toml file" in capsys.readouterr().err
