"""`learn`: experience to a driver's numbers."""

import argparse
import json
import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, Parser, Progress, Verbs, number, out_file
from countersteer.progress import clock

UNSEEN = 10_000_000  # first seed of the trials that judge what was learned
IN_NEW_TRIALS = "judging it in new trials, which compiles for half a minute the first time"


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
    turn.option("--generations", "N", number(1, 1000, int), 20, "steps of the search")
    turn.option("--candidates", "N", number(4, 1024, int), 24, "policies tried in each of them")
    turn.option("--trials", "N", number(1, 1024, int), 56, "random cars that each policy drives")
    meaning = "how far it looks at first: 1 for another car, 0.2 to polish"
    turn.option("--spread", "X", number(0.001, 10), 0.5, meaning)
    turn.seed()
    turn.out_file("POLICY.toml", "policy")

    does = "a network that drives a course, by PPO in the simulator, with random cars"
    ppo = learn("ppo", does, run_ppo)
    ppo.add_argument("course", metavar="COURSE", help="as for drive")
    ppo.option("--car", None, str, "rx7", "the nominal one")
    ppo.option("--cars", "SET", str, "around", "as for evaluate")
    meaning = "millions of decisions of 20 ms to learn from; 3 to 6 a minute on two cores"
    ppo.option("--samples", "M", number(0.1, 10_000), 70.0, meaning)
    meaning = "how a term of the reward counts, such as 'sideslip=5' (repeatable)"
    ppo.option("--reward", "TERM=WEIGHT", str, [], meaning, action="append")
    ppo.seed()
    ppo.out_file("POLICY.npz", "policy")

    does = "a table of values over a grid of states, by dynamic programming with the car's model"
    table = learn("tabular", does, run_tabular)
    grid_options(table, "what laps box")
    table.option("--cars", "SET", str, "around", "random cars that judge it, as for evaluate")
    table.option("--trials", "N", number(0, 10**6, int), 256, "of them; 0: none")

    does = "the same values as the car drives, with and without random actions, as in the paper"
    online = learn("online", does, run_online)
    grid_options(online, "few cells")
    meaning = "for which each learner drives"
    online.option("--seconds", "S", number(100, 10**7), 20_000.0, meaning)
    online.option("--learners", "N", number(1, 100, int), 5, "of each kind, by their seeds")

    does = "the best open-loop commands for a car that is wholly known: a yardstick for drivers"
    best = learn("optimum", does, run_optimum)
    best.add_argument("course", metavar="COURSE", help="as for drive")
    best.option("--car", None, str, "rx7", "the nominal one")
    best.option("--laps", None, number(1, 100, int), 1, "laps, where the course is closed")
    best.option("--rounds", "N", number(1, 100_000, int), 600, "of the search; 0.4 s each or more")
    best.seed()
    best.out_file("COMMANDS.csv", "list of commands")


def grid_options(made: Parser, default: str) -> None:
    """The options of a learner on a grid, with `--seed` and `--out`."""
    made.add_argument("course", metavar="COURSE", help="as for drive")
    made.option("--car", None, str, "rx7", "the nominal one")
    meaning = (
        "the grid: NAME=STEP or NAME=LOW:HIGH:STEP. A pose is place_m, offset_m, heading_deg or "
        "x_m, y_m, heading_deg. A motion is speed_mps or vx_mps, and any of vy_mps, sideslip_deg, "
        f"yaw_rate_degps, steering_deg (default: {default}, see docs/tabular.md)"
    )
    made.option("--dimensions", "NAME=STEP", str, None, meaning, nargs="+")
    throttle, lock = number(-1, 1), number(-90, 90)
    made.option("--throttle", "T", throttle, [0.0, 0.5, 1.0], "of the actions", nargs="+")
    angles = [-28.0, -14.0, 0.0, 14.0, 28.0]
    made.option("--steering-deg", "DEG", lock, angles, "of the actions", nargs="+")
    meaning = "for which an action is held, in steps of 0.02"
    made.option("--decision-s", "S", number(0.02, 0.3), 0.12, meaning)
    made.option("--horizon-s", "S", number(0.2, 1000), 2.0, "rewards so far ahead count 1/e")
    made.option("--margin-m", "M", number(0, 1), 0.03, "from a wall that counts as a touch")
    meaning = "how a term of the reward counts: time, road, goal or progress (repeatable)"
    made.option("--reward", "TERM=WEIGHT", str, [], meaning, action="append")
    made.seed()
    made.out_file("POLICY.npz", "policy")


