"""Recorded runs: listed, shown, marked, trimmed, and taken in from elsewhere.

A run is known by the name of its folder in one folder of runs. Nothing else is reached.
"""

import contextlib
import io
import itertools
import math
import re
import tempfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.cockpit import messages as m
from countersteer.errors import InputError
from countersteer.reading.content import read_text
from countersteer.reading.documents import json_object, toml
from countersteer.runs import marks

if TYPE_CHECKING:
    import numpy as np

    from countersteer.runs.files import Table
    from countersteer.runs.run import Run

MOST_LISTED = 200  # runs, the newest
LARGEST = 10  # MB, of run.toml and summary.json
LARGEST_UPLOAD, LARGEST_UNPACKED, MOST_FILES = 64 * 2**20, 256 * 2**20, 30  # bytes
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,99}")
UNPACKED = re.compile(r"(?:[^/\\]{1,100}/)?([a-z]{1,20}\.(?:csv|toml|json))")
# Formats that a log with this ending may have, in the order in which they are tried.
LOGS = {
    ".csv": ("dart", "eth", "vesc", "edgetx", "csv"),
    ".bag": ("rosbag",),
    ".mcap": ("rosbag",),
    ".db3": ("rosbag",),
}
BEFORE, AFTER = 1.0, 0.5  # s, kept around a turn
GHOST_PERIOD = 0.05  # s between two poses


class RunShelf:
    """The runs of a folder. Its methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        """The folder may not be there yet."""
        self.folder = folder
        self._known: dict[tuple[str, int], m.RunItem] = {}  # by name and time of change
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Names of all runs, the newest first."""
        if not self.folder.is_dir():
            return []
        found = []
        for path in self.folder.iterdir():
            if path.is_dir() and not path.name.startswith(".") and (path / "run.toml").is_file():
                found.append((path.stat().st_mtime_ns, path.name))
        return [name for _, name in sorted(found, reverse=True)]

    def path(self, name: str) -> Path:
        """The folder of a run. Raises `InputError` if there is none of that name."""
        if name not in self.names():
            raise InputError(f"run: there is no {name[:60]}")
        return self.folder / name

    def items(self) -> list[m.RunItem]:
        """What there is to say of the newest runs. A damaged one is left out."""
        found = []
        with self._lock:
            for name in self.names()[:MOST_LISTED]:
                folder = self.folder / name
                files = [folder / file for file in ("run.toml", "summary.json", marks.FILE)]
                key = name, sum(f.stat().st_mtime_ns for f in files if f.exists())
                if key not in self._known:
                    try:
                        self._known[key] = item(folder)
                    except (InputError, OSError):
                        continue
                found.append(self._known[key])
            kept = {id(one) for one in found}
            self._known = {k: one for k, one in self._known.items() if id(one) in kept}
        return found

    def mark(self, name: str, mark: str) -> None:
        """Mark a run good or bad, or take the mark away."""
        marks.write_mark(self.path(name), mark)

    def report(self, names: list[str]) -> str:
        """The page of a run, or of several side by side."""
        from countersteer.viewing.report import report_html

        return report_html(*self._views(names))

    def data(self, name: str) -> str:
        """A run's view as JSON, as its page holds it."""
        from countersteer.viewing.report import report_json

        return report_json(*self._views([name]))

    def _views(self, names: list[str]) -> list[dict[str, Any]]:
        from countersteer.runs.run import read_run
        from countersteer.viewing.side_by_side import with_places
        from countersteer.viewing.style import MOST_RUNS
        from countersteer.viewing.view import view_of

        if not 0 < len(names) <= MOST_RUNS:
            raise InputError(f"report: name 1 to {MOST_RUNS} runs")
        views = [view_of(read_run(self.path(name))) for name in names]
        return with_places(views) if len(views) > 1 else views

    def ghost(self, name: str) -> m.Ghost:
        """A run as a car to drive beside."""
        from countersteer.runs.run import read_run

        run = read_run(self.path(name))
        if run.truth is None or not len(run.truth):
            raise InputError(f"{name}: has no poses")
        return ghost_of(name, run.truth)

    def packed(self, name: str) -> bytes:
        """A run's folder as a ZIP file."""
        folder, content = self.path(name), io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as packed:
            for file in sorted(folder.iterdir()):
                if file.is_file() and not file.name.startswith("."):
                    packed.write(file, f"{name}/{file.name}")
        return content.getvalue()

    def trim(self, name: str, turn: int) -> str:
        """Write a new run with one turn of a run, counted from 1. Returns its name."""
        from countersteer.runs.run import read_run

        folder = self.path(name)
        run = read_run(folder)
        turns = run.summary.get("turns", [])
        if not turn <= len(turns):
            raise InputError(f"{name}: has {len(turns)} turns")
        with self._free_name(f"{name}-turn-{turn}") as new:
            write_turn(run, turns[turn - 1], self.folder / new)
        return new

    def take(self, file_name: str, content: bytes) -> tuple[str, str]:
        """Take in a dropped file: a run's folder as a ZIP, or a log. Returns name and remarks."""
        name = Path(file_name).name
        stem, ending = Path(name).stem, Path(name).suffix.lower()
        if not NAME.fullmatch(name):
            raise InputError("upload: name the file with letters, digits, spaces, . - and _")
        if len(content) > LARGEST_UPLOAD:
            raise InputError(f"{name}: over {LARGEST_UPLOAD // 2**20} MB")
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(dir=self.folder, prefix=".upload-") as scratch,
            self._free_name(stem) as new,
        ):
            if ending == ".zip":
                remarks = take_folder(content, name, Path(scratch), self.folder / new)
            elif ending in LOGS:
                log = Path(scratch) / f"{new}{ending}"
                log.write_bytes(content)
                remarks = take_log(log, LOGS[ending], self.folder)
            else:
                raise InputError(f"{name}: drop a run's folder, or a log ({', '.join(LOGS)})")
        return new, remarks

    @contextlib.contextmanager
    def _free_name(self, wanted: str) -> Iterator[str]:
        """A name that no run has, for a new one. Only one at a time is given."""
        with self._lock:
            for number in itertools.count(1):
                name = wanted if number == 1 else f"{wanted}-{number}"
                if not (self.folder / name).exists():
                    break
            yield name


