"""Writes a run's folder while the drive goes on."""

import itertools
import json
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
import tomli_w

from countersteer.errors import InputError
from countersteer.runs.files import TableWriter, column_rows, command_rows
from countersteer.runs.mcap import McapWriter

WHEELS = ("fl", "fr", "rl", "rr")


class Rows(NamedTuple):
    """What a piece of a drive adds: columns by file, SI units and radians."""

    commands: tuple[np.ndarray, np.ndarray, np.ndarray]  # time, throttle, steering
    telemetry: tuple[np.ndarray, ...]  # in the order of the header given; NaN: nothing new
    truth: tuple[np.ndarray, ...]  # in the order of `TRUTH`

    def cells(self) -> dict[str, list[list[str]]]:
        """The same as rows of text by table."""
        return {
            "commands": command_rows(*self.commands),
            "telemetry": column_rows(self.telemetry),
            "truth": column_rows(self.truth),
        }


def new_folder(out: Path | None, name: str) -> Path:
    """An empty folder for a run. Without `out`, a numbered one under `runs/`.

    A run that is there already is kept: it is moved aside to a name with the next free number.
    Raises `InputError` where the folder holds something that is no run.
    """
    if out is None:
        return _numbered(Path("runs"), name)
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            if not (out / "run.toml").exists():
                raise InputError(f"{out}: is there already and is not a run: give another --out")
            others = (out.with_name(f"{out.name}.{number}") for number in itertools.count(1))
            out.rename(next(path for path in others if not path.exists()))
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from None
    return out


def _numbered(parent: Path, name: str) -> Path:
    """A folder of the first free number; two drives at once get two."""
    number = 1
    while True:
        folder = parent / f"{name}-{number:03d}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None


class RunWriter:
    """A folder with `run.toml`, tables that grow, and `run.mcap`; flushed with every piece."""

    def __init__(
        self, folder: Path, about: dict[str, Any], headers: dict[str, tuple[str, ...]]
    ) -> None:
        """Writes `run.toml` and the headers, by the tables' names."""
        self.folder = folder
        text = tomli_w.dumps(about)
        (folder / "run.toml").write_text(text)
        self._tables = {
            name: TableWriter(folder / f"{name}.csv", header) for name, header in headers.items()
        }
        self._mcap = McapWriter(folder / "run.mcap", about, text, headers)
        self._summary: dict[str, Any] | None = None

    def write(self, cells: dict[str, list[list[str]]]) -> None:
        """Appends a piece: rows by table."""
        for name, table in self._tables.items():
            table.write(cells[name])
        self._mcap.write(cells)

    def finish(self, summary: dict[str, Any]) -> None:
        """Writes `summary.json`."""
        self._summary = summary
        (self.folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for table in self._tables.values():
            table.close()
        self._mcap.close(self._summary)