def say(options: argparse.Namespace, line: str) -> None:
    """A line of progress, unless one JSON object is asked for."""
    if not options.json:
        print(line, flush=True)


def say_and_wait(options: argparse.Namespace, line: str, what: str) -> None:
    """A line that announces a wait, and on a terminal a clock for it until the next output."""
    say(options, line)
    clock(f"learn {options.what}, {what}")


def in_blocks() -> int:
    """Get JAX ready for batches in one program (`engine.in_one_program`); returns the cores."""
    from countersteer.batch.engine import flags
    from countersteer.compiling import configure_jax

    cores = os.cpu_count() or 1
    os.environ.setdefault("XLA_FLAGS", flags(cores))
    configure_jax(blocks=True, cores=cores)
    return cores


def run_stop_angle(options: argparse.Namespace) -> int:
    """`learn stop-angle`."""
    with out_file(options.out):
        return learn_stop_angle(options)


def learn_stop_angle(options: argparse.Namespace) -> int:
    """The regression over turns that were stopped."""
    from countersteer.experiments import stop_regression
    from countersteer.learning.stop_angle import learn
    from countersteer.text import counted
    from countersteer.writing import whole, write_whole

    picture = options.out.with_suffix(".png")
    with whole(options.out) as policy, whole(picture) as drawn:
        found = learn(options.sources, math.radians(options.most_deg), policy)
        result = stop_regression.about(found)
        names = ", ".join(path.name for path in options.sources)
        stop_regression.draw(
            found, drawn, f"{counted(result['turns'], 'stopped turn')} (from {names})"[:90]
        )
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
    from countersteer.batch.evaluate import table_lines
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import load_policy, save_policy
    from countersteer.learning.curves import save
    from countersteer.learning.turning import Generation, search, verdict

    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    courses = [load_course(name) for name in options.courses]
    history: list[dict[str, float]] = []
    begun = time.process_time()

    def report(number: int, found: Generation) -> None:
        done = {"generation": number + 1.0, "cpu_s": time.process_time() - begun}
        history.append(done | found._asdict())
        drifts = f"{100 * found.drift_share:.0f}" if found.success_rate else "-"
        say(
            options,
            f"  {number + 1:3} of {options.generations}: cost {found.cost:.3f}, "
            f"{100 * found.success_rate:.0f} % get round, {drifts} % of them drift every turn; "
            f"best candidate {found.best_cost:.3f}",
        )

    car, population = load_car(options.car), load_population(options.cars)
    line = "the first generation compiles for half a minute the first time"
    say_and_wait(options, line, "first generation")
    policy = search(
        courses,
        car,
        population,
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
    panels = ("success_rate",), ("drift_share",), ("cost",), ("best_cost",)
    save(history, options.out, words, "cpu_s", ("minutes of CPU time", 60.0), panels)
    say_and_wait(options, IN_NEW_TRIALS, "new trials")
    # Seeds that the search has not used.
    found = verdict(courses, car, population, policy, (UNSEEN + options.seed) % 2**31)
    if options.json:
        print(json.dumps({"policy": str(options.out), "generations": history, "verdict": found}))
        return DONE
    print("\n".join(["in new trials:", *table_lines(found)]))
    for told in found.values():
        if told["no_drift"]:
            print(f"{Path(options.car).stem} {told['no_drift']}")
    print(f"policy: {options.out}; curves: {options.out.with_suffix('.png')}, .csv")
    return DONE


def run_ppo(options: argparse.Namespace) -> int:
    """`learn ppo`."""
    with out_file(options.out, ".npz"):
        return learn_ppo(options)


def learn_ppo(options: argparse.Namespace) -> int:
    """The training of a network. Killed, the same command goes on from the last checkpoint."""
    cores = in_blocks()
    from countersteer.batch.evaluate import table_lines
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.errors import InputError
    from countersteer.task.reward import DRIFTING, weights_of

    try:
        from countersteer.learning import ppo
    except ModuleNotFoundError as error:
        raise InputError(
            f"learn ppo needs {error.name}: pip install 'countersteer[learn]'"
        ) from None

    course, car = load_course(options.course), load_car(options.car)
    job = ppo.Job(
        course,
        Path(options.car).stem,
        car,
        options.cars,
        load_population(options.cars),
        weights_of(options.reward, DRIFTING),
        options.seed,
        round(options.samples * 1e6),
    )

    def report(told: dict[str, float]) -> None:
        if not options.json:
            print(ppo.line(told), flush=True)

    kept = ppo.checkpoint_of(options.out)
    if kept.exists():
        say(options, f"going on from {kept}")
    line = "the first iteration compiles for up to a minute the first time"
    say_and_wait(options, line, "first iteration")
    curves = ppo.train(job, options.out, cores, report)
    say_and_wait(options, IN_NEW_TRIALS, "new trials")
    # Seeds that training has not used.
    found = ppo.verdict(job, options.out, UNSEEN + options.seed)
    files = {"policy": str(options.out), "curves": str(options.out.with_suffix(".csv"))}
    if options.json:
        print(json.dumps(files | {"training": curves, "verdict": found}))
        return DONE
    print("\n".join(["in new trials, on ground truth:", *table_lines({course.name: found})]))
    print(f"policy: {files['policy']}; curves: {options.out.with_suffix('.png')}, .csv")
    print(
        f"to see it: countersteer drive {options.course} --car {options.car} "
        f"--driver {options.out} --estimate truth"
    )
    return DONE


def run_tabular(options: argparse.Namespace) -> int:
    """`learn tabular`."""
    with out_file(options.out, ".npz"):
        return learn_tabular(options)


def tabular_job(
    options: argparse.Namespace, course: Any, car: Any, dimensions: Sequence[str]
) -> Any:
    """The `learning.tabular.Job` of the options. Raises `InputError`."""
    from countersteer.learning import tabular
    from countersteer.task.reward import weights_of

    return tabular.Job(
        course,
        Path(options.car).stem,
        car,
        tabular.dimensions_of(options.dimensions or dimensions, course),
        tuple(options.throttle),
        tuple(map(math.radians, options.steering_deg)),
        0.02 * round(options.decision_s / 0.02),
        options.horizon_s,
        weights_of(options.reward, tabular.WEIGHTS, tabular.TERMS),
        options.margin_m,
    )


def learn_tabular(options: argparse.Namespace) -> int:
    """The table, its solution, the drive of the nominal car, and the verdict of random ones."""
    cores = in_blocks()
    from countersteer.batch.evaluate import nominal_drive, table_lines, verdict
    from countersteer.batch.population import load_population
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.registry import learned
    from countersteer.learning import tabular
    from countersteer.runs.files import csv_text
    from countersteer.task.judge import Outcome, summary
    from countersteer.viewing.slices import draw_slices
    from countersteer.writing import whole, write_whole

    course, car = load_course(options.course), load_car(options.car)
    population = load_population(options.cars)
    job = tabular_job(options, course, car, tabular.DIMENSIONS)
    count = len(job.actions.throttle)
    line = f"{job.table.size:,} states, {count} actions; the table compiles for half a minute first"
    say_and_wait(options, line, "table")
    with Progress(options.json) as progress:

        def report(what: str, value: float) -> None:
            if what == "table":
                progress.show(value, 1.0)
            else:
                say(options, f"  a sweep changed values by {value:.3g}; "
                    f"done under {tabular.SETTLED:g}")  # fmt: skip

        found = tabular.learn(job, cores, report)
    cost = found.cost
    say(options, f"table {cost['table_cpu_s']:.0f} s of CPU, solution "
        f"{cost['cpu_s'] - cost['table_cpu_s']:.0f} s")  # fmt: skip
    curve = found.solution.curve
    how = {"method": "modified policy iteration", "sweeps": len(curve)}
    write_whole(options.out, tabular.policy_file(job, found.solution.values, how, cost))
    rows = [list(row.values()) for row in curve]
    write_whole(options.out.with_suffix(".csv"), csv_text(list(curve[0]), rows))
    say_and_wait(options, "judging it, which compiles for a minute the first time", "judging")
    driver = learned("tabular", options.out, course, car)
    score, path = nominal_drive(course, car, driver)
    drive = summary(score, Outcome.of(int(score.outcome)))
    # Seeds that nothing is learned with.
    judged = {}
    if options.trials:
        first = UNSEEN + options.seed
        judged = verdict(course, car, population, driver, first, options.trials)
    picture = options.out.with_suffix(".png")
    with whole(picture) as part:
        title = f"learn tabular: {course.name}, {job.car_name}; {drive['verdict']}"
        draw_slices(tabular.slices(job, found.solution), course.walls, path, title, part)
    result = {"policy": str(options.out), "picture": str(picture), "states": job.table.size,
              "actions": count, "cost": cost, "sweeps": curve, "nominal": drive,
              "verdict": judged}  # fmt: skip
    if options.json:
        print(json.dumps(result))
        return DONE
    lap = "" if drive["lap_time_s"] is None else f", {drive['lap_time_s']:.2f} s"
    print(f"the nominal car, from rest: {drive['verdict']}{lap}")
    if judged:
        print("\n".join(["random cars, on ground truth:", *table_lines({course.name: judged})]))
    print(f"policy: {options.out}; picture: {picture}; sweeps: {options.out.with_suffix('.csv')}")
    print(
        f"to see it: countersteer drive {options.course} --car {options.car} "
        f"--driver {options.out} --estimate truth"
    )
    return DONE


def run_online(options: argparse.Namespace) -> int:
    """`learn online`."""
    with out_file(options.out, ".npz"):
        return learn_online(options)


def learn_online(options: argparse.Namespace) -> int:
    """The learners that drive, with random actions and without, beside dynamic programming."""
    cores = in_blocks()
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.learning import online, tabular
    from countersteer.runs.files import csv_text
    from countersteer.viewing.learners import draw_learners
    from countersteer.writing import whole, write_whole

    course, car = load_course(options.course), load_car(options.car)
    job = tabular_job(options, course, car, online.DIMENSIONS)
    line = f"{job.table.size:,} states; compiles for a minute or two first"
    say_and_wait(options, line, "first cars")
    learners = online.Online(job, options.seconds)
    found = {}
    with Progress(options.json) as progress:
        for i, name in enumerate(("exploring", "greedy")):

            def report(done: int, before: int = i) -> None:
                progress.show(before + done / online.TESTS, 2)

            found[name] = learners.learn(options.learners, options.seed, i == 0, report)
            last = found[name][1].metres[:, -1]
            say(options, f"  {name}: {', '.join(f'{m:.1f}' for m in last)} m in "
                f"{online.TEST:g} s, up to a touch")  # fmt: skip
    planned = tabular.learn(job, cores, look=learners.test)
    say(options, f"  dynamic programming: {planned.solution.curve[-1]['metres']:.1f} m")
    values, curves = found["exploring"]
    best = int(curves.metres[:, -1].argmax())
    cost = {"samples": curves.driven[-1] / job.decision, "cpu_s": float(curves.cpu[-1])}
    how = {"method": "real-time dynamic programming", "seed": options.seed + best}
    kept = online.unwrapped(job.table.pose, values[best])
    write_whole(options.out, tabular.policy_file(job, kept, how, cost))
    rows = [
        [name, options.seed + i, driven, cpu, metres]
        for name, (_, told) in found.items()
        for i, line in enumerate(told.metres)
        for driven, cpu, metres in zip(told.driven, told.cpu, line, strict=True)
    ]
    columns = ["learner", "seed", "driven_s", "cpu_s", "metres_m"]
    write_whole(options.out.with_suffix(".csv"), csv_text(columns, rows))
    picture = options.out.with_suffix(".png")
    begun = planned.cost["cpu_s"] - planned.solution.curve[-1]["cpu_s"]
    sweeps = [(begun + row["cpu_s"], row["metres"]) for row in planned.solution.curve]
    with whole(picture) as part:
        told = {name: curves for name, (_, curves) in found.items()}
        draw_learners(told, sweeps, f"learn online: {course.name}, {job.car_name}", part)
    result = {
        "policy": str(options.out),
        "picture": str(picture),
        "states": job.table.size,
        "cost": cost,
        "metres_m": {name: told.metres[:, -1].tolist() for name, (_, told) in found.items()},
        "driven_s": curves.driven.tolist(),
        "dynamic_programming": {"cost": planned.cost, "sweeps": planned.solution.curve},
    }
    if options.json:
        print(json.dumps(result))
        return DONE
    print(f"policy: {options.out}; picture: {picture}; curves: {options.out.with_suffix('.csv')}")
    return DONE


def run_optimum(options: argparse.Namespace) -> int:
    """`learn optimum`."""
    with out_file(options.out, ".csv"):
        return learn_optimum(options)


def learn_optimum(options: argparse.Namespace) -> int:
    """The search for the best commands."""
    import numpy as np

    from countersteer.car.files import load_car
    from countersteer.cli.recorded import summary_lines
    from countersteer.compiling import configure_jax
    from countersteer.course.files import load_course
    from countersteer.drivers.stored import fingerprint
    from countersteer.experiments.best_drive import best, judged, planned
    from countersteer.planning.mppi import KNOT
    from countersteer.runs.files import COMMANDS, command_rows, csv_text
    from countersteer.writing import write_whole

    configure_jax(blocks=True, cores=os.cpu_count() or 1)
    course, car, laps = load_course(options.course), load_car(options.car), options.laps
    course.check_laps(laps)
    line = "the planner drives first, some twenty seconds a lap"
    say_and_wait(options, line, "planner")
    begin = planned(course, car, laps)
    line = "the search begins; its first round compiles for half a minute the first time"
    say_and_wait(options, line, "first round")
    with Progress(options.json) as progress:
        found = best(
            course,
            car,
            begin,
            options.rounds,
            laps,
            seed=options.seed,
            report=lambda done, _: progress.show(done, options.rounds),
        )
    say_and_wait(options, "driving what was found", "judging")
    times = KNOT * np.arange(len(found.commands.throttle))
    rows = command_rows(times, found.commands.throttle, found.commands.steering)
    write_whole(options.out, csv_text(COMMANDS, rows))
    result = {
        "course": course.name,
        "car": options.car,
        "laps": laps,
        "fingerprint": fingerprint(course, car),
        "rounds": options.rounds,
        "seed": options.seed,
        "cost": found.cost,
        "planner": judged(course, car, begin, laps),
        "optimum": judged(course, car, found.commands, laps),
    }
    write_whole(options.out.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
    if options.json:
        print(json.dumps(result | {"commands": str(options.out)}))
        return DONE
    for who in ("planner", "optimum"):
        first, *turns = summary_lines(result[who])
        print("\n".join([f"{who}: {first}", *turns]))
    print(
        f"commands: {options.out}; to see them: "
        f"countersteer drive {options.course} --car {options.car} --driver {options.out}"
    )
    return DONE
