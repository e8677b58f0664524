"""Logs of other people by a mapping: what the importers make of them, and what they refuse."""

import json
import math
import runpy
from pathlib import Path

import numpy as np
import pytest

from countersteer import cli
from countersteer.car.files import load_car
from countersteer.errors import InputError
from countersteer.runs.importers import importer
from countersteer.runs.importers.guess import guess_mapping
from countersteer.runs.run import Run, read_run

ROOT = Path(__file__).parents[1]
OTHERS = ROOT.parent / "shared" / "data" / "other"
needs_data = pytest.mark.skipif(not OTHERS.is_dir(), reason="the logs of other cars are not here")

PLAIN = """
time = { column = "t", unit = "s" }
throttle = { column = "u", unit = "1" }
steering = { column = "d", unit = "rad" }
wheel_speed = { column = "v", unit = "m/s" }
"""
ROWS = "t,u,d,v\n0,0,0,0\n0.1,0.5,0.1,1\n0.2,0.5,-0.1,2\n"


def imported(
    tmp_path: Path, text: str, mapping: str = PLAIN, kind: str = "csv", name: str = "log.csv"
) -> Run:
    (tmp_path / name).write_text(text)
    (tmp_path / "map.toml").write_text(mapping)
    about = importer(kind, tmp_path / "map.toml")(tmp_path / name, tmp_path / "runs")
    return read_run(Path(about["run"]))


def with_entry(signal: str, entry: str) -> str:
    """The plain mapping with one entry replaced or added."""
    kept = [line for line in PLAIN.splitlines() if not line.startswith(f"{signal} ")]
    return "\n".join([*kept, f"{signal} = {{ {entry} }}"])


def refusal(tmp_path: Path, text: str, mapping: str = PLAIN) -> str:
    with pytest.raises(InputError) as caught:
        imported(tmp_path, text, mapping)
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 600
    assert not (tmp_path / "runs").exists()
    return message


# -------------------------------------------------------------------------------------------------
# Units, signs and clocks
# -------------------------------------------------------------------------------------------------

CAR = "full_lock_deg = 30\nwheel_radius_m = 0.05\ngear_ratio = 10\npole_pairs = 2\n"


@pytest.mark.parametrize(
    ("signal", "entry", "raw", "value"),
    [
        ("throttle", 'unit = "%"', 40, 0.4),
        ("throttle", 'unit = "%", zero = 50, span = 50', 75, 0.5),
        ("throttle", 'unit = "us"', 1750, 0.5),
        ("throttle", 'unit = "us", zero = 1480, span = -400', 1280, 0.5),
        ("throttle", 'unit = "counts", span = 1024', -512, -0.5),
        ("steering", 'unit = "deg", sign = -1', 12, -math.radians(12)),
        ("steering", 'unit = "1"', 0.5, math.radians(15)),
        ("steering", 'unit = "us", zero = 1500, span = 500', 1250, -math.radians(15)),
        ("wheel_speed", 'unit = "km/h"', 7.2, 2.0),
        ("wheel_speed", 'unit = "m/s", scale = 0.9', 2.0, 1.8),
        ("wheel_speed", 'unit = "rad/s"', 40, 2.0),
        ("wheel_speed", 'unit = "rpm"', 600, 2 * math.pi * 0.05),
        ("wheel_speed", 'unit = "erpm", sign = -1', -1200, 2 * math.pi * 0.05),
        ("gyro", 'unit = "deg/s", zero = 3', 93, math.pi / 2),
        ("accel_x", 'unit = "g"', 0.5, 4.905),
        ("battery", 'unit = "mV"', 7400, 7.4),
    ],
)
def test_units_signs_and_zeros(tmp_path, signal, entry, raw, value):
    text = f"t,u,d,v,raw\n0,0,0,0,{raw}\n1,0.1,0,1,{raw}\n"
    run = imported(tmp_path, text, CAR + with_entry(signal, f'column = "raw", {entry}'))
    names = {"wheel_speed": "wheel_speed_mps", "gyro": "gyro_radps"}
    names |= {"accel_x": "accel_x_mps2", "battery": "battery_v"}
    table = run.commands if signal in ("throttle", "steering") else run.telemetry
    np.testing.assert_allclose(table[names.get(signal, signal)], value, rtol=1e-9)


