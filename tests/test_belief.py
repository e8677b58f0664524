"""When a comparison or a fit is not to be believed, and which of several cars fits best."""

import json
import math

import numpy as np
import pytest

from countersteer.cli import main
from countersteer.runs.files import COMMANDS, TableWriter, command_rows
from countersteer.tuning import belief, tune

TIME = np.linspace(0.01, 1.0, 50)
GOOD = {"vx_mps": 0.03, "vy_mps": 0.01, "yaw_rate_radps": 0.08, "wheel_speed_mps": 0.03}
STILL = {"vx_mps": 0.4, "vy_mps": 0.2, "yaw_rate_radps": 0.9, "wheel_speed_mps": 0.5}


def scored(windows=20, still=STILL, **errors):
    """Errors as `replay --compare` writes them."""
    return {
        "windows": windows,
        "median_abs_error": GOOD | errors,
        "persistence": {"median_abs_error": still},
    }


def comparison(**changes):
    """A comparison that there is no reason to doubt."""
    return {
        "horizon_s": 1.0, "battery_charge": 0.8, "battery_from": "fit",
        "steady": scored(), "transient": scored(), "spins": {"windows": 0, "of": 40},
    } | changes  # fmt: skip


def doubts(yaw_rates=(1.0, -1.0) * 10, **changes):
    return belief.of_comparison(comparison(**changes), np.array(yaw_rates))


def motion(vx, vy, yaw_rate):
    """A window's motion, each a number or a series."""
    return tuple(np.broadcast_to(np.asarray(one, float), TIME.shape) for one in (vx, vy, yaw_rate))


def test_a_good_comparison_has_no_line():
    assert doubts() == []


def test_an_error_above_persistence_is_named_with_its_kind_and_figures():
    steady = scored(still=STILL | {"yaw_rate_radps": 0.4}, yaw_rate_radps=1.3)
    assert doubts(steady=steady) == [
        "The error of the yaw rate after 1 s in steady windows, 1.3 rad/s, is larger than if "
        "nothing changed (0.4): do not trust this car on this log."
    ]
    (line,) = doubts(transient=scored(vx_mps=0.6))
    assert "forward velocity after 1 s in transient windows, 0.6 m/s" in line


@pytest.mark.parametrize(
    "fine",
    [
        scored(still=STILL | {"vy_mps": 0.005}, vy_mps=0.02),  # as small as a good fit's
        scored(vx_mps=0.41),  # hardly above
        scored(windows=4, vx_mps=3.0),  # too few windows to tell
        {"windows": 0, "median_abs_error": {}, "persistence": {"median_abs_error": {}}},
    ],
)
def test_small_errors_and_few_windows_are_no_reason(fine):
    assert doubts(steady=fine) == []


def test_a_prediction_that_is_no_number_is_not_believed():
    (line,) = doubts(steady=scored(vy_mps=math.nan))
    assert "lateral velocity" in line


@pytest.mark.parametrize(
    ("simulated", "spins"),
    [
        (motion(2.0, 0.1, 2.2), 0),
        (motion(1.0, 1.2, 2.5), 0),  # slides more than the log does, but no spin
        (motion(0.5, 1.2, 2.5), 1),  # sideslip of 67 degrees
        (motion(np.linspace(2, -2, 50), 0.3, 2.5), 1),  # turned round
        (motion(2.0, 0.1, 5.0), 1),  # turns far faster than the log
        (motion(math.nan, math.nan, math.nan), 1),
        (motion(0.02, 0.1, 0.0), 0),  # it stands: no sideslip
    ],
)
def test_a_spin_is_counted_where_the_log_grips(simulated, spins):
    grips = motion(2.0, 0.3, 2.0)
    assert belief.spin_count([(grips, simulated)]) == {"windows": spins, "of": 1}
    slides = motion(2.0, 0.8, 2.0)
    assert belief.spin_count([(slides, simulated)]) == {"windows": 0, "of": 0}


def test_a_car_in_reverse_grips_too():
    back = motion(-1.0, 0.1, 0.5)
    assert belief.spin_count([(back, back)]) == {"windows": 0, "of": 1}
    assert belief.spin_count([(back, motion(1.0, 0.1, 0.5))])["windows"] == 1


