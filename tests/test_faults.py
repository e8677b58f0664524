"""What is false in a log is found where it is, and nothing where all is so."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from countersteer import cli
from countersteer.errors import InputError
from countersteer.runs.defects import find_defects, refuse, repair
from countersteer.runs.files import Table
from countersteer.runs.importers.dart import import_dart
from countersteer.runs.importers.eth import import_eth
from countersteer.runs.run import Run, read_run

DATA = Path(__file__).parents[2] / "shared" / "data"
DRIFT = "drift_tape_and_tiles/car_1_Datarecording_09_09_2024_18_13_59drifting_clockwise.csv"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real logs are not here")


def good(seed: int = 0) -> Run:
    """Twelve seconds: off from rest, straight, left, a slide to the right, and a coast to rest.

    Motion capture at 100 Hz with noise of 0.3 mm and 1 mrad, encoder and gyroscope at 20 Hz with
    their lags and steps, accelerometer at 100 Hz, commands at 20 Hz.
    """
    rng = np.random.default_rng(seed)
    fine = np.arange(0, 12, 0.001)
    speed = np.interp(fine, [0, 1, 2, 9, 11], [0, 0, 2, 2, 0])
    rate = np.interp(fine, [2.5, 3, 5, 5.5, 6, 8, 8.5], [0, 2, 2, 0, -3, -3, 0])
    slip = np.interp(fine, [5.5, 6.2, 7.8, 8.5], [0, 0.7, 0.7, 0])
    heading = 2.0 + np.cumsum(rate) * 0.001
    course = heading + slip
    x, y = (np.cumsum(speed * turn(course)) * 0.001 for turn in (np.cos, np.sin))
    vx, vy = speed * np.cos(slip), speed * np.sin(slip)
    # The wheels spin in the slide.
    wheel = vx + 1.3 * (slip > 0) * np.sin(np.clip((fine - 5.5) / 3, 0, 1) * math.pi)

    def at(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(time, fine, values)

    frame, board, slow = np.arange(0, 12, 0.01), np.arange(0, 12, 0.01), np.arange(0, 12, 0.05)
    truth = {
        "time_s": frame,
        "x_m": at(frame, x) + 3e-4 * rng.normal(size=len(frame)),
        "y_m": at(frame, y) + 3e-4 * rng.normal(size=len(frame)),
        "heading_rad": at(frame, heading) + 1e-3 * rng.normal(size=len(frame)),
    }
    fresh = np.arange(len(board)) % 5 == 0
    telemetry = {
        "time_s": board,
        "wheel_speed_mps": np.where(fresh, 0.04 * np.rint(at(board - 0.06, wheel) / 0.04), np.nan),
        "gyro_radps": np.where(
            fresh, at(board - 0.05, rate) + 0.03 * rng.normal(size=len(board)), np.nan
        ),
        "accel_x_mps2": at(board, np.gradient(vx, fine) - rate * vy)
        + 0.5 * rng.normal(size=len(board)),
        "accel_y_mps2": at(board, np.gradient(vy, fine) + rate * vx)
        + 0.5 * rng.normal(size=len(board)),
        "armed": np.where(fresh, 1.0, np.nan),
    }
    commands = {
        "time_s": slow,
        "throttle": np.select([slow < 1, slow < 2, slow < 9], [0.0, 0.6, 0.4], 0.0),
        "steering": np.interp(slow, [2.5, 3, 5, 5.5, 6, 8, 8.5], [0, 0.3, 0.3, 0, -0.4, 0.2, 0]),
    }
    return Run(Path("log"), {}, Table(commands), Table(telemetry), Table(truth))


def changed(run: Run, table: str, **columns: Callable[[Table], np.ndarray]) -> Run:
    """The run with columns of a table replaced, each by what a function makes of the table."""
    whole = getattr(run, table)
    made = Table(whole | {name: make(whole) for name, make in columns.items()})
    return dataclasses.replace(run, **{table: made})


def without_truth(run: Run) -> Run:
    return dataclasses.replace(run, truth=None)


def within(table: Table, start: float, end: float) -> np.ndarray:
    return (table["time_s"] >= start) & (table["time_s"] <= end)


def held(name: str, start: float, end: float, value: float) -> Callable[[Table], np.ndarray]:
    """A sensor that reports one value over a time."""

    def make(table: Table) -> np.ndarray:
        reports = np.isfinite(table[name])
        return np.where(within(table, start, end) & reports, value, table[name])

    return make


def dropped(run: Run, table: str, start: float, end: float) -> Run:
    """A table without its rows of a time."""
    whole = getattr(run, table)
    keep = ~within(whole, start, end)
    return dataclasses.replace(run, **{table: Table({k: v[keep] for k, v in whole.items()})})


def hit(run: Run, at: float) -> Run:
    """A wall that turns the car back with a fifth of its speed: what comes after is mirrored."""

    def bounced(name: str) -> Callable[[Table], np.ndarray]:
        def make(table: Table) -> np.ndarray:
            where = int(np.searchsorted(table["time_s"], at))
            back = table[name][where] - 0.2 * (table[name] - table[name][where])
            return np.where(np.arange(len(table)) > where, back, table[name])

        return make

    return changed(run, "truth", x_m=bounced("x_m"), y_m=bounced("y_m"))


def spiked(name: str, at: float, by: float, frames: int = 1) -> Callable[[Table], np.ndarray]:
    def make(table: Table) -> np.ndarray:
        where = int(np.searchsorted(table["time_s"], at))
        values = table[name].copy()
        values[where : where + frames] += by
        return values

    return make


def frozen(table: Table, name: str, start: float, frames: int) -> np.ndarray:
    values, where = table[name].copy(), int(np.searchsorted(table["time_s"], start))
    values[where : where + frames] = values[where - 1]
    return values


def capture_frozen(run: Run, start: float, frames: int) -> Run:
    return changed(
        run,
        "truth",
        **{
            name: lambda t, name=name: frozen(t, name, start, frames)
            for name in ("x_m", "y_m", "heading_rad")
        },
    )


def with_velocities(run: Run) -> Run:
    """Velocities beside the poses, as another system's motion capture gives them."""
    t = run.truth
    heading = t["heading_rad"]
    smooth = np.ones(9) / 9
    east, north, rate = (
        np.convolve(np.gradient(t[n], t["time_s"]), smooth, "same")
        for n in ("x_m", "y_m", "heading_rad")
    )
    vx = np.cos(heading) * east + np.sin(heading) * north
    vy = np.cos(heading) * north - np.sin(heading) * east
    table = Table(t | {"vx_mps": vx, "vy_mps": vy, "yaw_rate_radps": rate})
    return dataclasses.replace(run, truth=table)


