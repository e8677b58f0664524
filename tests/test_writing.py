"""Nothing is lost: results are written whole or not at all, by one process at a time."""

import errno
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from jax._src import lru_cache

from countersteer import writing
from countersteer.cache import cache_folder
from countersteer.car.files import car_tables, load_car, save_car
from countersteer.cli import DONE, FAILED, WRONG_INPUT, main
from countersteer.drivers.policy import library, save_policy
from countersteer.errors import InputError
from countersteer.progress import Progress, _Wait
from countersteer.runs.files import COMMANDS, csv_text, read_table, write_table
from countersteer.runs.recorder import Recorder, new_folder, whole_folder
from countersteer.runs.run import read_run
from countersteer.viewing.view import COLUMNS
from countersteer.writing import BusyError, alone, whole, write_together, write_whole
from studies.kills import kills, prepare

TRUTH = ("time_s", "x_m", "y_m", "heading_rad", *COLUMNS)
COUNT = 40  # rows of a run


def record(folder: Path, truth: tuple[str, ...] = TRUTH, **about: object) -> Path:
    """A run's folder without a summary, as a kill leaves it: a straight on at 1 m/s."""
    folder.mkdir(exist_ok=True)
    time = 0.005 * np.arange(COUNT)
    columns = {name: np.zeros(COUNT) + 1e-5 for name in truth}
    columns |= {"time_s": time, "x_m": time}
    commands = (time, np.linspace(0.1, 0.9, COUNT), np.radians(np.linspace(-25, 25, COUNT)))
    headers = {"commands": COMMANDS, "telemetry": ("time_s", "sonar_left_m"), "truth": truth}
    about = {"car": car_tables(load_car("rx7")), "driver": "none", **about}
    with Recorder(folder, about, headers) as recorder:
        echoes = (time, np.where(np.arange(COUNT) % 3, np.inf, 1.25))
        recorder.write({"commands": commands, "telemetry": echoes, "truth": [*columns.values()]})
    return folder


def fail(number):
    raise OSError(number, os.strerror(number))


def full_disk(monkeypatch):
    """No file reaches the disk."""
    monkeypatch.setattr(os, "fsync", lambda _: fail(errno.ENOSPC))


def interrupted(file):
    with whole(file) as part:
        part.write_text("half")
        raise KeyboardInterrupt


def filling_the_disk(out):
    with whole_folder(out) as part:
        (part / "run.toml").write_text("half")
        fail(errno.ENOSPC)


# Files


def test_a_file_is_replaced_whole(tmp_path):
    file = tmp_path / "car.toml"
    for text in ("one", "größer"):
        write_whole(file, text)
        assert file.read_text(encoding="utf-8") == text
    with whole(file) as part:
        assert part.name.startswith(".")
        assert str(os.getpid()) in part.name
        part.write_text("three")
        assert file.read_text(encoding="utf-8") == "größer"
    assert os.listdir(tmp_path) == ["car.toml"]
    assert file.read_text() == "three"


def test_an_error_leaves_the_file_before_and_names_it(tmp_path, monkeypatch):
    file = tmp_path / "car.toml"
    file.write_text("before")
    with pytest.raises(KeyboardInterrupt):
        interrupted(file)
    full_disk(monkeypatch)
    car, turning = load_car("rx7"), library().turning
    for write in (
        lambda: write_whole(file, "new"),
        lambda: save_car(car, file, {}),
        lambda: save_policy(file, {}, turning),
        lambda: write_table(file, {"x": np.zeros(3)}),
    ):
        with pytest.raises(OSError, match=r"No space.*car\.toml"):
            write()
        assert file.read_text() == "before"
        assert os.listdir(tmp_path) == ["car.toml"]


