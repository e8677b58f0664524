"""Files: what is written reads back the same, and what is wrong is refused in one line."""

import json
import math
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import countersteer
from conftest import driven, write_run
from countersteer import cli
from countersteer.batch.population import load_population
from countersteer.car.files import library, load_car, parameters, save_car
from countersteer.cli.completing import every_action, script
from countersteer.course.course import grip_speed, place, progress
from countersteer.course.files import library as courses
from countersteer.course.files import load_course
from countersteer.drivers import DRIVERS
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.policy import library as library_policy
from countersteer.drivers.policy import load_policy, save_policy
from countersteer.drivers.replay import Replay
from countersteer.drivers.straighten import straighten
from countersteer.errors import InputError
from countersteer.recorded_drive import frames
from countersteer.runs.files import column_rows, command_rows, read_commands, read_table
from countersteer.runs.recorder import Pace, Recorder, new_folder
from countersteer.runs.run import read_run
from countersteer.sensing.all_sensors import channels
from countersteer.signals import Command
from countersteer.text import read_text, tables_of
from countersteer.viewing.picture import draw_picture
from countersteer.viewing.report import report_html
from countersteer.viewing.view import view_of

COMMANDS = "time_s,throttle,direction,steering_deg\n"


@pytest.mark.parametrize("name", library())
def test_cars_round_trip(name, tmp_path):
    car = load_car(name)
    save_car(car, tmp_path / "car.toml", {"all": "a test"})
    again = load_car(str(tmp_path / "car.toml"))
    for one, other in zip(jax.tree.leaves(car), jax.tree.leaves(again), strict=True):
        assert one == pytest.approx(other, rel=1e-14)
    assert jax.tree.structure(car) == jax.tree.structure(again)


def test_a_car_takes_the_rest_from_its_base():
    rubber, tape = load_car("jetracer"), load_car("jetracer-tape")
    assert rubber.body == tape.body
    assert rubber.tires.front.friction > 2 * tape.tires.front.friction


