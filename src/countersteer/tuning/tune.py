"""`tune`: fit a car to runs, and measure its errors."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from countersteer.car.car import Car
from countersteer.car.files import car_text, library, load_car
from countersteer.car.parameter import EDGE, changed
from countersteer.errors import InputError
from countersteer.runs.defects import LogDefect, find_defects, repair
from countersteer.runs.files import drive_column
from countersteer.runs.run import Run
from countersteer.text import toml_of
from countersteer.tuning import belief, fit, shooting
from countersteer.tuning.fit import FLOOR, Fitted, Result
from countersteer.tuning.log_sensors import LogSensors, resolve
from countersteer.tuning.shooting import Shots
from countersteer.tuning.windows import CHANGES, QUANTITIES

EVERY = 0.25  # s between the starts of windows
MOST = 640  # windows in a fit, an equal share for each log: more only take time


class Logs(NamedTuple):
    """Windows of runs, with their start times (s)."""

    runs: list[Run]
    masked: list[str]  # a line for each repair and each stretch left out
    shots: Shots
    start: np.ndarray
    sensors: list[LogSensors]  # of each run

    @property
    def run(self) -> np.ndarray:
        """The index of each window's run: (windows,)."""
        return np.asarray(self.shots.run)

    def where(self, chosen: np.ndarray) -> "Logs":
        """The windows that a mask or indices choose."""
        shots = fit.select(self.shots, chosen)
        return self._replace(shots=shots, start=self.start[chosen])

    def with_charge(self, charge: np.ndarray) -> "Logs":
        """The windows with `charge` (runs,) as the known battery charge of their runs."""
        return self._replace(shots=fit.with_charge(self.shots, charge))

    def joined(self, other: "Logs") -> "Logs":
        """These windows, followed by those of other runs."""
        after = other.shots._replace(run=other.run + len(self.runs))
        return Logs(
            self.runs + other.runs,
            self.masked + other.masked,
            shooting.joined([self.shots, after]),
            np.concatenate([self.start, other.start]),
            self.sensors + other.sensors,
        )


def read_logs(runs: Sequence[Run], cars: Mapping[str, Car], every: float, base: str) -> Logs:
    """The windows of runs without their defects.

    `every` (s) is the time between two starts. Raises `InputError` if a run is unusable.
    """
    clean, sensors, masks, words = [], [], [], []
    for run in runs:
        car = cars[surface_of(run, cars, base)]
        found = find_defects(run, car)
        mended, repairs = repair(run)
        sensors.append(resolve(mended, car, fit.STEP))
        clean.append(sensors[-1].run)
        masks.append(found)
        words += [f"{run.path.name}: {line}" for line in repairs]
        words += [_defect_line(run, defect) for defect in found]
    surfaces = [surface_of(run, cars, base) for run in clean]
    shots, start = fit.take_shots(clean, dict(cars), surfaces, masks, every)
    return Logs(clean, words, shots, start, sensors)


def _defect_line(run: Run, defect: LogDefect) -> str:
    return f"{run.path.name}: {defect.start:.1f} to {defect.end:.1f} s: {defect.what}"


def surface_of(run: Run, cars: Mapping[str, Car], base: str) -> str:
    """The surface of a run: the car that its `run.toml` names if it is in `cars`, else the base."""
    name = str(run.about.get("car_name", base))
    return name if name in cars else base


def other_floors(base: str, named: Iterable[str]) -> dict[str, Car]:
    """The cars that logs name: a file beside a base file, or else a car of the library.

    Other names are left out. Their logs count as driven on the base's own floor.
    """
    where = {name: name for name in library()}
    if Path(base).suffix == ".toml":
        where |= {path.stem: str(path) for path in Path(base).parent.glob("*.toml")}
    return {name: load_car(where[name]) for name in sorted(set(named) & set(where))}


def by_surface(base: str, car: Car, others: Mapping[str, Car]) -> dict[str, Car]:
    """A car for each surface: the base, with the parameters of `FLOOR` from the others."""
    cars = {base: car}
    for name, other in others.items():
        cars[name] = car
        for path in FLOOR:
            cars[name] = changed(cars[name], path, np.float64(fit.value_of(other, path)))
    return cars