def test_files_that_belong_together_are_all_new_or_all_old(tmp_path, monkeypatch):
    files = [tmp_path / name for name in ("car.toml", "car.html", "car.json")]
    write_together(dict.fromkeys(files, "before"))
    missing = tmp_path / "none" / "a.toml"
    with pytest.raises(OSError, match="none'"):
        write_together(dict.fromkeys((*files, missing), "new"))
    assert [file.read_text() for file in files] == ["before"] * 3
    replaced = []
    monkeypatch.setattr(Path, "replace", lambda _, place: replaced.append(place.name))
    write_together(dict.fromkeys(files, "new"))
    assert replaced == ["car.json", "car.html", "car.toml"]  # the car last


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path):
    file, link = tmp_path / "car.toml", tmp_path / "link.toml"
    link.symlink_to(file)
    write_whole(link, "text")
    assert link.is_symlink()
    assert file.read_text() == "text"
    with pytest.raises(InputError, match="is not a file"):
        write_whole(Path(os.devnull), "text")


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path):
    file = tmp_path / "car.toml"
    file.write_text("before")
    code = (
        "import os, pathlib, signal, sys; from countersteer.writing import alone, whole\n"
        "file = pathlib.Path(sys.argv[1])\n"
        "with alone(file), whole(file) as part:\n"
        "    part.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(file)])
    assert done.returncode == -signal.SIGKILL
    assert file.read_text() == "before"
    assert len(os.listdir(tmp_path)) == 3  # part and lock
    living = tmp_path / f".car.toml.{os.getpid()}-999.part"
    living.write_text("of a process that is at work")
    with alone(file):
        write_whole(file, "new")
    assert sorted(os.listdir(tmp_path)) == [living.name, "car.toml"]


def test_long_names_are_no_harder(tmp_path):
    file = tmp_path / ("ä" * 120 + ".toml")
    with alone(file):
        write_whole(file, "text")
    assert file.read_text() == "text"


# Folders


def test_a_run_that_is_there_is_moved_to_the_next_free_number(tmp_path):
    out = tmp_path / "run"
    for number in range(3):
        with new_folder(out, "run") as folder:
            assert not os.listdir(folder)
            (folder / "run.toml").write_text(str(number))
    assert [(tmp_path / f"run{end}" / "run.toml").read_text() for end in (".1", ".2", "")] == [
        "0",
        "1",
        "2",
    ]
    assert sorted(os.listdir(tmp_path)) == ["run", "run.1", "run.2"]


def test_a_folder_that_is_written_at_once_appears_at_its_end(tmp_path):
    out = tmp_path / "logs" / "log"
    with whole_folder(out) as part:
        (part / "run.toml").write_text("one")
        assert not out.exists()
    with pytest.raises(OSError, match=f"No space.*{out}"):
        filling_the_disk(out)
    assert os.listdir(out.parent) == ["log"]
    with whole_folder(out) as part:
        (part / "run.toml").write_text("two")
    assert (out / "run.toml").read_text() == "two"
    assert (out.with_name("log.1") / "run.toml").read_text() == "one"
    assert sorted(os.listdir(out.parent)) == ["log", "log.1"]


# Kills itself before the n-th step on the disk, for each n, until there are no more steps.
KILLED_AT_EACH_STEP = """
import os, pathlib, shutil, signal, sys
from countersteer.runs.recorder import new_folder, whole_folder
from countersteer.writing import write_whole

STEPS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir", "shutil.rmtree"}
FILES = ("run.toml", "summary.json")
room, out = pathlib.Path(sys.argv[1]) / "room", pathlib.Path(sys.argv[1]) / "room" / "run"
make = {"new": lambda out: new_folder(out, "run"), "whole": whole_folder}[sys.argv[2]]

def write(text):
    with make(out) as folder:
        for name in FILES:
            write_whole(folder / name, text)

def write_and_die(last):
    steps = 0
    def step(event, _):
        nonlocal steps
        steps += event in STEPS
        if event in STEPS and steps == last:
            os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(step)
    write("new")
    os._exit(0)

for last in range(1, 200):
    shutil.rmtree(room, ignore_errors=True)
    write("before")
    child = os.fork()
    if not child:
        write_and_die(last)
    _, status = os.waitpid(child, 0)
    found = [
        [(folder / name).read_text() for name in FILES if (folder / name).exists()]
        for folder in room.glob("run*")
    ]
    assert found.count(["before"] * 2) == 1, (last, found)
    others = [texts for texts in found if texts != ["before"] * 2]
    assert others in ([], [[]], [["new"]], [["new"] * 2]), (last, found)
    assert sys.argv[2] == "new" or others in ([], [["new"] * 2]), (last, found)
    write("after")  # what the kill left is in nobody's way
    assert [(out / name).read_text() for name in FILES] == ["after"] * 2
    if status == 0:
        break
    assert os.WTERMSIG(status) == signal.SIGKILL
print(last)
"""


@pytest.mark.parametrize("kind", ["new", "whole"])
def test_a_kill_at_any_step_leaves_the_run_before(tmp_path, kind):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", KILLED_AT_EACH_STEP, str(tmp_path), kind],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 10


def test_a_folder_in_which_nothing_was_written_goes_away(tmp_path):
    def wrong(*names):
        with new_folder(tmp_path / "run", "run") as folder:
            for name in names:
                write_whole(folder / name, "text")
            raise InputError("wrong")

    for names in ((), ("run.toml",), ()):
        with pytest.raises(InputError, match="wrong"):
            wrong(*names)
    assert os.listdir(tmp_path) == ["run.1"]


@pytest.mark.parametrize("make", [lambda out: new_folder(out, "run"), whole_folder])
def test_processes_at_once_do_not_mix_their_files(tmp_path, make):
    """Threads have locks of their own, as processes do."""
    out = tmp_path / "run"

    def write(number):
        try:
            with make(out) as folder:
                for name in ("run.toml", "commands.csv", "truth.csv"):
                    write_whole(folder / name, str(number))
        except BusyError:
            return 0
        return 1

    with ThreadPoolExecutor(8) as pool:
        wrote = sum(pool.map(write, range(60)))
    folders = os.listdir(tmp_path)
    assert len(folders) == wrote > 0
    for folder in folders:
        files = [*(tmp_path / folder).iterdir()]
        assert len(files) == 3
        assert len({file.read_text() for file in files}) == 1


def test_the_folder_around_need_not_be_writable(tmp_path, monkeypatch):
    out = tmp_path / "mounted"
    out.mkdir()
    locked = writing._locked

    def refused(lock):
        if lock.parent == tmp_path:
            fail(errno.EACCES)
        return locked(lock)

    monkeypatch.setattr(writing, "_locked", refused)
    with new_folder(out, "run") as folder, pytest.raises(BusyError), new_folder(out, "run"):
        pass
    assert not os.listdir(folder)
    for other in (alone(tmp_path / "car.toml"), new_folder(tmp_path / "new", "run")):
        with pytest.raises(InputError, match="cannot be written: Permission denied"), other:
            pass


@pytest.mark.parametrize(
    ("result", "arguments"),
    [
        ("my_driver.py", "new driver my_driver"),
        ("car.toml", "tune run --out car.toml"),
        ("policy.toml", "learn stop-angle turns.csv --out policy.toml"),
        ("policy.toml", "learn turn box --out policy.toml"),
        ("box.gif", "export run --gif box.gif"),
        ("logs/log", "import eth log.npz --out logs"),
        ("out", "replay run --out out"),
    ],
)
def test_a_second_process_is_told_in_one_line(tmp_path, monkeypatch, capsys, result, arguments):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "run")
    np.savez("log.npz", obs=np.zeros((20, 12)), action=np.zeros((20, 2)))
    Path("logs").mkdir()
    before = sorted(os.listdir(tmp_path))
    with alone(Path(result)):
        assert main(arguments.split()) == WRONG_INPUT
    assert capsys.readouterr().err == f"countersteer: {result}: another process is writing there\n"
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize(
    "arguments",
    [
        "new driver my_driver",
        "tune run --out FILE/car.toml",
        "learn turn box --out FILE/policy.toml",
        "import eth log.npz --out FILE/logs",
        "trials throttle-steps --out FILE/steps",
        "replay run --out FILE/out",
    ],
)
def test_where_nothing_can_be_written_is_told_in_one_line(tmp_path, monkeypatch, capsys, arguments):
    """What is below a file stands for a folder that is read only, as root may write anywhere."""
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "run")
    np.savez("log.npz", obs=np.zeros((20, 12)), action=np.zeros((20, 2)))
    (tmp_path / "FILE").write_text("mine")
    if "FILE" not in arguments:
        monkeypatch.setattr(writing, "_locked", lambda _: fail(errno.EACCES))
    before = sorted(os.listdir(tmp_path))
    assert main(arguments.split()) == WRONG_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "FILE" in line or "my_driver.py: cannot be written: Permission denied" in line
    assert sorted(os.listdir(tmp_path)) == before
    assert (tmp_path / "FILE").read_text() == "mine"


