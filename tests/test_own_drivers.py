"""Drivers of one's own: named by a person, never by a file; made, judged, told what is wrong."""

import importlib.metadata
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from countersteer.batch import trials
from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.cli import DONE, FAILED, WRONG_INPUT, main
from countersteer.course.files import load_course
from countersteer.drivers import optimum, own
from countersteer.drivers.drift_turn import drift_turn
from countersteer.errors import InputError
from countersteer.pilot import Pilot, pilot_of_run
from countersteer.runs.files import read_commands

DRIVER = """
import countersteer as cs
class Mine:
    def __init__(self, car, speed=None): self.mass = float(car.body.mass)
    def reset(self, key): return 0
    def act(self, memory, seen): return cs.Command({throttle}, 0.0), memory + 1
"""


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(folder, text=DRIVER, **values):
    (folder / "mine.py").write_text(text.format(**({"throttle": 0.3} | values)))


def test_a_new_driver_drives_is_judged_and_is_compared(capsys):
    """The commands of the page."""
    assert main(["new", "driver", "my_driver"]) == DONE
    assert "countersteer drive box --driver my_driver.py:MyDriver" in capsys.readouterr().out
    assert main(["drive", "box", "--driver", "my_driver.py:MyDriver", "--json"]) == DONE
    found = json.loads(capsys.readouterr().out)
    assert found["success"]
    assert len(found["turns"]) == 4
    assert found["verdict"].startswith("goal reached, but did not drift: ")
    run = tomllib.loads((Path(found["out"]) / "run.toml").read_text())
    assert run["driver"] == "MyDriver"
    arguments = ["evaluate", "box", "--trials", "4", "--json"]
    assert main([*arguments, "--driver", "my_driver.py:MyDriver", "drift-turn"]) == DONE
    judged = json.loads(capsys.readouterr().out)["drivers"]
    assert list(judged) == ["my_driver.py:MyDriver", "drift-turn"]
    assert judged["my_driver.py:MyDriver"]["trials"] == 4
    assert judged["my_driver.py:MyDriver"]["successes"] >= 2
    assert judged["drift-turn"]["successes"] == 4
    assert main(["new", "driver", "my_driver"]) == WRONG_INPUT
    assert "is there already" in capsys.readouterr().err


def test_a_new_course_can_be_driven(capsys):
    assert main(["new", "course", "yard", "--json"]) == DONE
    assert main(["drive", "yard.toml", "--json"]) == DONE
    assert len(json.loads(capsys.readouterr().out.splitlines()[-1])["turns"]) == 2


