"""The paper's measurements: laws that their figures must keep."""

import json
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from countersteer import cli, experiments
from countersteer.car.files import load_car
from countersteer.drivers.drift_turn import SPIN, STRAIGHT
from countersteer.drivers.driver import Status
from countersteer.drivers.played_turn import PlayedTurn
from countersteer.experiments import (
    action_spread,
    battery,
    control_rate,
    drift_threshold,
    drift_turn,
    narrowest_corner,
    stop_time,
    turn_rate,
)
from countersteer.experiments.open_turns import Series
from countersteer.experiments.result import write
from countersteer.planning.mppi import KNOT
from countersteer.runs.run import read_run
from countersteer.signals import Command
from test_open_turns import LANES, TIME, slowing, write_run


@pytest.fixture(scope="module")
def car():
    return load_car("rx7")


def written(found, folder, name):
    """The files are there, and hold what was found."""
    told = write(found, folder, name)
    assert json.loads((folder / "summary.json").read_text())["text"] == found.text == told["text"]
    lines = (folder / f"{name}.csv").read_text().splitlines()
    assert lines[0] == ",".join(found.table)
    assert len(lines) == 1 + len(next(iter(found.table.values())))
    assert (folder / f"{name}.png").stat().st_size > 8000
    return told


def test_without_slip_a_car_turns_as_its_wheelbase_says(car, tmp_path):
    told = written(turn_rate.simulate(car, "rx7", lanes=LANES), tmp_path, "turn-rate")
    assert told["without_slip"] > 60
    assert told["felt_wheelbase_m"] == pytest.approx(0.25, rel=0.08)
    assert abs(told["straight_at_deg"]) < 0.1
    assert told["r_squared"] > 0.99


def test_a_log_tells_the_wheelbase_too(tmp_path):
    wheels = np.repeat(np.radians([-10, 0, 15]), 200)
    v, still = 0.9, np.zeros(600)
    rate = v * np.tan(wheels - math.radians(1)) / 0.3
    rear = 0.125 * rate  # rx7's rear axle, which does not slip
    series = Series(TIME, still + 0.3, wheels, still + v, rear, rate)
    write_run(tmp_path / "run", series, truth=True)
    told = turn_rate.measure([read_run(tmp_path / "run")]).figures
    assert told["felt_wheelbase_m"] == pytest.approx(0.3, rel=0.01)
    assert told["straight_at_deg"] == pytest.approx(1, abs=0.1)


def test_more_lock_drifts_at_less_energy(car, tmp_path):
    told = written(drift_threshold.simulate(car, "rx7", lanes=LANES), tmp_path, "drift-threshold")
    energy = [one["energy_j"] for one in told["thresholds"]]
    assert energy == sorted(energy, reverse=True)
    assert 1 < energy[-1] < 8
    for one in told["thresholds"]:
        assert one["speed_mps"] == pytest.approx(math.sqrt(2 * one["energy_j"] / 1.6))


def test_a_log_tells_of_wheels_turned_over_without_throttle(tmp_path):
    over = TIME > 1
    still = np.zeros_like(TIME)
    vy = np.where(over & (TIME < 1.3), -1.2, 0.0)
    series = Series(TIME, still, np.where(over, 0.3, 0.0), still + 2, vy, still)
    write_run(tmp_path / "run", series, truth=True)
    found = drift_threshold.measure([read_run(tmp_path / "run")])
    (peak,), (speed,) = found.table["peak_sideslip_deg"], found.table["speed_mps"]
    assert peak == pytest.approx(math.degrees(math.atan2(1.2, 2)))
    assert speed == pytest.approx(2)
    assert found.figures["drifted"] == 1


def test_stopping_takes_longer_from_a_higher_yaw_rate(car, tmp_path):
    found = stop_time.simulate(car, "rx7", trials=64, lanes=LANES)
    told = written(found, tmp_path, "stop-time")
    assert told["turns"] + told["ran_on"] == len(found.table["seed"])
    for region in told["regions"]:
        slope, error = (region["time"][f"slope{kind}_s_per_100degps"] for kind in ("", "_error"))
        assert slope > 2 * error > 0


def test_the_same_commands_bring_a_worn_battery_less_far(car, tmp_path):
    found = battery.simulate(car, "rx7", lanes=LANES)
    written(found, tmp_path, "battery")
    table = found.table
    speed = np.reshape(table["speed_mps"], (4, 3))  # charge, wear
    assert np.all(np.diff(speed, axis=0) < 0)
    assert np.all(np.diff(speed, axis=1) < 0)
    assert table["from_first_m"][0] == 0
    assert np.max(table["from_first_m"]) > 0.2