def test_motion_that_was_not_measured_tells_of_no_spin():
    unknown = motion(math.nan, math.nan, 1.0)
    assert belief.spin_count([(unknown, motion(0, 5, 9))]) == {"windows": 0, "of": 0}


def test_spins_are_a_line_when_they_are_more_than_a_few():
    (line,) = doubts(spins={"windows": 12, "of": 40})
    assert line.startswith("The simulation spins in 12 of 40 windows in which the log grips")
    assert doubts(spins={"windows": 1, "of": 40}) == []
    assert doubts(spins={"windows": 4, "of": 4}) == []


def test_a_battery_that_nobody_drives_is_a_line_if_it_was_fitted():
    (line,) = doubts(battery_charge=0.06)
    assert "charge that agrees best with the log is 0.06" in line
    assert len(doubts(battery_charge=0.104)) == 1  # the end of the search
    assert doubts(battery_charge=0.06, battery_from="voltmeter") == []
    assert doubts(battery_charge=0.15) == []


def test_turns_to_one_hand_only_are_told():
    assert doubts(yaw_rates=[2.0] * 30 + [-0.1] * 30) == [
        "All turns of this log are to the left: nothing is known of turns to the right."
    ]
    (line,) = doubts(yaw_rates=[-2.0] * 30 + [1.0])
    assert "to the right" in line
    assert doubts(yaw_rates=[2.0] * 30 + [-2.0] * 10) == []
    assert doubts(yaw_rates=[2.0, 2.0, 0.1, math.nan]) == []
    assert doubts(yaw_rates=[]) == []


# -------------------------------------------------------------------------------------------------
# Fits
# -------------------------------------------------------------------------------------------------


def told(windows=20, **errors):
    """Errors as `tune` writes them."""
    return {
        "windows": windows,
        "errors": {n: {"median_abs_error": e} for n, e in (GOOD | errors).items()},
        "persistence": {n: {"median_abs_error": e} for n, e in STILL.items()},
    }


def fitted_run(name, kind, **changes):
    return told() | {
        "run": name, "kind": kind, "steady": told(), "transient": told(), "battery_charge": 0.9,
        "battery_from": "fit", "spins": {"windows": 0, "of": 30},
    } | changes  # fmt: skip


def about(*runs, parameters=(), **totals):
    runs = runs or (fitted_run("one", "fitted"), fitted_run("two", "validation"))
    totals = {"fitted": {"rubber": told()}} | {
        kind.replace("_", " "): {"rubber": errors} for kind, errors in totals.items()
    }
    return {
        "runs": list(runs), "parameters": list(parameters), "surfaces": ["rubber"],
        "totals": totals,
    }  # fmt: skip


BOTH = {"rubber": np.array([1.0, -1.0] * 10)}


def test_a_good_fit_that_another_log_judged_has_no_line():
    assert belief.of_fit(about(validation=told()), BOTH) == []


def test_a_fit_that_no_other_log_judged_is_told_so():
    held = about(fitted_run("one", "fitted"), fitted_run("one", "held out"), held_out=told())
    (line,) = belief.of_fit(held, BOTH)
    assert line.startswith("No other log judges this fit: give --validate")


def test_what_was_fitted_is_not_judged_by_persistence_but_what_was_not_is():
    bad = {"transient": told(vx_mps=0.7)}
    assert belief.of_fit(
        about(fitted_run("a", "fitted", **bad), fitted_run("b", "validation")), BOTH
    ) == []  # fmt: skip
    (line,) = belief.of_fit(about(fitted_run("b", "validation", **bad)), BOTH)
    assert line.endswith("do not trust this car on b.")


def test_errors_far_above_those_of_the_fit_do_not_carry_over():
    (line,) = belief.of_fit(about(validation=told(yaw_rate_radps=0.5, vx_mps=0.07)), BOTH)
    assert line == (
        "On rubber, errors in the logs of --validate are far above those of what was fitted "
        "(forward velocity 0.07 and 0.03 m/s, yaw rate 0.5 and 0.08 rad/s): the fit does not carry "
        "over."
    )
    assert belief.of_fit(about(validation=told(vy_mps=0.025)), BOTH) == []