@pytest.mark.parametrize(
    ("entry", "cells"),
    [
        ('unit = "s"', ("1700000000.25", "1700000000.75")),
        ('unit = "ms"', ("1700000000250", "1700000000750")),
        ('unit = "ns"', ("1700000000250000000", "1700000000750000000")),
        ('unit = "datetime"', ("2023-11-14 22:13:20.250", "2023-11-14T22:13:20.750Z")),
    ],
)
def test_every_clock_begins_at_0(tmp_path, entry, cells):
    text = "t,u,d,v\n" + "".join(f"{cell},0.5,0,1\n" for cell in cells)
    run = imported(tmp_path, text, with_entry("time", f'column = "t", {entry}'))
    np.testing.assert_allclose(run.commands["time_s"], [0, 0.5], atol=1e-6)


def test_seconds_and_nanoseconds_apart_are_one_clock_and_a_period_is_a_clock(tmp_path):
    text = "t,ns,u,d,v\n1700000000,900000000,0.5,0,1\n1700000001,150000000,0.5,0,1\n"
    entry = 'columns = ["t", "ns"], unit = ["s", "ns"]'
    run = imported(tmp_path, text, with_entry("time", entry))
    np.testing.assert_allclose(run.commands["time_s"], [0, 0.25], atol=1e-6)
    run = imported(tmp_path, ROWS, with_entry("time", "period_s = 0.02"))
    np.testing.assert_allclose(run.telemetry["time_s"], [0, 0.02, 0.04])


def test_a_direction_gives_the_sign_and_a_switch_its_threshold(tmp_path):
    text = "t,u,d,v,gear,arm\n0,0.5,0,1,F,1900\n1,0.25,0,1,R,1100\n"
    mapping = PLAIN + (
        'direction = { column = "gear", reverse = "R" }\narmed = { column = "arm", above = 1500 }\n'
    )
    run = imported(tmp_path, text, mapping)
    assert run.commands["throttle"].tolist() == [0.5, -0.25]
    assert run.telemetry["armed"].tolist() == [1, 0]


def test_false_values_are_no_readings_and_repeated_ones_are_one(tmp_path):
    text = "t,u,d,v,w\n0,0,0,1,2\n1,0,0,11.111,4\n2,0,0,2,4\n3,0,0,2,5\n"
    mapping = with_entry("wheel_speed", 'columns = ["v", "w"], unit = "m/s", within = [0, 10]')
    assert imported(tmp_path, text, mapping).telemetry["wheel_speed_mps"].tolist() == [
        1.5, 4, 3, 3.5,
    ]  # fmt: skip
    mapping = with_entry("wheel_speed", 'column = "w", unit = "m/s", held = true')
    assert imported(tmp_path, text, mapping).telemetry["time_s"].tolist() == [0, 1, 3]


def test_a_pose_is_moved_to_the_centre_of_mass_and_a_quaternion_is_a_heading(tmp_path):
    angle = np.linspace(3.0, 3.4, 5)  # across a wrap
    rows = [
        f"{i},0.5,0,{math.cos(a)},{math.sin(a)},0,0,{math.sin(a / 2)},{math.cos(a / 2)}"
        for i, a in enumerate(angle)
    ]
    mapping = with_entry("wheel_speed", 'column = "X", unit = "m/s"') + (
        '\nx = { column = "X", unit = "m" }\ny = { column = "Y", unit = "m" }\n'
        'heading = { columns = ["qx", "qy", "qz", "qw"], unit = "quaternion" }\n'
        "sensors.capture.x_m = 1.0\n"
    )
    run = imported(tmp_path, "\n".join(["t,u,d,X,Y,qx,qy,qz,qw", *rows]), mapping)
    np.testing.assert_allclose(np.diff(run.truth["heading_rad"]), 0.1, atol=1e-9)
    np.testing.assert_allclose(run.truth["x_m"], 0, atol=1e-9)
    np.testing.assert_allclose(run.truth["y_m"], 0, atol=1e-9)