# Runs that were killed


def test_a_killed_run_reads_wherever_it_was_cut_off(tmp_path):
    folder = record(tmp_path / "run")
    whole_run, rng = read_run(folder), np.random.default_rng(0)
    for name in ("commands", "telemetry", "truth"):
        file = folder / f"{name}.csv"
        content = file.read_bytes()
        ends = [i + 1 for i, byte in enumerate(content) if byte == ord("\n")]
        for cut in (*rng.integers(ends[1], len(content), 60), *(end - 1 for end in ends[2:])):
            file.write_bytes(content[:cut])
            table, full = getattr(read_run(folder), name), getattr(whole_run, name)
            lines = content[:cut].count(b"\n") - 1
            assert len(table) == lines > 0
            for column, values in table.items():
                np.testing.assert_array_equal(values, full[column][:lines])
        file.write_bytes(content)


def test_a_table_that_was_written_by_hand_need_not_end_its_last_line(tmp_path):
    file = tmp_path / "commands.csv"
    file.write_text("time_s,x\n0,1\n1,25")
    assert read_table(file, ("x",))["x"].tolist() == [1, 25]
    assert read_table(file, ("x",), recorded=True)["x"].tolist() == [1]


def test_report_makes_the_page_of_a_killed_drive(tmp_path, capsys):
    killed = record(tmp_path / "killed", pilot={"kind": "none"})
    with (killed / "truth.csv").open("a") as file:
        file.write("0.2,0.2,0.1")
    log = record(tmp_path / "log", truth=TRUTH[:4], log_format="dart")
    (tmp_path / "nothing").mkdir()
    runs = [str(run) for run in (log, killed, tmp_path / "nothing")]
    assert main(["report", "--each", *runs, "--json"]) == WRONG_INPUT
    told = capsys.readouterr()
    (error,) = told.err.splitlines()
    assert "nothing: not a run" in error
    found = json.loads(told.out)
    assert len(found["errors"]) == 1
    of_log, made = found["reports"]
    assert of_log["verdict"] == "not judged"
    verdict = "not finished: the record ends at 0.20 s"
    assert (made["outcome"], made["verdict"]) == ("not finished", verdict)
    assert verdict in Path(made["report"]).read_text(encoding="utf-8")
    assert Path(made["picture"]).read_bytes().startswith(b"\x89PNG")
    assert main(["report", str(killed)]) == DONE
    assert capsys.readouterr().out == f"{killed}: {verdict}; report: {killed}/report.html\n"


