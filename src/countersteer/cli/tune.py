"""`tune`: logs of a car to the car's numbers."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.cli.options import DONE, Verbs, number, out_file
from countersteer.errors import InputError

if TYPE_CHECKING:
    from countersteer.car.car import Car


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    tune = verbs.verb("tune", "logs of a car to the car's numbers", run)
    tune.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder")
    meaning = "where the fit begins, and what is not fitted: library name or .toml"
    tune.option("--car", "BASE", str, "rx7", meaning)
    meaning = (
        "acceleration: the motor's strength from steps of throttle; longitudinal: motor, battery, "
        "rolling, braking; steering: servo and its map; handling: yaw inertia and grip; drift: "
        "combined slip past the limit; all: these in turn, then everything at once"
    )
    kinds = ("acceleration", "longitudinal", "steering", "handling", "drift", "all")
    tune.option("--fit", None, str, "all", meaning, choices=kinds)
    tune.out_file("CAR.toml", "car")
    tune.runs("--validate", "judge on these runs")
    meaning = (
        "runs since BASE was fitted to the others: fit to all, and say by how much BASE errs more "
        "on these, and whether the driver should be learned again"
    )
    tune.runs("--new", meaning)
    meaning = (
        "1: keep every third block of 2 s of each run back and judge on it (default 1 without "
        "--validate)"
    )
    tune.option("--hold-out", "0|1", number(0, 1, int), None, meaning)
    meaning = "with --fit acceleration: what tells the speed"
    tune.option("--source", None, str, "encoder", meaning, choices=("encoder", "sonar", "lines"))
    meaning = "with --fit acceleration: done when it changes by less"
    tune.option("--precision", "PART", number(1e-9, 1), 1e-3, meaning)


def run(options: argparse.Namespace) -> int:
    """`tune`."""
    with out_file(options.out):
        return fit(options)


def fit(options: argparse.Namespace) -> int:
    """A fit of any kind."""
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.runs.run import read_run
    from countersteer.tuning.tune import other_floors

    configure_jax(blocks=True)
    runs = [read_run(path) for path in options.runs]
    car, base = load_car(options.car), Path(options.car).stem
    if options.fit == "acceleration":
        if options.new:
            raise InputError("--new: --fit acceleration does not judge new runs")
        return tune_acceleration(options, runs, car)
    validation = [read_run(path) for path in options.validate]
    new = [read_run(path) for path in options.new]
    named = {str(run.about.get("car_name", base)) for run in (*runs, *validation, *new)}
    others = other_floors(options.car, named - {base})
    return tune_all(options, runs, validation, new, base, car, others)


def tune_all(
    options: argparse.Namespace,
    runs: list[Any],
    validation: list[Any],
    new: list[Any],
    base: str,
    car: "Car",
    others: dict[str, "Car"],
) -> int:
    """A fit to windows of logs: cars by surface, a page beside them."""
    import jax

    from countersteer.tuning import relearn, tune
    from countersteer.tuning.advice import next_log
    from countersteer.viewing.tuning_page import tuning_page
    from countersteer.writing import write_together

    with jax.enable_x64(True):
        cars = tune.by_surface(base, car, others)
        logs = old = tune.read_logs(runs, cars, tune.EVERY, base)
        if new:
            since = tune.read_logs(new, cars, tune.EVERY, base)
            logs = old.joined(since)
        judged = tune.read_logs(validation, cars, tune.EVERY, base) if validation else None
        hold_out = not validation if options.hold_out is None else bool(options.hold_out)
        say = (lambda _: None) if options.json else (lambda text: print(f"  {text}", flush=True))
        result, about, parts = tune.tune(logs, cars, options.fit, hold_out, judged, say)
        about |= {
            "car": options.car,
            "commands": shlex.join(["countersteer", *sys.argv[1:]]),
            "residuals": tune.residuals(result.cars, parts[0][1]),
            "next_log": next_log(about["parameters"]),
        }
        if new:
            about["new_runs"] = relearn.judge(
                cars, result.cars, old, since, options.fit, hold_out, say
            )
        drawn = tune.series(result.cars, parts)
    page = options.out.with_suffix(".html")
    short = {key: value for key, value in about.items() if key != "residuals"}
    files = tune.car_files(result, options.out)
    short["cars"] = {name: str(path) for name, path in files.items()}
    told = {
        page: tuning_page(about, drawn),
        options.out.with_suffix(".json"): json.dumps(short, indent=1) + "\n",
    }
    write_together(tune.car_texts(result, about, options.out) | told)
    if options.json:
        print(json.dumps(short | {"page": str(page)}))
        return DONE
    for line in (*tune.unseen_lines(about), *tune.table_lines(about)):
        print(line)
    for name, told in about["sensors"].items():
        for line in told["warnings"]:
            print(f"warning: {name}: {line}")
    if new:
        print(about["new_runs"]["verdict"])
    print(f"cars: {', '.join(map(str, files.values()))}; page: {page}")
    return DONE


def tune_acceleration(options: argparse.Namespace, runs: list[Any], car: "Car") -> int:
    """The paper's adjuster: one parameter from steps of throttle."""
    from countersteer.car.files import save_car
    from countersteer.tuning.acceleration import fit_acceleration
    from countersteer.viewing.acceleration import draw_acceleration
    from countersteer.writing import whole

    found = fit_acceleration(runs, car, options.source, options.precision)
    about: dict[str, Any] = {
        "parameter": found.parameter,
        "before": found.before,
        "value": found.after,
        "deviation": found.deviation,
        "rms_before_mps": found.rms_before,
        "rms_mps": found.rms_after,
        "iterations": found.iterations,
        "levels": [round(series.level, 3) for series in found.series],
        "not_used": {one.path.name: one.reason for one in found.unused},
        "masked": list(found.masked),
    }
    picture = options.out.with_suffix(".png")
    with whole(options.out) as fitted:
        save_car(found.car, fitted, {"acceleration": json.dumps(about)})
        draw_acceleration(found, picture)
    if options.json:
        print(json.dumps(about | {"car": str(options.out), "picture": str(picture)}))
        return DONE
    print(
        f"{found.parameter}: {found.before:.4g} -> {found.after:.4g} ± {found.deviation:.2g}; "
        f"speed off by {found.rms_before:.3f} m/s before, {found.rms_after:.3f} after, over "
        f"{len(found.series)} levels in {found.iterations} steps"
    )
    for name, reason in about["not_used"].items():
        print(f"  not used: {name}: {reason}")
    for line in found.masked:
        print(f"  masked: {line}")
    print(f"car: {options.out}; picture: {picture}")
    return DONE
