"""`experiment`: the paper's measurements."""

import argparse
import json
import os
from pathlib import Path

from countersteer import experiments
from countersteer.cli.options import DONE, Progress, Verbs, nominal_car
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    experiment = verbs.verb("experiment", "the paper's measurements", run)
    meaning = "; ".join(": ".join(pair) for pair in experiments.NAMES.items()).replace("%", "%%")
    names = tuple(experiments.NAMES)
    experiment.add_argument("name", choices=names, metavar="NAME", help=meaning)
    nominal_car(experiment)
    meaning = "measure in these runs' folders instead, of a real car or a simulated one"
    experiment.runs("--from", meaning, dest="runs")
    experiment.out_folder()


def run(options: argparse.Namespace) -> int:
    """`experiment`."""
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.experiments.result import write
    from countersteer.runs.recorder import new_folder
    from countersteer.runs.run import read_run

    # Only the closed loop is worth its time in a compiler that makes a function of it.
    closed = options.name in ("control-rate", "linked-turns")
    configure_jax(blocks=closed, cores=os.cpu_count() or 1)
    module, car = experiments.load(options.name), load_car(options.car, options.set)
    if options.runs and not hasattr(module, "measure"):
        raise InputError(f"--from: {options.name} is simulated, and measures no run")
    # A run that cannot be measured leaves no folder.
    measured = module.measure([read_run(path) for path in options.runs]) if options.runs else None
    with new_folder(options.out, options.name) as folder:
        if measured is None:
            with Progress(options.json) as progress:
                measured = module.simulate(car, Path(options.car).stem, progress.show)
        result = write(measured, folder, options.name)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
    else:
        print(f"{measured.text}\ntable, picture: {folder}")
    return DONE
