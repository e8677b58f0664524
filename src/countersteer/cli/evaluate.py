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
    laps_and_link(evaluate)


def run(options: argparse.Namespace) -> int:
    """`evaluate`."""
    import numpy as np

    from countersteer.batch import evaluate
    from countersteer.batch.population import load_population
    from countersteer.batch.separation import drawn_columns, result_columns, separation
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import for_another_car
    from countersteer.drivers.registry import make_driver
    from countersteer.link.link import LINKS
    from countersteer.runs.files import csv_text, read_commands
    from countersteer.runs.recorder import new_folder
    from countersteer.task.judge import Outcome
    from countersteer.viewing.evaluation import draw_evaluation
    from countersteer.writing import whole, write_whole

    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    course, car = load_course(options.course), load_car(options.car, options.set)
    nominal, population = load_car(options.car), load_population(options.cars)
    seeds = range(options.seed, options.seed + options.trials)
    trials = evaluate.Trials(
        course, car, nominal, population, seeds, options.speed_mps, options.laps,
        LINKS[options.link], options.estimate, options.dt,
    )  # fmt: skip
    with new_folder(options.out, f"{Path(options.course).stem}-evaluate") as folder:
        scores: dict[str, Any] = {}
        notes: dict[str, str | None] = {}
        with Progress(options.json) as progress:
            for i, name in enumerate(options.driver):

                def made(speed: float | None, name: str = name) -> Any:
                    driver, tables = make_driver(
                        name, course, nominal, speed, options.laps, read_commands
                    )
                    notes[name] = for_another_car(tables, options.car)
                    return driver

                def report(done: int, trials: int, before: int = i * options.trials) -> None:
                    progress.show(before + done, len(options.driver) * trials)

                scores[name] = trials.run(made, report)
        columns = drawn_columns(population, trials.drawn, course)
        for note in filter(None, notes.values()):
            complain(note)
        found = {}
        table: dict[str, Any] = {"driver": [], "seed": []}
        for name, score in scores.items():
            won = np.asarray(score.outcome == Outcome.REACHED.code)
            found[name] = evaluate.results(score, seeds) | {
                "separated_by": separation(columns, won)
            }
            results = result_columns(score)
            for key, values in {"seed": seeds, **columns, **results}.items():
                table.setdefault(key, []).extend(values)
            table["driver"] += [name] * len(seeds)
        result = trials.about() | {"car": options.car, "drivers": found}
        picture = folder / "evaluate.png"
        title = f"{course.name}, {options.car}, {options.trials} trials"
        with whole(folder / "evaluate.json") as told, whole(folder / "trials.csv") as listed:
            write_whole(told, json.dumps(result, indent=1) + "\n")
            rows = zip(*table.values(), strict=True)
            write_whole(listed, csv_text(list(table), rows, DIGITS))
            draw_evaluation(scores, title, picture)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
        return DONE
    for line in evaluate.table_lines(found):
        print(line)
    print(f"picture: {picture}; every trial: {folder / 'trials.csv'}")
    print(f"one trial again: {_again(options, found)}")
    return DONE


def _again(options: argparse.Namespace, found: dict[str, Any]) -> str:
    """The command that drives the first failed trial again, or the first if none failed."""
    failed = [(name, seed) for name in found for seed in found[name]["failed_seeds"]]
    driver, seed = (failed or [(options.driver[0], options.seed)])[0]
    words = ["countersteer", "drive", options.course, "--driver", driver, "--seed", seed]
    words += ["--cars", options.cars, "--car", options.car, "--laps", options.laps]
    words += ["--link", options.link, "--estimate", options.estimate, "--dt", f"{options.dt:g}"]
    words += [word for change in options.set for word in ("--set", change)]
    if options.speed_mps is not None:
        words += ["--speed-mps", "{:g}:{:g}".format(*options.speed_mps)]
    return shlex.join(map(str, words))