def test_a_turn_of_a_log_is_shown_about_its_kill(tmp_path):
    write_run(tmp_path / "run", slowing(4.0, 8.0, -1), truth=True)
    found = drift_turn.measure([read_run(tmp_path / "run")])
    told = written(found, tmp_path, "drift-turn")
    assert told["hand"] == "right"
    assert told["time_to_stop_s"] == pytest.approx(0.4875, abs=0.002)
    time, turned = found.table["time_to_kill_s"], found.table["turned_deg"]
    assert time[0] == pytest.approx(-1, abs=0.006)
    # An even rise over half a second, half a second held, and the slowing until zero and beyond.
    until_kill = turned[np.argmin(np.abs(time))] - turned[0]
    assert until_kill == pytest.approx(-math.degrees(1 + 2), abs=1.5)


def test_wide_corners_are_passed_by_grip_and_by_drift_and_a_slit_by_none(car):
    for slides in (False, True):
        wide, slit = (
            narrowest_corner.attempt(car, width, slides, 32, LANES) for width in (1.4, 0.2)
        )
        passed = np.isfinite(wide.time)
        assert passed.any()
        assert not np.isfinite(slit.time).any()
        assert np.all((wide.peak_sideslip[passed] > math.radians(25)) | (not slides))
        # From 1.2 m before to 1.2 m behind, the corner cut, at what speed it may have.
        length = np.hypot(*np.diff(wide.track[:2], axis=1)).sum()
        assert 1.5 < length < 2.6
        assert wide.track[2, -1] == pytest.approx(math.pi / 2, abs=math.radians(30))


def test_keys_are_full_or_none_and_a_novice_presses_them_late():
    rng = np.random.default_rng(0)
    given = Command(np.array([0.0, 0.2, 0.5, -0.9]), np.array([0.4, 0.1, -0.3, -0.01]))
    keys = action_spread.as_keys(given, 0.5)
    assert keys.throttle.tolist() == [0, 0, 1, -1]
    assert keys.steering.tolist() == [0.5, 0, -0.5, 0]
    line = np.repeat([0.0, 1.0, 0.0, -1.0], 20)
    for _ in range(20):
        late = action_spread.late(line, rng)
        on_time, after = (np.nonzero(np.diff(x))[0] for x in (line, late))
        delays = KNOT * (after - on_time[: len(after)])
        assert np.all(delays >= 0)
        assert np.all(delays < action_spread.LATE + 5 * action_spread.SCATTER)
        assert late[0] == line[0]


def test_the_best_commands_take_a_corner_and_keys_do_worse(car):
    """Small: eight cars for each kind, and a search of a few rounds."""
    found = action_spread.simulate(car, "rx7", cars=8, rounds=12)
    figures = found.figures
    assert figures["optimum"]["through_share"] > figures["novice"]["through_share"]
    assert figures["optimum"]["peak_sideslip_deg_median"] > 15
    assert list(found.table["commands"]) == list(action_spread.KINDS)
    assert "optimum" in found.text


class Inner(NamedTuple):
    phase: int
    turn: int


class Stub:
    """Begins its turn at half a second, and never ends it by itself."""

    def reset(self, key):
        return Inner(STRAIGHT, 0)

    def act(self, memory, observation):
        begins = (observation.time >= 0.5) & (memory.turn == 0)
        phase = jnp.where(begins, SPIN, memory.phase)
        return Command(-1.0 * phase, 0.0), Inner(phase, memory.turn + jnp.where(begins, 1, 0))

    def status(self, memory):
        return Status(memory.turn, memory.phase)


class Seen(NamedTuple):
    time: float


def test_open_loop_plays_its_commands_from_where_the_turn_begins_and_then_gives_it_back():
    throttle, steering = np.linspace(0.1, 0.9, 9), np.linspace(-0.4, 0.4, 9)
    driver = PlayedTurn(inner=Stub(), throttle=throttle, steering=steering)
    memory = driver.reset(None)
    for tick in range(450, 620, 5):
        now = tick / 1000
        command, memory = driver.act(memory, Seen(now))
        index = math.floor((now - 0.5) / control_rate.STEP + 1e-6)
        if 0 <= index < 9:
            assert float(command.throttle) == pytest.approx(throttle[index])
            assert float(command.steering) == pytest.approx(steering[index])
        elif now < 0.5:
            assert float(command.throttle) == -STRAIGHT
        else:
            assert int(memory.inner.phase) == STRAIGHT


def test_every_experiment_has_a_name_a_word_and_a_module():
    for name in experiments.NAMES:
        assert callable(experiments.load(name).simulate)


def test_the_command_measures_runs_and_says_where_it_cannot(tmp_path, capsys):
    run = write_run(tmp_path / "run", slowing(4.0, 8.0), truth=True)
    out = tmp_path / "out"
    assert (
        cli.main(["experiment", "drift-turn", "--from", str(run), "--out", str(out), "--json"]) == 0
    )
    told = json.loads(capsys.readouterr().out)
    assert told["experiment"] == "drift-turn"
    assert (out / "drift-turn.csv").exists()
    for name, message in (
        ("control-rate", "is simulated, and measures no run"),
        ("stop-time", "a line needs 15 or more"),
        ("drift-threshold", "in no run were the wheels turned over without throttle"),
    ):
        assert cli.main(["experiment", name, "--from", str(run)]) == 2
        assert message in capsys.readouterr().err
