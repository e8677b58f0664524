"""The numbers of a turn, learned by driving."""

import numpy as np
import pytest

from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.cli import main
from countersteer.course.course import from_segments
from countersteer.course.files import load_course
from countersteer.drivers import policy
from countersteer.drivers.policy import load_policy
from countersteer.learning import turning
from countersteer.task.judge import DRIFT, Outcome, Score
from countersteer.task.turns import Turns


def score(slip, error, outcome=(Outcome.REACHED.code,), ended=(1.0,), over=0.0, lap=5.0):
    turns = {name: np.zeros((1, 1)) for name in Turns._fields}
    turns |= {
        "peak_sideslip": np.radians([[slip]]),
        "error": np.radians([[error]]),
        "overshoot": np.radians([[over]]),
        "end": np.array([ended]),
    }
    others = dict.fromkeys(Score._fields, 0)
    return Score(**others)._replace(
        outcome=np.array(outcome), turns=Turns(**turns), goal_time=np.array([lap])
    )


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
    def cost(*faults, **more):
        return turning.cost(score(*faults, **more), 5.0)

    assert cost(40.0, 0.0) == pytest.approx([0.0])
    assert cost(40.0, 3.0) == pytest.approx([0.35])
    assert cost(32.0, 0.0) == pytest.approx([0.5])
    assert cost(20.0, 0.0) == pytest.approx([1.7 + 3.0])
    assert cost(40.0, 0.0, over=10.0) == pytest.approx([0.0])
    assert cost(40.0, 0.0, over=23.0) == pytest.approx([1.0])
    assert cost(40.0, 0.0, lap=6.0) == pytest.approx([2.4 * 0.2])
    failed = cost(40.0, 0.0, outcome=(Outcome.TOUCHED.code,), ended=(np.inf,), lap=np.inf)
    assert failed == pytest.approx([12.0])


def test_what_went_worst_is_tried_again(monkeypatch):
    """The trials of a later generation hold those that cost most before, and new ones."""
    course, begin, asked = load_course("box"), policy.library(), []

    def drive(*given):
        policies, trials = given[3:]
        asked.append(trials)
        bad = np.array([seed % 10 == 3 for seed in trials.seeds] * len(policies))
        outcome = np.where(bad, Outcome.TOUCHED.code, Outcome.REACHED.code)
        one = score(40.0, 0.0)
        turns = Turns(*(np.repeat(leaf, len(bad), axis=0) for leaf in one.turns))
        return one._replace(outcome=outcome, turns=turns, goal_time=np.full(len(bad), 5.0))

    monkeypatch.setattr(turning, "drive", drive)
    turning.search([course], None, None, begin, 3, 4, 40)
    first, second, third = (trials.seeds for trials in asked)
    assert len(first) == len(second) == len(third) == 40
    assert len(set(first)) == 40
    again = set(first) & set(second)
    assert again == {seed for seed in first if seed % 10 == 3} | again
    assert again
    assert set(third) & set(first), "not only of the generation just before"
    spoken = dict(zip(first, asked[0].speeds, strict=True))
    assert all(
        spoken[seed] == speed
        for seed, speed in zip(second, asked[1].speeds, strict=True)
        if seed in again
    ), "at the speed of before"


def test_a_car_that_does_not_slide_is_told_so():
    grippy = load_car("rx7", ["tires.rear.friction=2.0"])
    most, _ = turning.slides(grippy)
    assert most < DRIFT < turning.slides(load_car("rx7"))[0]
    told = turning.reason(load_course("box"), grippy, score(10.0, 0.0))
    assert told.startswith("cannot drift the corners of box, because it does not slide")


def test_a_corridor_that_is_too_narrow_is_told_so():
    course = from_segments(
        "slit", 0.3, False, [("straight", 2.0, 0.0), ("turn", 1.57, 0.0), ("straight", 2.0, 0.0)]
    )
    told = turning.reason(course, load_car("rx7"), score(10.0, 0.0))
    assert told.startswith("cannot drift the corners of slit, because the corridor is too narrow")
    assert "this one has 0.3 m" in told


def test_a_car_that_could_drift_is_told_that_it_has_not_learned_to():
    failed = score(40.0, 0.0, outcome=(Outcome.TOUCHED.code,), ended=(np.inf,))
    told = turning.reason(load_course("box"), load_car("rx7"), failed)
    assert told.startswith("has not learned to drift the corners of box: 1 of 1 random cars fail")
    assert "'touched a wall'" in told


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