def test_overrides_reach_any_declared_parameter():
    car = load_car("rx7", ["battery.wear=0.5", "sensors.sonar.firing=in-turn"])
    assert car.battery.wear == 0.5
    assert car.sensors.sonar.firing == "in-turn"
    assert load_car("rx7", ["servo.limit_left_deg=20"]).servo.limit_left == math.radians(20)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[body]\nmass_kg = -1.0", "body.mass_kg = -1 is outside its range"),
        ("[body]\nmass_kg = nan", "body.mass_kg = nan is outside its range"),
        ("[body]\nmass_kg = '1'", "body.mass_kg must be a number"),
        ("[body]\nmass = 1.0", "unknown key body.mass; did you mean body.mass_kg?"),
        ("[wings]\nspan_m = 1.0", "unknown key wings"),
        ("body = 3", "body must be a table"),
        ("base = 'no-such-car'", "no car no-such-car"),
        ("base = 'car.toml'", "base must name another car, not 'car.toml'"),
        ("", "holds no parameter"),
        ("[source]\nall = 'nowhere'", "holds no parameter"),
        ("description = 3", "description must be a text"),
        ("[body\n", "not valid TOML"),
        ("[body]\nfront_axle_m = 0.3\nwheelbase_m = 0.2", "front_axle_m must be less"),
        ("[sensors.sonar]\nfiring = 'never'", "must be one of together, in-turn"),
        ("[tires.front]\nfriction = inf", "tires.front.friction = inf is outside"),
    ],
)
def test_a_wrong_car_is_refused_in_one_line(text, says, tmp_path):
    path = tmp_path / "car.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_car(str(path))
    assert says in str(caught.value)
    assert str(path) in str(caught.value) or "no car" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("width_m = 1.0", "give either segments or walls_m"),
        ("width_m = 0\nsegments = [{straight_m = 1.0}]", "width_m must be a number in"),
        ("width_m = 1\nsegments = [{straight_m = nan}]", "segments[0].straight_m must be"),
        ("width_m = 1\nsegments = [{turn_deg = 90}]", "segments[0] must be a straight"),
        ("width_m = 1\nsegments = [{bend = 90}]", "segments[0] must be"),
        ("width_m = 1\nlength_m = 3\nsegments = []", "unknown key length_m"),
        (
            "width_m = 1\nclosed = true\nsegments = [{straight_m = 1.0}]",
            "the segments end 1 m ahead",
        ),
        (
            "name = 'x'\nwidth_m = 1\nclosed = true\nsegments = [{straight_m = 1}]",
            "the segments end 1 m ahead",
        ),
        ("walls_m = [[[0, 0]]]", "walls_m[0] must hold two or more points"),
        ("width_m = 1\nsegments = [{straight_m = 1}]\n[start]\ndistance_m = 2", "start.distance_m"),
        ("width_m = 1\nsegments = [{straight_m = 1}]\n[start]\noffset_m = 2", "start.offset_m"),
    ],
)
def test_a_wrong_course_is_refused_in_one_line(text, says, tmp_path):
    path = tmp_path / "course.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_course(str(path))
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("", "holds no command"),
        ("0,0.5,forward,0\n0.1,1.5,forward,0\n", "line 3: throttle must be in [0, 1]"),
        ("0,0.5,sideways,0\n", "line 2: direction must be"),
        ("0,0.5,forward,100\n", "line 2: steering_deg must be in"),
        ("0.2,0.5,forward,0\n0.1,0.5,forward,0\n", "line 3: time_s goes backwards"),
        ("0,nan,forward,0\n", "line 2: throttle must be in [0, 1]"),
        ("nan,0,forward,0\n", "line 2: time_s is not a number"),
        ("0,zero,forward,0\n", "line 2: throttle must be a number"),
        ("0,0.5,forward\n0,0.5,forward,0\n", "line 2: 3 cells, not 4"),
    ],
)
def test_wrong_commands_are_refused_in_one_line(rows, says, tmp_path):
    path = tmp_path / "commands.csv"
    path.write_text(COMMANDS + rows)
    with pytest.raises(InputError) as caught:
        read_commands(path)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    "arguments",
    [
        ["drive"],
        ["drive", "no-such-course"],
        ["drive", "box", "--car", "no-such-car"],
        ["drive", "box", "--car", "missing.toml"],
        ["drive", "box", "--driver", "nobody"],
        ["drive", "box", "--driver", "missing.csv"],
        ["drive", "box", "--set", "battery.wear=2"],
        ["drive", "box", "--set", "battery.wear=nan"],
        ["drive", "box", "--set", "wear"],
        ["drive", "box", "--set", "wear=1"],
        ["drive", "box", "--battery", "1.5"],
        ["drive", "box", "--battery", "nan"],
        ["drive", "box", "--speed-mps", "fast"],
        ["drive", "box", "--dt", "0"],
        ["drive", "box", "--laps", "0"],
        ["drive", "ess", "--laps", "2"],
        ["drive", "/dev/zero"],
        ["drive", "box", "--driver", "endless.csv"],
        ["drive", "box", "--car", "endless.toml"],
        ["drive", "box", "--driver", "short.csv", "--speed-mps", "2"],
        ["list", "cars", "--car", "rx7"],
        ["completion", "ksh"],
        ["drive", "box", "--frobnicate"],
        ["fly", "box"],
        ["replay", "missing"],
        ["replay", "missing", "--initial", "vx_mps=2"],
        ["replay", "missing", "--compare"],
        ["replay", "short.csv", "--horizon", "1"],
        ["replay", "short.csv", "--compare", "--initial", "vx_mps=2"],
        ["import", "dart", "missing.csv", "--out", "somewhere"],
        ["import", "betamax", "missing.csv", "--out", "somewhere"],
    ],
)
def test_wrong_arguments_end_with_status_2_and_one_line(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("endless.toml", "endless.csv"):
        Path(name).symlink_to("/dev/zero")
    Path("short.csv").write_text(COMMANDS + "0,0,forward,0\n")
    before = set(tmp_path.iterdir())
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.strip().splitlines()) == 1
    assert printed.err.startswith("countersteer: ")
    assert set(tmp_path.iterdir()) == before


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 100), st.floats(-1, 1), st.floats(-1.5, 1.5)), min_size=1))
def test_commands_round_trip(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("commands") / "commands.csv"
    time, throttle, steering = (np.array(column) for column in zip(*sorted(rows), strict=True))
    lines = command_rows(time, throttle, steering)
    path.write_text(COMMANDS + "".join(",".join(line) + "\n" for line in lines))
    read = read_commands(path)
    np.testing.assert_array_equal(read["time_s"], time)
    np.testing.assert_array_equal(read["throttle"], throttle)
    np.testing.assert_allclose(read["steering"], steering, rtol=1e-15, atol=0)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1))
