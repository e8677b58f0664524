"""What a new user meets: verdicts that are true, courses that can be drawn, words that help."""

import csv
import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from countersteer import progress
from countersteer.batch.separation import separation, separation_line
from countersteer.car.files import load_car
from countersteer.cli import DONE, WRONG_INPUT, main
from countersteer.course.course import from_segments, place
from countersteer.course.files import load_course
from countersteer.drivers.policy import for_another_car, library
from countersteer.drivers.pursuit import pursuit
from countersteer.errors import InputError
from countersteer.learning import turning as learning
from countersteer.task.judge import Outcome, Task, summary

COURSES = Path(__file__).parents[1] / "examples" / "courses"
DRAWN = ("oval", "hairpin", "eight", "snake")


# Verdicts


def score_of(contacts, slips):
    task = Task.of(from_segments("two", 1.4, False, CORNERS))
    score = task.init()
    count = len(slips)
    turns = score.turns._replace(
        begin=np.arange(1.0, count + 1), end=np.arange(1.5, count + 1.5),
        peak_sideslip=np.radians(slips),
    )  # fmt: skip
    return score._replace(wall_contacts=contacts, goal_time=5.0, time=6.0, turns=turns)


CORNERS = [("straight", 3, 0), ("turn", 1.5, 0), ("straight", 3, 0), ("turn", -1.5, 0)]
CORNERS += [("straight", 3, 0)]


@pytest.mark.parametrize(
    ("contacts", "slips", "outcome", "verdict"),
    [
        (0, [30, 40], "goal reached", "goal reached"),
        (0, [12, 7], "goal reached", "goal reached, but did not drift: 12° of sideslip at most"),
        (0, [12, 40], "goal reached", "goal reached, but drifted in 1 of 2 turns"),
        (1, [30, 40], "touched a wall", "touched a wall"),
    ],
)
def test_a_verdict_says_what_happened(contacts, slips, outcome, verdict):
    found = summary(score_of(contacts, slips), Outcome.REACHED)
    assert found["completed"]
    assert found["success"] == (contacts == 0)
    assert (found["outcome"], found["verdict"]) == (outcome, verdict)
    assert found["drifts"] == sum(slip > 25 for slip in slips)


def test_every_trial_stands_in_a_table(tmp_path, capsys):
    out = tmp_path / "found"
    arguments = ["evaluate", "box", "--trials", "4", "--speed-mps", "1.5:3", "--out", str(out)]
    assert main([*arguments, "--set", "battery.wear=0.2", "--json"]) == DONE
    found = json.loads(capsys.readouterr().out)["drivers"]["drift-turn"]
    rows = list(csv.DictReader((out / "trials.csv").read_text().splitlines()))
    assert [int(row["seed"]) for row in rows] == [0, 1, 2, 3]
    assert sum(int(row["success"]) for row in rows) == found["successes"]
    laps = [float(row["lap_time_s"]) for row in rows if row["success"] == "1"]
    assert np.median(laps) == pytest.approx(found["lap_time_s_median"], rel=1e-5)
    assert all(1.5 <= float(row["speed_asked_mps"]) <= 3 for row in rows)
    assert len({row["tires.rear.friction"] for row in rows}) == 4
    assert found["separated_by"] == []


def test_the_command_for_one_trial_again_can_be_pasted(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "box", "--trials", "2", "--set", "battery.wear=0.2"]) == DONE
    line = capsys.readouterr().out.splitlines()[-1]
    command = line.removeprefix("one trial again: countersteer ").split()
    assert command[:2] == ["drive", "box"]
    assert command[-2:] == ["--set", "battery.wear=0.2"]
    assert main([*command, "--json"]) == DONE


def test_draws_that_separate_are_named_and_others_are_not():
    rng = np.random.default_rng(3)
    grip, other = rng.uniform(0.3, 0.5, 400), rng.uniform(0, 1, 400)
    won = grip + 0.02 * rng.normal(size=400) > 0.36
    (found,) = separation({"grip": grip, "other": other}, won)
    assert found["draw"] == "grip"
    assert found["pairs_told"] > 0.9
    assert "failures have a lower grip: median 0.3" in separation_line(found)
    assert separation({"grip": grip}, np.ones(400, bool)) == []