def test_a_new_car_is_read_with_and_without_a_speed_controller(capsys):
    assert main(["new", "car", "mycar", "--json"]) == DONE
    assert "drive box --car mycar.toml" in json.loads(capsys.readouterr().out)["try"]
    car = load_car("mycar.toml")
    assert float(car.battery.full) == 8.4
    assert float(car.motor.dead_zone) == float(load_car("rx7").motor.dead_zone)
    file = Path("mycar.toml")
    file.write_text(re.sub(r"^# (?=\[speed_|gain|feed)", "", file.read_text(), flags=re.M))
    assert float(load_car("mycar.toml").speed_controller.gain) == 0.2


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        (None, "mine.py:Mine", "there is no file mine.py"),
        (DRIVER, "mine.py", "name the class as well, as in mine.py:Mine"),
        (DRIVER, "mine.py:Yours", "has no Yours: it has Mine"),
        ("def f(:", "mine.py:Mine", "SyntaxError"),
        ("1 / 0", "mine.py:Mine", "ZeroDivisionError: division by zero"),
        ("class Mine: pass", "mine.py:Mine", "has no method reset"),
        (
            "class Mine:\n def __init__(self, tires): pass",
            "mine.py:Mine",
            "cannot be made: TypeError",
        ),
    ],
)
def test_what_is_wrong_with_a_driver_is_told_in_a_line(folder, capsys, text, name, words):
    if text is not None:
        (folder / "mine.py").write_text(text.replace("{throttle}", "0.3"))
    assert main(["drive", "box", "--driver", name]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1


def test_a_driver_that_fails_in_the_middle_says_where_and_keeps_its_run(folder, capsys):
    written(folder, throttle="0.3 / (memory < 300)")
    assert main(["drive", "box", "--driver", "mine.py:Mine", "--out", "run"]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert "Mine.act at 1.500 s: ZeroDivisionError" in error
    assert "mine.py, line 6" in error
    assert len((folder / "run" / "commands.csv").read_text().splitlines()) > 100


def test_no_file_that_is_read_can_name_code(folder, capsys):
    written(folder, "open('evil', 'w').close()")
    (folder / "policy.toml").write_text('kind = "python"\nname = "mine.py:Mine"\n')
    assert main(["drive", "box", "--driver", "policy.toml"]) == WRONG_INPUT
    written(folder)
    assert main(["drive", "straight", "--driver", "mine.py:Mine", "--out", "run"]) in (DONE, FAILED)
    written(folder, "open('evil', 'w').close()")
    about = tomllib.loads((folder / "run" / "run.toml").read_text())
    assert about["pilot"] == {"kind": "python", "name": "mine.py:Mine"}
    with pytest.raises(InputError, match="no driver of kind 'python'"):
        pilot_of_run(about, read_commands)
    assert main(["replay", "run", "--out", "again"]) in (DONE, FAILED)
    assert not (folder / "evil").exists()
    capsys.readouterr()


def test_an_installed_package_may_offer_a_driver(folder, monkeypatch):
    written(folder)
    point = importlib.metadata.EntryPoint("theirs", "mine:Mine", own.GROUP)

    def points(group, name=None):
        assert group == own.GROUP
        return [point] if name in (None, "theirs") else []

    monkeypatch.setattr(importlib.metadata, "entry_points", points)
    monkeypatch.syspath_prepend(str(folder))
    assert own.installed() == ["theirs"]
    made = own.own_driver("theirs", load_course("box"), load_car("rx7"), None, 1)
    assert made.mass == pytest.approx(1.6)


def test_drives_one_by_one_are_judged_as_a_batch_is(monkeypatch):
    course, car, seeds = load_course("box"), load_car("rx7"), range(2)
    drawn = draw(load_population("around"), car, course, seeds, np.float64)
    driver = drift_turn(course, car)
    pilot = Pilot.of(driver, course, car)
    whole, _ = trials.run_trials(course, pilot, drawn, [driver] * 2, seeds, 1, 14.0, lanes=2)
    monkeypatch.setattr(trials, "traceable", lambda _: False)
    alone, _ = trials.run_trials(course, pilot, drawn, [driver] * 2, seeds, 1, 14.0)
    for name in ("outcome", "goal_time", "wall_contacts"):
        np.testing.assert_allclose(getattr(alone, name), getattr(whole, name), atol=1e-6)
    np.testing.assert_allclose(alone.turns.peak_sideslip, whole.turns.peak_sideslip, atol=1e-6)


def test_the_stored_optimum_is_the_drive_that_it_is_said_to_be(capsys):
    for path in optimum.library():
        about = json.loads(path.with_suffix(".json").read_text())
        told, course = about["optimum"], about["course"]
        assert main(["drive", course, "--driver", "optimum", "--json"]) == DONE
        driven = json.loads(capsys.readouterr().out)
        assert driven["success"]
        assert driven["wall_contacts"] == told["wall_contacts"] == 0
        assert driven["lap_time_s"] == pytest.approx(told["lap_time_s"], abs=0.01)
        assert driven["lap_time_s"] < about["planner"]["lap_time_s"]
    assert main(["drive", "ess", "--driver", "optimum"]) == WRONG_INPUT
    assert "no optimum is stored for 1 lap of ess" in capsys.readouterr().err
