"""Speed from each reader agrees with the truth within the deviation that it states."""

from pathlib import Path

import jax
import numpy as np
import pytest

from conftest import step_run
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.runs.run import Run
from countersteer.tuning.speed import Speed, read_speed

WALL = 'name = "wall"\nwalls_m = [[[3.2, -1.5], [3.2, 1.5]]]\n[start]\nx_m = 0.0\ny_m = 0.0\n'
LEVELS, SEEDS = (0.25, 0.32, 0.4, 0.5), 5
LINED = ["sensors.line_detector.lines=across-x", "sensors.line_detector.spacing_m=0.05"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Steps of throttle towards a wall, with lines on the floor, five seeds each."""
    folder = tmp_path_factory.mktemp("steps")
    (folder / "wall.toml").write_text(WALL)
    course, car = load_course(str(folder / "wall.toml")), load_car("rx7", LINED)
    found = []
    for level in LEVELS:
        for seed in range(SEEDS):
            start = (0.01 * seed, 0.0, 0.0)
            out = folder / f"{level}-{seed}"
            found.append(step_run(out, course, car, level, 1.2, 1.2, seed=seed, start=start))
    return found


def errors(runs: list[Run], source: str, column: str, radius: float = 1.0) -> np.ndarray:
    """Errors of all values in standard deviations."""
    told = []
    for run in runs:
        speed = read_speed(run, source)
        truth = radius * np.interp(speed.time, run.truth["time_s"], run.truth[column])
        told.append((speed.value - truth) / speed.deviation)
    return np.concatenate(told)


@pytest.mark.parametrize(
    ("source", "column", "radius", "least"),
    [
        ("encoder", "wheel_rl_radps", 0.0315, 700),
        ("sonar", "vx_mps", 1.0, 80),
        ("lines", "vx_mps", 1.0, 180),
    ],
)
def test_the_stated_deviation_is_the_true_one(runs, source, column, radius, least):
    off = errors(runs, source, column, radius)
    assert len(off) >= least
    within = [float(np.mean(np.abs(off) <= sigmas)) for sigmas in (1, 2)]
    # A normal error would give 0.68 and 0.95; those of counting are a triangle: 0.65 and 0.97.
    assert 0.56 <= within[0] <= 0.8, within
    assert 0.91 <= within[1] <= 1.0, within
    assert abs(np.mean(off)) < 0.35


def test_all_three_tell_the_speed_of_a_step(runs):
    for source, off in (("encoder", 0.17), ("sonar", 0.07), ("lines", 0.08)):
        speed = read_speed(runs[-1], source)
        truth = np.interp(speed.time, runs[-1].truth["time_s"], runs[-1].truth["vx_mps"])
        late = speed.time > 0.5
        assert np.sqrt(np.mean((speed.value - truth)[late] ** 2)) < off
        assert np.all(np.diff(speed.time) > 0)
        assert np.all(speed.deviation > 0)


def told(tmp: Path, about: dict, **columns: np.ndarray) -> Run:
    commands = Table(time_s=np.zeros(1), throttle=np.ones(1), steering=np.zeros(1))
    return Run(tmp, about, commands, Table(columns), None)


def approach(spikes: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Pings at 40 Hz of a car at 1.5 m/s; a share of them hear something nearer, or nothing."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 1.2, 0.025)
    distance = np.round(3 - 1.5 * time + 0.008 * rng.normal(size=len(time)), 2)
    spike = rng.random(len(time)) < spikes
    other = np.where(rng.random(len(time)) < 0.5, rng.uniform(0.3, 2.5, len(time)), np.inf)
    return time, np.where(spike, other, distance)


def test_spikes_of_the_sonar_do_not_count(tmp_path):
    values, deviations = [], []
    for seed in range(20):
        time, distance = approach(0.2, seed)
        speed = read_speed(told(tmp_path, {}, time_s=time, sonar_front_m=distance), "sonar")
        values.append(speed.value)
        deviations.append(speed.deviation)
    off = np.concatenate(values) - 1.5
    assert len(off) > 90
    assert np.max(np.abs(off)) < 0.4
    assert np.mean(np.abs(off) <= 2 * np.concatenate(deviations)) > 0.85


def test_an_encoder_without_counts_tells_its_step_itself(tmp_path):
    time = np.arange(0, 6, 0.1)
    speed = 0.0413 * np.rint(np.linspace(0, 1.5, 60) / 0.0413)
    found = read_speed(told(tmp_path, {}, time_s=time, wheel_speed_mps=speed), "encoder")
    assert found.deviation == pytest.approx(0.0413 / np.sqrt(6))
    np.testing.assert_allclose(found.time, time[1:] - 0.05)


def test_lines_that_are_passed_between_two_rows_all_count(tmp_path):
    time = np.arange(0, 1, 0.03)
    counts = np.floor(4.0 * time / 0.05)
    run = told(tmp_path, {"line_spacing_m": 0.05}, time_s=time, line_crossings=counts)
    found = read_speed(run, "lines")
    assert np.mean(found.value) == pytest.approx(4.0, rel=0.02)
    assert isinstance(found, Speed)


@pytest.mark.parametrize(
    ("source", "about", "columns", "words"),
    [
        ("radar", {}, {}, "no reader of speed radar"),
        ("encoder", {}, {}, "wheel_speed_mps is not there"),
        ("encoder", {}, {"wheel_speed_mps": [0.0, 0.0, 0.0]}, "never changes"),
        ("sonar", {}, {"sonar_front_m": [np.inf] * 3}, "never follows a wall"),
        ("lines", {}, {"line_crossings": [0.0, 1.0, 2.0]}, "line_spacing_m must say"),
        ("lines", {"line_spacing_m": 0.1}, {"line_crossings": [0.0, 1.0, 1.0]}, "no two lines"),
        ("lines", {"line_spacing_m": 0.1}, {"line_crossings": [2.0, 3.0, 1.0]}, "0.20 s: .*falls"),
    ],
)
def test_what_tells_no_speed_is_refused(tmp_path, source, about, columns, words):
    arrays = {name: np.array(values) for name, values in columns.items()}
    with pytest.raises(InputError, match=words):
        read_speed(told(tmp_path, about, time_s=0.1 * np.arange(3), **arrays), source)


def test_the_detector_s_noise_and_its_readers_take_no_part_where_it_is_off(runs):
    plain = load_car("rx7")
    assert plain.sensors.line_detector.lines == "none"
    assert len(jax.tree.leaves(plain)) == len(jax.tree.leaves(runs[0].car))