def stuck(
    column: str, start: float, end: float, value: float, alone: bool = False
) -> Callable[[Run], Run]:
    """Makes a sensor report one value; alone: with no motion capture beside it."""

    def broken(run: Run) -> Run:
        run = changed(run, "telemetry", **{column: held(column, start, end, value)})
        return without_truth(run) if alone else run

    return broken


# Each makes one fault in a good log. What must be found: words, column, and a time within it.
FAULTS: dict[str, tuple[Callable[[Run], Run], str, str, float]] = {
    "encoder_stuck_at_rest": (
        stuck("wheel_speed_mps", 9, 12, 2.0),
        "encoder stays at 2.00 m/s without throttle",
        "wheel_speed_mps",
        11.5,
    ),
    "encoder_stuck_at_rest_alone": (
        stuck("wheel_speed_mps", 9, 12, 2.0, alone=True),
        "encoder stays at 2.00 m/s without throttle",
        "wheel_speed_mps",
        11.5,
    ),
    "encoder_stuck_low": (
        stuck("wheel_speed_mps", 1.3, 4, 0.56),
        "under drive, slower than the car: stuck",
        "wheel_speed_mps",
        3.0,
    ),
    "encoder_counts_nothing": (
        stuck("wheel_speed_mps", 0, 12, 0.0),
        "encoder stays at 0.00 m/s under drive",
        "wheel_speed_mps",
        4.0,
    ),
    "encoder_counts_nothing_alone": (
        stuck("wheel_speed_mps", 0, 12, 0.0, alone=True),
        "encoder stays at 0.00 m/s",
        "wheel_speed_mps",
        4.0,
    ),
    "encoder_stuck_alone": (
        stuck("wheel_speed_mps", 0.2, 2.4, 1.0, alone=True),
        "whatever the throttle: stuck",
        "wheel_speed_mps",
        2.0,
    ),
    "gyroscope_stuck": (
        stuck("gyro_radps", 2, 9, 0.02),
        "gyroscope stays at 0.02 rad/s",
        "gyro_radps",
        4.0,
    ),
    "gyroscope_stuck_alone": (
        stuck("gyro_radps", 2.2, 5, 0.02, alone=True),
        "gyroscope stays at 0.02 rad/s",
        "gyro_radps",
        4.0,
    ),
    "dead_man_switch": (
        stuck("armed", 3, 4, 0.0),
        "dead-man switch is released",
        "",
        3.5,
    ),
    "capture_dropout": (
        lambda r: dropped(r, "truth", 4, 4.2),
        "truth.csv has no rows for 0.2",
        "",
        4.1,
    ),
    "capture_repeats": (
        lambda r: capture_frozen(r, 3.0, 3),
        "repeats a frame",
        "",
        3.01,
    ),
    "capture_spike": (
        lambda r: changed(r, "truth", x_m=spiked("x_m", 3.0, 0.06)),
        "false frame",
        "",
        3.0,
    ),
    "capture_yaw_flips": (
        lambda r: changed(r, "truth", heading_rad=spiked("heading_rad", 3.0, 3.0, 2)),
        "false frame",
        "",
        3.0,
    ),
    "capture_jump": (
        lambda r: changed(r, "truth", y_m=spiked("y_m", 4.0, 0.3, 9999)),
        "jumps by 0.2",
        "",
        3.995,
    ),
    "capture_empty": (
        lambda r: changed(
            r, "truth", x_m=lambda t: np.where(within(t, 4, 4.5), np.nan, t["x_m"])
        ),
        "x_m is empty",
        "x_m",
        4.2,
    ),
    "false_yaw_rate": (
        lambda r: changed(
            with_velocities(r), "truth", yaw_rate_radps=spiked("yaw_rate_radps", 4.0, -200)
        ),
        "is not the heading's",
        "yaw_rate_radps",
        4.0,
    ),
    "collision": (lambda r: hit(r, 4.0), "a collision", "", 4.0),
    "collision_alone": (
        lambda r: without_truth(
            changed(r, "telemetry", accel_x_mps2=spiked("accel_x_mps2", 4.0, -30, 2))
        ),
        "a collision",
        "",
        4.0,
    ),
    "clock_jumps": (
        lambda r: changed(
            r, "commands", time_s=lambda t: t["time_s"] + np.where(t["time_s"] > 5, 1.5, 0)
        ),
        "commands.csv has no rows for 1.5",
        "",
        6.0,
    ),
    "clock_stands": (
        lambda r: changed(
            r, "telemetry", time_s=lambda t: np.maximum(t["time_s"], 0.02)
        ),
        "telemetry.csv has two rows at one time",
        "",
        0.02,
    ),
    "sensor_silent": (
        stuck("gyro_radps", 4, 6, np.nan),
        "gyro_radps reports nothing",
        "gyro_radps",
        5.0,
    ),
    "column_empty": (
        lambda r: changed(r, "telemetry", gyro_radps=lambda t: np.nan * t["gyro_radps"]),
        "gyro_radps of telemetry.csv is empty",
        "gyro_radps",
        5.0,
    ),
    "infinite": (
        stuck("gyro_radps", 4, 4.01, np.inf),
        "gyro_radps is infinite",
        "gyro_radps",
        4.0,
    ),
}  # fmt: skip

