"""New runs beside old ones: whether the driver should be learned again."""

import json
from pathlib import Path

import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.cli import main
from countersteer.errors import InputError
from countersteer.runs.files import COMMANDS, TableWriter, command_rows
from countersteer.runs.run import read_run
from countersteer.tuning import relearn, tune

BASE = "jetracer-tape"
WORN = ["tires.front.friction=0.27", "tires.rear.friction=0.28"]  # from 0.38 and 0.45


def drive(folder: Path, seed: int, *changes: str) -> Path:
    """A log of launches, curves and slides by a car of the library with these changes."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 9, 0.05)
    block = np.floor(time / 1.5).astype(int)
    throttle = np.where(time < 0.3, 0, rng.uniform(0.25, 0.9, 8)[block])
    steering = np.radians(rng.uniform(-25, 25, 8)[block])
    commands = folder / f"commands-{seed}.csv"
    table = TableWriter(commands, COMMANDS)
    table.write(command_rows(time, throttle, steering))
    table.close()
    out = folder / f"run-{seed}"
    arguments = ["replay", str(commands), "--car", BASE, "--out", str(out), "--seed", str(seed)]
    assert main([*arguments, *(f"--set={change}" for change in changes), "--json"]) in (0, 1)
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, list[Path]]:
    folder = tmp_path_factory.mktemp("logs")
    return {
        "old": [drive(folder, seed) for seed in (1, 2, 3)],
        "same": [drive(folder, 4)],
        "worn": [drive(folder, 5, *WORN)],
    }


def read(paths: list[Path]) -> tune.Logs:
    return tune.read_logs([read_run(path) for path in paths], {BASE: load_car(BASE)}, 0.25, BASE)


def test_the_same_car_is_not_learned_again(runs):
    cars = {BASE: load_car(BASE)}
    found = relearn.judge(cars, cars, read(runs["old"]), read(runs["same"]), "handling", False)
    assert not found["learn_again"], found
    assert found["threshold"] > 1
    assert found["gain"] == pytest.approx(0)
    assert "learn the driver again: no." in relearn.verdict(found)


def test_a_car_whose_tyres_wore_is_learned_again(runs, tmp_path, capsys):
    out = tmp_path / "again.toml"
    paths = {kind: [str(path) for path in some] for kind, some in runs.items()}
    arguments = ["tune", *paths["old"], "--new", *paths["worn"], "--car", BASE]
    capsys.readouterr()
    assert main([*arguments, "--fit", "handling", "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = told["new_runs"]
    assert found["learn_again"], found
    assert found["excess"] > 1.5 * found["threshold"]
    assert found["refit"]["held_out"]
    assert found["refit"]["error"] < found["refit"]["error_before"]
    assert 0 < found["gain"] < 1
    assert {"run-1", "run-5"} <= {run["run"] for run in told["runs"]}
    assert found["verdict"].startswith("learn the driver again: yes.")
    assert found["verdict"] in out.with_suffix(".html").read_text()


def test_what_sets_new_runs_apart_is_their_error_and_not_what_was_driven(runs):
    """Slides among new runs are compared with slides among the old."""
    cars = {BASE: load_car(BASE)}
    old = read(runs["old"])
    slide = relearn.kinds(old.shots) == relearn.KINDS.index(relearn.fit.slides)
    assert 5 <= np.sum(slide) <= len(slide) / 2
    found = relearn.judge(cars, cars, old, old.where(slide), "handling", False)
    assert found["excess"] == pytest.approx(1)


def test_pieces_follow_the_time_and_share_the_windows(runs):
    old = read(runs["old"])
    piece = relearn.pieces_of_time(old.run, old.start)
    assert np.ptp(np.bincount(piece, minlength=relearn.PIECES)) <= 1
    order = np.lexsort((old.start, old.run))
    assert np.all(np.diff(piece[order]) >= 0)


def test_too_little_to_compare_with_is_one_line(runs):
    cars = {BASE: load_car(BASE)}
    old = read(runs["old"])
    few = old.where(np.arange(len(old.start)) < 15)
    with pytest.raises(InputError, match="the old runs hold 15 windows"):
        relearn.judge(cars, cars, few, old, "handling", False)
