"""Files that are damaged, hostile or of another kind: read right, or refused in one line."""

import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from countersteer import cli
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.policy import load_policy
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.reading.content import read_bytes, reading
from countersteer.reading.values import number, shown, whole
from countersteer.runs.defects import find_defects
from countersteer.runs.files import read_commands
from countersteer.runs.importers.dart import import_dart
from countersteer.runs.importers.eth import import_eth
from countersteer.runs.run import read_run
from countersteer.tuning.fit import halves
from countersteer.viewing.view import known_rows
from studies.fuzz_files import Finding, TooSlowError, fuzz, limited, tried
from studies.fuzz_inputs import Format, dart, eth, formats, picture, run_folder
from studies.fuzz_mutations import archive_changed

CASES = Path(__file__).parents[2] / "shared" / "cases"
KNOWN = formats()
LONG, DEEP = "9" * 5000, "[" * 5000
WALLS = "walls_m = [[[0, 0], [1, 1]]]\n"
CORRIDOR = "width_m = 1\nsegments = [{straight_m = 2}]\n"
MAP = "image: map.png\nresolution: 0.05\norigin: [-3, -1, 0]\n"


def load_driver(name: str):
    return make_driver(name, load_course("box"), load_car("rx7"), None, 1, read_commands)


READERS = {
    "car": load_car,
    "course": load_course,
    "policy": load_policy,
    "driver": load_driver,
    "set": load_population,
}


def refusal(read, *given: object) -> str:
    """The message of the refusal: one short line, within a second of work."""
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        read(*given)
    text = str(caught.value)
    assert time.process_time() - begin < 1
    assert text.isprintable(), text
    assert len(text) < 600
    return text