# Each spoils a whole column. What must be said, and the place.
REFUSED: dict[str, tuple[Callable[[Run], Run], str]] = {
    "heading_mirrored": (
        lambda r: changed(r, "truth", heading_rad=lambda t: -t["heading_rad"]),
        "heading_rad turns against the course",
    ),
    "heading_from_another_axis": (
        lambda r: changed(r, "truth", heading_rad=lambda t: t["heading_rad"] + np.pi),
        "heading_rad is off the course",
    ),
    "heading_in_degrees": (
        lambda r: changed(
            r, "truth", heading_rad=lambda t: (np.degrees(t["heading_rad"]) + 180) % 360 - 180
        ),
        "truth.csv, 1.*heading_rad .* in degrees",
    ),
    "yaw_rate_in_degrees": (
        lambda r: changed(
            with_velocities(r), "truth", yaw_rate_radps=lambda t: np.degrees(t["yaw_rate_radps"])
        ),
        "yaw_rate_radps .* in degrees",
    ),
    "gyroscope_in_degrees": (
        lambda r: changed(r, "telemetry", gyro_radps=lambda t: np.degrees(t["gyro_radps"])),
        "telemetry.csv, 2.*gyro_radps",
    ),
    "gyroscope_in_degrees_alone": (
        lambda r: without_truth(
            changed(r, "telemetry", gyro_radps=lambda t: np.degrees(t["gyro_radps"]))
        ),
        "telemetry.csv, .*gyro_radps is beyond 60",
    ),
    "wheel_speed_in_cmps": (
        lambda r: without_truth(
            changed(r, "telemetry", wheel_speed_mps=lambda t: 100 * t["wheel_speed_mps"])
        ),
        "telemetry.csv, 1.*wheel_speed_mps is beyond 30",
    ),
    "wheel_speed_in_kmph": (
        lambda r: changed(r, "telemetry", wheel_speed_mps=lambda t: 3.6 * t["wheel_speed_mps"]),
        "wheel_speed_mps is in km/h",
    ),
    "velocities_in_kmph": (
        lambda r: changed(
            with_velocities(r),
            "truth",
            vx_mps=lambda t: 3.6 * t["vx_mps"],
            vy_mps=lambda t: 3.6 * t["vy_mps"],
        ),
        "vx_mps, vy_mps is in km/h",
    ),
    "positions_in_cm": (
        lambda r: changed(
            r, "truth", x_m=lambda t: 100 * t["x_m"], y_m=lambda t: 100 * t["y_m"]
        ),
        "truth.csv, 0.*not metres",
    ),
    "throttle_in_percent": (
        lambda r: changed(r, "commands", throttle=lambda t: 100 * t["throttle"]),
        "commands.csv, 1.00 s: throttle .*percent",
    ),
    "steering_beyond_any_lock": (
        lambda r: changed(r, "commands", steering=lambda t: 4 * t["steering"]),
        "commands.csv, .*steering_deg is beyond any lock",
    ),
    "time_in_ms": (
        lambda r: changed(r, "telemetry", time_s=lambda t: 1000 * t["time_s"]),
        "telemetry.csv: goes on to .*milliseconds",
    ),
    "time_goes_back": (
        lambda r: changed(
            r, "truth", time_s=lambda t: t["time_s"] - np.where(t["time_s"] > 5, 2.0, 0)
        ),
        "truth.csv, 3.*time_s goes backwards",
    ),
    "no_rows": (
        lambda r: dataclasses.replace(r, truth=Table({k: v[:0] for k, v in r.truth.items()})),
        "truth.csv: holds no rows",
    ),
    "empty_positions": (
        lambda r: changed(r, "truth", x_m=lambda t: np.nan * t["x_m"]),
        "truth.csv, 0.00 s: x_m is empty",
    ),
}  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", [lambda r: r, without_truth, with_velocities])
def test_nothing_is_found_in_a_good_log(seed, kind):
    assert find_defects(kind(good(seed))) == []


