"""A log and its mapping: the signals in the project's units, on one clock."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.values import shown
from countersteer.runs.files import FASTEST, LARGEST, LARGEST_STEERING, LATEST, LONGEST
from countersteer.runs.importers.imported import Columns, Imported, with_encoder, write_run
from countersteer.runs.importers.mapping import Entry, Recipe, column_missing
from countersteer.runs.importers.units import TELEMETRY, TRUTH, factor_of

DIGITS = 6  # decimals of times (s)
CLIPPED = 1.25  # up to this throttle, what is beyond 1 is a channel's end point
COARSE = 0.2  # s between commands; beyond, a log is coarse
TURNS = 0.1  # rad, rad/s: commands and yaw rates beyond are compared by their signs
AGREE = 0.3  # share of equal signs; below, a sign is wrong


class LogTable(Protocol):
    """A table of a log, whatever its format."""

    names: list[str]

    def numbers(self, name: str) -> np.ndarray:
        """A column as numbers; NaN where it has none."""
        ...

    def text(self, name: str) -> list[str]:
        """A column as text."""
        ...

    def times(self, names: Sequence[str]) -> np.ndarray:
        """Columns with dates and times, as seconds."""
        ...

    def place(self, row: int) -> str:
        """Where a row stands, for messages."""
        ...


Find = Callable[[str], LogTable | None]  # a table by its name in a mapping


class Series(NamedTuple):
    """A signal over time (s, on the log's own clock)."""

    time: np.ndarray
    value: np.ndarray
    table: LogTable


def import_mapped(
    log: Path, out: Path, format_name: str, recipe: Recipe, find: Find
) -> dict[str, Any]:
    """Write a log as a run folder, by its mapping. Returns a report for JSON.

    Raises `InputError` if the mapping does not fit the log.
    """
    return write_run(log, out, converted(log, format_name, recipe, find))


def converted(log: Path, format_name: str, recipe: Recipe, find: Find) -> Imported:
    """The signals of a log in the project's units. Raises `InputError`."""
    reader = _Reader(recipe, find)
    found = {
        signal: series
        for signal in recipe.entries
        if signal != "time" and (series := reader.series(signal)) is not None
    }
    drive = "speed" if "speed" in found else "throttle"
    if drive not in found:
        raise InputError(
            f"{log}: no throttle and no commanded speed: the mapping has to name one of them"
        )
    begin = min(float(series.time[0]) for series in found.values())
    found = {
        signal: series._replace(time=np.round(series.time - begin, DIGITS))
        for signal, series in found.items()
    }
    for signal, series in found.items():
        if series.time[-1] > LATEST:
            raise InputError(
                f"{log}: {signal} is {series.time[-1]:.4g} s after the log's first row: is the "
                "unit of time right, and is it one clock for all?"
            )
    time, motor, steering = _commands(found, drive)
    telemetry = _telemetry(found)
    truth = _truth(found, recipe.where)
    if telemetry is None and truth is None:
        raise InputError(f"{log}: no sensor and no motion capture: name wheel_speed, gyro or x")
    doubts = _doubts(time, motor, steering, found)
    about: dict[str, Any] = {
        "log_format": format_name,
        "mapping": Path(recipe.where).name,
        **recipe.about,
        **{key: recipe.numbers[key] for key in ("full_lock_deg",) if key in recipe.numbers},
        "signals": sorted(found),
        "doubts": doubts,
    }
    if "wheel_speed" in found:
        about = with_encoder(about)
    rows = max(len(series.time) for series in found.values())
    return Imported(about, rows, time, motor, steering, telemetry, truth, drive == "speed")


class _Reader:
    """Reads signals by their entries; each table's clock is read once."""

    def __init__(self, recipe: Recipe, find: Find) -> None:
        self.recipe, self.find = recipe, find
        self.clocks: dict[int, np.ndarray] = {}

    def series(self, signal: str) -> Series | None:
        """A signal's readings; None if the log may lack it and does."""
        chosen = self._chosen(signal)
        if chosen is None:
            return None
        table, entry = chosen
        time = self._clock(table)
        value = self._value(signal, table, entry)
        known = np.isfinite(value)
        if entry.held:
            known &= np.append(True, np.diff(value) != 0)
        if not np.any(known):
            if signal in self.recipe.optional:
                return None
            raise InputError(f"{self.recipe.where}: {signal}: the log has no value of it")
        return Series(time[known], value[known], table)

    def _chosen(self, signal: str) -> tuple[LogTable, Entry] | None:
        """The first entry whose table and columns the log has. Raises `InputError`."""
        for entry in self.recipe.entries[signal]:
            table = self.find(entry.table)
            if table is not None and set(entry.columns) <= set(table.names):
                return table, entry
        if signal in self.recipe.optional and signal != "time":
            return None
        entry = self.recipe.entries[signal][0]
        table = self.find(entry.table)
        if table is None:
            raise InputError(f"{self.recipe.where}: {signal}: the log has no {shown(entry.table)}")
        missing = next(name for name in entry.columns if name not in table.names)
        raise column_missing(self.recipe, signal, missing, table.names)

    def _clock(self, table: LogTable) -> np.ndarray:
        """The time of each row of a table (s)."""
        if id(table) not in self.clocks:
            self.clocks[id(table)] = self._time(table)
        return self.clocks[id(table)]

    def _time(self, table: LogTable) -> np.ndarray:
        entries = self.recipe.entries["time"]
        entry = next((e for e in entries if set(e.columns) <= set(table.names)), None)
        if entry is None:
            raise column_missing(self.recipe, "time", entries[0].columns[0], table.names)
        if entry.period is not None:
            return entry.period * np.arange(len(table.text(table.names[0])))
        if entry.units == ("datetime",):
            time = table.times(entry.columns)
        else:
            parts = []
            for place, name in enumerate(entry.columns):
                unit = entry.unit_of("time", place)
                parts.append(unit.factor * (table.numbers(name) - unit.zero))
            time = np.sum(parts, axis=0)
        for wrong, message in (
            (~np.isfinite(time), "time is not a number"),
            (np.append(False, np.diff(time) < 0), "time goes backwards"),
        ):
            if np.any(wrong):
                raise InputError(f"{table.place(int(np.argmax(wrong)))}: {message}")
        return time

    def _value(self, signal: str, table: LogTable, entry: Entry) -> np.ndarray:
        """The values of a signal in the project's units; NaN where there is no reading."""
        if signal == "direction":
            words = table.text(entry.columns[0])
            return np.array([-1.0 if word in entry.reverse else 1.0 for word in words])
        raw = np.stack([table.numbers(name) for name in entry.columns])
        raw = np.where((raw >= entry.low) & (raw <= entry.high), raw, math.nan)
        if signal == "armed":
            return np.where(np.isfinite(raw[0]), raw[0] > entry.above, math.nan)
        if "quaternion" in entry.units:
            x, y, z, w = raw
            return entry.sign * np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
        parts = []
        for place, column in enumerate(raw):
            unit = entry.unit_of(signal, place)
            factor = entry.sign * entry.scale * factor_of(unit, self.recipe.numbers)
            parts.append(factor * (column - unit.zero) / unit.span)
        known = ~np.isnan(parts)
        count = np.sum(known, axis=0)
        total = np.sum(np.where(known, parts, 0.0), axis=0)
        value: np.ndarray = np.where(count > 0, total / np.maximum(count, 1), math.nan)
        most = {"throttle": CLIPPED, "speed": FASTEST, "steering": math.radians(LARGEST_STEERING)}
        beyond = np.abs(value) > most.get(signal, LARGEST)
        if np.any(beyond):
            row = int(np.argmax(beyond))
            raise InputError(
                f"{table.place(row)}: {signal} would be {value[row]:.4g}: look at its unit, zero "
                f"and span in {self.recipe.where}"
            )
        return np.clip(value, -1.0, 1.0) if signal == "throttle" else value


def _commands(found: dict[str, Series], drive: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, throttle or speed, and steering: a row whenever one of them is commanded."""
    parts = [found[name] for name in (drive, "steering", "direction") if name in found]
    time = np.unique(np.concatenate([part.time for part in parts]))
    time = time[time >= max(part.time[0] for part in parts)]

    def held(name: str, otherwise: float) -> np.ndarray:
        if name not in found:
            return np.full(len(time), otherwise)
        series = found[name]
        return series.value[np.searchsorted(series.time, time, side="right") - 1]

    return time, held(drive, 0.0) * held("direction", 1.0), held("steering", 0.0)


def _telemetry(found: dict[str, Series]) -> Columns | None:
    """The sensors' readings; a cell is empty where a sensor has none at that time."""
    there = [name for name in TELEMETRY if name in found]
    if not there:
        return None
    time = np.unique(np.concatenate([found[name].time for name in there]))
    columns = {"time_s": time}
    for name in there:
        column = np.full(len(time), math.nan)
        column[np.searchsorted(time, found[name].time)] = found[name].value
        columns[TELEMETRY[name].column] = column
    return columns


def _truth(found: dict[str, Series], where: str) -> Columns | None:
    """Motion capture as it is, where the mapping names a whole pose.

    It is moved to the centre of mass where the run is read, by its `[sensors.capture]`.
    """
    there = [name for name in TRUTH if name in found]
    if not there:
        return None
    missing = [name for name in ("x", "y", "heading") if name not in found]
    if missing:
        raise InputError(f"{where}: {there[0]} needs {', '.join(missing)} too: a whole pose")
    time = found["x"].time
    for name in there:
        time = time[np.isin(time, found[name].time)]
    if not len(time):
        raise InputError(f"{where}: {', '.join(there)} never come at one time")
    at = {n: found[n].value[np.searchsorted(found[n].time, time)] for n in there}
    at["heading"] = np.unwrap(at["heading"])
    return {"time_s": time} | {TRUTH[name].column: at[name] for name in TRUTH if name in at}


def _doubts(
    time: np.ndarray, drive: np.ndarray, steering: np.ndarray, found: dict[str, Series]
) -> list[str]:
    """What looks wrong in a converted log: one line each."""
    lines = []
    if "steering" not in found:
        lines.append("no steering: every command is straight ahead")
    if "wheel_speed" not in found and "x" not in found:
        lines.append("no wheel speed and no pose: a comparison has no speed to start from")
    if len(time) > 1 and np.median(np.diff(time)) > COARSE:
        lines.append(f"commands come every {np.median(np.diff(time)):.2g} s only")
    if time[-1] > LONGEST:
        lines.append(f"it goes on to {time[-1]:.0f} s: compare and tune take an hour at most")
    if not np.any(drive > 0):
        lines.append("the motor is never driven forward: look at the sign of its command")
    if "gyro" in found:
        rate = np.interp(time, found["gyro"].time, found["gyro"].value)
        forward = drive > 0
        if "wheel_speed" in found:
            speed = found["wheel_speed"]
            forward &= np.interp(time, speed.time, speed.value) > TURNS
        turning = forward & (np.abs(steering) > TURNS) & (np.abs(rate) > TURNS)
        if np.sum(turning) > 10:
            same = float(np.mean(np.sign(steering[turning]) == np.sign(rate[turning])))
            if same < AGREE:
                lines.append(
                    f"in {100 * (1 - same):.0f} % of the turns the gyroscope turns against the "
                    "steering: one of their signs is wrong"
                )
    return lines
