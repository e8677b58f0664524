"""Recorded runs: listed, shown, marked, trimmed, and taken in from elsewhere.

A run is known by the name of its folder in one folder of runs. Nothing else is reached.
"""

import threading
from pathlib import Path
from typing import Any

from countersteer.cockpit import messages as m
from countersteer.errors import InputError
from countersteer.reading.content import read_text
from countersteer.reading.documents import json_object, toml
from countersteer.runs import marks

MOST_LISTED = 200  # runs, the newest
LARGEST = 10  # MB, of run.toml and summary.json


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

    def list(self) -> list[m.RunItem]:
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
