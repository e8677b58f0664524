"""`evaluate`: drivers judged over randomised cars."""

import argparse
import json
import os
import shlex
from pathlib import Path
from typing import Any

from countersteer.cli.options import (
    DONE,
    SPEEDS,
    Progress,
    Verbs,
    complain,
    laps_and_link,
    number,
    physics,
)

DIGITS = 7  # of numbers in trials.csv


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    evaluate = verbs.verb("evaluate", "drivers judged over randomised cars", run)
    evaluate.add_argument("course", metavar="COURSE", help="as for drive")
    meaning = "as for drive, one or more (default drift-turn)"
    evaluate.add_argument("--driver", nargs="+", default=["drift-turn"], metavar="D", help=meaning)
    evaluate.option("--trials", "N", number(1, 10**6, int), 1000, "random cars")
    physics(evaluate, "rx7")
    evaluate.option("--cars", "SET", str, "around", "what varies: library name or .toml file")
    meaning = "speed that the driver is asked to bring to a turn, drawn for each trial, or one V"
    evaluate.option("--speed-mps", "LO:HI", SPEEDS, None, meaning)
    laps_and_link(evaluate, estimates=True)
    meaning = "of drivers that are called from Python, such as mppi: they take seconds a trial"
    evaluate.option("--slow-trials", "N", number(1, 10**6, int), None, meaning)


def run(options: argparse.Namespace) -> int:
    """`evaluate`."""
    import numpy as np

    from countersteer.batch import evaluate
    from countersteer.batch.margin import Margin
    from countersteer.batch.population import load_population
    from countersteer.batch.separation import drawn_columns, result_columns, separation
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import for_another_car
    from countersteer.drivers.registry import learned_at, make_driver, steers_by
    from countersteer.link.link import LINKS
    from countersteer.pilot import traceable
    from countersteer.runs.files import csv_text, read_commands
    from countersteer.runs.recorder import new_folder
    from countersteer.task.judge import Outcome
    from countersteer.viewing.evaluation import draw_evaluation
    from countersteer.viewing.league import league_page
    from countersteer.writing import whole, write_whole

    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    course, car = load_course(options.course), load_car(options.car, options.set)
    nominal, population = load_car(options.car), load_population(options.cars)
    names, estimates = list(dict.fromkeys(options.driver)), list(dict.fromkeys(options.estimate))
    rows = [(name, estimate) for name in names for estimate in estimates]
    margin = Margin.of(course)
    found: dict[str, dict[str, Any]] = {}
    scores: dict[str, Any] = {}
    table: dict[str, Any] = {"driver": [], "estimate": [], "seed": []}
    with new_folder(options.out, f"{Path(options.course).stem}-evaluate") as folder:
        with Progress(options.json) as progress:
            for i, (name, estimate) in enumerate(rows):
                told: dict[str, Any] = {}

                def made(speed: float | None, name: str = name, told: dict[str, Any] = told) -> Any:
                    driver, tables = make_driver(
                        name, course, nominal, speed, options.laps, read_commands
                    )
                    told.update(tables)
                    return driver

                def report(done: int, trials: int, before: int = i) -> None:
                    progress.show(before + done / trials, len(rows))

                first = made(None if options.speed_mps is None else options.speed_mps[0])
                slow = options.slow_trials and not traceable(first)
                count = options.slow_trials if slow else options.trials
                seeds = range(options.seed, options.seed + count)
                trials = evaluate.Trials(
                    course, car, nominal, population, seeds, options.speed_mps, options.laps,
                    LINKS[options.link], estimate, options.dt,
                )  # fmt: skip
                score, margins = trials.run_watched(made, margin, report)
                note = for_another_car(told, options.car)
                if note and estimate == estimates[0]:
                    complain(note)
                key = name if len(estimates) == 1 else f"{name}, {estimate}"
                scores[key] = score
                columns = drawn_columns(population, trials.drawn, course)
                won = np.asarray(score.outcome == Outcome.REACHED.code)
                found[key] = evaluate.results(score, seeds, margins) | {
                    "separated_by": separation(columns, won),
                    "driver": name,
                    "estimate": estimate,
                    "steers_by": steers_by(told),
                    "learned_at": learned_at(told),
                    "command": _command(options, name, estimate, count),
                }
                results = {**columns, **result_columns(score), "wall_margin_m": margins}
                for column, values in {"seed": seeds, **results}.items():
                    table.setdefault(column, []).extend(values)
                table["driver"] += [name] * count
                table["estimate"] += [estimate] * count
        result = trials.about() | {
            "car": options.car,
            "estimate": estimates[0] if len(estimates) == 1 else estimates,
            "drivers": found,
        }
        picture, page = folder / "evaluate.png", folder / "evaluate.html"
        title = f"{course.name}, {options.car}, {options.trials} trials"
        with (
            whole(folder / "evaluate.json") as told_file,
            whole(folder / "trials.csv") as listed,
            whole(page) as league,
        ):
            write_whole(told_file, json.dumps(result, indent=1) + "\n")
            lines = zip(*table.values(), strict=True)
            write_whole(listed, csv_text(list(table), lines, DIGITS))
            draw_evaluation(scores, title, picture)
            write_whole(league, league_page(result, picture.read_bytes()))
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
        return DONE
    for line in evaluate.table_lines(found):
        print(line)
    print(f"page: {page}; picture: {picture}; every trial: {folder / 'trials.csv'}")
    print(f"one trial again: {_again(options, found)}")
    return DONE


def _command(options: argparse.Namespace, driver: str, estimate: str, count: int) -> str:
    """The command that makes a row of the league again."""
    words = ["countersteer", "evaluate", options.course, "--driver", driver]
    words += ["--trials", count, "--seed", options.seed, "--cars", options.cars]
    words += _shared(options, estimate)
    return shlex.join(map(str, words))


def _shared(options: argparse.Namespace, estimate: str) -> list[Any]:
    """Options that all commands of an evaluation share."""
    words = ["--car", options.car, "--laps", options.laps, "--link", options.link]
    words += ["--estimate", estimate, "--dt", f"{options.dt:g}"]
    words += [word for change in options.set for word in ("--set", change)]
    if options.speed_mps is not None:
        words += ["--speed-mps", "{:g}:{:g}".format(*options.speed_mps)]
    return words


def _again(options: argparse.Namespace, found: dict[str, Any]) -> str:
    """The command that drives the first failed trial again, or the first if none failed."""
    failed = [(one, seed) for one in found.values() for seed in one["failed_seeds"]]
    one, seed = (failed or [(next(iter(found.values())), options.seed)])[0]
    words = ["countersteer", "drive", options.course, "--driver", one["driver"], "--seed", seed]
    words += ["--cars", options.cars, *_shared(options, one["estimate"])]
    return shlex.join(map(str, words))
