"""Commands for a series of drives: for the simulator and for a real car."""

import json

import numpy as np
import pytest

from countersteer import cli
from countersteer.errors import InputError
from countersteer.experiments.throttle_steps import LEVELS, read_levels, throttle_steps
from countersteer.runs.files import read_commands
from countersteer.runs.run import read_run


def test_ten_steps_from_rest_a_second_each_then_nothing(tmp_path, capsys):
    assert cli.main(["trials", "throttle-steps", "--out", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [run["throttle"] for run in told["runs"]] == list(LEVELS)
    assert len(list(tmp_path.glob("*.csv"))) == 10
    for run in told["runs"]:
        commands = read_commands(tmp_path / run["commands"])
        time, throttle = commands["time_s"], commands["throttle"]
        np.testing.assert_allclose(throttle, np.where(time < 0.999, run["throttle"], 0))
        assert time[-1] == 2
        assert np.all(commands["steering"] == 0)


def test_other_levels_lengths_and_rates(tmp_path):
    told = throttle_steps(tmp_path, read_levels("0.25,-0.5"), 0.5, 20)
    assert [run["commands"].rsplit("/")[-1] for run in told["runs"]] == [
        "throttle-0.25.csv",
        "throttle-reverse-0.5.csv",
    ]
    commands = read_commands(tmp_path / "throttle-reverse-0.5.csv")
    assert np.sum(commands["throttle"] == -0.5) == 10
    assert np.diff(commands["time_s"]) == pytest.approx(0.05)


@pytest.mark.parametrize("text", ["", "0.1,x", "0.1,1.5", "0,0.5", "0.3,0.30", "nan"])
def test_levels_that_cannot_be_driven_are_refused(text):
    with pytest.raises(InputError, match="--levels"):
        read_levels(text)


def test_the_list_of_runs_is_printed_for_a_person(tmp_path, capsys):
    assert cli.main(["trials", "throttle-steps", "--out", str(tmp_path / "new")]) == 0
    printed = capsys.readouterr().out
    assert printed == (tmp_path / "new" / "README.txt").read_text()
    assert "throttle-0.7.csv" in printed


def test_a_step_runs_in_the_simulator_with_lines_on_the_floor(tmp_path):
    throttle_steps(tmp_path / "steps", (0.4,))
    status = cli.main(
        [
            *("replay", str(tmp_path / "steps" / "throttle-0.4.csv")),
            *("--set", "sensors.line_detector.lines=across-x"),
            *("--out", str(tmp_path / "run"), "--json"),
        ]
    )
    assert status == 0
    run = read_run(tmp_path / "run")
    assert run.about["line_spacing_m"] == 0.1
    counts = run.telemetry["line_crossings"]
    assert np.nanmax(counts) == pytest.approx(run.truth["x_m"][-1] / 0.1, abs=1.1)
    speed = run.telemetry["line_speed_mps"]
    there = np.isfinite(speed)
    assert there.sum() == np.isfinite(counts).sum() - 1
    at = run.telemetry["time_s"][there] - 0.05 / speed[there]
    truth = np.interp(at, run.truth["time_s"], run.truth["vx_mps"])
    np.testing.assert_allclose(speed[there], truth, rtol=0.05, atol=0.03)
