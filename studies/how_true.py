"""How true cars are: persistence, published models and ours on every log of `../shared/data`.

`python -m studies.how_true PAGE [--data FOLDER] [--car NAME=FILE.toml ...]` writes the page, and
its pictures into a folder beside it. NAME is the car that a log's importer names, and FILE is
judged in its place. The table is printed log by log.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from PIL import Image

from countersteer.car.car import Car
from countersteer.car.files import LIBRARY, load_car
from countersteer.compiling import configure_jax
from countersteer.errors import InputError
from countersteer.runs.importers import importer
from countersteer.runs.run import Run, read_run
from countersteer.text import read_toml
from countersteer.tuning import fit
from countersteer.tuning.belief import WORDS
from countersteer.tuning.compare import (
    HORIZON,
    Window,
    changes,
    compare,
    simulation_of,
    slides,
)
from countersteer.tuning.windows import asked
from countersteer.viewing.style import (
    INK,
    MEASURED,
    SIMULATED,
    SOFT,
    Prediction,
    draw_commands,
    draw_windows,
    dress,
    light,
    new_figure,
)
from countersteer.writing import whole as written
from countersteer.writing import write_whole
from studies.published import Dart, Eth, Model, Velocity, predict

NOTHING, PUBLISHED, OURS = "nothing changes", "published", "ours"
MODELS = (NOTHING, PUBLISHED, OURS)
JUDGED = {
    "vx_mps": "forward, m/s",
    "vy_mps": "lateral, m/s",
    "yaw_rate_radps": "yaw rate, rad/s",
}
WITHOUT_CAPTURE = {"vx_mps": "wheel_speed_mps"}  # the wheels stand for the car's speed
KINDS = {  # of windows
    "all": lambda _: True,
    "where something changes": changes,
    "where the car slides": slides,
}
FEWEST = 5  # windows of a row
WORSE = 1.2  # times persistence; beyond it, a log is listed
SHOWN, APART = 5.0, 1.0  # s of a log in a picture, and between the windows drawn
SIZE_IN = (9.0, 5.6)
THEIRS = light("run-4")
COLOURS = 64  # of a picture, so that it stays small
EXAMPLES = Path("examples/logs")


class Source(NamedTuple):
    """Logs of one folder that are judged together."""

    title: str
    files: str  # pattern below the data's folder
    format: str  # of `import`
    model: Model | None
    car: str = ""  # where the importer names none
    car_file: str = ""  # of that car
    mapping: str = ""


def of_other_make(name: str, files: str) -> Source:
    """Logs that a mapping of `examples/logs` imports, with the car beside it."""
    car, mapping = (str(EXAMPLES / f"{name}{end}.toml") for end in ("_car", ""))
    return Source(name, files, "csv", None, name, car, mapping)


SOURCES = (
    *(
        Source(folder, f"dart/{folder}/*.csv", "dart", Dart())
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
    ),
    Source("ETH train_1", "eth_rccar/train_1.npz", "eth", Eth()),
    Source("ETH train_2", "eth_rccar/train_2.npz", "eth", Eth()),
    of_other_make("tudelft_1to5", "other/tudelft_1to5/c*.csv"),
    of_other_make("f1tenth_ds5", "other/f1tenth_ds5"),
)

# States one second after a like start differ so much in the log itself (the data's README).
REPEATABLE = {"drift_tape_and_tiles": (0.027, 0.022, 0.105)}

STEPS = "throttle_steps_rubber_floor"  # also judged over the whole of each run

# Part of a log's name, the manoeuvre, and whether the whole of it is one window
PICTURES = {
    "drift": ("drifting_clockwise", "Drift at full throttle and full lock", False),
    "circle": ("09_27_2024", "Circles on tiles, another day", False),
    "ramp": ("15_46_50steer02_ramp", "Throttle ramps on tiles", False),
    "steps": ("08_30_2024_15_01_02", "A straight step of throttle, the whole run", True),
    "slide": ("train_2", "Slides of the ETH car", False),
    "slippery": ("2025-04-16-17-36-01", "Racing on a slippery floor", False),
}

# What is known of logs that a car of the library predicts badly
REASONS = {
    "throttle_steps_rubber_floor": "One trim of the steering stands for all days. On a straight at "
    "2 m/s, half a degree of it is 0.1 rad/s.",
    "throttle_ramps": "A steady circle, which doing nothing predicts.",
    "circles_tape_and_tiles": "A steady circle, which doing nothing predicts.",
    "tudelft_1to5": "The car is the one of the examples, before any fit.",
    "f1tenth_ds5": "The car is the one of the examples, before any fit.",
}


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
        still = [[off(window, name, "unchanged") for name in JUDGED] for window in self.ours]
        return {NOTHING: np.array(still)} | {
            model: np.array(
                [[off(window, name, "simulated") for name in JUDGED] for window in windows]
            )
            for model, windows in self.windows.items()
        }

    @property
    def ours(self) -> list[Window]:
        """The windows as our car predicts them."""
        return self.windows[OURS]


def off(window: Window, name: str, column: str) -> float:
    """The absolute error of a quantity at a window's end; NaN if it was not measured."""
    one = window.get(name) or window.get(WITHOUT_CAPTURE.get(name, name))
    return np.nan if one is None else float(abs(getattr(one, column)[-1] - one.measured[-1]))


