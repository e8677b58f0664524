"""How true cars are: persistence, published models and ours on every log of `../shared/data`.

`python -m studies.how_true PAGE [--data FOLDER] [--car NAME=FILE.toml ...]` writes the page and its
pictures, and prints the table. NAME is the car that a log's importer names; FILE is judged in its
place. All models start in the same windows of a second as `replay --compare`, from the measured
state, and get the log's commands. The published models know no battery; ours gets the charge that
`replay --compare` finds.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer.car.files import LIBRARY, load_car
from countersteer.compiling import configure_jax
from countersteer.errors import InputError
from countersteer.runs.importers import importer
from countersteer.runs.run import Run, read_run
from countersteer.text import read_toml
from countersteer.tuning import fit
from countersteer.tuning.compare import HORIZON, Window, changes, compare, simulation_of
from countersteer.tuning.windows import asked
from studies.published import Dart, Eth, Model, Velocity, predict

NOTHING, PUBLISHED, OURS = "nothing changes", "published", "ours"
JUDGED = {  # quantities of the table; without motion capture the wheels stand for the car's speed
    "vx_mps": "forward, m/s",
    "vy_mps": "lateral, m/s",
    "yaw_rate_radps": "yaw rate, rad/s",
}
WITHOUT_CAPTURE = {"vx_mps": "wheel_speed_mps"}
WORSE = 1.2  # times persistence; beyond it, a log is listed
DART, EXAMPLES = "dart", Path("examples/logs")


class Source(NamedTuple):
    """Logs of one folder that are judged together."""

    title: str
    files: str  # pattern below the data's folder
    format: str  # of `import`
    model: Model | None
    car: str = ""  # where the importer names none
    car_file: str = ""  # of that car
    mapping: str = ""


SOURCES = [
    Source(f"`{folder}`", f"dart/{folder}/*.csv", DART, Dart())
    for folder in (
        "throttle_steps_rubber_floor",
        "steering_steps",
        "steering_sines",
        "circles_rubber_floor",
        "free_driving",
        "circles_27_sept_2024_fast_ramp",
        "throttle_ramps",
        "circles_tape_and_tiles",
        "drift_tape_and_tiles",
        "slippery_floor_racing",
        "slippery_floor_racing_no_tape",
    )
] + [
    Source("ETH `train_1`", "eth_rccar/train_1.npz", "eth", Eth()),
    Source("ETH `train_2`", "eth_rccar/train_2.npz", "eth", Eth()),
    *(
        Source(
            f"`{name}`",
            pattern,
            "csv",
            None,
            name,
            str(EXAMPLES / f"{name}_car.toml"),
            str(EXAMPLES / f"{name}.toml"),
        )
        for name, pattern in (
            ("tudelft_1to5", "other/tudelft_1to5/c*.csv"),
            ("f1tenth_ds5", "other/f1tenth_ds5"),
        )
    ),
]


class Judged(NamedTuple):
    """One log."""

    source: str
    log: str
    car: str
    fitted: bool  # the car's fit has seen the log
    charge: float  # of the battery
    windows: dict[str, list[Window]]  # by model, in the same order

    def errors(self) -> dict[str, np.ndarray]:
        """By model, the absolute errors at the windows' ends: (windows, `JUDGED`)."""
        ours = self.windows[OURS]
        still = [[off(window, name, "unchanged") for name in JUDGED] for window in ours]
        found = {NOTHING: np.array(still)}
        for model, windows in self.windows.items():
            found[model] = np.array(
                [[off(window, name, "simulated") for name in JUDGED] for window in windows]
            )
        return found

    def transient(self) -> np.ndarray:
        """True for windows in which something changes: (windows,)."""
        return np.array([changes(window) for window in self.windows[OURS]])


def off(window: Window, name: str, column: str) -> float:
    """The absolute error of a quantity at a window's end; NaN if it was not measured."""
    one = window.get(name) or window.get(WITHOUT_CAPTURE.get(name, name))
    return np.nan if one is None else float(abs(getattr(one, column)[-1] - one.measured[-1]))


def judge(source: Source, run: Run, car_name: str, car_file: str) -> Judged:
    """All models in the windows of one log."""
    car = load_car(car_file)
    result, series = compare(run, car, HORIZON, fit.STEP)
    windows = {OURS: series["windows"]}
    if source.model is not None:
        windows[PUBLISHED] = published_windows(source.model, run, car, HORIZON)[0]
    return Judged(
        source.title,
        run.path.name,
        car_name,
        has_seen(car_file, run.path.name),
        result["battery_charge"],
        windows,
    )


