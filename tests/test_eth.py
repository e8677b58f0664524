"""Logs of the ETH car: what the importer makes of them."""

from pathlib import Path

import numpy as np
import pytest

from countersteer import cli
from countersteer.car.files import load_car
from countersteer.errors import InputError
from countersteer.runs.importers.eth import PERIOD, import_eth
from countersteer.runs.run import Run, read_run
from countersteer.tuning.compare import compare

DATA = Path(__file__).parents[2] / "shared" / "data" / "eth_rccar"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the ETH logs are not here")


def made(rows: int = 60) -> dict[str, np.ndarray]:
    """A left-hand circle at 2 m/s, 20 degrees of sideslip to the right, as such a file tells it."""
    rate, slip = 2.5, np.radians(20)
    time = PERIOD * np.arange(rows)
    course = 1.0 + rate * time
    heading = course + slip
    action = np.stack([0.5 * np.ones(rows), np.where(time < 1, 0.7, -0.2)], axis=1)
    obs = np.zeros((rows, 12))
    obs[:, 0] = 2 / rate * np.sin(course)
    obs[:, 1] = -2 / rate * np.cos(course)
    obs[:, 2] = (heading + np.pi) % (2 * np.pi) - np.pi
    obs[:, 3], obs[:, 4] = 2 * np.cos(course), 2 * np.sin(course)
    obs[:, 5] = rate
    for past in (1, 2, 3):
        obs[past:, 12 - 2 * past : 14 - 2 * past] = action[:-past] * [0.5, 1.0]
    return {"obs": obs, "action": action}


def imported(tmp_path: Path, **arrays: np.ndarray) -> tuple[dict, Run]:
    np.savez(tmp_path / "log.npz", **arrays)
    about = import_eth(tmp_path / "log.npz", tmp_path / "runs")
    return about, read_run(Path(about["run"]))


def test_velocities_are_turned_into_the_body_and_the_heading_unwrapped(tmp_path):
    about, run = imported(tmp_path, **made())
    truth = run.truth
    np.testing.assert_allclose(truth["vx_mps"], 2 * np.cos(np.radians(20)))
    np.testing.assert_allclose(truth["vy_mps"], -2 * np.sin(np.radians(20)))
    np.testing.assert_allclose(np.diff(truth["heading_rad"]), 2.5 * PERIOD, atol=1e-9)
    assert about["repairs"]["heading_unwrapped"] == 1
    assert about["repairs"]["commands_not_in_buffer"] == 0
    assert run.about["car_name"] == "eth"


def test_a_command_stands_at_its_own_row_s_time_and_the_sign_is_the_direction(tmp_path):
    arrays = made()
    _, run = imported(tmp_path, **arrays)
    np.testing.assert_allclose(run.commands["time_s"], PERIOD * np.arange(60), atol=1e-9)
    np.testing.assert_allclose(run.commands["throttle"], arrays["action"][:, 1])
    np.testing.assert_allclose(run.commands["steering"], np.radians(18))
    assert run.about["full_lock_deg"] == 36


def test_commands_that_the_buffer_does_not_hold_are_counted(tmp_path):
    arrays = made()
    arrays["action"] = np.roll(arrays["action"], 1, axis=0)
    about, _ = imported(tmp_path, **arrays)
    assert about["repairs"]["commands_not_in_buffer"] == 2


def test_false_yaw_rates_are_empty_and_repeated_frames_left_out(tmp_path):
    arrays = made()
    arrays["obs"][20, 5] = -245.0
    arrays["obs"][40] = arrays["obs"][39]
    about, run = imported(tmp_path, **arrays)
    truth = run.truth
    assert about["repairs"]["yaw_rates_false"] == 2  # with the row behind it
    assert np.flatnonzero(np.isnan(truth["yaw_rate_radps"])).tolist() == [20, 21]
    assert about["rows"] == {"log": 60, "commands": 60, "truth": 59}
    assert not np.any(np.isclose(truth["time_s"], 39 * PERIOD))