def test_a_full_disk_keeps_the_page_before(tmp_path, monkeypatch, capsys):
    run = record(tmp_path / "run")
    (run / "report.html").write_text("before")
    full_disk(monkeypatch)
    files = sorted(os.listdir(run))
    assert main(["report", str(run)]) == FAILED
    assert capsys.readouterr().err == (
        f"countersteer: {run}/report.png: {os.strerror(errno.ENOSPC)}\n"
    )
    assert (run / "report.html").read_text() == "before"
    assert sorted(os.listdir(run)) == files


def test_rows_that_do_not_say_the_motion_are_not_drawn(tmp_path, capsys):
    run = record(tmp_path / "run", pilot={"kind": "none"})
    lines = (run / "truth.csv").read_text().splitlines()
    empty = [line.split(",")[0] + "," * (len(TRUTH) - 1) for line in lines[-5:]]
    (run / "truth.csv").write_text("\n".join([*lines[:-5], *empty]) + "\n")
    assert main(["report", str(run), "--json"]) == DONE
    (made,) = json.loads(capsys.readouterr().out)["reports"]
    assert made["driven_s"] == pytest.approx(0.005 * (COUNT - 6))


def test_kills_at_random_instants_lose_nothing(tmp_path):
    """A small part of `python -m studies.kills`."""
    prepare(["import"], tmp_path)
    for kill in kills("import", 2, np.random.default_rng(0), tmp_path):
        assert (kill.lost, kill.unreadable) == ("", ""), kill


# Tables


def test_one_place_writes_the_text_of_a_table():
    rows = [("a,b", 12345678, 1 / 3, np.float32(0.5)), ("left", np.int64(1), np.nan, -np.inf)]
    text = "word,count,third,x\n"
    text += '"a,b",12345678,0.333333,0.5\nleft,1,,-inf\n'
    assert csv_text(("word", "count", "third", "x"), rows) == text
    assert csv_text(("x",), [(1 / 3,)], digits=3) == "x\n0.333\n"


# What is around a drive


def test_without_a_home_there_is_no_cache(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    with pytest.raises(OSError, match="Not a directory"):
        cache_folder().mkdir(parents=True)


@pytest.mark.parametrize("memory", ["folder", "file/waits.json", "broken.json"])
def test_times_of_before_that_cannot_be_kept_are_no_matter(tmp_path, memory):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "broken.json").write_bytes(b'{"drive box": 3.\xff')
    wait = _Wait("drive box", tmp_path / memory, sys.stderr)
    wait._begin -= 10
    wait.end()
    if memory == "broken.json":
        kept = json.loads((tmp_path / memory).read_text())
        assert kept["drive box"] == pytest.approx(10, abs=3)


def test_a_damaged_entry_of_jaxs_cache_is_replaced(tmp_path):
    cache = lru_cache.LRUCache(str(tmp_path), max_size=-1)
    cache.put("key", b"cut off")
    cache.put("key", b"whole")
    assert cache.get("key") == b"whole"


COMMAND = f"{sys.executable} -m countersteer"


@pytest.mark.parametrize(
    ("command", "status", "lines"),
    [
        ("list cars > /dev/full", FAILED, 1),
        ("list cars >&- 2>&- <&-", DONE, 0),
        ("new course NAME! 2> /dev/full", WRONG_INPUT, 0),
    ],
)
def test_streams_that_are_full_or_closed(tmp_path, command, status, lines):
    done = subprocess.run(
        f"{COMMAND} {command}", shell=True, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == status
    assert len(done.stderr.splitlines()) == lines
    assert "Traceback" not in done.stderr


def test_progress_needs_no_terminal(capsys):
    with Progress() as progress:
        progress.show(1, 2)
    assert capsys.readouterr() == ("", "")