def item(folder: Path) -> m.RunItem:
    """What the list says of a run. Raises `InputError` or `OSError` if it cannot be read."""
    about = toml(read_text(folder / "run.toml", LARGEST), folder.name)
    file = folder / "summary.json"
    told = json_object(read_text(file, LARGEST), folder.name) if file.exists() else {}

    def text(table: dict[str, Any], key: str, other: str = "") -> str:
        value = table.get(key, other)
        return value[:200] if isinstance(value, str) and value.isprintable() else other

    def count(key: str) -> int:
        value = told.get(key)
        return value if isinstance(value, int) and 0 <= value <= 10**6 else 0

    course = about.get("course")
    turns, lap = told.get("turns"), told.get("lap_time_s")
    place = text(course, "name") if isinstance(course, dict) else ""
    driver = text(about, "driver", text(about, "log_format"))
    return m.RunItem(
        id=folder.name,
        title=", ".join(word for word in (place, driver, text(about, "car_name")) if word),
        course=place,
        driver=driver,
        outcome=text(told, "verdict", "not judged" if "log_format" in about else "not finished"),
        mark=marks.read_mark(folder),
        turns=len(turns) if isinstance(turns, list) else 0,
        drifts=count("drifts"),
        time_s=float(lap) if isinstance(lap, int | float) else float("nan"),
        simulated="pilot" in about,
    )


def ghost_of(name: str, table: "Table") -> m.Ghost:
    """A car to draw, from a table of poses; every `GHOST_PERIOD`."""
    import numpy as np

    from countersteer.task.turns import sideslip

    period = float(np.median(np.diff(table["time_s"]))) if len(table["time_s"]) > 1 else 1.0
    every = slice(None, None, max(1, round(GHOST_PERIOD / max(period, 1e-4))))
    slips = np.zeros(len(table["time_s"]))
    if "vx_mps" in table:
        slips = np.degrees(sideslip(table["vx_mps"], table["vy_mps"]))
    columns = {key: table[key][every] for key in ("time_s", "x_m", "y_m", "heading_rad")}
    return m.Ghost(
        name=name,
        sideslip_deg=slips[every].tolist(),
        **{key: column.tolist() for key, column in columns.items()},
    )


