"""Writes a run's folder during the drive, which is simulated, imported or real."""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.files import COMMANDS, TableWriter, column_rows, command_rows
from countersteer.runs.mcap import McapWriter
from countersteer.signals import TRUTH, Command, Readings, flat, pairs
from countersteer.text import toml_of


class Pace(NamedTuple):
    """Recording periods of the tables, in ticks of `dt` seconds."""

    dt: float
    telemetry: int
    truth: int
    onboard: bool  # True: each reading has a row at its own tick


class Frames(NamedTuple):
    """Readings and commands between pilot and car; arrays have a leading axis of instants.

    A real car's recorder feeds one instant at a time, a simulation half a second.
    """

    tick: np.ndarray
    readings: Readings  # last reports of the sensors
    command: Command  # of the car from this instant on
    fresh: np.ndarray  # True for a new command
    truth: tuple[np.ndarray, ...] | None = None  # values of `TRUTH`; None: unknown


def new_folder(out: Path | None, name: str) -> Path:
    """Make an empty folder for a run: `out`, or else a numbered one under `runs/`.

    An existing run is kept under another name, with the next free number. Raises `InputError` if
    the folder holds something other than a run, or if it cannot be made.
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
    """Make the folder with the first free number. Simultaneous drives get different folders."""
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


def _due(tick: np.ndarray, before: np.ndarray, every: int) -> np.ndarray:
    """True where a multiple of `every` ticks was reached since the frame before."""
    due: np.ndarray = tick // every > before // every
    return due


class Recorder:
    """Writes `run.toml`, growing tables and `run.mcap` to a folder, flushed with every piece.

    It takes frames (`record`), or whole tables from an importer (`write`).
    """

    def __init__(
        self,
        folder: Path,
        about: dict[str, Any],
        headers: Mapping[str, Sequence[str]] | None = None,
        channels: Readings | None = None,
        pace: Pace | None = None,
    ) -> None:
        """Write `run.toml` and the `headers` of the tables, by name.

        Frames need the `channels` of the car's sensors and the `pace`. Their headers follow from
        the channels.
        """
        self.folder = folder
        self._channels, self._pace = channels, pace
        self._last = self._newest = self._told = -1  # last ticks: frame, reading, telemetry row
        if channels is not None:
            told = [column for channel in flat(channels) for column in channel.columns]
            truth = ("time_s", *(channel.name for channel in TRUTH))
            headers = {"commands": COMMANDS, "telemetry": ("time_s", *told), "truth": truth}
        assert headers is not None
        text = toml_of(about)
        (folder / "run.toml").write_text(text)
        self._tables = {
            name: TableWriter(folder / f"{name}.csv", header) for name, header in headers.items()
        }
        self._mcap = McapWriter(folder / "run.mcap", about, text, headers)
        self._summary: dict[str, Any] | None = None

    def record(self, frames: Frames) -> None:
        """Append frames as rows of all three tables."""
        assert self._channels is not None, "frames need channels"
        assert self._pace is not None, "frames need a pace"
        pace, tick = self._pace, np.asarray(frames.tick)
        time, told = tick * pace.dt, [*pairs(self._channels, frames.readings)]
        before = np.concatenate([[self._last], tick[:-1]])
        rows = _due(tick, before, pace.telemetry)
        if pace.onboard:
            newest = np.maximum.accumulate(
                np.max([np.asarray(reading.tick) for _, reading in told], axis=0)
            )
            rows |= newest > np.maximum(np.concatenate([[self._newest], newest[:-1]]), 0)
            self._newest = max(self._newest, int(newest[-1]))
        rows = np.nonzero(rows)[0]
        since = np.maximum(np.concatenate([[self._told], tick[rows]])[:-1], 0)
        telemetry = [time[rows]]
        for channel, reading in told:
            new = np.asarray(reading.tick)[rows] > since
            width = max(1, math.prod(channel.shape))
            values = np.asarray(reading.value)[rows].reshape(len(rows), width)  # a column each
            telemetry.extend(np.where(new[:, None], values, np.nan).T)
        if len(rows):
            self._told = int(tick[rows[-1]])
        command = [np.asarray(part) for part in frames.command]
        # A car cannot run a command of NaN.
        fresh = np.nonzero(np.asarray(frames.fresh) & np.isfinite(command[0] + command[1]))[0]
        tables = {
            "commands": tuple(part[fresh] for part in (time, *command)),
            "telemetry": telemetry,
        }
        shown = np.nonzero(_due(tick, before, pace.truth))[0]
        self._last = int(tick[-1]) if len(tick) else self._last
        if frames.truth is not None:
            tables["truth"] = [np.asarray(column)[shown] for column in (time, *frames.truth)]
        self.write(tables)

    def write(self, tables: Mapping[str, Sequence[np.ndarray]]) -> None:
        """Append a piece: columns by table, in the order of its header.

        `commands` is time, throttle (negative in reverse) and steering (rad); NaN is an empty cell.
        """
        cells: dict[str, list[list[str]]] = {name: [] for name in self._tables}
        for name, columns in tables.items():
            cells[name] = command_rows(*columns) if name == "commands" else column_rows(columns)
        for name, table in self._tables.items():
            table.write(cells[name])
        self._mcap.write(cells)

    def finish(self, summary: dict[str, Any]) -> None:
        """Write `summary.json`."""
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
