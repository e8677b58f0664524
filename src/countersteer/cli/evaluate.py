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
    laps_and_link,
    number,
    physics,
)


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
    from countersteer.batch import evaluate
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.registry import make_driver
    from countersteer.link.link import LINKS
    from countersteer.runs.files import read_commands
    from countersteer.runs.recorder import new_folder
    from countersteer.viewing.evaluation import draw_evaluation

    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    course, car = load_course(options.course), load_car(options.car, options.set)
    nominal, population = load_car(options.car), load_population(options.cars)
    seeds = range(options.seed, options.seed + options.trials)
    trials = evaluate.Trials(
        course, car, nominal, population, seeds, options.speed_mps, options.laps,
        LINKS[options.link], options.estimate, options.dt,
    )  # fmt: skip
    folder = new_folder(options.out, f"{Path(options.course).stem}-evaluate")
    scores = {}
    with Progress(options.json) as progress:
        for i, name in enumerate(options.driver):

            def made(speed: float | None, name: str = name) -> Any:
                return make_driver(name, course, nominal, speed, options.laps, read_commands)[0]

            def report(done: int, trials: int, before: int = i * options.trials) -> None:
                progress.show(before + done, len(options.driver) * trials)

            scores[name] = trials.run(made, report)
    found = {name: evaluate.results(score, seeds) for name, score in scores.items()}
    result = trials.about() | {"car": options.car, "drivers": found}
    (folder / "evaluate.json").write_text(json.dumps(result, indent=1) + "\n")
    picture = folder / "evaluate.png"
    title = f"{course.name}, {options.car}, {options.trials} trials"
    draw_evaluation(scores, title, picture)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
        return DONE
    for line in evaluate.table_lines(found):
        print(line)
    print(f"picture: {picture}")
    words = ["drive", options.course, "--cars", options.cars, "--car", options.car]
    if options.speed_mps is not None:
        words += ["--speed-mps", "{:g}:{:g}".format(*options.speed_mps)]
    print(f"one trial again: countersteer {shlex.join(words)} --driver D --seed SEED, and what")
    print("else was asked for here: --set, --laps, --link, --estimate, --dt")
    return DONE