def tune(
    logs: Logs,
    cars: dict[str, Car],
    what: str,
    hold_out: bool,
    validation: Logs | None,
    report: Callable[[str], None],
) -> tuple[Result, dict[str, Any], list[tuple[str, Logs]]]:
    """Fit a car, and measure its errors. Returns the fit, its JSON, and the windows by kind.

    With `hold_out`, blocks of the logs' time are held out of the fit (`fit.blocks`). Raises
    `InputError` if the logs are too short for that.
    """
    began = time.monotonic()
    parts = [("fitted", logs)]
    if hold_out:
        kind = fit.blocks(logs.start, logs.run)
        if not ((kind == 1).any() and (kind == 2).any()):
            raise InputError("too little data to hold a part out: give --validate, or --hold-out 0")
        parts = [("fitted", logs.where(kind == 1)), ("held out", logs.where(kind == 2))]
    fitted = parts[0][1]
    thin = fitted.where(spread(fitted.run))
    result = fit.fit(cars, thin.shots, what, report)
    # A charge that no log states is estimated from the fitted windows; for other logs, from theirs.
    charge = fit.estimated_charge(result.cars, thin.shots)
    parts = [(title, part.with_charge(charge)) for title, part in parts]
    if validation is not None:
        charge = fit.estimated_charge(result.cars, validation.shots)
        parts.append(("validation", validation.with_charge(charge)))
    runs: list[dict[str, Any]] = []
    totals: dict[str, Any] = {}
    for title, part in parts:
        totals[title] = {}
        for number, name in enumerate(cars):
            chosen = part.shots.surface == number
            if chosen.any():
                totals[title][name] = judged(result.cars, part.where(chosen).shots)
        for i, run in enumerate(part.runs):
            chosen = part.run == i
            if chosen.any():
                shots = part.where(chosen).shots
                surface = list(cars)[int(shots.surface[0])]
                entry = {
                    "run": run.path.name,
                    "surface": surface,
                    "kind": title,
                    "battery_charge": float(shots.charge[0]),
                    "battery_known": "battery_charge" in run.about,
                    "battery_from": part.sensors[i].charge_from or "fit",
                }
                runs.append(entry | judged(result.cars, shots))
    about: dict[str, Any] = {
        "fit": what,
        "seconds": round(time.monotonic() - began, 1),
        "surfaces": list(cars),
        "parameters": [parameter_row(one, logs.runs) for one in result.fitted],
        "not_determined": sorted({f.path for f in result.fitted if not f.determined}),
        "at_bounds": sorted({f.path for f in result.fitted if f.at_bound}),
        "runs": runs,
        "totals": totals,
        "masked": logs.masked,
        "sensors": {
            run.path.name: {"estimates": of.as_json(), "warnings": of.warnings}
            for run, of in zip(logs.runs, logs.sensors, strict=True)
        },
        "evaluations": result.evaluations,
        "cost": result.cost,
    }
    turned = {
        name: fitted.shots.measured[fitted.shots.surface == number, 2, -1]
        for number, name in enumerate(cars)
    }
    about["warnings"] = belief.of_fit(about, turned)
    return result, about, parts