def test_a_policy_for_another_car_says_so():
    pilot = {"file": "drift-turn", "numbers": {"car": "rx7"}}
    assert for_another_car(pilot, "rx7") is None
    assert for_another_car({"kind": "straighten"}, "jetracer") is None
    line = for_another_car(pilot, "jetracer")
    assert "was learned for rx7, not for jetracer" in line
    assert "learn turn COURSE --car jetracer" in line


def test_what_is_learned_stays_within_the_declared_ranges(monkeypatch):
    """A search that spreads far: whatever it tries can be written and read."""
    tried = []

    def drive(*given):
        tried.extend(given[3])
        raise StopIteration

    monkeypatch.setattr(learning, "drive", drive)
    with pytest.raises(StopIteration):
        learning.search([load_course("box")], None, None, library(), 1, 64, 4, 10.0)
    low, high = learning.ranges(library())
    numbers = np.array([learning.flat(policy) for policy in tried])
    assert np.all((numbers >= low) & (numbers <= high))
    assert np.any(numbers == low)  # else nothing was held back
    assert np.any(numbers == high)


# Courses


@pytest.mark.parametrize("name", DRAWN)
def test_a_course_that_people_draw_takes_at_most_ten_lines(name):
    file = COURSES / f"{name}.toml"
    assert len(file.read_text().splitlines()) <= 10
    course = load_course(str(file))
    assert course.goal_distance > 8
    driver = pursuit(course, load_car("rx7"))
    assert np.all(driver.speeds > 0.5)
    assert driver.speeds.min() < driver.speeds.max()


@pytest.mark.parametrize("name", DRAWN)
def test_pursuit_drives_it(name, tmp_path, capsys):
    arguments = ["evaluate", str(COURSES / f"{name}.toml"), "--trials", "4", "--estimate", "pose"]
    assert main([*arguments, "--driver", "pursuit", "--json", "--out", str(tmp_path / "x")]) == DONE
    assert json.loads(capsys.readouterr().out)["drivers"]["pursuit"]["successes"] == 4


def test_an_oval_is_as_long_as_it_should_be():
    course = load_course(str(COURSES / "oval.toml"))
    assert course.length == pytest.approx(2 * 3 + 2 * np.pi * 1.5, rel=2e-3)
    x, y, heading = place(course, 3 + np.pi * 1.5 / 2)
    assert (x, y) == pytest.approx((4.5, 1.5), abs=0.01)
    assert heading == pytest.approx(np.pi / 2, abs=0.05)


def test_where_a_course_crosses_itself_no_wall_stands_in_the_way():
    course = load_course(str(COURSES / "eight.toml"))
    a, b = course.walls[:, :2], course.walls[:, 2:]
    step = b - a
    for distance in np.arange(0, course.length, 0.02):
        at = np.array(place(course, distance)[:2])
        on = np.clip(np.sum((at - a) * step, axis=1) / np.sum(step**2, axis=1), 0, 1)
        away = np.min(np.hypot(*(a + on[:, None] * step - at).T))
        assert away > 0.45, distance