def test_a_folder_of_files_with_their_own_rows_is_one_log(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "asked.csv").write_text("t,V,d\n10,1.0,0\n11,2.0,0.1\n")
    (folder / "imu.csv").write_text("t,w\n9.5,90\n10.5,45\n")
    (tmp_path / "map.toml").write_text(
        'time = { column = "t", unit = "s" }\n'
        'speed = { from = "asked.csv", column = "V", unit = "m/s" }\n'
        'steering = { from = "asked.csv", column = "d", unit = "rad" }\n'
        'gyro = { from = "imu.csv", column = "w", unit = "deg/s" }\n'
    )
    about = importer("csv", tmp_path / "map.toml")(folder, tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert run.commands["speed"].tolist() == [1.0, 2.0]
    assert run.commands["time_s"].tolist() == [0.5, 1.5]
    assert run.telemetry["time_s"].tolist() == [0, 1]


@pytest.mark.parametrize(
    "text",
    [
        "t;u;d;v;\n0;0,5;0,1;1;\n0,1;0,5;0,1;2;\n",
        "# from the car\n# t,u,d,v\n0,0.5,0.1,1\n0.1,0.5,0.1,2\n",
        "t\tu\td\tv\r\n0\t0.5\t0.1\t1\r\n0.1\t0.5\t0.1\t2\r\n\r\n",
        "t, u, d, v\n0, 0.5, 0.1, 1\n0.1, 0.5, 0.1, 2\n0.2, 0.",
        "\ufefft,u,d,v\n0,0.5,0.1,1\n0.1,0.5,0.1,2\n",
    ],
)
def test_files_may_be_written_in_other_ways(tmp_path, text):
    run = imported(tmp_path, text)
    assert run.commands["throttle"].tolist() == [0.5, 0.5]
    assert run.telemetry["wheel_speed_mps"].tolist() == [1, 2]
    np.testing.assert_allclose(run.commands["steering"], 0.1)


# -------------------------------------------------------------------------------------------------
# Refusals and doubts
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mapping", "says"),
    [
        ('time = { column = "t", unit = "s" }', "no throttle and no commanded speed"),
        ("throttle = 3", "time is missing"),
        (with_entry("time", 'column = "t", unit = "h"'), "time.unit must be one of s, ms"),
        (with_entry("throttle", 'column = "gas", unit = "1"'), "no column 'gas'; it has 't'"),
        (with_entry("throttle", 'column = "u"'), "throttle.unit must be one of 1, %"),
        (with_entry("throttle", 'column = "u", unit = "counts"'), "throttle.span is missing"),
        (with_entry("throttle", 'colum = "u"'), "did you mean column?"),
        (with_entry("throtle", 'column = "u"'), "did you mean throttle?"),
        (with_entry("steering", 'column = "d", unit = "1"'), "needs full_lock_deg"),
        (with_entry("wheel_speed", 'column = "v", unit = "erpm"'), "needs wheel_radius_m"),
        (with_entry("wheel_speed", 'column = "v", unit = "m/s", sign = 2'), "must be 1 or -1"),
        (with_entry("wheel_speed", 'column = "v", unit = "m/s", within = [2, 1]'), "must rise"),
        (with_entry("speed", 'column = "v", unit = "m/s"'), "give one of them"),
        (with_entry("x", 'column = "v", unit = "m"'), "x needs y, heading too"),
        (PLAIN + f"pole_pairs = {'9' * 400}", "a whole number of some 400 digits"),
        (PLAIN + "sensors.encoder.lag_s = -1", "sensors.encoder.lag_s"),
        (PLAIN + 'sensors.gyroscope.unit = "deg/s"', "give the signal its unit instead"),
        (PLAIN + "[", "not valid TOML"),
        (PLAIN + "gyro = []", "gyro must be an entry"),
    ],
)
def test_a_wrong_mapping_is_refused_with_its_key(tmp_path, mapping, says):
    message = refusal(tmp_path, ROWS, mapping)
    assert says in message
    assert "map.toml" in message or "log.csv" in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("t,u,d,v\n", "holds no rows"),
        ("\0\0\0\0", "holds no rows"),
        ("t,u,d,v\n0,0\0,0,0\n", "u must be a number"),
        ("t,u,d,v\n0,0,0,0\n1,x,0,0\n", "line 3: u must be a number, not 'x'"),
        ("t,u,d,v\n0,0,0\n1,0,0,0\n", "line 2: 3 cells, not 4"),
        ("t,u,d,v\n1,0,0,0\n0,0,0,0\n", "line 3: time goes backwards"),
        ("t,u,d,v\n0,0,0,0\n,0,0,0\n", "line 3: time is not a number"),
        ("t,u,d,v\n0,0,0,0\n1,50,0,0\n", "throttle would be 50"),
        ("t,u,d,v\n0,0,45,0\n", "steering would be 45"),
        ("t,u,d,v\n0,0,0,0\n9e9,0,0,0\n", "is the unit of time right"),
        (f"t,u,d,v\n0,{'9' * 5000},0,0\n", "throttle would be inf"),
        ("t,u,d,v\n0,0,0,1e300\n", "wheel_speed would be 1e+300"),
        ("a" * 5000 + "\n1\n", "no column"),
        ("," * 20_000 + "\n1\n", "columns, over 10000"),
        ("t,u,d,v\n0,0,0,\n", "wheel_speed: the log has no value of it"),
        ("t,u,d,v\n" + '0,"' + "x" * 200_000 + '",0,0\n', "no CSV file"),
    ],
)
def test_a_wrong_log_is_refused_with_its_line(tmp_path, text, says):
    assert says in refusal(tmp_path, text)


