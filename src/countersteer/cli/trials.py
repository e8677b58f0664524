"""`trials`: many drives, or commands for them."""

import argparse
import json
import os
from pathlib import Path
from typing import Any

from countersteer.cli.options import CHARGES, DONE, SPEEDS, Progress, Verbs, nominal_car, number
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    trials = verbs.group("trials", "many drives, or commands for them", "WHAT")
    does = "commands: from rest, straight, each a second at one throttle, then none"
    steps = trials("throttle-steps", does, run_steps)
    steps.option("--out", "DIR", Path, None, "folder of the files", required=True)
    steps.option(
        "--levels", "LIST", str, None, "throttles, such as 0.2,0.5 (default ten, 0.1 to 1)"
    )
    steps.option("--duration-s", "S", number(0.01, 60), 1.0, "at each throttle")
    steps.option("--rate-hz", "HZ", number(1, 1000), 100.0, "rows a second")
    does = "turns in the open, stopped at different yaw rates: time and angle until stopped"
    turns = trials("turns", does, run_turns)
    nominal_car(turns)
    meaning = "draw each trial's car from this set (default the car itself)"
    turns.option("--cars", "SET", str, None, meaning)
    turns.option("--trials", "N", number(1, 10**6, int), 1000, "turns")
    meaning = "drawn for each trial, or one V (default 1:3)"
    turns.add_argument(
        "--speed-mps", type=SPEEDS, default=(1.0, 3.0), metavar="LO:HI", help=meaning
    )
    meaning = "charge, 0 to 1 (default the set's, or 0.3:1)"
    turns.option("--battery", "LO:HI", CHARGES, None, meaning)
    turns.option("--driver", "POLICY", str, "drift-turn", "whose turns")
    turns.seed()
    turns.out_folder()
    meaning = "find the turns in these runs' folders instead, of a real car or a simulated one"
    turns.runs("--from", meaning, dest="runs")


def run_steps(options: argparse.Namespace) -> int:
    """`trials`."""
    from countersteer.experiments.throttle_steps import LEVELS, read_levels, throttle_steps

    levels = LEVELS if options.levels is None else read_levels(options.levels)
    result = throttle_steps(options.out, levels, options.duration_s, options.rate_hz)
    if options.json:
        print(json.dumps(result))
    else:
        print((options.out / "README.txt").read_text(), end="")
    return DONE


def run_turns(options: argparse.Namespace) -> int:
    """`trials turns`."""
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.drivers.policy import load_policy
    from countersteer.experiments import open_turns
    from countersteer.runs.recorder import new_folder
    from countersteer.writing import whole, write_whole

    if options.runs:
        rows = [row for path in options.runs for row in open_turns.of_run(path)]
        if not rows:
            raise InputError(f"--from: {len(options.runs)} runs, and no turn that was stopped")
        tried, title = None, ", ".join(path.name for path in options.runs[:2])
        title += f" and {len(options.runs) - 2} more" if len(options.runs) > 2 else ""
    else:
        configure_jax(cores=os.cpu_count() or 1)
        car, turning = load_car(options.car, options.set), load_policy(options.driver).turning
        cars = load_population(options.cars) if options.cars else None
        charge = options.battery or (None if cars else (0.3, 1.0))
        seeds = range(options.seed, options.seed + options.trials)
        tried, title = options.trials, f"{options.car}, {options.trials} turns"
    with new_folder(options.out, "turns") as folder:
        if not options.runs:
            with Progress(options.json) as progress:
                rows = open_turns.trial(
                    car, turning, cars, seeds, options.speed_mps, charge, progress.show
                )
        table = open_turns.as_table(rows)
        result: dict[str, Any] = (
            {"car": options.car} if tried else {"runs": [str(path) for path in options.runs]}
        )
        result |= open_turns.summary(table, tried)
        with whole(folder / "turns.json") as told, whole(folder / "turns.csv") as listed:
            write_whole(told, json.dumps(result, indent=1) + "\n")
            open_turns.write_rows(listed, rows)
            open_turns.draw_turns(table, folder / "turns.png", title)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
        return DONE
    print(f"{len(rows)} turns that were stopped; low, median, high:")
    for name in open_turns.COLUMNS[1:7]:
        ends = result[name]
        if ends:
            print(f"  {name:20}" + "".join(f"{ends[k]:10.2f}" for k in ("low", "median", "high")))
    print(f"table: {folder / 'turns.csv'}; picture: {folder / 'turns.png'}")
    return DONE