# -------------------------------------------------------------------------------------------------
# Documents
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "text", "says"),
    [
        ("car", f"[body]\nmass_kg = {LONG}", "a number or a date is too large"),
        ("car", f"[body]\nmass_kg = {LONG[:400]}", "mass_kg = a whole number of some 400 digits"),
        ("car", "[body]\nmass_kg = 0x" + "f" * 9000, "a whole number of some 10837 digits"),
        ("car", f"a = {DEEP}", "nested too deeply"),
        ("car", "a." * 5000 + "b = 1", "nested too deeply"),
        ("car", "a.b." * 20 + "c = 1", "nested too deeply"),
        ("car", 'base = "a\\u0000b.toml"', "base must be a name or a path, not 'a\\x00b.toml'"),
        ("car", f'base = "{"x" * 900}.toml"', "base must be a name or a path, not 'xxxx"),
        ("car", "base = ['rx7']", "base must be a name or a path, not ['rx7']"),
        ("car", "base = '.'", "no car ."),
        ("car", '"a\\nb" = 1', "unknown key a\\nb"),
        ("car", f"{'x' * 9000} = 1", "unknown key xxxxxxxxxx"),
        ("car", "[tires.front]\nlaw = ['brush']", "tires.front.law must be one of"),
        ("car", '[sensors.sonar.mounts."a,b"]\nx_m = 0.1', "a mount's name has"),
        ("car", "mass = 2001-02-31", "not valid TOML"),
        (
            "course",
            f"width_m = {LONG[:400]}\nsegments = [{{straight_m = 1}}]",
            "not a whole number",
        ),
        ("course", "width_m = nan\nsegments = [{straight_m = 1}]", "width_m must be a number in"),
        ("course", f"{CORRIDOR}name = 'a\\u0000b'".replace("'", '"'), "name must be a text of at"),
        ("course", f"{CORRIDOR}name = '{'x' * 101}'", "name must be a text of at most 100"),
        ("course", f"{CORRIDOR}closed = 1", "closed must be true or false, not 1"),
        ("course", f"{WALLS}start = {{x_m = 1e400}}", "start.x_m must be a number"),
        ("course", "width_m = 1\nsegments = [" + "{straight_m = 1}," * 501 + "]", "501 segments"),
        ("course", "walls_m = [[" + "[0, 1]," * 8200 + "]]", "over 8192 pieces of wall"),
        (
            "policy",
            'kind = "drift-turn"\n[turning]\nspeed_mps = [nan]',
            "speed_mps[0] = nan is",
        ),
        ("policy", 'kind = "drift-turn"\ncar = 3\n[turning]', "car must be a text"),
        (
            "policy",
            'kind = "drift-turn"\n[turning]\n[source]\na = 0xfff',
            "source.a must be",
        ),
        ("driver", "kind = 0x" + "f" * 9000, "kind must be one of drift-turn, plan, not a whole"),
        ("driver", "kind = ['plan']", "kind must be one of drift-turn, plan, not ['plan']"),
        ("driver", 'kind = "plan"\n[[policy]]\ndoes = ["drift"]', "does must be one of"),
        (
            "driver",
            'kind = "plan"\n[[policy]]\ndoes = "curve"\nspeed_mps = true',
            "speed_mps must be",
        ),
        (
            "driver",
            'kind = "plan"\n[[policy]]\ndoes = "commands"\ncommands = "\\u0000"',
            "commands must be a name or a path",
        ),
        ("set", "vary = 3", "vary must be a table"),
        ("set", "start = [1]", "start must be a table"),
        ("set", '[vary]\n"body.mass_kg" = {within = inf}', "body.mass_kg.within must be a number"),
        ("set", "[start]\ncharge = [0, true]", "start.charge must be a number in [0, 1], not True"),
    ],
)
def test_a_wrong_toml_file_is_refused(tmp_path, kind, text, says):
    path = tmp_path / "file.toml"
    path.write_text(text)
    assert says in refusal(READERS[kind], str(path))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: &a [x]\nb: *a\n", "anchors and aliases are not read"),
        ("<<: {image: map.png}\n", "not valid YAML"),
        ("a: &a [*a]\n", "anchors and aliases are not read"),
        (f"a: {DEEP}", "nested too deeply"),
        (f"a: {LONG}\n", "a number or a date is too large"),
        ("a: 2001-02-31\n", "a number or a date is too large"),
        ("a: !!python/object/apply:os.getcwd []\n", "not valid YAML"),
        ("- a\n", "it has no keys"),
        (f"resolution: {LONG[:400]}\nimage: map.png\norigin: [0, 0, 0]\n", "resolution must be a"),
        (
            "resolution: 0.05\nimage: [map.png]\norigin: [0, 0, 0]\n",
            "image must be a name or a path",
        ),
        ('resolution: 1\nimage: "a\\0b"\norigin: [0, 0, 0]\n', "image must be a name or a path"),
        ("resolution: .nan\nimage: map.png\norigin: [0, 0, 0]\n", "resolution must be a number"),
        (MAP + "x: 1\n" * 30_000, "larger than 0.1 MB"),
    ],
)
def test_a_wrong_map_is_refused(tmp_path, text, says):
    (tmp_path / "map.png").write_bytes(picture())
    (tmp_path / "m.yaml").write_text(text)
    assert says in refusal(load_course, str(tmp_path / "m.yaml"))


def test_a_bomb_of_aliases_and_one_of_merge_keys_end_at_once(tmp_path):
    aliases = "a0: &a0 [x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30)
    )
    merges = "m0: &m0 {a: 1}\n" + "".join(
        f"m{i}: &m{i}\n  <<: [{', '.join([f'*m{i - 1}'] * 9)}]\n" for i in range(1, 30)
    )
    for text in (aliases, merges):
        (tmp_path / "m.yaml").write_text(text + "image: *a29\n")
        assert "anchors and aliases" in refusal(load_course, str(tmp_path / "m.yaml"))


def test_numbers_of_maps_may_be_written_as_yaml_1_2_has_them(tmp_path):
    (tmp_path / "map.png").write_bytes(picture())
    for text in ("5e-2", "0.05", "5.0E-2", ".5e-1"):
        (tmp_path / "m.yaml").write_text(MAP.replace("0.05", text))
        assert load_course(str(tmp_path / "m.yaml")).closed


# -------------------------------------------------------------------------------------------------
# A run's folder
# -------------------------------------------------------------------------------------------------