@pytest.mark.parametrize("kind", ["csv", "edgetx", "vesc", "donkeycar", "run", "rosbag"])
@pytest.mark.parametrize("place", ["/dev/zero", "nowhere", "."])
def test_what_is_no_file_is_refused(tmp_path, monkeypatch, capsys, kind, place):
    if kind == "rosbag":
        pytest.importorskip("rosbags", reason="rosbags is not here (make bags)")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map.toml").write_text(PLAIN)
    arguments = ["import", kind, place, "--out", "runs"]
    if kind != "run":
        arguments += ["--map", "map.toml"]
    assert cli.main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert place in lines[0]


def test_formats_with_fixed_columns_take_no_mapping_and_csv_needs_one(tmp_path):
    with pytest.raises(InputError, match="takes no mapping"):
        importer("dart", tmp_path / "map.toml")
    (tmp_path / "log.csv").write_text(ROWS)
    with pytest.raises(InputError, match="--guess"):
        importer("csv")(tmp_path / "log.csv", tmp_path / "runs")


def test_signs_that_disagree_are_a_doubt(tmp_path):
    time = np.arange(0, 5, 0.05)
    turn = np.sin(time)
    rows = [f"{t},0.5,{0.3 * s},1,{-2 * s}" for t, s in zip(time, turn, strict=True)]
    mapping = PLAIN + 'gyro = { column = "w", unit = "rad/s" }\n'
    run = imported(tmp_path, "\n".join(["t,u,d,v,w", *rows]), mapping)
    assert "one of their signs is wrong" in run.about["doubts"][0]
    mapping = with_entry("steering", 'column = "d", unit = "rad", sign = -1')
    mapping += '\ngyro = { column = "w", unit = "rad/s" }\n'
    assert not imported(tmp_path, "\n".join(["t,u,d,v,w", *rows]), mapping).about["doubts"]