def spread(run: np.ndarray, most: int = MOST) -> np.ndarray:
    """The indices of `most` windows or less, evenly among those of each log (windows,)."""
    of_log = [np.flatnonzero(run == number) for number in np.unique(run)]
    share = max(most // len(of_log), 1)
    even = [np.unique(np.linspace(0, len(k) - 1, min(share, len(k))).astype(int)) for k in of_log]
    return np.sort(np.concatenate([k[i] for k, i in zip(of_log, even, strict=True)]))


def transient(shots: Shots) -> np.ndarray:
    """True for windows whose motion changes by more than `CHANGES`; without capture, the wheels."""
    start = np.stack([*shots.velocity], axis=1)[:, :, None]
    change = np.abs(shots.measured[:, :3] - start)
    wheels = np.abs(shots.measured[:, 3] - shots.wheel_speed[:, None])
    captured = np.isfinite(shots.measured[:, 0]).any(axis=1)
    lively = np.nan_to_num(change) > np.array([*CHANGES.values()])[:, None]
    return np.where(
        captured, lively.any(axis=(1, 2)), (np.nan_to_num(wheels) > CHANGES["vx_mps"]).any(axis=1)
    )


def judged(cars: dict[str, Car], shots: Shots) -> dict[str, Any]:
    """Errors over the windows, over the steady and the transient ones, and how many spin."""
    predicted, lively = fit.Problem(cars, shots, ()).predictions(), transient(shots)

    def over(chosen: np.ndarray) -> dict[str, Any]:
        found: dict[str, Any] = {"windows": int(chosen.sum())}
        if chosen.any():
            some = fit.errors(predicted[chosen], fit.select(shots, chosen))
            found |= {"errors": some["simulated"], "persistence": some["persistence"]}
        return found

    motions = zip(shots.measured[:, :3], predicted[:, :3], strict=True)
    return over(np.full(len(lively), True)) | {
        "steady": over(~lively),
        "transient": over(lively),
        "spins": belief.spin_count(motions),
    }


def parameter_row(one: Fitted, runs: Sequence[Run]) -> dict[str, Any]:
    """A fitted parameter in the units of files."""
    declared = fit.declaration(one.path)
    suffix, factor = EDGE[declared.unit]
    return {
        "path": one.path,
        "surface": one.surface,
        "run": None if one.run is None else runs[one.run].path.name,
        "unit": suffix.lstrip("_"),
        "prior": one.before / factor,
        "value": one.value / factor,
        "deviation": one.deviation / factor,
        "by_curvature": one.by_curvature / factor,
        "by_halves": one.by_halves / factor,
        "determined": one.determined,
        "at_bound": one.at_bound,
    }


def series(cars: dict[str, Car], parts: Sequence[tuple[str, Logs]]) -> list[dict[str, Any]]:
    """The series of the page: each run as measured, with its simulated windows."""
    drawn: dict[str, dict[str, Any]] = {}
    for kind, part in parts:
        found = fit.Problem(cars, part.shots, ()).predictions()
        steps = shooting.SAMPLE * np.arange(1, part.shots.measured.shape[-1] + 1)
        for i, run in enumerate(part.runs):
            rows = np.flatnonzero(part.run == i)
            if not len(rows):
                continue
            entry = drawn.setdefault(
                run.path.name,
                {
                    "run": run.path.name,
                    "surface": list(cars)[int(part.shots.surface[rows[0]])],
                    "kind": kind,
                    "quantities": [
                        {"name": q, "time": [], "measured": [], "windows": []} for q in QUANTITIES
                    ],
                    "commands": {
                        "time": run.commands["time_s"],
                        drive_column(run.commands): run.commands[drive_column(run.commands)],
                        "steering_deg": np.degrees(run.commands["steering"]),
                    },
                },
            )
            for row in rows:
                times = part.start[row] + steps
                for j, quantity in enumerate(entry["quantities"]):
                    quantity["time"].append(times)
                    quantity["measured"].append(part.shots.measured[row, j])
                    quantity["windows"].append(
                        {
                            "time": times,
                            "simulated": found[row, j],
                            "held_out": kind != "fitted",
                        }
                    )
    for entry in drawn.values():
        for quantity in entry["quantities"]:
            times = np.concatenate(quantity["time"])
            order = np.unique(np.round(times, 4), return_index=True)[1]
            quantity["measured"] = np.concatenate(quantity["measured"])[order]
            quantity["time"] = times[order]
        entry["quantities"] = [q for q in entry["quantities"] if np.isfinite(q["measured"]).any()]
    return list(drawn.values())


def residuals(cars: dict[str, Car], logs: Logs, most: int = 3000) -> dict[str, Any]:
    """Normalised residuals by quantity. Larger sets are thinned to fewer than 2 `most`."""
    found = fit.Problem(cars, logs.shots, ()).predictions()
    result = {}
    for i, quantity in enumerate(QUANTITIES):
        off = ((found - logs.shots.measured)[:, i] / fit.SCALES[i]).ravel()
        off = off[np.isfinite(off)]
        if len(off):
            values = off[:: max(1, len(off) // most)].tolist()
            result[quantity] = {"scale": float(fit.SCALES[i]), "values": values}
    return result


def car_files(result: Result, out: Path) -> dict[str, Path]:
    """The file of each car: the first car's is `out`, those of the others are beside it."""
    first, *others = result.cars
    return {first: out} | {name: out.with_name(f"{name}.toml") for name in others}


def car_texts(result: Result, about: dict[str, Any], out: Path) -> dict[Path, str]:
    """The texts of `car_files`: the first car in full, the others with `FLOOR` alone."""
    files = car_files(result, out)
    base = about.get("car", next(iter(files)))
    source = {"fit": f"countersteer tune --fit {about['fit']} --car {base}"}
    runs = sorted({run["run"] for run in about["runs"] if run["kind"] != "validation"})
    source["logs"] = ", ".join(runs)
    texts = {}
    for name, path in files.items():
        about_source = source | {
            kind.replace(" ", "_"): _errors(totals[name])
            for kind, totals in about["totals"].items()
            if name in totals
        }
        if about["not_determined"]:
            about_source["not_determined"] = (
                ", ".join(about["not_determined"]) + ": the logs hardly tell them"
            )
        if path == out:
            texts[path] = car_text(result.cars[name], about_source)
            continue
        tables: dict[str, Any] = {"base": out.name, "source": about_source}
        for path_inside in FLOOR:
            *rooms, key = path_inside.split(".")
            suffix, factor = EDGE[fit.declaration(path_inside).unit]
            table = tables
            for room in rooms:
                table = table.setdefault(room, {})
            table[key + suffix] = fit.value_of(result.cars[name], path_inside) / factor
        texts[path] = toml_of(tables)
    return texts


def _errors(total: dict[str, Any]) -> str:
    """Median errors at the ends of windows, as a text."""
    errors = ", ".join(
        f"{quantity} {entry['median_abs_error']:.3f}" for quantity, entry in total["errors"].items()
    )
    return f"median error after {fit.HORIZON:g} s in {total['windows']} windows: {errors}"


def unseen_lines(about: dict[str, Any]) -> list[str]:
    """The lines for a terminal that come first: errors on what was not fitted, and the warnings."""
    unseen = [run for run in about["runs"] if run["kind"] != "fitted"]
    names = [name for name in QUANTITIES if any(name in run["errors"] for run in unseen)]
    width = max((len(run["run"]) + len(run["kind"]) + 2 for run in unseen), default=0)
    width = max(width, len("- where something changes"))
    lines = []
    if unseen:
        head = " ".join(f"{name:>17}" for name in names)
        lines.append(f"{'not fitted (if nothing changed)':{width}} windows {head}")
    for run in unseen:
        for title, scored in (
            (f"{run['run']}, {run['kind']}", run),
            ("- where something changes", run["transient"]),
        ):
            cells = [_cell(scored, name) for name in names]
            if "errors" in scored:
                lines.append(f"{title:{width}} {scored['windows']:7d} {' '.join(cells)}")
    return lines + [f"warning: {line}" for line in about["warnings"]]


def _cell(scored: dict[str, Any], name: str) -> str:
    """A quantity's error, and that of persistence in brackets."""
    if name not in scored.get("errors", {}):
        return f"{'':17}"
    error, still = (scored[key][name]["median_abs_error"] for key in ("errors", "persistence"))
    return f"{f'{error:.3f} ({still:.3f})':>17}"


def table_lines(about: dict[str, Any]) -> list[str]:
    """The lines for a terminal: errors by surface, and the parameters."""
    lines = []
    for kind, totals in about["totals"].items():
        for surface, total in totals.items():
            lines.append(f"{kind}, {surface}: {total['windows']} windows (if nothing changed)")
            for quantity, entry in total["errors"].items():
                still = total["persistence"].get(quantity, {}).get("median_abs_error", np.nan)
                error = entry["median_abs_error"]
                lines.append(f"  {quantity:18} {error:7.3f}  ({still:.3f})")
    for one in about["parameters"]:
        flag = "" if one["determined"] else "  not determined"
        flag += "  at its bound" if one["at_bound"] else ""
        unit = f"_{one['unit']}" if one["unit"] else ""
        where = one["surface"] or one["run"]
        name = one["path"] + unit + (f" ({where})" if where else "")
        change = f"{one['prior']:10.4g} -> {one['value']:10.4g} ± {one['deviation']:.2g}"
        lines.append(f"  {name:52} {change}{flag}")
    return lines
