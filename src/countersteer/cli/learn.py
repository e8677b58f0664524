"""`learn`: experience to a driver's numbers."""

import argparse
import json
import math
import os
from pathlib import Path

from countersteer.cli.options import DONE, Verbs, number, out_file


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    learn = verbs.group("learn", "experience to a driver's numbers", "METHOD")
    does = "how far a car still turns once it is stopped: lines over the yaw rate, by speed"
    stop = learn("stop-angle", does, run_stop_angle)
    meaning = "a turns.csv, the folder of trials turns, or a run's folder"
    stop.add_argument("sources", nargs="+", type=Path, metavar="TABLE_OR_RUN", help=meaning)
    stop.out_file("POLICY.toml", "policy")
    meaning = "leave out turns that ran on for more than this"
    stop.option("--most-deg", "DEG", number(1, 360), 90.0, meaning)

    does = "the numbers of the drift-turn driver, by driving random cars with many candidates"
    turn = learn("turn", does, run_turn)
    turn.add_argument("courses", nargs="+", metavar="COURSE", help="as for drive; by turns")
    turn.option("--car", None, str, "rx7", "the nominal one")
    turn.option("--cars", "SET", str, "around", "as for evaluate")
    turn.option("--begin", "POLICY", str, "drift-turn", "where the search begins")
    turn.option("--generations", "N", number(1, 1000, int), 30, "steps of the search")
    turn.option("--candidates", "N", number(4, 1024, int), 32, "policies tried in each of them")
    turn.option("--trials", "N", number(1, 1024, int), 48, "random cars that each policy drives")
    meaning = "how far it looks at first: 1 for another car, 0.2 to polish"
    turn.option("--spread", "X", number(0.001, 10), 0.5, meaning)
    turn.seed()
    turn.out_file("POLICY.toml", "policy")


def run_stop_angle(options: argparse.Namespace) -> int:
    """`learn stop-angle`."""
    with out_file(options.out):
        return learn_stop_angle(options)


def learn_stop_angle(options: argparse.Namespace) -> int:
    """The regression over turns that were stopped."""
    from countersteer.experiments import stop_regression
    from countersteer.learning.stop_angle import learn
    from countersteer.writing import whole, write_whole

    picture = options.out.with_suffix(".png")
    with whole(options.out) as policy, whole(picture) as drawn:
        found = learn(options.sources, math.radians(options.most_deg), policy)
        result = stop_regression.about(found)
        names = ", ".join(path.name for path in options.sources)
        stop_regression.draw(found, drawn, f"{result['turns']} turns of {names}"[:90])
        write_whole(options.out.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
    if options.json:
        print(json.dumps(result | {"policy": str(options.out), "picture": str(picture)}))
        return DONE
    print("\n".join(stop_regression.lines(result)))
    print(f"policy: {options.out}; picture: {picture}")
    return DONE


def run_turn(options: argparse.Namespace) -> int:
    """`learn turn`."""
    with out_file(options.out):
        return learn_turn(options)


def learn_turn(options: argparse.Namespace) -> int:
    """The search for the numbers of a turn."""
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import load_policy, save_policy
    from countersteer.learning.turning import Generation, search

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
    save_policy(
        options.out,
        {"turning": source, "stop_angle": source},
        *policy,
        car=Path(options.car).stem,
    )
    result = {"policy": str(options.out), "generations": history}
    print(json.dumps(result) if options.json else f"policy: {options.out}")
    return DONE