# -------------------------------------------------------------------------------------------------
# A guessed mapping
# -------------------------------------------------------------------------------------------------


def own_log() -> str:
    """A log as people write it: pulses, degrees, km/h, deg/s, Unix time in ms."""
    time = np.arange(0, 10, 0.05)
    lines = ["timestamp_ms,steering_us,throttle_pct,speed (km/h),gyro_z (deg/s),vbat_v,lap"]
    for t in time:
        turn = math.sin(t)
        pulse, rate = 1500 - 300 * turn, 60 * turn
        lines.append(
            f"{1700000000000 + 1000 * t:.0f},{pulse:.0f},{30 + 5 * turn:.1f},7.2,{rate:.1f},7.9,1"
        )
    return "\n".join(lines)


def test_a_guessed_mapping_imports_the_log_that_it_was_guessed_from(tmp_path, capsys):
    (tmp_path / "log.csv").write_text(own_log())
    out = tmp_path / "first.toml"
    arguments = ["import", "csv", "--guess", str(tmp_path / "log.csv"), "--out", str(out)]
    assert cli.main(arguments) == 0
    told = capsys.readouterr().out
    assert "doubt: steering" in told
    assert "full_lock_deg" in told
    text = out.read_text()
    assert "# doubt: steering, gyro: opposite signs" in text
    assert "# not used: lap" in text
    about = importer("csv", out)(tmp_path / "log.csv", tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert run.commands["time_s"][-1] == pytest.approx(9.95)
    np.testing.assert_allclose(run.telemetry["wheel_speed_mps"], 2.0)
    assert np.max(run.telemetry["gyro_radps"]) == pytest.approx(math.radians(60), rel=0.01)
    assert np.corrcoef(run.commands["steering"], run.telemetry["gyro_radps"])[0, 1] > 0.99
    assert not about["doubts"]
    assert cli.main(arguments) == 2  # it writes over no mapping


@pytest.mark.parametrize(
    ("header", "row", "signal", "entry"),
    [
        ("t,thr,d", "{t},0.4,0", "throttle", {"unit": "1"}),
        ("t,throttle,d", "{t},62,0", "throttle", {"unit": "%", "zero": 50, "span": 50}),
        ("t,cmd_speed_mps,d", "{t},2,0", "speed", {"unit": "m/s"}),
        ("t,thr,yaw_rate", "{t},0.4,1.5", "gyro", {"unit": "rad/s"}),
        ("t,thr,gyro_radps", "{t},0.4,1.5", "gyro", {"unit": "rad/s"}),
        ("t,thr,gyro_dps", "{t},0.4,150", "gyro", {"unit": "deg/s"}),
        ("t,thr,wheel_speed_radps", "{t},0.4,9", "wheel_speed", {"unit": "rad/s"}),
        ("t,thr,yaw_rate", "{t},0.4,150", "gyro", {"unit": "deg/s"}),
        ("t,thr,speed_FL,speed_FR", "{t},0.4,1,2", "wheel_speed", {"unit": "m/s"}),
        ("s,ns,thr,v", "{t},5,0.4,1", "time", {"columns": ["s", "ns"], "unit": ["s", "ns"]}),
        ("t,thr,erpm", "{t},0.4,9000", "wheel_speed", {"unit": "erpm"}),
        ("t_us,thr,v", "{t}e6,0.4,1", "time", {"unit": "us"}),
        ("time,thr,v", "{t}e3,0.4,1", "time", {"unit": "ms"}),
        ("Epoch_ms,thr,v", "{t}e3,0.4,1", "time", {"column": "Epoch_ms", "unit": "ms"}),
    ],
)
def test_units_are_guessed_from_names_and_values(tmp_path, header, row, signal, entry):
    rows = [row.format(t=round(0.05 * i, 3)) for i in range(40)]
    if "62" in row:
        rows[0] = row.format(t=0).replace("62", "50")
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    text, _ = guess_mapping(tmp_path / "log.csv")
    (line,) = (line for line in text.splitlines() if line.startswith(f"{signal} = "))
    for key, value in entry.items():
        assert f"{key} = {json.dumps(value)}" in line


def test_a_log_without_a_command_gets_no_guess(tmp_path):
    (tmp_path / "log.csv").write_text("t,temperature\n0,20\n1,21\n")
    with pytest.raises(InputError, match="no column looks like a throttle"):
        guess_mapping(tmp_path / "log.csv")


# -------------------------------------------------------------------------------------------------
# Formats with mappings of their own
# -------------------------------------------------------------------------------------------------


def test_a_log_of_vesc_tool(tmp_path):
    text = (
        "ms_today;input_voltage;erpm;duty_cycle;speed_meters_per_sec;accX;accY;gyroZ;\n"
        "45000000;11.8;3000;0.2;1.5;0.1;0;90;\n45000050;11.7;3000;0.3;1.6;0.1;0;45;\n"
    )
    (tmp_path / "log.csv").write_text(text)
    about = importer("vesc")(tmp_path / "log.csv", tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert run.commands["time_s"].tolist() == [0, 0.05]
    assert run.commands["throttle"].tolist() == [0.2, 0.3]
    assert run.telemetry["battery_v"].tolist() == [11.8, 11.7]
    np.testing.assert_allclose(run.telemetry["gyro_radps"], np.radians([90, 45]))
    assert "no steering" in about["doubts"][0]
    mapping = CAR + 'wheel_speed = { column = "erpm", unit = "erpm" }\n'
    run = imported(tmp_path, text, mapping, "vesc")
    np.testing.assert_allclose(run.telemetry["wheel_speed_mps"], 2 * math.pi * 0.05 * 2.5)


@pytest.mark.parametrize("columns", ["CH1(us),CH2(us)", "ST,TH"])
def test_a_log_of_an_edgetx_radio(tmp_path, columns):
    left, forward = ("1250", "1750") if "us" in columns else ("-512", "512")
    text = (
        f"Date,Time,RxBt(V),GSpd(kmh),{columns},TxBat(V)\n"
        f"2026-05-01,12:00:00.000,7.9,7.2,{left},{forward},8.0\n"
        f"2026-05-01,12:00:00.100,7.9,7.2,{left},{forward},8.0\n"
    )
    (tmp_path / "log.csv").write_text(text)
    about = importer("edgetx")(tmp_path / "log.csv", tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert run.commands["time_s"].tolist() == [0, 0.1]
    np.testing.assert_allclose(run.commands["throttle"], 0.5)
    np.testing.assert_allclose(run.commands["steering"], math.radians(12.5))
    np.testing.assert_allclose(run.telemetry["wheel_speed_mps"], 2.0)


def tub(folder: Path, records: list[dict], deleted: tuple[int, ...] = ()) -> None:
    """Write a tub of version 2, in two catalogs."""
    folder.mkdir()
    paths = ["catalog_0.catalog", "catalog_1.catalog"]
    for path, part in zip(paths, (records[:3], records[3:]), strict=True):
        (folder / path).write_text("".join(json.dumps(record) + "\n" for record in part))
    lines = [["user/angle", "user/throttle"], ["float", "float"], {}, {"created_at": 1.0}]
    lines.append({"paths": paths, "current_index": 6, "deleted_indexes": list(deleted)})
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, lines)))