BAD = {
    "action_missing": ({"action": None}, "array 'action' is missing"),
    "obs_narrow": ({"obs": np.zeros((60, 6))}, "'obs' must be numbers (N, 12)"),
    "not_as_long": ({"action": np.zeros((59, 2))}, "as long as each other"),
    "empty": ({"obs": np.zeros((0, 12)), "action": np.zeros((0, 2))}, "two rows or more"),
    "percent": ({"action": 70 * np.ones((60, 2))}, "row 0 (0.00 s): action must be in [-1, 1]"),
    "objects": ({"obs": np.array([["a", None]], object)}, "no .npz file of numbers"),
    "words": ({"obs": np.full((60, 12), "x")}, "'obs' must be numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_log_is_refused_in_one_line(tmp_path, name):
    changes, message = BAD[name]
    arrays = {k: v for k, v in (made() | changes).items() if v is not None}
    with pytest.raises(InputError) as refused:
        imported(tmp_path, **arrays)
    assert message in str(refused.value)
    assert "log.npz" in str(refused.value)
    assert not (tmp_path / "runs").exists()


def test_a_row_that_is_no_number_is_named_with_its_time(tmp_path):
    arrays = made()
    arrays["obs"][30, 4] = np.nan
    with pytest.raises(InputError, match=r"row 30 \(1\.01 s\): obs is not a number"):
        imported(tmp_path, **arrays)


@pytest.mark.parametrize("content", [b"", b"x" * 1000, None])
def test_a_file_of_another_kind_is_refused(tmp_path, content):
    log = tmp_path / "log.npz"
    if content is not None:
        log.write_bytes(content)
    with pytest.raises(InputError, match=r"log\.npz"):
        import_eth(log, tmp_path / "runs")


def test_the_command_line_imports_it(tmp_path, capsys):
    np.savez(tmp_path / "log.npz", **made())
    status = cli.main(
        ["import", "eth", str(tmp_path / "log.npz"), "--out", str(tmp_path / "runs"), "--json"]
    )
    assert status == 0
    assert (tmp_path / "runs" / "log" / "truth.csv").exists()
    assert '"log_format": "eth"' in capsys.readouterr().out


def test_the_library_s_car_has_the_published_numbers():
    body = load_car("eth").body
    assert (float(body.mass), float(body.front_axle)) == (1.65, 0.13)
    assert float(body.wheelbase - body.front_axle) == pytest.approx(0.17)


@needs_data
@pytest.mark.parametrize(("name", "seconds"), [("train_1", 303), ("train_2", 127)])
def test_the_real_logs_agree_with_themselves(tmp_path, name, seconds):
    about = import_eth(DATA / f"{name}.npz", tmp_path)
    run = read_run(tmp_path / name)
    truth = run.truth
    assert about["duration_s"] == pytest.approx(seconds, abs=1)
    assert about["repairs"]["commands_not_in_buffer"] == 0
    assert 20 < about["repairs"]["yaw_rates_false"] < 60
    # Distance moved against the logged speed: the period; at its lag: the axes and the heading.
    span = np.diff(truth["time_s"])
    moved = np.hypot(np.diff(truth["x_m"]), np.diff(truth["y_m"]))
    speed = np.hypot(truth["vx_mps"], truth["vy_mps"])
    middle = (speed[1:] + speed[:-1]) / 2
    fast = middle > 1
    assert np.sum(moved[fast]) == pytest.approx(np.sum((middle * span)[fast]), rel=0.01)
    turned = np.diff(truth["heading_rad"]) / span
    rate = truth["yaw_rate_radps"][1:]
    there = np.isfinite(rate)
    assert np.median(np.abs(turned - rate)[there]) < 0.07
    course = np.arctan2(np.diff(truth["y_m"]), np.diff(truth["x_m"]))
    slip = np.arctan2(truth["vy_mps"], truth["vx_mps"])
    apart = np.angle(np.exp(1j * (course - (truth["heading_rad"] + slip)[1:])))
    assert np.degrees(np.median(np.abs(apart[fast]))) < 3


@needs_data
def test_the_library_s_car_predicts_slides_that_it_was_not_fitted_to(tmp_path):
    """After a second of open loop, at the median, in forward windows that reach 20 degrees."""
    import_eth(DATA / "train_2.npz", tmp_path)
    found, _ = compare(read_run(tmp_path / "train_2"), load_car("eth"), dt=0.002)
    sliding = found["sliding"]
    assert sliding["windows"] >= 15
    for name, limit in (("vx_mps", 0.45), ("vy_mps", 0.18), ("yaw_rate_radps", 0.55)):
        assert sliding["median_abs_error"][name] < limit, name
        still = sliding["persistence"]["median_abs_error"][name]
        assert sliding["median_abs_error"][name] < 0.7 * still, name