def published_windows(
    model: Model, run: Run, car: Any, horizon: float | None
) -> tuple[list[Window], list[float]]:
    """The windows as a published model predicts them, and their starts (s).

    `car` has no part in the prediction but for the starts of logs without motion capture.
    """
    simulation, *_ = simulation_of(run, car, horizon, fit.STEP)
    starts, ticks = simulation.starts, simulation.ticks
    command = asked(run.commands, np.arange(int(starts.max()) + ticks), fit.STEP)
    lock = np.radians(run.about["full_lock_deg"])
    drive, steering = model.inputs(command.throttle, command.steering / lock, fit.STEP)
    rows = starts[:, None] + np.arange(ticks)
    motion = simulation.states.motion
    begin = Velocity(*(np.asarray(one) for one in (motion.vx, motion.vy, motion.yaw_rate)))
    return simulation.windows_of(predict(model, begin, drive[rows], steering[rows], fit.STEP))


def has_seen(car_file: str, log: str) -> bool:
    """Whether `[source]` of a car's file names the log among those that it was fitted to."""
    tables, _ = read_toml(car_file, LIBRARY, "car")
    named = str(tables.get("source", {}).get("logs", "")).partition("validate")[0]
    words = named.replace(":", " ").replace(",", " ").split()
    return any(len(word) > 4 and word in log for word in words)


def medians(judged: Iterable[Judged], transient: bool) -> tuple[int, dict[str, np.ndarray]]:
    """How many windows, and by model the median errors over them: (`JUDGED`,)."""
    pooled: dict[str, list[np.ndarray]] = {}
    for one in judged:
        chosen = one.transient() if transient else slice(None)
        for model, errors in one.errors().items():
            pooled.setdefault(model, []).append(errors[chosen])
    whole = {model: np.concatenate(parts) for model, parts in pooled.items()}
    count = len(whole[NOTHING])
    found = {}
    for model, errors in whole.items():
        known = np.isfinite(errors).any(axis=0)
        found[model] = np.full(len(JUDGED), np.nan)
        if known.any():
            found[model][known] = np.nanmedian(errors[:, known], axis=0)
    return count, found


def table(judged: Sequence[Judged], by_log: bool) -> list[str]:
    """The rows of the table, by source or by log."""
    groups: dict[str, list[Judged]] = {}
    for one in judged:
        groups.setdefault(one.log if by_log else one.source, []).append(one)
    models = (NOTHING, PUBLISHED, OURS)
    lines = [
        "| logs | car | fit | windows | " + " | ".join(JUDGED.values()) + " |",
        "| --- | --- | --- | ---: |" + " ---: |" * len(JUDGED),
    ]
    for title, group in groups.items():
        seen = {one.fitted for one in group}
        kind = "seen" if seen == {True} else "held out" if seen == {False} else "some seen"
        if by_log:
            kind += f", battery {group[0].charge:.2f}"
        for words, transient in ((title, False), ("– where something changes", True)):
            count, errors = medians(group, transient)
            if not count:
                continue
            cells = []
            for k in range(len(JUDGED)):
                numbers = [errors[m][k] if m in errors else np.nan for m in models]
                cells.append(" / ".join("–" if np.isnan(n) else f"{n:.3f}" for n in numbers))
            lines.append(f"| {words} | {group[0].car} | {kind} | {count} | {' | '.join(cells)} |")
    return lines


def worse(judged: Iterable[Judged]) -> list[str]:
    """A line for each log and quantity at which ours is beyond `WORSE` times persistence."""
    lines = []
    for one in judged:
        for words, transient in (("", False), (", transient", True)):
            count, errors = medians([one], transient)
            for k, name in enumerate(JUDGED):
                ours, still = errors[OURS][k], errors[NOTHING][k]
                if ours > WORSE * still:
                    lines.append(
                        f"{one.source} {one.log}{words}: {name} {ours:.3f}, persistence "
                        f"{still:.3f} ({ours / still:.1f}x), {count} windows"
                    )
    return lines


def imported(data: Path, out: Path, only: str) -> list[tuple[Source, Run]]:
    """All logs as run folders below `out`. A log that `import` refuses is named and left out."""
    found = []
    for number, source in enumerate(one for one in SOURCES if only in one.title):
        for file in sorted(data.glob(source.files)):
            mapping = Path(source.mapping) if source.mapping else None
            try:
                made = importer(source.format, mapping)(file, out / str(number))
            except InputError as error:
                print(f"left out: {error}", flush=True)
                continue
            found.append((source, read_run(Path(made["run"]))))
    return found


def read_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m studies.how_true", description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--car", action="append", default=[], metavar="NAME=FILE.toml")
    parser.add_argument("--only", default="", help="sources whose title holds this")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    options = read_arguments(arguments)
    cars: Mapping[str, str] = dict(one.split("=", 1) for one in options.car)
    configure_jax(blocks=True)
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(True):
        judged = []
        for source, run in imported(options.data, Path(folder), options.only):
            name = source.car or str(run.about["car_name"])
            file = cars.get(name, source.car_file or name)
            try:
                judged.append(judge(source, run, name, file))
            except InputError as error:
                print(f"left out: {error}", flush=True)
                continue
            print("\n".join(table(judged[-1:], True)[2:]), flush=True)
    print("\n".join(table(judged, False)))
    print("\n".join(worse(judged)))


if __name__ == "__main__":
    main(sys.argv[1:])