def records() -> list[dict]:
    return [
        {"_index": i, "_timestamp_ms": 1700000000000 + 50 * i, "user/mode": "user"}
        | {"user/angle": 0.1 * i, "user/throttle": 0.3, "enc/speed": 0.5 * i}
        for i in range(6)
    ]


def test_a_tub_of_donkeycar_without_its_deleted_records(tmp_path):
    tub(tmp_path / "tub", records(), deleted=(2,))
    about = importer("donkeycar")(tmp_path / "tub", tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert run.commands["time_s"].tolist() == [0, 0.05, 0.15, 0.2, 0.25]
    np.testing.assert_allclose(run.commands["steering"][1], -math.radians(2.5))
    assert run.telemetry["wheel_speed_mps"].tolist() == [0, 0.5, 1.5, 2, 2.5]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"_timestamp_ms": "now"}, "_timestamp_ms"),
        ({"user/throttle": "fast"}, "user/throttle must be a number, not 'fast'"),
        ({"user/throttle": 10**400}, "throttle would be inf"),
        ({"_index": -1}, "_index"),
        ({f"k{i}": 0 for i in range(200)}, "keys, over 100"),
    ],
)
def test_a_damaged_record_of_a_tub_is_named(tmp_path, change, says):
    damaged = records()
    damaged[4] |= change
    tub(tmp_path / "tub", damaged)
    with pytest.raises(InputError, match="tub") as caught:
        importer("donkeycar")(tmp_path / "tub", tmp_path / "runs")
    assert says in str(caught.value)


