"""Writes a run's folder during the drive, which is simulated, imported or real."""

import contextlib
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from countersteer.errors import InputError
from countersteer.runs.files import (
    COMMANDS,
    SPEED_COMMANDS,
    TableWriter,
    column_rows,
    command_rows,
    speed_rows,
)
from countersteer.runs.mcap import McapWriter
from countersteer.signals import TRUTH, AnyCommand, Command, Readings, SpeedCommand, flat, pairs
from countersteer.text import toml_of
from countersteer.writing import (
    BusyError,
    alone,
    is_empty,
    naming,
    new_part,
    remove,
    write_whole,
)

# The files by which a folder is known as a result of this program.
RESULTS = ("run.toml", "evaluate.json", "turns.json", "summary.json")


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
    command: AnyCommand  # of the car from this instant on
    fresh: np.ndarray  # True for a new command
    truth: tuple[np.ndarray, ...] | None = None  # values of `TRUTH`; None: unknown
    estimate: tuple[np.ndarray, ...] | None = None  # values of `ESTIMATE` but the time


@contextlib.contextmanager
def new_folder(out: Path | None, name: str, parent: Path = Path("runs")) -> Iterator[Path]:
    """Make an empty folder for results: `out`, or else a numbered one in `parent`.

    No other process of this program writes there until the block ends. An existing result is kept
    under another name, with the next free number. If the block raises an exception and nothing was
    written, the folder goes away. Raises `InputError` if another process writes there, if the
    folder holds something other than a result, or if it cannot be made.
    """
    with contextlib.ExitStack() as stack:
        folder = _numbered(parent, name, stack) if out is None else _made(out, stack)
        try:
            yield folder
        except BaseException:
            with contextlib.suppress(OSError):  # it is not empty
                folder.rmdir()
            raise


@contextlib.contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """As `new_folder`, for a run that is written at once: the folder appears when the block ends.

    Give the path of a part, to write the files to. If the block raises an exception, `out` stays
    as it was. An `OSError` names `out`.
    """
    with contextlib.ExitStack() as stack:
        _reserve(out, stack)
        with naming(out):
            part = new_part(Path(os.path.abspath(out)))
            part.mkdir()
            try:
                yield part
                _move_aside(out)
                if out.exists():
                    remove(out)  # it is empty
                part.rename(out)
            finally:
                remove(part)


def _made(out: Path, stack: contextlib.ExitStack) -> Path:
    """Make the folder `out`, which other processes leave alone until the stack is closed."""
    _reserve(out, stack)
    try:
        _move_aside(out)
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from None
    return out


def _reserve(out: Path, stack: contextlib.ExitStack) -> None:
    """Keep other processes from `out`. Raises `InputError` if no result may be made there."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        stack.enter_context(alone(out))
        if not out.exists() or (out.is_dir() and is_empty(out)):
            return
        results = any((out / name).exists() for name in RESULTS)
    except OSError as error:
        raise InputError(f"{out}: cannot be made: {error.strerror}") from None
    if not results:
        raise InputError(f"{out}: is there already and is not a run: give another --out")
    if out.name in ("", ".."):
        raise InputError(f"{out}: holds a run: give another --out")


def _move_aside(out: Path) -> None:
    """Give an existing result the next free number. The caller has reserved `out`."""
    if not out.exists() or is_empty(out):
        return
    for number in itertools.count(1):
        other = out.with_name(f"{out.name}.{number}")
        # Another process may be about to write to that name.
        with contextlib.suppress(BusyError), alone(other):
            if not other.exists():
                out.rename(other)
                return


def _numbered(parent: Path, name: str, stack: contextlib.ExitStack) -> Path:
    """Make the folder with the first free number. Simultaneous drives get different folders."""
    for number in itertools.count(1):
        folder = parent / f"{name}-{number:03d}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from None
        with contextlib.suppress(BusyError):  # who was given its name may have been faster
            stack.enter_context(alone(folder))
            return folder
    raise AssertionError("numbers have no end")


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
        command: type[AnyCommand] = Command,
        more: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """Write `run.toml` and the `headers` of the tables, by name.

        Frames need the `channels` of the car's sensors, the `pace`, and the type of `command`.
        Their headers follow from these, and `more` adds tables: `estimate` for frames that have
        one, and those that `write` fills.
        """
        self.folder = folder
        self._channels, self._pace = channels, pace
        self._last = self._newest = self._told = -1  # last ticks: frame, reading, telemetry row
        if channels is not None:
            told = [column for channel in flat(channels) for column in channel.columns]
            truth = ("time_s", *(channel.name for channel in TRUTH))
            commands = SPEED_COMMANDS if command is SpeedCommand else COMMANDS
            headers = {"commands": commands, "telemetry": ("time_s", *told), "truth": truth}
            headers |= more or {}
        assert headers is not None
        by_speed = "speed_mps" in headers.get("commands", ())
        self._command_rows = speed_rows if by_speed else command_rows
        text = toml_of(about)
        write_whole(folder / "run.toml", text)
        self._tables = {
            name: TableWriter(folder / f"{name}.csv", header) for name, header in headers.items()
        }
        self._mcap = McapWriter(folder / "run.mcap", about, text, headers)
        self._summary: dict[str, Any] | None = None

    def record(
        self, frames: Frames, beside: Mapping[str, Sequence[np.ndarray]] | None = None
    ) -> None:
        """Append frames as rows of their tables, and rows of other tables from the same time."""
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
        if frames.estimate is not None and "estimate" in self._tables:
            tables["estimate"] = [np.asarray(c)[shown] for c in (time, *frames.estimate)]
        self.write(tables | dict(beside or {}))

    def write(self, tables: Mapping[str, Sequence[np.ndarray]]) -> None:
        """Append a piece: columns by table, in the order of its header.

        `commands` is time, throttle (negative in reverse) or speed (m/s), and steering (rad). NaN
        is an empty cell.
        """
        cells: dict[str, list[list[str]]] = {name: [] for name in self._tables}
        for name, columns in tables.items():
            cells[name] = (
                self._command_rows(*columns) if name == "commands" else column_rows(columns)
            )
        for name, table in self._tables.items():
            table.write(cells[name])
        self._mcap.write(cells)

    def finish(self, summary: dict[str, Any]) -> None:
        """Write `summary.json`."""
        self._summary = summary
        write_whole(self.folder / "summary.json", json.dumps(summary, indent=1) + "\n")

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