# -------------------------------------------------------------------------------------------------
# Judging
# -------------------------------------------------------------------------------------------------


def judge(
    source: Source, run: Run, name: str, file: str, horizon: float | None = HORIZON
) -> tuple[Judged, dict[str, Any]]:
    """All models in the windows of one log, and the series of `compare`."""
    car = load_car(file)
    result, series = compare(run, car, horizon, fit.STEP)
    windows = {OURS: series["windows"]}
    if source.model is not None:
        windows[PUBLISHED] = published_windows(source.model, run, car, horizon)
    seen = has_seen(file, run.path.name)
    judged = Judged(source.title, run.path.name, name, seen, result["battery_charge"], windows)
    return judged, series


def published_windows(model: Model, run: Run, car: Car, horizon: float | None) -> list[Window]:
    """The windows as a published model predicts them.

    `car` has no part in the prediction, but for the starts of logs without motion capture.
    """
    simulation, *_ = simulation_of(run, car, horizon, fit.STEP)
    starts, ticks = simulation.starts, simulation.ticks
    command = asked(run.commands, np.arange(int(starts.max()) + ticks), fit.STEP)
    lock = np.radians(run.about["full_lock_deg"])
    drive, steering = model.inputs(command[0], command.steering / lock, fit.STEP)
    rows = starts[:, None] + np.arange(ticks)
    motion = simulation.states.motion
    begin = Velocity(*(np.asarray(one) for one in (motion.vx, motion.vy, motion.yaw_rate)))
    return simulation.windows_of(predict(model, begin, drive[rows], steering[rows], fit.STEP))[0]


def has_seen(file: str, log: str) -> bool:
    """Whether `[source]` of a car's file names the log among those that it was fitted to."""
    tables, _ = read_toml(file, LIBRARY, "car")
    named = str(tables.get("source", {}).get("logs", "")).partition("validate")[0]
    words = named.replace(":", " ").replace(",", " ").split()
    return any(len(word) > 4 and word in log for word in words)


def medians(judged: Iterable[Judged], kind: str) -> tuple[int, dict[str, np.ndarray]]:
    """How many windows are of a kind, and by model the median errors over them: (`JUDGED`,)."""
    pooled: dict[str, list[np.ndarray]] = {}
    for one in judged:
        chosen = np.array([KINDS[kind](window) for window in one.ours], bool)
        for model, errors in one.errors().items():
            pooled.setdefault(model, []).append(errors[chosen])
    together = {model: np.concatenate(parts) for model, parts in pooled.items()}
    found = {}
    for model, errors in together.items():
        known = np.isfinite(errors).any(axis=0)
        found[model] = np.full(len(JUDGED), np.nan)
        found[model][known] = np.nanmedian(errors[:, known], axis=0)
    return len(together[NOTHING]), found