def test_a_tub_names_no_file_outside_of_it(tmp_path):
    tub(tmp_path / "tub", records())
    manifest = tmp_path / "tub" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("catalog_0.catalog", "../../secret"))
    with pytest.raises(InputError, match="must name files of the tub"):
        importer("donkeycar")(tmp_path / "tub", tmp_path / "runs")


def test_a_script_of_thirty_lines_writes_a_run_folder(tmp_path, monkeypatch):
    script = ROOT / "examples" / "logs" / "write_run.py"
    assert len(script.read_text().splitlines()) <= 30
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    about = importer("run")(tmp_path / "mine", tmp_path / "runs")
    run = read_run(Path(about["run"]))
    assert about["repairs"]["clock_moved_s"] > 1e9  # it writes Unix time
    assert run.commands["time_s"][0] == 0
    assert {"wheel_speed_mps", "gyro_radps"} <= run.telemetry.keys()
    assert (tmp_path / "runs" / "mine" / "run.mcap").exists()


def test_a_run_folder_with_commanded_speeds_and_two_clocks_is_read_or_refused(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "commands.csv").write_text("time_s,speed_mps,steering_deg\n5,1,0\n6,-2,10\n")
    (mine / "telemetry.csv").write_text("time_s,gyro_radps\n5,0.1\n6,0.2\n")
    run = read_run(Path(importer("run")(mine, tmp_path / "runs")["run"]))
    assert run.commands["speed"].tolist() == [1, -2]
    (mine / "telemetry.csv").write_text("time_s,gyro_radps\n1700000000,0.1\n1700000001,0.2\n")
    with pytest.raises(InputError, match="one clock"):
        importer("run")(mine, tmp_path / "more")


# -------------------------------------------------------------------------------------------------
# Logs of other cars
# -------------------------------------------------------------------------------------------------


@needs_data
@pytest.mark.parametrize(
    ("mapping", "log", "most"),
    [
        ("tudelft_1to5", "tudelft_1to5/coastdown_attempt_1.csv", 4.7),
        ("tudelft_1to5", "tudelft_1to5/circle_experiment_1.csv", 3.6),
        ("f1tenth_ds5", "f1tenth_ds5", 3.4),
    ],
)
def test_the_mappings_of_the_examples_read_the_logs_of_other_cars(tmp_path, mapping, log, most):
    path = ROOT / "examples" / "logs" / f"{mapping}.toml"
    assert len(path.read_text().splitlines()) <= 15
    load_car(str(path.with_name(f"{mapping}_car.toml")))
    about = importer("csv", path)(OTHERS / log, tmp_path)
    run = read_run(Path(about["run"]))
    assert not about["doubts"]
    assert np.nanmax(run.telemetry["wheel_speed_mps"]) == pytest.approx(most, rel=0.1)
    assert np.nanmax(np.abs(run.telemetry["gyro_radps"])) < 3