def check(run: Run, name: str) -> None:
    inject, words, column, at = FAULTS[name]
    found = find_defects(inject(run))
    named = [fault for fault in found if words in fault.what]
    assert named, found
    assert all(fault.column == column for fault in named)
    assert any(fault.start - 1e-9 <= at <= fault.end + 1e-9 for fault in named), named


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_where_it_is(name):
    check(good(), name)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_brings_no_false_alarm_elsewhere(name):
    inject, words, _, at = FAULTS[name]
    for fault in find_defects(inject(good())):
        assert words in fault.what or fault.start - 0.3 <= at <= fault.end + 0.3, fault


@pytest.mark.parametrize("name", REFUSED)
def test_a_column_that_means_something_else_is_refused(name):
    inject, words = REFUSED[name]
    run = inject(good())
    with pytest.raises(InputError, match=words) as refused:
        find_defects(run)
    assert str(refused.value).startswith("log/")
    assert "\n" not in str(refused.value)


def test_a_heading_that_wraps_is_unwrapped_and_said():
    run = good()
    wrapped = changed(
        run, "truth", heading_rad=lambda t: (t["heading_rad"] + np.pi) % (2 * np.pi) - np.pi
    )
    mended, lines = repair(wrapped)
    turns = mended.truth["heading_rad"] - run.truth["heading_rad"]
    np.testing.assert_allclose(turns, turns[0], atol=1e-9)
    assert len(lines) == 1
    assert "log/truth.csv: heading_rad wraps" in lines[0]
    assert "unwrapped" in lines[0]
    assert find_defects(wrapped) == []
    assert repair(run) == (run, [])


def test_a_quaternion_that_changes_its_sign_is_no_unit():
    run = good()
    flips = 2 * np.pi * (np.arange(len(run.truth)) % 40 < 5)
    flipped = changed(run, "truth", heading_rad=lambda t: t["heading_rad"] + flips)
    assert find_defects(flipped) == []


