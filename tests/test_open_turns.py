"""Turns in the open that are stopped, simulated and found in logs; what is learned from them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from countersteer import cli
from countersteer.car.files import load_car
from countersteer.drivers.policy import load_policy
from countersteer.drivers.turning import Turning
from countersteer.errors import InputError
from countersteer.experiments.local_regression import fit, predicted
from countersteer.experiments.open_turns import (
    Series,
    as_table,
    of_run,
    read_turns,
    stops,
    trial,
    write_rows,
)
from countersteer.experiments.stop_regression import regress_stops

# Numbers of its own: the library's may change.
TURNING = Turning(
    speeds=np.array([1.4, 1.9, 2.4]),
    lead=np.array([0.55, 0.76, 1.0]),
    lock=np.array([0.4, 0.37, 0.25]),
    rate=np.array([4.0, 3.4, 3.4]),
    throttle=np.array([1.0, 0.7, 0.6]),
    counter=np.array([0.45, 0.45, 0.45]),
    rate_gain=0.24,
    stop_gain=0.5,
    settled=1.2,
    hold_p=0.9,
    hold_d=0.1,
    hold_slip=0.5,
    hold_throttle=0.15,
)
TIME = np.arange(0, 3, 0.005)
LANES = 32


def slowing(rate: float, slowing_by: float, hand: int = 1) -> Series:
    """A car that is killed at 1 s, when its yaw rate begins to fall evenly."""
    yaw_rate = hand * np.where(
        TIME < 1, rate * np.clip(TIME / 0.5, 0, 1), rate - slowing_by * (TIME - 1)
    )
    throttle = np.where(TIME < 1 - 1e-9, 0.6, 0.0)
    still = np.zeros_like(TIME)
    return Series(TIME, throttle, still, 2 + still, -hand * 0.4 * (TIME > 0.8), yaw_rate)


@pytest.mark.parametrize("hand", [1, -1])
def test_time_and_angle_to_a_stop_are_those_of_an_even_slowing(hand):
    (stop,) = stops(slowing(4.0, 8.0, hand))
    assert stop.hand == hand
    assert stop.time == pytest.approx(1)
    assert stop.yaw_rate == pytest.approx(4)
    assert stop.duration == pytest.approx((4 - 0.1) / 8, abs=1e-6)
    assert stop.angle == pytest.approx((4**2 - 0.1**2) / 16, abs=1e-6)
    assert stop.entry_speed == pytest.approx(2)
    assert stop.peak_sideslip == pytest.approx(math.atan2(0.4, 2))


def test_a_stop_that_is_broken_off_or_too_slow_or_never_comes_is_none():
    series = slowing(4.0, 8.0)
    again = series.throttle.copy()
    again[TIME > 1.2] = 0.3
    assert stops(series._replace(throttle=again)) == []
    assert stops(slowing(0.9, 8.0)) == []
    assert stops(slowing(4.0, 0.5)) == []
    assert stops(series._replace(vx=0.1 * series.vx)) == []


def write_run(folder: Path, series: Series, truth: bool) -> Path:
    folder.mkdir()
    (folder / "run.toml").write_text(
        "battery_charge = 0.7\n[sensors]\nencoder.lag_s = 0.06\ngyroscope.lag_s = 0.05\n"
    )
    told = zip(TIME, series.throttle, np.degrees(series.steering), strict=True)
    lines = [f"{t:.3f},{u:g},forward,{angle:.6f}" for t, u, angle in told]
    (folder / "commands.csv").write_text(
        "\n".join(["time_s,throttle,direction,steering_deg", *lines]) + "\n"
    )
    if truth:
        columns = (TIME, 0 * TIME, 0 * TIME, 0 * TIME, series.vx, series.vy, series.yaw_rate)
        head, name = "time_s,x_m,y_m,heading_rad,vx_mps,vy_mps,yaw_rate_radps", "truth.csv"
    else:
        # The gyroscope tells what was 0.05 s before, and the encoder 0.06 s.
        gyro = np.interp(TIME - 0.05, TIME, series.yaw_rate)
        columns = (TIME, np.interp(TIME - 0.06, TIME, series.vx), gyro)
        head, name = "time_s,wheel_speed_mps,gyro_radps", "telemetry.csv"
    rows = [",".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True)]
    (folder / name).write_text("\n".join([head, *rows]) + "\n")
    return folder


@pytest.mark.parametrize("truth", [True, False])
def test_a_log_tells_the_same_by_motion_capture_and_by_its_sensors(tmp_path, truth):
    (row,) = of_run(write_run(tmp_path / "run", slowing(4.0, 8.0, -1), truth))
    table = as_table([row])
    assert table["hand"][0] == "right"
    assert table["angle_to_stop_deg"][0] == pytest.approx(math.degrees(0.999), abs=0.6)
    assert table["time_to_stop_s"][0] == pytest.approx(0.4875, abs=0.002)
    assert table["kill_speed_mps"][0] == pytest.approx(2, abs=1e-6)
    assert table["battery_charge"][0] == 0.7
    assert math.isnan(table["peak_sideslip_deg"][0]) != truth


@pytest.fixture(scope="module")
def turns():
    """Rows of 64 trials with the nominal car."""
    return trial(load_car("rx7"), TURNING, None, range(64), (1.4, 2.4), (0.3, 1.0), lanes=LANES)


def test_trials_reach_the_kills_and_stop(turns):
    table = as_table(turns)
    assert len(turns) >= 60
    assert set(table["hand"]) == {"left", "right"}
    rate = table["kill_yaw_rate_degps"]
    assert rate.min() < 100
    assert rate.max() > 200
    assert np.all(table["angle_to_stop_deg"] > 2)
    # What turns faster takes longer to stop.
    assert np.corrcoef(rate, table["time_to_stop_s"])[0, 1] > 0.5


def test_a_trial_is_its_seed_whatever_is_driven_beside_it(turns):
    again = trial(load_car("rx7"), TURNING, None, [3, 40], (1.4, 2.4), (0.3, 1.0), lanes=LANES)
    by_seed = {row[8]: row for row in turns}
    for row in again:
        np.testing.assert_allclose(row[1:10], by_seed[row[8]][1:10], rtol=1e-3)


def test_the_table_reads_back(turns, tmp_path):
    write_rows(tmp_path / "turns.csv", turns)
    read, table = read_turns(tmp_path), as_table(turns)
    assert list(read["hand"]) == list(table["hand"])
    for name in ("kill_yaw_rate_degps", "angle_to_stop_deg", "battery_charge", "seed"):
        np.testing.assert_allclose(read[name], table[name], rtol=1e-5)


def test_lines_are_found_again_with_their_bounds_and_no_more_of_them():
    rng = np.random.default_rng(1)
    v, x = rng.uniform(1, 3, 600), rng.uniform(1, 5, 600)
    y = np.where(v < 2, 0.1 + 0.10 * x, 0.3 + 0.15 * x) + 0.03 * rng.normal(size=600)
    found = fit(v, x, y)
    assert len(found.lines) >= 2
    assert min(abs(line.low - 2) for line in found.lines) < 0.1
    first, last = found.lines[0], found.lines[-1]
    for line, offset, slope in ((first, 0.1, 0.10), (last, 0.3, 0.15)):
        assert abs(line.slope - slope) < 4 * line.slope_error
        assert abs(line.offset - offset) < 4 * line.offset_error
        assert line.deviation == pytest.approx(0.03, rel=0.3)


def test_one_line_has_one_region():
    rng = np.random.default_rng(2)
    v, x = rng.uniform(1, 3, 400), rng.uniform(1, 5, 400)
    found = fit(v, x, 0.2 + 0.12 * x + 0.05 * rng.normal(size=400))
    assert len(found.lines) == 1
    assert found.lines[0].slope == pytest.approx(0.12, abs=0.01)


def test_what_is_learned_predicts_turns_that_were_not_seen(turns):
    table = as_table(turns)
    half = np.arange(len(turns)) % 2 == 0
    learned = regress_stops(type(table)({k: v[half] for k, v in table.items()}))
    new = ~half & (table["angle_to_stop_deg"] < 30)
    v, r = table["kill_speed_mps"][new], np.radians(table["kill_yaw_rate_degps"][new])
    angle = np.radians(table["angle_to_stop_deg"][new])
    driver = np.array([float(learned.stop_angle.angle(a, b)) for a, b in zip(v, r, strict=True)])
    np.testing.assert_allclose(driver, predicted(learned.angle.lines, v, r), atol=1e-9)
    assert np.sqrt(np.mean((driver - angle) ** 2)) < 0.6 * np.std(angle)


def test_turns_become_a_policy_that_drives(turns, tmp_path, capsys):
    write_rows(tmp_path / "turns.csv", turns)
    policy = tmp_path / "policy.toml"
    arguments = ["learn", "stop-angle", str(tmp_path / "turns.csv"), "--out", str(policy), "--json"]
    assert cli.main(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["turns"] + told["ran_on"] == len(turns)
    assert sum(region["turns"] for region in told["regions"]) == told["turns"]
    read = load_policy(str(policy))
    slopes = [region["angle"]["slope_s"] for region in told["regions"]]
    np.testing.assert_allclose(read.stop_angle.slope, slopes, rtol=1e-6)
    assert np.array_equal(read.turning.lock, load_policy("drift-turn").turning.lock)
    assert policy.with_suffix(".png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("left,", "up,"), "line 2: hand must be left or right"),
        (("time_to_stop_s", "time"), "column time_to_stop_s is missing"),
        ((",2.0,", ",-2.0,"), "line 2: kill_speed_mps must be a number"),
        ((",2.0,", ",,"), "line 2: kill_speed_mps must be a number"),
    ],
)
def test_a_table_that_is_wrong_is_told_by_its_line(tmp_path, change, message):
    head = (
        "hand,entry_speed_mps,kill_speed_mps,kill_yaw_rate_degps,time_to_stop_s,angle_to_stop_deg"
    )
    (tmp_path / "t.csv").write_text(f"{head}\nleft,1.9,2.0,150,0.2,12\n".replace(*change))
    with pytest.raises(InputError, match=message):
        read_turns(tmp_path / "t.csv")


def test_too_few_turns_carry_no_line(turns, tmp_path, capsys):
    write_rows(tmp_path / "turns.csv", turns[:9])
    out = str(tmp_path / "p.toml")
    assert cli.main(["learn", "stop-angle", str(tmp_path / "turns.csv"), "--out", out]) == 2
    assert "a line needs 15 or more" in capsys.readouterr().err
    assert not Path(out).exists()