def test_tables_round_trip(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("table") / "table.csv"
    rows = column_rows([np.arange(len(values)), np.array(values)])
    path.write_text("time_s,value\n" + "".join(",".join(row) + "\n" for row in rows))
    np.testing.assert_array_equal(read_table(path, ("time_s",))["value"], np.array(values))


def test_a_line_that_was_cut_off_is_passed_over_and_said(tmp_path, caplog):
    path = tmp_path / "table.csv"
    path.write_text("time_s,x_m,y_m\n0,1,2\n0.1,1.5,2")
    assert len(read_table(path, ("time_s",))) == 2
    assert not caplog.messages
    path.write_text("time_s,x_m,y_m\n0,1,2\n0.1,1.5")
    assert len(read_table(path, ("time_s",))) == 1
    assert caplog.messages == [f"{path}: its last line, cut off in the middle, is passed over"]


def test_a_base_is_looked_for_beside_the_car_that_names_it(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "base.toml").write_text("base = 'rx7'\n[body]\nmass_kg = 1.9")
    (tmp_path / "mine" / "car.toml").write_text("base = '../base.toml'")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_car("../mine/car.toml").body.mass == 1.9
    assert load_car(str(tmp_path / "mine" / "car.toml")).body.mass == 1.9
    (tmp_path / "base.toml").write_text("base = 'elsewhere/../mine/car.toml'")
    with pytest.raises(InputError, match="base must name another car"):
        load_car("../mine/car.toml")


def test_what_is_too_large_is_refused(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text("#" * 2000)
    assert len(read_text(path, 0.002)) == 2000
    with pytest.raises(
        InputError, match=r"large\.toml: cannot be read: it is larger than 0\.001 MB"
    ):
        read_text(path, 0.001)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="it is not text"):
        read_text(path)


def made(out: Path | None, name: str) -> Path:
    with new_folder(out, name) as folder:
        return folder


def test_drives_at_once_get_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: made(None, "box"), range(40)))
    assert sorted(folders) == [Path("runs") / f"box-{i:03d}" for i in range(1, 41)]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        made(tmp_path / "file" / "run", "box")


def test_the_box_states_its_grip_speed():
    course = load_course("box")
    speed = grip_speed(course, load_car("rx7"))
    text = (Path(cli.__file__).parents[1] / "course" / "library" / "box.toml").read_text()
    assert f"{speed:.2f} m/s" in text


@pytest.mark.parametrize("name", courses())
def test_corridors_keep_their_width_and_the_line_its_distance(name):
    course = load_course(name)
    for distance in np.linspace(0.01, course.length - 0.01, 97):
        x, y, _ = place(course, float(distance))
        a, b = course.walls[:, :2] - [x, y], course.walls[:, 2:] - [x, y]
        along = (b - a) / np.hypot(*(b - a).T)[:, None]
        foot = np.clip(-np.sum(a * along, axis=1), 0, np.hypot(*(b - a).T))
        nearest = np.hypot(*(a + foot[:, None] * along).T).min()
        assert nearest == pytest.approx(course.width / 2)
        assert progress(course, np.array([x]), np.array([y]), float(distance))[0] == pytest.approx(
            distance
        )


def test_box_has_four_right_turns_and_closes():
    course = load_course("box")
    assert [math.degrees(t.angle) for t in course.turns] == [-90] * 4
    assert course.length == pytest.approx(12.0)
    assert len(course.turns_ahead(1)) == 4
    assert len(course.turns_ahead(3)) == 12