def run_with(folder: Path, changes: dict[str, str]) -> Path:
    """A run with texts in place of its files."""
    folder.mkdir()
    for name, content in run_folder().items():
        (folder / name).write_bytes(content)
    for name, text in changes.items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("battery_charge = 'full'", "battery_charge must be a number in [0, 1], not 'full'"),
        ("battery_charge = 7", "battery_charge must be a number in [0, 1], not 7"),
        ("battery_charge = nan", "battery_charge must be a number in [0, 1], not nan"),
        ("initial = 3", "initial must be a table, not 3"),
        ("initial = {vx_mps = '1'}", "initial.vx_mps must be a number"),
        ("start = {x_m = 0, y_m = 0}", "start.heading_rad is missing"),
        ("start = {x_m = inf, y_m = 0, heading_rad = 0}", "start.x_m must be a number"),
        ("laps = 0.5", "laps must be a whole number in [1, 1000], not 0.5"),
        ("seed = 0x" + "f" * 9000, "seed must be a whole number"),
        ("car_name = ['rx7']", "car_name must be a printable text"),
        ("precision_bits = 16", "precision_bits must be 32 or 64, not 16"),
        ("velocity_lag_s = 'x'", "velocity_lag_s must be a number"),
        ("line_spacing_m = 0", "line_spacing_m must be a number"),
        ("sensors = {encoder = 3}", "sensors.encoder must be a table"),
        ("sensors = {gyroscope = {lag_s = nan}}", "sensors.gyroscope.lag_s must be a number"),
        ("link = 'radio'", "link must be a table"),
        ("rates = {dt_s = 0}", "rates.dt_s must be a number in [1e-05, 0.02], not 0"),
        ("floor = {waves = []}", "floor.amplitude is missing"),
        ("floor = {amplitude = 0, waves = [{}]}", "floor.waves[0].x_radpm is missing"),
        ("course = 3", "course must be a table"),
        ("course = {walls_m = [[0, 0, 1]]}", "course.walls_m[0] must be a list of 4"),
        ("course = {walls_m = [[0, 0, 1, true]]}", "course.walls_m[0][3] must be a number"),
        ("course = {turns = [{distance_m = 1}]}", "course.turns[0].turn_deg is missing"),
        ("pilot = []", "pilot must be a table"),
        ("car = 3", "car must be a table"),
        ("format = 2", "is later than 1"),
    ],
)
def test_a_wrong_key_of_run_toml_is_named(tmp_path, text, says):
    refused_in_a_run(tmp_path / "run", "run.toml", text, says)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 100_000, "nested too deeply"),
        ('{"a": ' + "[" * 40 + "]" * 40 + "}", "nested too deeply"),
        (f'{{"a": {LONG}}}', "a number is too large"),
        ("[]", "must hold one JSON object"),
        ('{"turns": 3}', "turns must be a list, not 3"),
        ('{"turns": [{"begin_s": 0}]}', "turns[0].end_s is missing"),
        ('{"turns": [{"begin_s": 0, "end_s": NaN}]}', "turns[0].end_s must be a number"),
        ('{"wall_contacts": "3"}', "wall_contacts must be a whole number"),
        ('{"lap_time_s": "fast"}', "lap_time_s must be a number"),
        ('{"success": 1}', "success must be true or false"),
    ],
)
def test_a_wrong_summary_is_refused(tmp_path, text, says):
    refused_in_a_run(tmp_path / "run", "summary.json", text, says)


def refused_in_a_run(folder, name, text, says):
    told = refusal(read_run, run_with(folder, {name: text}))
    assert f"{folder}/{name}: " in told
    assert says in told


def test_unknown_keys_are_passed_over_and_old_imports_read(tmp_path):
    text = 'format = "dart"\ncar_name = "jetracer"\nanything = {goes = [1]}\n'
    run = read_run(run_with(tmp_path / "run", {"run.toml": text, "summary.json": '{"x": NaN}'}))
    assert run.about["log_format"] == "dart"
    assert run.about["anything"] == {"goes": [1]}
    assert run.summary == {"x": None}