def write_turn(run: "Run", turn: dict[str, Any], out: Path) -> None:
    """Write a run from one turn of a run. Its clock starts at 0, with the motion of that time."""
    import numpy as np

    from countersteer.runs.files import COMMANDS, SPEED_COMMANDS, read_table
    from countersteer.runs.recorder import Recorder, whole_folder

    begin, end = max(turn["begin_s"] - BEFORE, 0.0), turn["end_s"] + AFTER
    by_speed = "speed" in run.commands
    held = max(int(np.searchsorted(run.commands["time_s"], begin, "right")) - 1, 0)
    commands = {name: column[held:] for name, column in run.commands.items()}
    commands["time_s"] = np.maximum(commands["time_s"], begin)
    tables: dict[str, Any] = {
        "commands": commands, "telemetry": run.telemetry, "truth": run.truth,
        "estimate": run.estimate,
    }  # fmt: skip
    if (run.path / "inputs.csv").exists():
        tables["inputs"] = read_table(run.path / "inputs.csv", ("time_s",), recorded=True)
    cut = {name: _between(table, begin, end) for name, table in tables.items() if table}
    headers = {name: tuple(table) for name, table in cut.items()}
    headers["commands"] = SPEED_COMMANDS if by_speed else COMMANDS
    about = {
        key: run.about[key] for key in run.about if key not in ("driven_by", "changes", "faults")
    }
    about["trimmed"] = {"from": run.path.name, "begin_s": begin, "end_s": end}
    if run.truth is not None and len(cut["truth"]["time_s"]):
        first = {name: float(column[0]) for name, column in cut["truth"].items()}
        known = {name: value for name, value in first.items() if math.isfinite(value)}
        about["start"] = {k: known[k] for k in ("x_m", "y_m", "heading_rad")}
        moves = ("vx_mps", "vy_mps", "yaw_rate_radps")
        about["initial"] = {k: known[k] for k in moves if k in known}
    own = turn | {"begin_s": turn["begin_s"] - begin, "end_s": turn["end_s"] - begin}
    words = f"one turn of {run.path.name}"
    summary = {
        "completed": False, "success": False, "outcome": words, "verdict": words,
        "drifts": int(turn.get("peak_sideslip_deg", 0) > 25), "turns": [own],
    }  # fmt: skip
    with whole_folder(out) as part, Recorder(part, about, headers) as recorder:
        recorder.write({name: tuple(table.values()) for name, table in cut.items()})
        recorder.finish(summary)


def _between(table: Any, begin: float, end: float) -> dict[str, "np.ndarray"]:
    """The rows of a table within a time, on a clock that starts there."""
    rows = (table["time_s"] >= begin) & (table["time_s"] <= end)
    cut = {name: column[rows] for name, column in table.items()}
    return cut | {"time_s": cut["time_s"] - begin}


def take_folder(content: bytes, name: str, scratch: Path, out: Path) -> str:
    """Unpack a run's folder, check it and put it at `out`. Returns remarks for the person."""
    from countersteer.runs.importers.run import import_run
    from countersteer.runs.run import read_run

    own = scratch / out.name
    own.mkdir()
    unpack(content, name, own)
    if (own / "summary.json").exists() or "pilot" in _about(own):
        read_run(own)  # it raises `InputError` if a table is wrong
        own.rename(out)
        return "The run is in the list."
    import_run(own, out.parent)
    return "The log is in the list."


def _about(folder: Path) -> dict[str, Any]:
    file = folder / "run.toml"
    return toml(read_text(file, LARGEST), file.name) if file.exists() else {}


def unpack(content: bytes, name: str, out: Path) -> None:
    """The tables of a run's folder from a ZIP file. Raises `InputError` for anything else."""
    left = LARGEST_UNPACKED
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            parts = packed.infolist()
            if len(parts) > MOST_FILES:
                raise InputError(f"{name}: over {MOST_FILES} files: drop one run's folder")
            for part in parts:
                found = UNPACKED.fullmatch(part.filename)
                if not found:  # folders, pages, pictures and run.mcap
                    continue
                with packed.open(part) as file:
                    data = file.read(left + 1)
                left -= len(data)
                if left < 0:
                    raise InputError(f"{name}: over {LARGEST_UNPACKED // 2**20} MB unpacked")
                (out / found[1]).write_bytes(data)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise InputError(f"{name}: is no ZIP file that can be read: {error}") from None
    if not (out / "commands.csv").exists():
        raise InputError(f"{name}: no run's folder: it has no commands.csv")


def take_log(log: Path, formats: tuple[str, ...], out: Path) -> str:
    """Import a log by the first format that takes it. Returns remarks for the person."""
    from countersteer.runs.importers import importer
    from countersteer.runs.importers.guess import guess_mapping

    errors = []
    for name in formats:
        try:
            if name != "csv":
                importer(name)(log, out)
                return f"Imported as a log of {name}."
            text, doubts = guess_mapping(log)
            mapping = log.with_suffix(".toml")
            mapping.write_text(text, encoding="utf-8")
            importer(name, mapping)(log, out)
            return "Imported by a guess of its columns. " + " ".join(map(str, doubts))
        except InputError as error:
            errors.append(str(error))
    raise InputError(errors[-1].replace(f"{log.parent}/", ""))