def test_every_parameter_is_declared_with_unit_range_and_meaning():
    found = parameters()
    assert len(found) > 80
    assert len({entry["path"] for entry in found}) == len(found)
    for entry in found:
        assert len(entry["meaning"]) > 5, entry
        if entry["choices"]:
            assert entry["default"] in entry["choices"]
        else:
            assert entry["low"] <= entry["default"] <= entry["high"]


@pytest.mark.parametrize("name", library())
def test_the_parameters_that_are_listed_make_the_car(name):
    """Each path and value, given to `--set`, leads from another car to this one."""
    car = load_car(name)
    other = next(other for other in library() if other != name)
    again = load_car(other, [f"{p['path']}={p['value']}" for p in parameters(car)])
    for one, two in zip(jax.tree.leaves(car), jax.tree.leaves(again), strict=True):
        assert one == pytest.approx(two, rel=1e-11)


def test_lists_tell_one_from_another_and_align(capsys):
    for what, count in (("cars", len(library())), ("courses", len(courses())), ("drivers", 4)):
        assert cli.main(["list", what]) == 0
        text = capsys.readouterr().out
        assert cli.main(["list", what, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)[what]
        assert len(found) == len(text.splitlines()) >= count
        assert all(len(line) > 30 for line in text.splitlines())
        # The second column starts at the same place in every line.
        width = max(len(item["name"]) for item in found)
        for item, line in zip(found, text.splitlines(), strict=True):
            assert line[: width + 2].rstrip() == item["name"]
            assert line[width + 2] != " "
    assert cli.main(["list", "cars", "--json"]) == 0
    (rx7,) = [c for c in json.loads(capsys.readouterr().out)["cars"] if c["name"] == "rx7"]
    assert (rx7["mass_kg"], rx7["wheelbase_m"], rx7["drive"]) == (1.6, 0.25, "4WD")
    assert rx7["description"]
    assert cli.main(["list", "parameters", "--car", "rx7", "--json"]) == 0
    listed = {p["path"]: p for p in json.loads(capsys.readouterr().out)["parameters"]}
    servo = listed["servo.limit_left_deg"]
    assert (servo["value"], servo["low"], servo["high"], servo["unit"]) == (28, 1, 65, "deg")
    assert listed["sensors.sonar.mounts.left.angle_deg"]["value"] == 90


def test_every_option_has_help():
    for action in every_action(cli.parser()):
        assert action.help or action.dest == "verb", action


BASH = """
source completion
COMP_WORDS=("${@:1}") COMP_CWORD=$(($# - 1))
_countersteer_complete 2> /dev/null  # compopt: no line is being completed
echo "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def completions(tmp_path_factory):
    """What bash offers for the last word of a command."""
    folder = tmp_path_factory.mktemp("completion")
    (folder / "completion").write_text(script(cli.parser(), "bash", DRIVERS))
    (folder / "my car.toml").write_text("")

    def offered(*words: str) -> str:
        done = subprocess.run(
            ["bash", "-c", BASH, "bash", "countersteer", *words],
            cwd=folder, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert not done.stderr
        return done.stdout.strip()

    return offered


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("dr",), "drive"),
        (("drive", "e"), "ess"),
        (("drive", "box", "--lap"), "--laps"),
        (("drive", "box", "--car", "rx"), "rx7"),
        (("drive", "box", "--car", "my"), "my car.toml"),
        (("drive", "box", "--driver", "str"), "straighten"),
        (("drive", "box", "--link", ""), "onboard radio"),
        (("drive", "box", "--set", "servo.limit_l"), "servo.limit_left_deg="),
        (("list", "para"), "parameters"),
        (("trials", "tu"), "turns"),
        (("trials", "turns", "--car", "rx"), "rx7"),
        (("replay", "comp"), "completion"),
    ],
)
def test_bash_completes(words, offered, completions):
    assert completions(*words) == offered


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_take_their_script(shell, tmp_path):
    text = script(cli.parser(), shell, DRIVERS)
    for word in ("drive", "estimate", "rx7", "box", "drift-turn", "battery.wear="):
        assert word in text
    if shutil.which(shell):
        (tmp_path / "script").write_text(text)
        subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)


def test_a_run_that_is_there_is_moved_aside(tmp_path, capsys):
    commands = tmp_path / "commands.csv"
    commands.write_text(COMMANDS + "0,0.3,forward,0\n0.2,0,forward,0\n")
    out = tmp_path / "run"
    for _ in range(2):
        assert cli.main(["replay", str(commands), "--out", str(out), "--json"]) == 0
    assert read_run(out).truth is not None
    assert read_run(tmp_path / "run.1").truth is not None
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious.txt").write_text("x")
    assert cli.main(["replay", str(commands), "--out", str(other)]) == 2
    assert "not a run" in capsys.readouterr().err


def start(tmp_path: Path, *arguments: str, **options: object) -> subprocess.Popen:
    """The command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "countersteer", *arguments],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def test_an_interrupt_leaves_files_that_read(tmp_path):
    out = tmp_path / "run"
    process = start(tmp_path, "drive", "box", "--laps", "500", "--out", str(out), "--json")
    table = out / "truth.csv"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (table.exists() and table.stat().st_size > 1000):
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    run = read_run(out)
    assert len(run.truth) > 10
    assert json.loads((out / "summary.json").read_text())["outcome"] == "interrupted"