def test_a_heading_that_turns_round_halfway_is_found():
    run = good()
    back = np.pi * (np.arange(len(run.truth)) > 500)
    found = find_defects(changed(run, "truth", heading_rad=lambda t: t["heading_rad"] + back))
    assert any("points backwards" in fault.what and fault.end > 8 for fault in found)


def test_wheels_that_spin_and_a_gyroscope_at_its_reach_are_not_stuck():
    def clipped(table: Table) -> np.ndarray:
        return np.clip(table["gyro_radps"], -2.2, 2.2)

    spins = changed(
        good(),
        "telemetry",
        wheel_speed_mps=held("wheel_speed_mps", 5.6, 8.4, 3.28),
        gyro_radps=clipped,
    )
    assert find_defects(spins) == []


def test_only_a_wall_is_found_in_what_the_simulator_drove(tmp_path):
    for arguments in (["box"], ["straight", "--driver", "straighten"]):
        out = tmp_path / arguments[0]
        assert cli.main(["drive", *arguments, "--json", "--out", str(out)]) == 0
        assert find_defects(read_run(out)) == []
    steps = tmp_path / "into-the-wall.csv"
    steps.write_text("time_s,throttle,direction,steering_deg\n0,0.5,forward,0\n4,0,forward,0\n")
    out = tmp_path / "hit"
    cli.main(["drive", "box", "--driver", str(steps), "--json", "--out", str(out)])
    found = find_defects(read_run(out))
    assert len(found) >= 1
    assert all("a collision" in fault.what for fault in found)


# -------------------------------------------------------------------------------------------------
# Real logs
# -------------------------------------------------------------------------------------------------


@needs_data
def test_the_dart_logs_are_clean_but_for_the_dead_man_switch(tmp_path):
    logs = sorted((DATA / "dart").rglob("*.csv"))
    assert len(logs) >= 30
    for log in logs:
        run = read_run(Path(import_dart(log, tmp_path / log.parent.name)["run"]))
        for fault in find_defects(run):
            ends = fault.end in (run.truth["time_s"][[0, -1]] if run.truth else ())
            assert "dead-man" in fault.what or (ends and "is empty" in fault.what), (log, fault)


@needs_data
def test_in_the_eth_logs_the_car_hits_something_three_times(tmp_path):
    hits = []
    for name in ("train_1", "train_2"):
        import_eth(DATA / "eth_rccar" / f"{name}.npz", tmp_path)
        for fault in find_defects(read_run(tmp_path / name)):
            if "a collision" in fault.what:
                hits.append((name, round(fault.start)))
            else:
                assert fault.column == "yaw_rate_radps", fault
    assert hits == [("train_1", 143), ("train_1", 232), ("train_1", 233)]


@pytest.fixture(scope="module")
def drift(tmp_path_factory) -> Run:
    """A real log with motion capture."""
    return read_run(Path(import_dart(DATA / "dart" / DRIFT, tmp_path_factory.mktemp("d"))["run"]))


REAL: dict[str, tuple[Callable[[Run], Run], str]] = {
    "encoder": (
        stuck("wheel_speed_mps", 8, 21, 0.0),
        "encoder stays at 0.00",
    ),
    "gyroscope": (
        stuck("gyro_radps", 8, 21, 0.01),
        "gyroscope stays",
    ),
    "dropout": (lambda r: dropped(r, "truth", 12, 12.3), "truth.csv has no rows"),
    "spike": (lambda r: changed(r, "truth", y_m=spiked("y_m", 12.0, 0.05)), "false frame"),
    "jump": (lambda r: changed(r, "truth", y_m=spiked("y_m", 12.0, 0.2, 9999)), "jumps by"),
    "repeats": (lambda r: capture_frozen(r, 12.0, 2), "repeats a frame"),
}


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_a_fault_put_into_a_real_log_is_found_and_alone(drift, name):
    inject, words = REAL[name]
    before = find_defects(drift)
    fresh = [fault for fault in find_defects(inject(drift)) if fault not in before]
    assert fresh
    assert all(words in fault.what for fault in fresh), fresh


@needs_data
@pytest.mark.parametrize(
    ("inject", "words"),
    [
        (REFUSED["heading_in_degrees"][0], "in degrees"),
        (REFUSED["gyroscope_in_degrees"][0], "gyro_radps"),
        (REFUSED["positions_in_cm"][0], "not metres"),
    ],
)
def test_a_wrong_unit_in_a_real_log_is_refused(drift, inject, words):
    refuse(drift)
    with pytest.raises(InputError, match=words):
        refuse(inject(drift))