@pytest.mark.parametrize("verb", ["replay", "compare", "tune", "turns", "export"])
@pytest.mark.parametrize("table", ["commands.csv", "telemetry.csv", "truth.csv"])
def test_a_clock_of_unix_time_is_refused_by_every_verb(tmp_path, capsys, verb, table):
    run, out = run_with(tmp_path / "run", {}), tmp_path / "out"
    lines = (run / table).read_text().splitlines()
    late = [
        f"{1.7e9 + float(t):.3f},{rest}" for t, _, rest in (x.partition(",") for x in lines[1:])
    ]
    (run / table).write_text("\n".join([lines[0], *late, ""]))
    arguments = {
        "replay": ["replay", str(run), "--out", str(out)],
        "compare": ["replay", str(run), "--compare", "--out", str(out)],
        "tune": ["tune", str(run), "--out", str(out / "car.toml")],
        "turns": ["trials", "turns", "--from", str(run), "--out", str(out)],
        "export": ["export", str(run), "--gif", str(tmp_path / "out.gif")],
    }[verb]
    assert cli.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{table}, line 2: time_s must be within 1e+06 s of 0, not 1700000000" in line
    assert not out.exists() or not any(out.iterdir())


def test_a_log_of_hours_is_not_simulated_at_each_instant(tmp_path, capsys):
    run = run_with(tmp_path / "run", {})
    with (run / "commands.csv").open("a") as file:
        file.write("900000,0,forward,0\n")
    for arguments in (["replay", str(run), "--compare"], ["tune", str(run), "--out", "c.toml"]):
        assert cli.main(arguments) == 2
        assert "goes on to 900000 s, over 3600 s" in capsys.readouterr().err


def test_a_run_without_a_stopped_turn_is_refused_before_anything_is_written(tmp_path, capsys):
    still = "time_s,throttle,direction,steering_deg\n0,0,forward,0\n3,0,forward,0\n"
    run = run_with(tmp_path / "run", {"commands.csv": still})
    for arguments in (
        ["trials", "turns", "--from", str(run)],
        ["experiment", "stop-time", "--from", str(run)],
    ):
        assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
        assert not (tmp_path / "out").exists()


def test_rows_that_are_no_numbers_are_not_drawn(tmp_path):
    run = read_run(run_with(tmp_path / "run", {}))
    for name, value in (("x_m", np.nan), ("vx_mps", np.inf), ("wheel_fl_radps", 1e15)):
        run.truth[name][3] = value
        assert len(known_rows(run)) == len(run.truth) - 1
        run.truth[name][3] = 0.0
    run.truth["y_m"][:] = np.nan
    assert "holds no row" in refusal(known_rows, run)


@pytest.mark.parametrize("count", range(1, 20))
def test_each_half_of_a_fit_has_windows(count):
    """One window has no halves."""
    half = halves(np.zeros(count, int))
    assert len(half) == count
    assert set(half.tolist()) == ({0} if count == 1 else {0, 1})


# -------------------------------------------------------------------------------------------------
# Tables, arrays, imports
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["\n", "\r\n\r\n", "  \n\n", "\r\n \r\n"])
def test_blank_lines_at_the_end_are_passed_over(tmp_path, end):
    log = tmp_path / "log.csv"
    log.write_bytes(dart() + end.encode())
    (tmp_path / "plain.csv").write_bytes(dart())
    found, plain = (import_dart(p, tmp_path / "out") for p in (log, tmp_path / "plain.csv"))
    assert found["rows"] == plain["rows"]
    commands = tmp_path / "commands.csv"
    commands.write_text("time_s,throttle,direction,steering_deg\n0,0,forward,0\n" + end)
    assert len(read_commands(commands)) == 1