def test_a_full_disk_is_one_line_and_what_was_written_reads(tmp_path):
    """Files may grow to 200 kB: the limit stands in for the disk."""
    out = tmp_path / "run"
    process = start(
        tmp_path,
        "drive",
        "box",
        "--laps",
        "50",
        "--out",
        str(out),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)),
        # Python would leave a module cut off that it compiles under such a limit.
        env={
            "PATH": "",
            "JAX_ENABLE_COMPILATION_CACHE": "false",
            "PYTHONDONTWRITEBYTECODE": "1",
        },
    )
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 1
    assert len(errors.strip().splitlines()) == 1
    assert "too large" in errors or "space" in errors
    assert len(read_run(out).truth) > 10


def test_the_package_runs_as_a_module(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "countersteer", "list", "cars"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "rx7" in done.stdout


def test_help_comes_without_loading_the_physics():
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import sys, countersteer.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: pass\n"
            "print(sorted(m for m in sys.modules if m in ('jax', 'numpy', 'matplotlib', 'shtab')))",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip().endswith("[]")


def test_rounded_corners_join_their_straights_on_one_circle(tmp_path):
    path = tmp_path / "round.toml"
    path.write_text(
        "width_m = 1.2\nclosed = true\nsegments = ["
        + "{straight_m = 4.0}, {turn_deg = -90.0, radius_m = 1.0}," * 4
        + "]"
    )
    course = load_course(str(path))
    assert course.length == pytest.approx(4 * (2 + math.pi / 2), rel=1e-3)
    assert [t.distance for t in course.turns] == pytest.approx(
        [2 + math.pi / 4 + i * (2 + math.pi / 2) for i in range(4)]
    )
    centres = np.array([[1, -1], [3, -1], [3, -3], [1, -3]])
    for side, radius in ((1.2 / 2, 1.6), (-1.2 / 2, 0.4)):
        half = len(course.walls) // 2
        ends = course.walls[:half, :2] if side > 0 else course.walls[half:, :2]
        away = np.hypot(*(ends[:, None] - centres[None]).transpose(2, 0, 1)).min(axis=1)
        np.testing.assert_allclose(away, radius, rtol=5e-3)  # chords of 5°, mitred


def test_the_cars_of_the_examples_load():
    paths = sorted((Path(__file__).parents[1] / "examples" / "dart").glob("*.toml"))
    assert len(paths) == 3
    cars = [load_car(str(path)) for path in paths]
    assert len({car.tires.front.friction for car in cars}) == 3
    assert len({car.body.mass for car in cars}) == 1


def test_frames_one_at_a_time_make_the_tables_of_frames_in_pieces(tmp_path):
    """A real car's recorder is fed as readings come; a simulation's by half seconds."""
    course, car = load_course("box"), load_car("rx7", ["sensors.lidar.beams=5"])
    record = driven(course, car, drift_turn(course, car), 0.4)
    whole = frames(record, len(record.tick))
    pace = Pace(0.001, 5, 5, True)
    for name, step in (("pieces", 100), ("single", 1)):
        (tmp_path / name).mkdir()
        with Recorder(tmp_path / name, {"car_name": "rx7"}, None, channels(car), pace) as recorder:
            for first in range(0, len(record.tick), step):
                recorder.record(jax.tree.map(lambda leaf, a=first, n=step: leaf[a : a + n], whole))
    for table in ("commands", "telemetry", "truth"):
        one, other = ((tmp_path / n / f"{table}.csv").read_text() for n in ("pieces", "single"))
        assert one == other
        assert len(one.splitlines()) > 50


def test_frames_of_a_car_with_a_clock_of_its_own_are_all_kept(tmp_path):
    """Every 9 to 11 ms, a millisecond after the readings were taken."""
    car = load_car("rx7")
    record = driven(
        None, car, Replay(times=np.zeros(1), commands=Command(np.ones(1), np.zeros(1))), 1.0
    )
    ticks = np.cumsum(np.random.default_rng(0).integers(9, 12, 90)) + 1
    whole = frames(record, len(record.tick))
    rows = jax.tree.map(lambda leaf: leaf[ticks], whole)._replace(fresh=np.ones(90, bool))
    rows = rows._replace(readings=jax.tree.map(lambda leaf: leaf[ticks - 1], whole.readings))
    with Recorder(tmp_path, {"car_name": "rx7"}, None, channels(car), Pace(0.001, 5, 5, True)) as r:
        for i in range(90):
            r.record(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], rows))
    table = read_table(tmp_path / "telemetry.csv", ("time_s",))
    assert len(table) == 90
    assert np.isfinite(table["gyro_radps"]).sum() == 90
    assert len(read_table(tmp_path / "truth.csv", ("time_s",))) == 90


