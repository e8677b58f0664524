"""A live drive as an ordinary run folder, with what the hands did beside the commands."""

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.recorded_drive import frames, pace_of
from countersteer.runs.files import ESTIMATE
from countersteer.runs.recorder import Recorder, new_folder
from countersteer.sensing.all_sensors import channels
from countersteer.simulator import Record, Simulator
from countersteer.text import toml_of
from countersteer.writing import remove, write_whole

# What hands did: axes of keys or stick, which of `messages.SOURCES` they came from, who drove (0
# the person, 1 the driver), the gyroscope, and whether the page was silent. A row at each change.
INPUTS = (
    "time_s", "seq", "steer", "throttle", "brake", "source", "driver", "gyro", "gyro_strength",
    "silent",
)  # fmt: skip
FAULTS = {"off": "dead", "failing": "spike"}  # kind of fault of a sensor's state
MOST_CHANGES = 1000  # that are noted in `run.toml`


class Recording:
    """Writes the folder of a drive as it goes."""

    def __init__(self, runs: Path, name: str, about: dict[str, Any], simulator: Simulator) -> None:
        """Make a numbered folder in `runs`."""
        self._open = contextlib.ExitStack()
        self.folder = self._open.enter_context(new_folder(None, name, runs))
        self.about = about | {"driven_by": [], "changes": [], "faults": []}
        tables = {"inputs": INPUTS}
        if about["estimate"] != "truth":
            tables["estimate"] = ESTIMATE
        about = {key: value for key, value in self.about.items() if value != []}
        self._recorder = self._open.enter_context(
            Recorder(
                self.folder,
                about,
                channels=channels(simulator.car),
                pace=pace_of(simulator),
                more=tables,
            )
        )
        self._onboard = simulator.link.onboard
        self._before: tuple[float, float] | None = None  # the last command that was written
        self._inputs: list[tuple[float, ...]] = []
        self._input: tuple[float, ...] = ()  # the last, without its time and number
        self._stale = False  # whether `run.toml` is

    def input(self, row: tuple[float, ...]) -> None:
        """Note what the hands do from a time on: a row of `INPUTS`."""
        if self._input != row[2:]:
            self._input = row[2:]
            self._inputs.append(row)

    def driven_by(self, time: float, who: str) -> None:
        """Note who drives from a time (s) on."""
        self.about["driven_by"].append({"from_s": time, "who": who})
        self._stale = True

    def sensor(self, time: float, name: str, state: str) -> None:
        """Note the state of a sensor from a time on; faults are those of `run.toml`."""
        faults = self.about["faults"]
        for fault in faults:
            if fault["sensor"] == name and math.isinf(fault["duration_s"]):
                fault["duration_s"] = time - fault["start_s"]
        if state in FAULTS:
            kind = FAULTS[state]
            faults.append({"sensor": name, "kind": kind, "start_s": time, "duration_s": math.inf})
        self.change(time, f"sensor {name}", state)

    def change(self, time: float, what: str, value: Any) -> None:
        """Note a change of the car, the floor or a sensor's noise in mid-drive."""
        changes = self.about["changes"]
        if len(changes) < MOST_CHANGES:
            changes.append({"time_s": time, "what": what, "to": value})
            self._stale = True

    def write(self, record: Record) -> None:
        """Append a record with a leading axis of ticks."""
        thin = frames(record, len(record.tick))
        if self._onboard:  # a command that is held is one row
            thin = thin._replace(fresh=self._is_new(thin.command))
        rows, self._inputs = self._inputs, []
        columns = list(np.array(rows, float).T) if rows else [np.zeros(0)] * len(INPUTS)
        self._recorder.record(thin, {"inputs": columns})
        if self._stale:
            self._stale = False
            self._write_about()

    def _is_new(self, command: Any) -> np.ndarray:
        """Whether each row's command differs from the one before it."""
        throttle, steering = (np.asarray(part) for part in command)
        first = self._before or (np.nan, np.nan)
        self._before = float(throttle[-1]), float(steering[-1])
        changed: np.ndarray = (np.diff(throttle, prepend=first[0]) != 0) | (
            np.diff(steering, prepend=first[1]) != 0
        )
        return changed

    def _write_about(self) -> None:
        about = {key: value for key, value in self.about.items() if value != []}
        write_whole(self.folder / "run.toml", toml_of(about))

    def finish(self, summary: dict[str, Any]) -> None:
        """Complete the files."""
        people = {part["who"] for part in self.about["driven_by"]}
        self.about["driver"] = " and ".join(sorted(people, reverse=True)) or "person"
        self._write_about()
        self._recorder.finish(summary)
        self._open.close()

    def drop(self) -> None:
        """Remove the folder: there is nothing in it that a person would keep."""
        self._open.close()
        remove(self.folder)