def test_a_parameter_at_a_bound_is_named_with_its_value():
    row = {
        "path": "tires.front.friction", "surface": "rubber", "run": None, "unit": "",
        "value": 1.5, "at_bound": True,
    }  # fmt: skip
    full = row | {"path": "battery.charge", "surface": None, "run": "one", "value": 1.0}
    (line,) = belief.of_fit(about(parameters=[row, full, row | {"at_bound": False}]), BOTH)
    assert line.startswith("tires.front.friction (rubber) is at an end of its range, 1.5:")


def test_a_fit_to_turns_of_one_hand_is_told_so_by_floor():
    (line,) = belief.of_fit(about(), {"rubber": np.full(20, -1.0)})
    assert line.startswith("All turns of the fitted logs on rubber are to the right")


def test_the_terminal_has_what_was_not_fitted_first():
    lines = tune.unseen_lines(about() | {"warnings": ["beware"]})
    assert lines[0].startswith("not fitted (if nothing changed)")
    assert lines[1].split()[:5] == ["two,", "validation", "20", "0.030", "(0.400)"]
    assert lines[2].startswith("- where something changes")
    assert lines[-1] == "warning: beware"
    nothing = about(fitted_run("one", "fitted")) | {"warnings": []}
    assert tune.unseen_lines(nothing) == []


# -------------------------------------------------------------------------------------------------
# Several cars
# -------------------------------------------------------------------------------------------------


def test_the_best_car_has_the_least_errors_steady_and_transient_alike():
    nothing = {"windows": 0, "median_abs_error": {}, "persistence": {"median_abs_error": {}}}
    cars = {
        "steady": comparison(transient=scored(windows=2, vx_mps=2.0)),
        "even": comparison(steady=scored(windows=900, vx_mps=0.06)),
        "wild": comparison(transient=scored(vx_mps=math.nan)),
    }
    assert belief.best(cars) == "even"
    assert belief.score(comparison(transient=nothing)) == belief.score(comparison())


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A run of a car that names neither of those it is compared with."""
    folder = tmp_path_factory.mktemp("belief")
    time = np.arange(0, 4, 0.05)
    table = TableWriter(folder / "commands.csv", COMMANDS)
    steering = np.radians(np.where(time < 2, 15.0, -15.0))
    table.write(command_rows(time, np.where(time < 0.3, 0.0, 0.4), steering))
    table.close()
    out = folder / "run"
    command = ["replay", str(folder / "commands.csv"), "--car", "jetracer-tape", "--dt", "0.002"]
    assert main([*command, "--out", str(out), "--json"]) in (0, 1)
    return out


def test_several_cars_are_compared_and_the_best_is_named(log, tmp_path, capsys):
    cars = ["--car", "jetracer", "--car", "jetracer-tape"]
    command = ["replay", str(log), "--compare", "--dt", "0.002", "--battery", "1"]
    capsys.readouterr()
    assert main([*command, *cars, "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["best"] == "jetracer-tape"
    assert found["scores"]["jetracer-tape"] < 0.2 < 1 < found["scores"]["jetracer"]
    assert set(found["cars"]) == {"jetracer", "jetracer-tape"}
    assert found["cars"]["jetracer"]["windows"] == found["cars"]["jetracer-tape"]["windows"]
    assert found["cars"]["jetracer-tape"]["warnings"] == []
    assert json.loads((tmp_path / "compare.json").read_text()) == found
    assert main([*command, *cars, "--out", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    ranked = [line.split()[0] for line in lines if line.startswith("jetracer")]
    assert ranked[:2] == ["jetracer-tape", "jetracer"]
    assert any(line.startswith("jetracer-tape fits best: least median errors") for line in lines)


def test_several_cars_are_for_a_comparison(log, tmp_path, capsys):
    for cars, words in ((("rx7", "jetracer"), "give one"), (("rx7", "rx7"), "given twice")):
        options = [word for car in cars for word in ("--car", car)]
        assert main(["replay", str(log), *options, "--out", str(tmp_path)]) == 2
        assert words in capsys.readouterr().err
