"""The public names: a drive in five lines, from an empty folder."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import countersteer as cs

FIVE = """
import countersteer as cs
run = cs.drive("box", car="rx7", driver="drift-turn", seed=1, set=["battery.wear=0.3"])
print(run.outcome, len(run.turns), run.success)
print(run.columns["x_m"].shape, run)
try:
    print(len(run.to_pandas()) == len(run.columns["x_m"]))
except ImportError as error:
    print(error)
assert "<iframe" in run._repr_html_() and "jax" in __import__("sys").modules
"""


def test_five_lines_drive_from_an_empty_folder(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", FIVE], cwd=tmp_path, capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    first, second, third = done.stdout.splitlines()
    assert first == "goal reached 4 True"
    assert "box-drift-turn-001: goal reached, 4 turns" in second
    assert third in ("True", "to_pandas needs pandas: pip install pandas")
    assert (tmp_path / "runs" / "box-drift-turn-001" / "report.png").exists()


def test_importing_it_imports_nothing_heavy():
    code = "import sys, countersteer; assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", cs.__all__)
def test_each_public_name_is_there_and_documented(name):
    found = getattr(cs, name)
    assert len(inspect.getdoc(found) or "") > 20
    assert name in dir(cs)
    with pytest.raises(AttributeError, match="no attribute 'drift'"):
        _ = cs.drift


def test_a_few_lines_step_a_simulator_with_a_pilot():
    course, nominal = cs.load_course("box"), cs.load_car("rx7")
    pilot = cs.Pilot.of(cs.load_driver("drift-turn", course, nominal), course, nominal)
    simulator = cs.Simulator.of(course, cs.load_car("rx7", ["battery.wear=0.3"]), seed=1)
    loop, memory = simulator.init(), pilot.init(simulator.root)
    for _ in range(500):
        command, memory = pilot.act(memory, simulator.readings(loop), loop.tick)
        loop, record = simulator.apply(loop, command, pilot.control)
    assert float(record.motion.vx[-1]) > 0.5
    assert float(record.motion.x[-1]) > course.start[0]


def test_a_run_is_loaded_and_a_wrong_input_is_one_line(tmp_path):
    run = cs.drive("straight", driver="straighten", out=tmp_path / "run")
    again = cs.load_run(tmp_path / "run")
    assert again.outcome == run.outcome == "goal reached"
    assert again.turns == []
    np.testing.assert_array_equal(again.columns["x_m"], run.columns["x_m"])
    with pytest.raises(cs.InputError, match="no driver nobody: give one of"):
        cs.drive("box", driver="nobody", out=tmp_path / "none")
    with pytest.raises(cs.InputError, match="is open, and driven once"):
        cs.drive("straight", laps=2)


def test_evaluate_tells_of_one_driver():
    found = cs.evaluate("box", trials=4, seed=7, speed=(1.5, 3.0))
    assert found["trials"] == 4
    assert found["heading_overshoot_deg_p95"] >= found["heading_overshoot_deg_median"] > 0


def test_a_wrong_word_is_answered_in_one_line():
    for wrong in ({"link": "carrier-pigeon"}, {"estimate": "guess"}):
        for call in (cs.drive, cs.evaluate):
            with pytest.raises(cs.InputError, match="must be one of") as error:
                call("box", **wrong)
            assert "\n" not in str(error.value)


def test_the_page_has_every_name_argument_and_member():
    page = (Path(__file__).parents[1] / "docs" / "python.md").read_text()
    for name in cs.__all__:
        assert f"cs.{name}" in page or f"`{name}`" in page or name == "Run", name
    for call in (cs.drive, cs.evaluate, cs.load_car, cs.load_course, cs.load_driver, cs.load_run):
        for argument in inspect.signature(call).parameters:
            assert re.search(rf"\b{argument}\b", page), (call, argument)
    members = [m for m in vars(cs.Run) if not m.startswith("_")]
    for member in [*members, "columns", "commands", "telemetry", "about", "folder"]:
        assert f"run.{member}" in page, member
