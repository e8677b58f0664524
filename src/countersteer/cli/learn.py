"""`learn`: experience to a driver's numbers."""

import argparse
import json
import math
import os
from pathlib import Path

from countersteer.cli.options import DONE, Verbs, number
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    learn = verbs.group("learn", "experience to a driver's numbers", "METHOD")
    stop = learn(
        "stop-angle",
        "how far a car still turns once it is stopped: lines over the yaw rate, by speed",
        run_stop_angle,
    )
    stop.add_argument(
        "sources",
        nargs="+",
        type=Path,
        metavar="TABLE_OR_RUN",
        help="a turns.csv, the folder of trials turns, or a run's folder",
    )
    stop.add_argument(
        "--out", type=Path, required=True, metavar="POLICY.toml", help="where the policy is written"
    )
    stop.add_argument(
        "--most-deg",
        type=number(1, 360),
        default=90.0,
        metavar="DEG",
        help="leave out turns that ran on for more than this (default 90)",
    )

    turn = learn(
        "turn",
        "the numbers of the drift-turn driver, by driving random cars with many candidates",
        run_turn,
    )
    turn.add_argument("courses", nargs="+", metavar="COURSE", help="as for drive; by turns")
    turn.add_argument("--car", default="rx7", help="the nominal one (default rx7)")
    turn.add_argument("--cars", default="around", metavar="SET", help="as for evaluate")
    turn.add_argument(
        "--begin",
        default="drift-turn",
        metavar="POLICY",
        help="where the search begins (default that of the driver)",
    )
    turn.add_argument(
        "--generations", type=number(1, 1000, int), default=30, metavar="N", help="default 30"
    )
    turn.add_argument(
        "--candidates", type=number(4, 1024, int), default=32, metavar="N", help="default 32"
    )
    turn.add_argument(
        "--trials",
        type=number(1, 1024, int),
        default=48,
        metavar="N",
        help="random cars that each of them drives (default 48)",
    )
    turn.add_argument(
        "--spread",
        type=number(0.001, 10),
        default=0.5,
        metavar="X",
        help="how far it looks at first: 1 for another car, 0.2 to polish (default 0.5)",
    )
    turn.add_argument("--seed", type=number(0, 2**30, int), default=0, help="default 0")
    turn.add_argument(
        "--out", type=Path, required=True, metavar="POLICY.toml", help="where the policy is written"
    )


def run_stop_angle(options: argparse.Namespace) -> int:
    """`learn stop-angle`."""
    from countersteer.experiments import stop_regression
    from countersteer.learning.stop_angle import learn

    if options.out.suffix != ".toml":
        raise InputError(f"--out {options.out}: name a .toml file")
    found = learn(options.sources, math.radians(options.most_deg), options.out)
    result, picture = stop_regression.about(found), options.out.with_suffix(".png")
    options.out.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    names = ", ".join(path.name for path in options.sources)
    stop_regression.draw(found, picture, f"{result['turns']} turns of {names}"[:90])
    if options.json:
        print(json.dumps(result | {"policy": str(options.out), "picture": str(picture)}))
        return DONE
    print("\n".join(stop_regression.lines(result)))
    print(f"policy: {options.out}; picture: {picture}")
    return DONE


def run_turn(options: argparse.Namespace) -> int:
    """`learn turn`."""
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import load_policy, save_policy
    from countersteer.learning.turning import Generation, search

    if options.out.suffix != ".toml":
        raise InputError(f"--out {options.out}: name a .toml file")
    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    courses = [load_course(name) for name in options.courses]
    history: list[dict[str, float]] = []

    def report(number: int, found: Generation) -> None:
        history.append(found._asdict())
        if not options.json:
            print(
                f"  {number + 1:3}: cost {found.cost:.3f}, {100 * found.success_rate:.0f} % get "
                f"round; best candidate {found.best_cost:.3f}",
                flush=True,
            )

    policy = search(
        courses,
        load_car(options.car),
        load_population(options.cars),
        load_policy(options.begin),
        options.generations,
        options.candidates,
        options.trials,
        options.spread,
        options.seed,
        report,
    )
    words = f"countersteer learn turn {' '.join(options.courses)} --car {options.car}"
    source = f"{words} --cars {options.cars} --generations {options.generations}"
    save_policy(options.out, {"turning": source, "stop_angle": source}, *policy)
    result = {"policy": str(options.out), "generations": history}
    print(json.dumps(result) if options.json else f"policy: {options.out}")
    return DONE