def over_whole_run(judged: Judged) -> dict[str, float]:
    """By model, the RMS error of the wheel speed in one window that is the whole run."""
    found = {}
    for model, (window,) in judged.windows.items():
        one = window["wheel_speed_mps"]
        found[model] = float(np.sqrt(np.mean((one.simulated - one.measured) ** 2)))
    return found


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


# -------------------------------------------------------------------------------------------------
# The page
# -------------------------------------------------------------------------------------------------


def rows(title: str, group: Sequence[Judged]) -> list[str]:
    """The rows of logs that are judged together, one a kind of windows."""
    seen = {one.fitted for one in group}
    fitted = "fitted" if seen == {True} else "held out" if seen == {False} else "some fitted"
    lines = []
    for kind in KINDS:
        count, errors = medians(group, kind)
        if count < (1 if kind == "all" else FEWEST):
            continue
        cells = [
            cell([errors[model][k] if model in errors else np.nan for model in MODELS])
            for k in range(len(JUDGED))
        ]
        about = (title, group[0].car, fitted) if kind == "all" else (f"– {kind}", "", "")
        lines.append(f"| {' | '.join(about)} | {count} | {' | '.join(cells)} |")
    if title.strip("`") in REPEATABLE:
        cells = [f"{number:.3f}" for number in REPEATABLE[title.strip("`")]]
        lines.append(f"| – the log's own repeatability | | | | {' | '.join(cells)} |")
    return lines


def cell(numbers: Sequence[float]) -> str:
    """The errors of `MODELS`, the least of them bold."""
    if np.all(np.isnan(numbers)):
        return ""
    least = int(np.nanargmin(numbers))
    words = ["–" if np.isnan(number) else f"{number:.3f}" for number in numbers]
    words[least] = f"**{words[least]}**"
    return " · ".join(words)


def worse(judged: Iterable[Judged]) -> list[str]:
    """A table of the logs with an error of ours beyond `WORSE` times persistence, and reasons."""
    lines, sources = [], []
    for one in judged:
        found = []
        for kind, mark in (("all", ""), ("where something changes", " (transient)")):
            count, errors = medians([one], kind)
            for k, words in enumerate(JUDGED.values()):
                ours, still = errors[OURS][k], errors[NOTHING][k]
                if count >= FEWEST and ours > WORSE * still:
                    found.append(f"{words.split(',')[0]}{mark} {still:.3f} · {ours:.3f}")
        if found:
            about = f"`{one.source}`: {one.log}"
            lines.append(f"| {about} | {one.car} | {one.charge:.2f} | {'; '.join(found)} |")
            sources.append(one.source)
    if not lines:
        return ["On no log."]
    reasons = [f"- `{one}`: {REASONS[one]}" for one in dict.fromkeys(sources) if one in REASONS]
    return [
        f"Errors are of {NOTHING} · {OURS}. `replay --compare` warns of the larger ones itself.",
        "",
        "| log | car | battery | errors |",
        "| --- | --- | ---: | --- |",
        *lines,
        "",
        *(["What is known of them:", "", *reasons] if reasons else []),
    ]


def steps(whole: Mapping[float, Mapping[str, float]]) -> list[str]:
    """The table of whole runs; errors are by throttle and model."""
    if not whole:
        return []
    levels = sorted(whole)
    lines = [
        "## Straight steps of throttle, the whole run",
        "",
        "RMS error of the wheel speed, m/s, over the whole of each run, from rest to rest:",
        "",
        "| throttle | " + " | ".join(f"{level:.2f}" for level in levels) + " | mean |",
        "| --- |" + " ---: |" * (len(levels) + 1),
    ]
    for model in (PUBLISHED, OURS):
        errors = [whole[level][model] for level in levels]
        cells = [f"{error:.3f}" for error in (*errors, float(np.mean(errors)))]
        lines.append(f"| {model} | {' | '.join(cells)} |")
    return [*lines, ""]