@pytest.mark.parametrize(("form", "good", "suffix"), [("dart", dart, "csv"), ("eth", eth, "npz")])
def test_a_bad_log_does_not_keep_the_others_from_being_imported(
    tmp_path, capsys, form, good, suffix
):
    files = [tmp_path / f"{name}.{suffix}" for name in ("first", "bad", "last")]
    for file in files:
        file.write_bytes(good() if file.stem != "bad" else b"PK\x05\x06 nothing")
    arguments = ["import", form, *map(str, files), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert [line.split()[0] for line in printed.out.splitlines()] == [f.name for f in files[::2]]
    (line,) = printed.err.splitlines()
    assert line.startswith(f"countersteer: {files[1]}: ")
    for name in ("first", "last"):
        assert len(read_run(tmp_path / "out" / name).commands) > 10
    assert cli.main([*arguments, "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert [Path(run["run"]).name for run in told["runs"]] == ["first", "last"]
    assert [one["file"] for one in told["failed"]] == [str(files[1])]


def test_a_number_of_any_length_in_a_table_is_a_number_or_refused(tmp_path):
    path = tmp_path / "commands.csv"
    path.write_text(f"time_s,throttle,direction,steering_deg\n0,{LONG},forward,0\n")
    assert "throttle must be in [0, 1]" in refusal(read_commands, path)
    path.write_text(f"time_s,throttle,direction,steering_deg\n0,0,forward,{'x' * 9000}\n")
    assert "steering_deg must be a number, not 'xxx" in refusal(read_commands, path)
    path.write_text(f"time_s,throttle,direction,steering_deg\n0,0,forward,{'x' * 200_000}\n")
    assert "no CSV file" in refusal(read_commands, path)


def npz(tmp_path: Path, **arrays: np.ndarray) -> Path:
    np.savez(tmp_path / "log.npz", **arrays)
    return tmp_path / "log.npz"


def test_the_least_integer_is_no_action(tmp_path):
    action = np.zeros((20, 2), np.int64)
    action[4, 1] = np.iinfo(np.int64).min  # its magnitude is no int64
    log = npz(tmp_path, obs=np.zeros((20, 12)), action=action)
    assert "row 4 (0.13 s): action must be in [-1, 1]" in refusal(import_eth, log, tmp_path / "out")


@pytest.mark.parametrize(
    ("header", "says"),
    [
        ("'<f8', 'fortran_order': False, 'shape': (99999999999999, 12)", "is not that of its data"),
        ("'<f8', 'fortran_order': False, 'shape': (-40, -12)", "is not that of its data"),
        ("'<f8', 'fortran_order': False, 'shape': (41, 12)", "is not that of its data"),
        (f"'<f8', 'fortran_order': False, 'shape': ({LONG},)", "no .npz file of numbers"),
        ("'|O', 'fortran_order': False, 'shape': (480,)", "no .npz file of numbers"),
        ("'<f8', 'fortran_order': False, 'shape': ((((", "no .npz file of numbers"),
        ("'<V96', 'fortran_order': False, 'shape': (40,)", "'obs' must be numbers"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path, header, says):
    import zipfile

    obs, text = np.zeros((40, 12)), f"{{'descr': {header}, }}\n".encode()
    data = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + obs.tobytes()
    log = npz(tmp_path, action=np.zeros((40, 2)))
    with zipfile.ZipFile(log, "a") as packed:
        packed.writestr("obs.npy", data)
    assert says in refusal(import_eth, log, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("at", "value", "says"),
    [(8, 1, "it is encrypted"), (10, 99, "another method"), (10, 12, "another method")],
)
def test_a_member_of_another_kind_is_refused(tmp_path, at, value, says):
    content = bytearray(eth())
    content[content.index(b"PK\x01\x02") + at] = value
    (tmp_path / "log.npz").write_bytes(content)
    assert says in refusal(import_eth, tmp_path / "log.npz", tmp_path / "out")


def test_what_unpacks_to_too_much_and_what_is_there_twice_is_refused(tmp_path):
    import zipfile

    log = tmp_path / "log.npz"
    with zipfile.ZipFile(log, "w", zipfile.ZIP_DEFLATED) as packed:
        for i in range(6):
            packed.writestr(f"a{i}.npy", bytes(50_000_000))
    assert "holds more than 256 MB" in refusal(import_eth, log, tmp_path / "out")
    with zipfile.ZipFile(log, "w") as packed:
        for i in range(2000):
            packed.writestr(f"a{i}.npy", b"")
    assert "too many members" in refusal(import_eth, log, tmp_path / "out")
    with zipfile.ZipFile(log, "w") as packed:
        packed.writestr("obs.npy", b"")
        packed.writestr("obs", b"")
    assert "an array twice" in refusal(import_eth, log, tmp_path / "out")


# -------------------------------------------------------------------------------------------------
# Kinds of files
# -------------------------------------------------------------------------------------------------

NODES = {"endless": "no regular file", "pipe": "no regular file", "folder": "a folder"}


def place(path: Path, node: str) -> None:
    if node == "endless":
        path.symlink_to("/dev/zero")
    elif node == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("name", KNOWN)
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, name, node):
    one = KNOWN[name]
    for target in one.targets:
        folder = tmp_path / target
        folder.mkdir()
        for file, content in one.files.items():
            (folder / file).write_bytes(content)
        (folder / target).unlink()
        place(folder / target, node)
        assert NODES[node] in refusal(one.read, folder) or (name, node) == ("turns", "folder")


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "large.csv"
    with path.open("wb") as file:
        file.truncate(10**12)  # a hole: it takes no room
    assert "larger than 256 MB" in refusal(read_bytes, path)


def test_free_walls_are_refused_by_drivers_of_corridors(tmp_path, capsys):
    walls = tmp_path / "w.toml"
    walls.write_text(WALLS)
    for driver in ("drift-turn", "straighten", "pursuit"):
        assert cli.main(["drive", str(walls), "--driver", driver]) == 2
        assert "free walls have no centre line" in capsys.readouterr().err


# -------------------------------------------------------------------------------------------------
# Values, and the net
# -------------------------------------------------------------------------------------------------


def test_what_is_shown_is_short_whatever_it_is():
    loop: list = []
    loop.append(loop)
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    for value in (loop, deep, 10**5000, -(10**5000), "x" * 10**6, ["y" * 999] * 999, {1: loop}):
        assert len(shown(value)) <= 80
        assert shown(value).isprintable()
    assert shown("a\0b\nc\x1b[2J") == "'a\\x00b\\nc\\x1b[2J'"
    assert shown(10**5000) == "a whole number of some 5000 digits"
    assert shown({"a": [1, 2.5, None]}) == "{'a': [1, 2.5, None]}"


@pytest.mark.parametrize("value", [True, "1", None, [], float("nan"), 10**400, -(10**400), 1.1])
def test_what_is_no_number_within_the_range_is_refused(value):
    assert "f: k must be a number in [0, 1], not " in refusal(number, value, "f: k", 0, 1)
    assert "f: k must be a whole number in [0, 1], not " in refusal(whole, value, "f: k", 0, 1)


def test_the_net_catches_what_readers_did_not_foresee_and_nothing_else():
    def fails(error: BaseException) -> None:
        with reading("file"):
            raise error

    cause = ZeroDivisionError("x" * 999)
    with pytest.raises(InputError, match=r"^file: cannot be read: ZeroDivisionError: x") as caught:
        fails(cause)
    assert caught.value.__cause__ is cause
    assert len(str(caught.value)) < 150
    assert refusal(fails, RecursionError()) == "file: cannot be read: it is nested too deeply"
    assert refusal(fails, OSError(2, "No such file")) == "file: cannot be read: No such file"
    with pytest.raises(KeyboardInterrupt):
        fails(KeyboardInterrupt())


# -------------------------------------------------------------------------------------------------
# The fuzzer, and cases
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KNOWN)
def test_the_fuzzer_begins_with_files_that_read(tmp_path, name):
    for file, content in KNOWN[name].files.items():
        (tmp_path / file).write_bytes(content)
    KNOWN[name].read(tmp_path)


def test_mutated_files_are_read_or_refused_in_one_line():
    counts, found = fuzz([*KNOWN.values()], seed=1, count=26 * len(KNOWN), out=None)
    assert not found
    assert sum(counts.values()) == 26 * len(KNOWN)
    assert sum(n for (_, kind), n in counts.items() if kind == "read") > len(KNOWN)
    assert sum(n for (_, kind), n in counts.items() if kind == "refused") > 10 * len(KNOWN)


def test_the_fuzzer_finds_a_bug_and_makes_its_file_small(tmp_path):
    def read(folder: Path) -> None:
        content = (folder / "f.csv").read_bytes()
        if len(content.splitlines()) > 3 and b"7" in content:
            raise ZeroDivisionError
        raise InputError("refused")

    lines = b"".join(b"%d\n" % i for i in range(40))
    one = Format("lines", {"f.csv": lines}, ("f.csv",), read)
    counts, found = fuzz([one], seed=0, count=30, out=tmp_path)
    assert counts["lines", "found"] > 5
    assert ["ZeroDivisionError" in what for what in found] == [True]
    (case,) = tmp_path.iterdir()
    assert "ZeroDivisionError" in (case / "EXPECTED.txt").read_text()
    assert len((case / "f.csv").read_bytes()) < 20


def test_the_fuzzer_ends_what_does_not_end_and_sees_long_messages(tmp_path):
    def endless() -> None:
        with limited(0.05):
            while True:
                pass

    with pytest.raises(TooSlowError):
        endless()

    def long(_: Path) -> None:
        raise InputError("x" * 500)

    assert isinstance(tried(Format("long", {}, (), long), tmp_path), Finding)


def test_mutated_archives_are_still_archives_mostly():
    from random import Random

    changed = [archive_changed(Random(i), eth()) for i in range(40)]
    assert sum(content.startswith(b"PK") for content in changed) > 30
    assert len(set(changed)) > 25


RIGHT = {
    "bad-base-nul": (["list", "parameters", "--car", "c.toml"], 2, "base"),
    "bad-drive-free-walls": (["drive", "w.toml"], 2, "centre line"),
    "bad-eth-header": (["import", "eth", "l.npz", "--out", "OUT"], 2, "l.npz"),
    "bad-eth-int64-min": (
        ["import", "eth", "l.npz", "--out", "OUT"],
        2,
        "action must be in [-1, 1]",
    ),
    "bad-eth-method": (["import", "eth", "l.npz", "--out", "OUT"], 2, "method"),
    "bad-eth-shape-huge": (["import", "eth", "l.npz", "--out", "OUT"], 2, "shape"),
    "bad-eth-shape-lie": (["import", "eth", "l.npz", "--out", "OUT"], 2, "shape"),
    "bad-run-charge-range": (["replay", ".", "--out", "OUT"], 2, "run.toml: battery_charge"),
    "bad-run-charge-text": (["replay", ".", "--out", "OUT"], 2, "run.toml: battery_charge"),
    "bad-run-initial-type": (["replay", ".", "--out", "OUT"], 2, "run.toml: initial"),
    "bad-toml-big-int": (["list", "parameters", "--car", "c.toml"], 2, "body.mass_kg"),
    "bad-toml-long-int": (["list", "parameters", "--car", "c.toml"], 2, "too large"),
    "bad-yaml-alias-bomb": (["drive", "m.yaml"], 2, "aliases"),
    "bad-yaml-merge-bomb": (["drive", "m.yaml"], 2, "aliases"),
    "waypoints-x-y-yaw-speed": (["drive", "waypoints.csv"], 2, "is the heading of the line"),
    "dart-blank-last-line": (["import", "dart", "log.csv", "good.csv", "--out", "OUT"], 0, ""),
    "speed-commanded": (["replay", "commands.csv", "--out", "OUT"], 2, "column speed_mps"),
    "own-log-gyro-degps": (["replay", ".", "--compare", "--out", "OUT"], 2, "in degrees"),
    "own-log-epoch": (["replay", ".", "--compare", "--out", "OUT"], 2, "Unix time"),
}


@pytest.mark.skipif(not CASES.is_dir(), reason="the cases are not here")
def test_rows_of_one_topic_are_as_good_as_one_row():
    topics = read_run(CASES / "telemetry-row-a-topic")
    rows = read_run(CASES / "telemetry-row-a-topic" / "same-in-one-row")
    for name, column in rows.telemetry.items():
        np.testing.assert_array_equal(topics.telemetry[name], column)
    assert find_defects(topics) == find_defects(rows) == []


@pytest.mark.skipif(not CASES.is_dir(), reason="the cases are not here")
@pytest.mark.parametrize("name", RIGHT)
def test_cases_of_others(tmp_path, monkeypatch, capsys, name):
    arguments, status, says = RIGHT[name]
    shutil.copytree(CASES / name, tmp_path / name)
    monkeypatch.chdir(tmp_path / name)
    out = str(tmp_path / "out")
    assert cli.main([out if word == "OUT" else word for word in arguments]) == status
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == (1 if status else 0)
    assert says in "".join(errors)