def test_a_run_that_was_killed_still_has_a_page_and_a_picture(tmp_path):
    (tmp_path / "run").mkdir()
    course, car = load_course("straight"), load_car("rx7")
    write_run(tmp_path / "run", course, car, straighten(course, car), 1.0)
    (tmp_path / "run" / "summary.json").unlink()
    truth = tmp_path / "run" / "truth.csv"
    truth.write_text("\n".join(truth.read_text().splitlines()[:2]) + "\n")
    view = view_of(read_run(tmp_path / "run"))
    assert "not finished: the record ends at 0.00 s" in report_html(view)
    draw_picture(view, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("kind", "read"),
    [
        ("car", load_car),
        ("course", load_course),
        ("set", load_population),
        ("policy", load_policy),
    ],
)
def test_a_file_of_a_later_format_is_refused_in_one_line(tmp_path, kind, read):
    file = tmp_path / f"{kind}.toml"
    file.write_text("format = 2\n")
    with pytest.raises(InputError, match=r"format 2 is later than 1.*install a newer one") as error:
        read(str(file))
    assert str(file) in str(error.value)
    for value in ("0", "true", '"1"', "1.5"):
        file.write_text(f"format = {value}\n")
        with pytest.raises(InputError, match="format must be a whole number from 1 on"):
            read(str(file))


def test_every_toml_that_comes_with_the_package_or_that_it_writes_has_a_format(tmp_path):
    package = Path(countersteer.__file__).parent
    files = list(package.rglob("library/*.toml"))
    save_car(load_car("rx7"), tmp_path / "car.toml", {"all": "a test"})
    save_policy(tmp_path / "policy.toml", {"all": "a test"}, library_policy().turning)
    (tmp_path / "run").mkdir()
    headers = {"commands": tuple(COMMANDS.strip().split(","))}
    with Recorder(tmp_path / "run", {"title": "a run"}, headers):
        files += [*tmp_path.glob("*.toml"), tmp_path / "run" / "run.toml"]
    assert len(files) > 12
    for file in files:
        assert tomllib.loads(file.read_text())["format"] == 1, file
        assert "format" not in tables_of(file.read_text(), str(file))