def page(
    judged: Sequence[Judged],
    whole: Mapping[float, Mapping[str, float]],
    pictures: Mapping[str, str],
    options: Sequence[str],
) -> str:
    """The text of the docs page; `whole` is of `steps`, and `pictures` are captions by file."""
    groups: dict[str, list[Judged]] = {}
    for one in judged:
        groups.setdefault(one.source, []).append(one)
    command = " ".join(["python -m studies.how_true docs/how_true.md", *options])
    lines = [
        "# How true is it?",
        "",
        f"Made by `make how-true` (`{command}`). Do not edit it.",
        "",
        "Each log is cut into windows of one second, as `replay --compare` does. Three predictions "
        "start from the measured state, and get the log's commands:",
        "",
        "- **nothing changes**: the velocities stay as they are (persistence);",
        "- **published**: the model that was published with the log, of DART or of ETH "
        "(`studies/published.py`);",
        "- **ours**: the car of the library that `import` names for the log.",
        "",
        "A cell has the median absolute errors at the ends of the windows in this order, the least "
        "one bold. Logs without motion capture have the wheels' speed in place of the car's.",
        "",
        "*Fitted*: the car's fit has seen these logs, so its errors flatter it. *Held out*: it has "
        "not. The published models were fitted by their authors: DART's to the floor of good grip, "
        "with the straight steps among the drives; ETH's to drives of this car. Where a log does "
        "not tell how full the battery was, ours has the charge that agrees best with the log. The "
        "published models know no battery.",
        "",
        "| logs | car | fit | windows | " + " | ".join(JUDGED.values()) + " |",
        "| --- | --- | --- | ---: |" + " ---: |" * len(JUDGED),
    ]
    for title, group in groups.items():
        lines += rows(f"`{title}`", group)
    lines += ["", *steps(whole), f"## Where it is worse than {WORSE:g} times doing nothing", ""]
    lines += worse(judged)
    lines += ["", "## Pictures", "", LEGEND, ""]
    for file, caption in pictures.items():
        lines += [caption, "", f"![{Path(file).stem}]({file})", ""]
    return "\n".join(lines)


LEGEND = (
    "Grey is the log, orange our car, purple the published model. Each prediction starts at its "
    "dot from the measured state. A picture shows the stretch of its log in which most changes."
)


# -------------------------------------------------------------------------------------------------
# Pictures
# -------------------------------------------------------------------------------------------------


def busiest(starts: np.ndarray, windows: Sequence[Window]) -> float:
    """The start (s) of the stretch of `SHOWN` seconds in which the motion changes most."""
    size = [
        sum(
            float(np.mean(np.abs(one.measured - one.unchanged))) / scale
            for name, scale in zip(WORDS, fit.SCALES, strict=True)
            if (one := window.get(name)) is not None
        )
        for window in windows
    ]
    within = [
        np.sum(np.array(size)[(starts >= begin) & (starts <= begin + SHOWN - HORIZON)])
        for begin in starts
    ]
    return float(starts[int(np.argmax(within))])


