"""The functions of `import countersteer`: a drive, an evaluation, and their parts by name."""

import html
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.batch import evaluate as evaluation
from countersteer.batch.margin import Margin
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.drivers.driver import Driver
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.estimation.registry import ESTIMATORS
from countersteer.link.link import LINKS
from countersteer.progress import Progress
from countersteer.recorded_drive import drive as record
from countersteer.recorded_drive import prepare
from countersteer.runs.files import read_commands
from countersteer.runs.recorder import new_folder
from countersteer.runs.run import Run as RunFolder
from countersteer.runs.run import read_run
from countersteer.viewing.picture import draw_picture
from countersteer.viewing.report import report_html
from countersteer.viewing.view import view_of
from countersteer.writing import write_whole


class Run:
    """A recorded drive: simulated, imported or real. In a notebook it shows its report.

    `columns` are those of `truth.csv` (NumPy arrays, units in the names). `commands` and
    `telemetry` are the other tables, `about` is `run.toml`. `folder` is the path of all files.
    """

    def __init__(self, folder: RunFolder) -> None:
        """From the content of a run's folder."""
        self.folder, self.about = folder.path, folder.about
        self.commands, self.telemetry = folder.commands, folder.telemetry
        self.columns: dict[str, np.ndarray] = folder.truth or {}
        self._summary, self._outcome = folder.summary, folder.outcome

    @property
    def outcome(self) -> str:
        """How the drive ended, in words."""
        return self._outcome

    @property
    def success(self) -> bool:
        """Whether the car reached its goal and touched no wall."""
        return bool(self._summary.get("success", False))

    @property
    def turns(self) -> list[dict[str, Any]]:
        """The turns as the judge found them; units are in the names."""
        return list(self._summary.get("turns", []))

    def to_pandas(self) -> Any:
        """The columns as a data frame. Raises `ImportError` if pandas is missing."""
        try:
            import pandas  # type: ignore[import-untyped]  # no package of ours needs it
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        return pandas.DataFrame(dict(self.columns))

    def __repr__(self) -> str:
        """The run in one line."""
        end = float(self.columns["time_s"][-1]) if len(self.columns) else 0.0
        return f"<Run {self.folder}: {self.outcome}, {len(self.turns)} turns, {end:.2f} s>"

    def _repr_html_(self) -> str:
        """The report page, for a notebook."""
        page = html.escape((self.folder / "report.html").read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{page}" width="100%" height="760" frameborder="0"></iframe>'


def load_run(folder: str | Path) -> Run:
    """The run in a folder. Raises `InputError` if it is not a run's folder."""
    return Run(read_run(Path(folder)))


def load_driver(
    name: str, course: Any, car: Any, speed: float | None = None, laps: int = 1
) -> Driver:
    """A driver by name or file, for a `Course` and a nominal `Car`; `speed` in m/s."""
    return make_driver(name, course, car, speed, laps, read_commands)[0]


def drive(
    course: str,
    car: str = "rx7",
    driver: str = "drift-turn",
    *,
    seed: int = 0,
    set: Sequence[str] = (),  # noqa: A002  # as on the command line
    speed: float | None = None,
    laps: int = 1,
    battery: float = 1.0,
    estimate: str = "filter",
    link: str = "onboard",
    dt: float = 0.001,
    out: str | Path | None = None,
) -> Run:
    """Drive once and record it, as `countersteer drive` does. Names are those of its options.

    `set` overrides parameters of the simulated car (`"battery.wear=0.3"`). The driver does not know
    them. `speed` is in m/s, `battery` is the charge from 0 to 1, `dt` is in seconds. The run's
    folder is `out`, or a new one under `runs/`. Raises `InputError` with one line for wrong input.
    """
    configure_jax(batches=False, cores=2)
    where, simulated = load_course(course), load_car(car, set)
    _check(link=(link, LINKS), estimate=(estimate, ESTIMATORS))
    what = prepare(
        where,
        simulated,
        driver,
        car_name=car,
        speed=speed,
        laps=laps,
        estimate=estimate,
        link=LINKS[link],
        dt=dt,
        seed=seed,
        charge=battery,
    )
    name = f"{Path(where.name).stem}-{what.about['driver']}"
    with new_folder(None if out is None else Path(out), name) as folder:
        with Progress() as progress:
            record(what, folder, progress.show)
        run = read_run(folder)
        view = view_of(run)
        write_whole(folder / "report.html", report_html(view))
        draw_picture(view, folder / "report.png")
    return Run(run)


def evaluate(
    course: str,
    driver: str = "drift-turn",
    *,
    trials: int = 1000,
    car: str = "rx7",
    cars: str = "around",
    seed: int = 0,
    speed: tuple[float, float] | None = None,
    laps: int = 1,
    estimate: str = "filter",
    link: str = "onboard",
    dt: float = 0.001,
) -> dict[str, Any]:
    """Evaluate a driver on random cars. Returns what `countersteer evaluate --json` has of it.

    `speed` is a range in m/s. It is fastest as the first use of JAX in a process.
    """
    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    where, nominal = load_course(course), load_car(car)
    _check(link=(link, LINKS), estimate=(estimate, ESTIMATORS))
    seeds = range(seed, seed + trials)
    many = evaluation.Trials(
        where, nominal, nominal, load_population(cars), seeds, speed, laps, LINKS[link],
        estimate, dt,
    )  # fmt: skip
    with Progress() as progress:
        score, margins = many.run_watched(
            lambda v: load_driver(driver, where, nominal, v, laps), Margin.of(where), progress.show
        )
    return evaluation.results(score, seeds, margins)


def _check(**choices: tuple[str, Iterable[str]]) -> None:
    """Raise `InputError` if a value is not one of its choices."""
    for name, (value, known) in choices.items():
        if value not in known:
            raise InputError(f"{name} must be one of {', '.join(known)}, not {value!r}")