@pytest.mark.parametrize(
    ("segments", "words"),
    [
        ("{turn_deg = 90}", "segments[0] must be a straight: write {length_m = 1.0}"),
        ("{straight_m = 3}, {turn_deg = 180, radius_m = 1}, {straight_m = 3}",
         "segments[0]: straight_m runs to a corner point, and a turn of 180° or more has none: "
         "write length_m"),
        ("{straight_m = 3}, {turn_deg = 180}, {straight_m = 3}", "needs an arc: write radius_m"),
        ("{length_m = 3}, {turn_deg = 90}, {turn_deg = 90, radius_m = 1}, {length_m = 1}",
         "segments[1]: a turn beside another needs a radius_m over 0"),
        ("{straight_m = 1}, {turn_deg = 90, radius_m = 2}, {straight_m = 3}",
         "segments[0] needs a straight_m of 2 or more"),
        ("{length_m = 3}, {turn_deg = 351, radius_m = 1}, {length_m = 3}", "in [-350, 350]"),
        ("{lenght_m = 3}", "{length_m = …} (its own length)"),
        ("{length_m = 3}, {turn_deg = 270, radius_m = 1}, {length_m = 3}",
         "crosses itself: write crosses = true"),
    ],
)  # fmt: skip
def test_each_error_of_a_course_says_what_to_write(tmp_path, segments, words):
    file = tmp_path / "mine.toml"
    file.write_text(f"width_m = 1\nsegments = [{segments}]\n")
    with pytest.raises(InputError, match=re.escape(words)) as error:
        load_course(str(file))
    assert str(file) in str(error.value)


def test_a_circuit_that_does_not_close_says_by_how_much(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        "width_m = 1\nclosed = true\nsegments = [{length_m = 3}, {turn_deg = 180, radius_m = 1}, "
        "{length_m = 2}, {turn_deg = 180, radius_m = 1}]\n"
    )
    with pytest.raises(InputError, match=r"end 1 m ahead and .* left of the start, turned by 0°"):
        load_course(str(file))


# Words


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("drve box", "there is no drve (did you mean drive?)"),
        ("drive box --sed 3", "there is no --sed (did you mean --seed?)"),
        ("drive box --link radoi", "there is no radoi (did you mean radio?)"),
        ("drive bx", "no course bx (did you mean box?)"),
        ("drive box --car rx8", "no car rx8 (did you mean rx7?)"),
        ("drive box --driver drift", "no driver drift"),
    ],
)
def test_a_wrong_word_is_answered_with_the_nearest(capsys, arguments, words):
    assert main(arguments.split()) == WRONG_INPUT
    error = capsys.readouterr().err
    assert words in error
    assert len(error.strip().splitlines()) == 1


def test_a_bare_command_helps(capsys):
    assert main([]) == DONE
    assert "usage: countersteer" in capsys.readouterr().out


def test_output_that_nobody_reads_on_ends_quietly():
    command = f"{sys.executable} -m countersteer list parameters | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert len(done.stdout.splitlines()) == 1
    assert done.stderr == ""


def test_a_terminal_is_told_at_once_what_is_started(tmp_path):
    """On a pseudo-terminal: the first line comes before JAX is imported, and goes away."""
    code = (
        "import sys, time, pathlib; from countersteer import progress\n"
        "with progress.waiting('drive box', pathlib.Path(sys.argv[1])):\n"
        "    assert 'jax' not in sys.modules\n"
        "    time.sleep(1.7); print('done')\n"
        "    progress.clock('judging'); time.sleep(1.7); print('judged')\n"
    )
    memory = tmp_path / "waits.json"

    def shown():
        main_end, end = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-c", code, str(memory)], stdout=end, stderr=end, close_fds=True
        )
        os.close(end)
        text = b""
        while True:
            try:
                part = os.read(main_end, 4096)
            except OSError:
                break
            if not part:
                break
            text += part
        assert process.wait(timeout=30) == 0
        os.close(main_end)
        return text.decode()

    first, second = shown(), shown()
    assert first.startswith("\r\x1b[Kdrive box: starting")
    assert "loading and compiling, 1 s\r" in first
    assert "last time" not in first
    assert "2 s last time" in second
    assert "\r\x1b[Kdone\r\n\r\x1b[Kjudging: starting" in second
    assert second.count("2 s last time") >= 2
    assert second.rstrip().endswith("\r\x1b[Kjudged")
    assert list(json.loads(memory.read_text())) == ["drive box", "judging"]


def test_nothing_is_said_where_nobody_looks(tmp_path, capsys):
    with progress.waiting("drive box", tmp_path / "waits.json"):
        pass
    assert capsys.readouterr() == ("", "")
    assert not (tmp_path / "waits.json").exists()