def draw(judged: Judged, series: Mapping[str, Any], title: str, path: Path) -> None:
    """Write a stretch of a log, with the predictions of both models, as PNG."""
    figure, canvas = new_figure(*SIZE_IN)
    starts, commands = np.array(series["starts_s"]), series["commands"]
    first = busiest(starts, judged.ours) if len(starts) > 1 else float(starts[0])
    last = first + SHOWN if len(starts) > 1 else float(commands["time_s"][-1])
    wanted = np.arange(first, last - HORIZON + 1e-6, APART) if len(starts) > 1 else starts
    shown = sorted({int(np.argmin(np.abs(starts - time))) for time in wanted})
    names = [name for name in WORDS if name in series["measured"]]
    if len(names) > len(JUDGED):
        names.remove("wheel_speed_mps")
    names += ["commands"]
    left, right, top, bottom = 0.07, 0.93, 0.91, 0.085
    pitch = (top - bottom) / len(names)
    figure.text(left, 0.955, title, color=INK, size=12, weight="bold", va="center")
    keys = (("log", MEASURED), (OURS, SIMULATED), (PUBLISHED, THEIRS))
    for place, (words, colour) in enumerate(keys):
        figure.text(
            0.72 + 0.07 * place, 0.955, words, color=colour, size=11, weight="bold", va="center"
        )
    for k, name in enumerate(names):
        axes = figure.add_axes((left, top - (k + 1) * pitch, right - left, pitch - 0.05))
        axes.set_xlim(first, last)
        dress(axes)
        axes.tick_params(labelbottom=name == "commands")
        axes.locator_params(axis="y", nbins=4)
        above = top - k * pitch - 0.022
        if name == "commands":
            draw_commands(axes, commands, np.degrees(commands["steering"]))
            axes.set_xlabel("time, s", color=SOFT, size=9.5)
            words = "commands"
        else:
            lines = [
                Prediction(
                    np.append(starts[i], one.time),
                    np.append(one.unchanged[:1], one.simulated),
                    colour,
                )
                for model, colour in ((PUBLISHED, THEIRS), (OURS, SIMULATED))
                for i in shown
                if (one := judged.windows[model][i].get(name)) is not None
            ]
            signal = series["measured"][name]
            draw_windows(axes, signal.time, signal.value, lines)
            words = ", ".join(WORDS[name])
        figure.text(left, above, words, color=INK, size=9.5, va="center")
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(COLOURS)
    with written(path) as part:
        picture.save(part, format="PNG", optimize=True)


def drawn(
    source: Source, run: Run, name: str, file: str, kept: tuple[Judged, dict[str, Any]], page: Path
) -> dict[str, str]:
    """Draw the log if it is one of `PICTURES`. Returns its caption by its path from the page."""
    for key, (log, title, is_whole) in PICTURES.items():
        if log in run.path.name:
            judged, series = judge(source, run, name, file, None) if is_whole else kept
            picture = page.with_suffix("") / f"{key}.png"
            picture.parent.mkdir(parents=True, exist_ok=True)
            draw(judged, series, title, picture)
            fitted = "fitted" if judged.fitted else "held out"
            return {f"{picture.parent.name}/{picture.name}": f"{title} (`{name}`, {fitted}):"}
    return {}


# -------------------------------------------------------------------------------------------------
# The command
# -------------------------------------------------------------------------------------------------


def read_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(prog="python -m studies.how_true")
    parser.add_argument("page", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--car", action="append", default=[], metavar="NAME=FILE.toml")
    parser.add_argument("--only", default="", help="folders whose name holds this")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> None:
    """Run the command."""
    options = read_arguments(arguments)
    cars: Mapping[str, str] = dict(one.split("=", 1) for one in options.car)
    configure_jax(blocks=True)
    judged: list[Judged] = []
    pictures: dict[str, str] = {}
    whole: dict[float, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(True):
        for source, run in imported(options.data, Path(folder), options.only):
            name = source.car or str(run.about["car_name"])
            file = cars.get(name, source.car_file or name)
            try:
                kept = judge(source, run, name, file)
            except InputError as error:
                print(f"left out: {error}", flush=True)
                continue
            judged.append(kept[0])
            if source.title == STEPS:
                level = round(float(np.max(run.commands["throttle"])), 2)
                whole[level] = over_whole_run(judge(source, run, name, file, None)[0])
            pictures |= drawn(source, run, name, file, kept, options.page)
            title = f"{run.path.name}, battery {kept[0].charge:.2f}"
            print("\n".join(rows(title, [kept[0]])), flush=True)
    text = page(judged, whole, pictures, [f"--car {one}" for one in options.car])
    write_whole(options.page, text)
    print(text)


if __name__ == "__main__":
    main(sys.argv[1:])
