"""The command line: parse, call, print."""

import argparse
import dataclasses
import json
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer import __version__
from countersteer.errors import InputError

if TYPE_CHECKING:
    from countersteer.car.car import Car
    from countersteer.course.course import Course
    from countersteer.pilot import Pilot
    from countersteer.simulator import Simulator

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
DRIVERS = ("drift-turn", "straighten")
EXPERIMENTS = (
    "turn-rate", "drift-threshold", "stop-time", "drift-turn", "control-rate", "battery",
    "linked-turns", "narrowest-corner",
)  # fmt: skip
LONGEST_REPLAY = 3600.0  # s
FASTEST_GIF = 50  # frames a second


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> Any:
        """Raises `InputError` with what argparse found."""
        raise InputError(f"{message} (see {self.prog} --help)")


def number(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    """A number within bounds."""

    def read(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be a number in [{low:g}, {high:g}], not {text}")
        return value

    return read


def span(low: float, high: float) -> Callable[[str], tuple[float, float]]:
    """A range LO:HI within bounds, or one number for both."""

    def read(text: str) -> tuple[float, float]:
        first, _, last = text.partition(":")
        one = number(low, high)
        ends = (one(first), one(last or first))
        if ends[0] > ends[1]:
            raise argparse.ArgumentTypeError(f"must rise, not {text}")
        return ends

    return read


SPEEDS, CHARGES = span(0.2, 20), span(0, 1)  # m/s; of a battery


def parser() -> Parser:
    """All verbs with their options."""
    top = Parser(prog="countersteer", description="Makes a radio-controlled car drift by itself.")
    top.add_argument("--version", action="version", version=f"countersteer {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True)

    def verb(name: str, does: str, run: Callable[[argparse.Namespace], int]) -> Parser:
        made = verbs.add_parser(name, help=does, description=does)
        made.add_argument("--json", action="store_true", help="one JSON object, nothing else")
        made.set_defaults(run=run)
        return made

    def group(name: str, does: str, metavar: str) -> Callable[..., Parser]:
        """A verb of several things, each with options of its own."""
        made = verbs.add_parser(name, help=does, description=does)
        kinds = made.add_subparsers(dest="what", metavar=metavar, required=True, help=does)

        def kind(name: str, does: str, run: Callable[[argparse.Namespace], int]) -> Parser:
            part: Parser = kinds.add_parser(name, help=does, description=does)
            part.add_argument("--json", action="store_true", help="one JSON object, nothing else")
            part.set_defaults(run=run)
            return part

        return kind

    def nominal_car(made: Parser, car: str | None = "rx7") -> None:
        default = f"default {car}" if car else "default the run's own, else rx7"
        made.add_argument("--car", default=car, help=f"library name or .toml file ({default})")
        made.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="PATH=VALUE",
            help="override a parameter of the car, such as battery.wear=0.5 (repeatable; "
            "'countersteer list parameters' has them all)",
        )

    def physics(made: Parser, car: str | None) -> None:
        nominal_car(made, car)
        made.add_argument("--seed", type=number(0, 2**31 - 1, int), default=0, help="default 0")
        made.add_argument(
            "--dt",
            type=number(1e-5, 0.02),
            default=0.001,
            metavar="S",
            help="physics step in seconds (default 0.001)",
        )
        made.add_argument("--out", type=Path, metavar="DIR", help="default a new one in runs/")

    def laps_and_link(made: Parser) -> None:
        made.add_argument(
            "--laps",
            type=number(1, 1000, int),
            default=1,
            metavar="N",
            help="of a closed course (default 1)",
        )
        made.add_argument(
            "--link",
            choices=("onboard", "radio"),
            default="onboard",
            help="where the driver runs: in the car, or behind a radio that delays and loses "
            "packets (default onboard)",
        )
        made.add_argument(
            "--estimate",
            choices=("filter", "pose", "reckoning", "truth"),
            default="filter",
            help="what the driver knows of its motion: by the velocity filter (default), dead "
            "reckoning, by a particle filter of the pose (slower), all from the sensors; or the "
            "truth",
        )

    drive = verb("drive", "one closed-loop drive over a course", run_drive)
    drive.add_argument(
        "course",
        metavar="COURSE",
        help="library name, or a file: .toml, a centre line with widths .csv (F1TENTH), "
        "a map .yaml with its image (ROS)",
    )
    drive.add_argument(
        "--driver",
        default="drift-turn",
        help=f"{', '.join(DRIVERS)}, a plan's name, a policy or plan .toml, or a commands.csv "
        "(default drift-turn)",
    )
    physics(drive, "rx7")
    drive.add_argument(
        "--speed-mps",
        type=SPEEDS,
        default=None,
        metavar="V",
        help="speed that the driver is asked to bring to a turn (default the driver's); with "
        "--cars also LO:HI",
    )
    drive.add_argument(
        "--cars",
        metavar="SET",
        help="drive the car, charge and start that --seed draws from this set, as evaluate does",
    )
    drive.add_argument(
        "--battery", type=number(0, 1), metavar="F", help="charge, 0 to 1 (default 1)"
    )
    drive.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="TEXT",
        help="a sensor that is dead, stuck or spiking for a while: 'SENSOR KIND START DURATION' in "
        "seconds, such as 'gyroscope stuck 2.0 0.5' (repeatable)",
    )
    laps_and_link(drive)

    evaluate = verb("evaluate", "drivers judged over randomised cars", run_evaluate)
    evaluate.add_argument("course", metavar="COURSE", help="as for drive")
    evaluate.add_argument(
        "--driver",
        nargs="+",
        default=["drift-turn"],
        metavar="D",
        help="as for drive, one or more (default drift-turn)",
    )
    evaluate.add_argument(
        "--trials", type=number(1, 10**6, int), default=1000, metavar="N", help="default 1000"
    )
    physics(evaluate, "rx7")
    evaluate.add_argument(
        "--cars",
        default="around",
        metavar="SET",
        help="what varies: library name or .toml file (default around)",
    )
    evaluate.add_argument(
        "--speed-mps",
        type=SPEEDS,
        default=None,
        metavar="LO:HI",
        help="speed that the driver is asked to bring to a turn, drawn for each trial, or one V",
    )
    laps_and_link(evaluate)

    replay = verb("replay", "commands in, motion out; or a log against the simulator", run_replay)
    replay.add_argument(
        "source", type=Path, metavar="COMMANDS_OR_RUN", help="a commands.csv, or a run's folder"
    )
    physics(replay, None)
    replay.add_argument(
        "--initial", default="", metavar="STATES", help='such as "vx_mps=2,yaw_rate_radps=1"'
    )
    replay.add_argument(
        "--battery",
        type=number(0, 1),
        metavar="F",
        help="charge, 0 to 1 (default: the run's battery_charge, or else 1; with --compare, "
        "or else what agrees best)",
    )
    replay.add_argument("--compare", action="store_true", help="measured against simulated")
    replay.add_argument(
        "--horizon",
        metavar="S|run",
        help="seconds that are predicted at a time, or run: the whole of it (with --compare; "
        "default 1.0)",
    )

    take = verb("import", "other people's logs to run folders", run_import)
    take.add_argument("format", choices=("dart", "eth"), metavar="FORMAT", help="dart or eth")
    take.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a log")
    take.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of the run folders"
    )

    trials = group("trials", "many drives, or commands for them", "WHAT")
    steps = trials(
        "throttle-steps",
        "commands: from rest, straight, each a second at one throttle, then none",
        run_trials,
    )
    steps.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the files")
    steps.add_argument(
        "--levels", metavar="LIST", help="throttles, such as 0.2,0.5 (default ten, 0.1 to 1)"
    )
    steps.add_argument(
        "--duration-s",
        type=number(0.01, 60),
        default=1.0,
        metavar="S",
        help="at each throttle (default 1)",
    )
    steps.add_argument(
        "--rate-hz",
        type=number(1, 1000),
        default=100.0,
        metavar="HZ",
        help="rows a second (default 100)",
    )
    turns = trials(
        "turns",
        "turns in the open, stopped at different yaw rates: time and angle until stopped",
        run_turns,
    )
    nominal_car(turns)
    turns.add_argument(
        "--cars", metavar="SET", help="draw each trial's car from this set (default the car itself)"
    )
    turns.add_argument(
        "--trials", type=number(1, 10**6, int), default=1000, metavar="N", help="default 1000"
    )
    turns.add_argument(
        "--speed-mps", type=SPEEDS, default=(1.0, 3.0), metavar="LO:HI", help="default 1:3"
    )
    turns.add_argument(
        "--battery",
        type=CHARGES,
        default=None,
        metavar="LO:HI",
        help="charge, 0 to 1 (default the set's, or 0.3:1)",
    )
    turns.add_argument(
        "--driver", default="drift-turn", metavar="POLICY", help="whose turns (default drift-turn)"
    )
    turns.add_argument("--seed", type=number(0, 2**31 - 1, int), default=0, help="default 0")
    turns.add_argument("--out", type=Path, metavar="DIR", help="default a new one in runs/")
    turns.add_argument(
        "--from",
        dest="runs",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUN",
        help="find the turns in these runs' folders instead, of a real car or a simulated one",
    )

    experiment = verb("experiment", "the paper's measurements", run_experiment)
    experiment.add_argument(
        "name", choices=EXPERIMENTS, metavar="NAME", help=", ".join(EXPERIMENTS)
    )
    nominal_car(experiment)
    experiment.add_argument(
        "--from",
        dest="runs",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUN",
        help="measure in these runs' folders instead, of a real car or a simulated one",
    )
    experiment.add_argument("--out", type=Path, metavar="DIR", help="default a new one in runs/")

    learn = group("learn", "experience to a driver's numbers", "METHOD")
    stop = learn(
        "stop-angle",
        "how far a car still turns once it is stopped: lines over the yaw rate, by speed",
        run_learn_stop_angle,
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
        run_learn_turn,
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

    tune = verb("tune", "logs of a car to the car's numbers", run_tune)
    tune.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder")
    tune.add_argument(
        "--car",
        default="rx7",
        metavar="BASE",
        help="where the fit begins, and what is not fitted: library name or .toml (default rx7)",
    )
    tune.add_argument(
        "--fit",
        default="all",
        choices=("acceleration", "longitudinal", "steering", "handling", "drift", "all"),
        help="acceleration: the motor's strength from steps of throttle; longitudinal: motor, "
        "battery, rolling, braking; steering: servo and its map; handling: yaw inertia and grip; "
        "drift: combined slip past the limit; all: these in turn, then everything at once "
        "(default all)",
    )
    tune.add_argument(
        "--out", type=Path, required=True, metavar="CAR.toml", help="where the car is written"
    )
    tune.add_argument(
        "--validate", nargs="+", type=Path, default=[], metavar="RUN", help="judge on these runs"
    )
    tune.add_argument(
        "--new",
        nargs="+",
        type=Path,
        default=[],
        metavar="RUN",
        help="runs since BASE was fitted to the others: fit to all, and say by how much BASE errs "
        "more on these, and whether the driver should be learned again",
    )
    tune.add_argument(
        "--hold-out",
        type=number(0, 1, int),
        default=None,
        metavar="0|1",
        help="1: keep every third block of 2 s of each run back and judge on it (default 1 "
        "without --validate)",
    )
    tune.add_argument(
        "--source",
        choices=("encoder", "sonar", "lines"),
        default="encoder",
        help="with --fit acceleration: what tells the speed (default encoder)",
    )
    tune.add_argument(
        "--precision",
        type=number(1e-9, 1),
        default=1e-3,
        metavar="PART",
        help="with --fit acceleration: done when it changes by less (default 0.001)",
    )

    export = verb("export", "a run seen from above, as a GIF or an MP4", run_export)
    export.add_argument("source", type=Path, metavar="RUN", help="a run's folder")
    target = export.add_mutually_exclusive_group(required=True)
    target.add_argument("--gif", type=Path, metavar="FILE", help="write an animated GIF")
    target.add_argument("--mp4", type=Path, metavar="FILE", help="write a video (H.264)")
    export.add_argument(
        "--width-px", type=number(160, 3840, int), default=640, metavar="PX", help="default 640"
    )
    export.add_argument(
        "--fps", type=number(1, 100), metavar="N", help="frames a second (default GIF 20, MP4 25)"
    )
    export.add_argument(
        "--speed",
        type=number(0.01, 100),
        default=1.0,
        metavar="X",
        help="times as fast as it was; 0.5 is slow motion (default 1)",
    )
    export.add_argument("--follow", action="store_true", help="the camera stays with the car")
    export.add_argument(
        "--from-s", type=number(0, 1e6), default=0.0, metavar="S", help="begin (default the run's)"
    )
    export.add_argument(
        "--to-s", type=number(0, 1e6), default=1e6, metavar="S", help="end (default the run's)"
    )
    export.add_argument("--force", action="store_true", help="replace a file that is there")

    bench = verb("bench", "speed, side by side with what it is compared to", run_bench)
    bench.add_argument("--quick", action="store_true", help="under a minute, less exact")
    bench.add_argument("--out", type=Path, metavar="FILE.md", help="a page of it, with its picture")

    lists = verb("list", "what there is by name", run_list)
    lists.add_argument(
        "what",
        choices=("cars", "courses", "drivers", "parameters"),
        help="parameters: all that --set takes",
    )
    lists.add_argument("--car", help="with parameters: the values of this car")

    complete = verb("completion", "a script that completes commands in a shell", run_completion)
    complete.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell it is for")
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a verb; returns the exit status."""
    try:
        options = parser().parse_args(arguments)
        return int(options.run(options))
    except InputError as error:
        print(f"countersteer: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("countersteer: interrupted", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        print(f"countersteer: {name}{error.strerror or error}", file=sys.stderr)
        return FAILED


def run_drive(options: argparse.Namespace) -> int:
    """`drive`."""
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.library import make_driver
    from countersteer.evaluation.drive import about_run
    from countersteer.link.link import LINKS
    from countersteer.pilot import Pilot
    from countersteer.runs.files import read_commands
    from countersteer.sensing.faults import read_fault
    from countersteer.simulator import Simulator

    course, car = load_course(options.course), load_car(options.car, options.set)
    check_laps(options, course)
    charge, start, speed, floor = 1.0, None, None, None
    if options.battery is not None:
        charge = options.battery
    if options.cars is not None:
        if options.battery is not None:
            raise InputError("--battery: --cars draws the charge")
        car, charge, start, speed, floor = drawn_alone(options, course, car)
    elif options.speed_mps is not None:
        speed, most = options.speed_mps
        if most != speed:
            raise InputError("--speed-mps LO:HI: a range is drawn from with --cars only")
    nominal, link = load_car(options.car), LINKS[options.link]
    driver, tables = make_driver(
        options.driver, course, nominal, speed, options.laps, read_commands
    )
    made = options.driver.endswith((".csv", ".toml"))
    name = Path(options.driver).stem if made else options.driver
    pilot = Pilot.of(driver, course, nominal, options.estimate, link, options.dt)
    simulator = Simulator.of(
        course,
        car,
        link=link,
        dt=options.dt,
        seed=options.seed,
        charge=charge,
        start=start,
        floor=floor,
        faults=tuple(read_fault(text) for text in options.fault),
    )
    about = about_run(simulator, pilot, course, name, options.car, options.laps, nominal, tables)
    # A lap at a crawl still ends.
    longest = 20.0 + (course.lap_end(options.laps) or 0.0) / 0.3
    return record(options, simulator, pilot, course, about, longest, course.name)


def check_laps(options: argparse.Namespace, course: "Course") -> None:
    """Only a closed course has laps."""
    if options.laps > 1 and not course.closed:
        raise InputError(f"--laps {options.laps}: {options.course} is open, and driven once")


def drawn_alone(options: argparse.Namespace, course: "Course", car: "Car") -> tuple[Any, ...]:
    """The trial of `--seed`: car, charge, start, speed asked for and floor."""
    import jax
    import numpy as np

    from countersteer.evaluation.population import draw, load_population

    drawn = draw(
        load_population(options.cars), car, course, [options.seed], np.float32, options.speed_mps
    )
    speed = None if drawn.speed is None else float(drawn.speed[0])
    x, y, heading = (float(value) for value in drawn.pose[0])
    alone, floor = jax.tree.map(lambda leaf: leaf[0], (drawn.cars, drawn.floor))
    return alone, float(drawn.charge[0]), (x, y, heading), speed, floor


def run_evaluate(options: argparse.Namespace) -> int:
    """`evaluate`."""
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.library import make_driver
    from countersteer.evaluation import evaluate
    from countersteer.evaluation.population import load_population
    from countersteer.link.link import LINKS
    from countersteer.runs.files import read_commands
    from countersteer.runs.recorder import new_folder
    from countersteer.simulator import keep_programs

    keep_programs(blocks=True, cores=os.cpu_count() or 1)
    course, car = load_course(options.course), load_car(options.car, options.set)
    check_laps(options, course)
    if course.goal_distance is None:
        raise InputError(f"{options.course}: has no goal, so nothing tells a success")
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
    evaluate.picture(scores, f"{course.name}, {options.car}, {options.trials} trials", picture)
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


def run_replay(options: argparse.Namespace) -> int:
    """`replay`."""
    from countersteer.car.files import load_car
    from countersteer.course.files import course_of_run
    from countersteer.drivers.library import replay
    from countersteer.estimation.dead_reckoning import DeadReckoning
    from countersteer.evaluation.drive import about_run
    from countersteer.pilot import Pilot
    from countersteer.runs.files import read_commands
    from countersteer.runs.run import read_run
    from countersteer.simulator import Simulator
    from countersteer.world.floor import floor_of_run

    if options.horizon and not options.compare:
        raise InputError("--horizon is of a comparison: give --compare as well")
    if options.initial and options.compare:
        raise InputError("--initial: --compare starts from what was measured")
    run = read_run(options.source) if options.source.is_dir() else None
    if run is None and not options.source.exists():
        raise InputError(f"{options.source}: no such run folder or commands.csv")
    if options.battery is not None and run is not None:
        about = {**run.about, "battery_charge": options.battery}
        run = dataclasses.replace(run, about=about)
    if run is not None and options.car is None and run.car is not None and not options.set:
        car, name = run.car, str(run.about.get("car_name", "its own car"))
    else:
        name = options.car or (str(run.about.get("car_name", "rx7")) if run else "rx7")
        car = load_car(name, options.set)
    if options.compare:
        if run is None:
            raise InputError("--compare needs a run folder, such as import makes")
        return run_compare(options, run, car, name)
    commands = run.commands if run else read_commands(options.source)
    pose, velocity = read_initial(options.initial)
    if run is not None and not options.initial:
        begin = run.about.get("start") or run.about.get("course", {}).get("start")
        if begin:
            pose = (begin["x_m"], begin["y_m"], begin["heading_rad"])
        first = run.about.get("initial", {})
        velocity = (
            first.get("vx_mps", 0.0),
            first.get("vy_mps", 0.0),
            first.get("yaw_rate_radps", 0.0),
        )
    charge = 1.0 if options.battery is None else options.battery
    if run is not None:
        charge = float(run.about.get("battery_charge", 1.0))
    course = course_of_run(run.about) if run else None
    # A driver that plays commands looks at no estimate.
    estimator = DeadReckoning(start=pose, dt=options.dt)
    pilot = Pilot.with_estimator(replay(commands), estimator, dt=options.dt)
    simulator = Simulator.of(
        course,
        car,
        dt=options.dt,
        seed=options.seed,
        start=pose,
        velocity=velocity,
        charge=charge,
        floor=floor_of_run(run.about) if run else None,
    )
    times = commands["time_s"]
    if times[-1] > LONGEST_REPLAY:
        raise InputError(f"{options.source}: commands go on to {times[-1]:g} s, over an hour")
    last = float(times[-1] - times[-2]) if len(times) > 1 else 1.0
    longest, laps = float(times[-1]) + last, int(run.about.get("laps", 1)) if run else 1
    about = about_run(simulator, pilot, course, "replay", name, laps, car, {"kind": "replay"})
    return record(options, simulator, pilot, course, about, longest, options.source.stem)


def record(
    options: argparse.Namespace,
    simulator: "Simulator",
    pilot: "Pilot",
    course: "Course | None",
    about: dict[str, Any],
    longest: float,
    place: str,
) -> int:
    """Drives, writes the run's folder with its pictures, and prints what came of it."""
    from countersteer.evaluation.drive import drive
    from countersteer.runs.recorder import new_folder
    from countersteer.runs.run import read_run
    from countersteer.simulator import keep_programs
    from countersteer.viewing.picture import Painter
    from countersteer.viewing.report import report_html
    from countersteer.viewing.view import view_of

    keep_programs(batches=False)
    folder = new_folder(options.out, f"{Path(place).stem}-{about['driver']}")
    painter = Painter(folder / "report.png")
    with Progress(options.json) as progress:
        result = drive(
            simulator, pilot, course, folder, about, about["laps"], longest, progress.show
        )
    view = view_of(read_run(folder))
    (folder / "report.html").write_text(report_html(view))
    painter.draw(view)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
    else:
        print_result(result, folder)
    if result["status"] == "interrupted":
        print("countersteer: interrupted", file=sys.stderr)
        return INTERRUPTED
    return DONE if result["success"] else FAILED


def run_compare(options: argparse.Namespace, run: Any, car: "Car", name: str) -> int:
    """`replay --compare`."""
    from countersteer.evaluation.compare import compare, draw_comparison
    from countersteer.simulator import keep_programs

    keep_programs()
    horizon = None if options.horizon == "run" else read_horizon(options.horizon or "1.0")
    result, series = compare(run, car, horizon, options.dt)
    out = options.out or run.path
    out.mkdir(parents=True, exist_ok=True)
    (out / "compare.json").write_text(json.dumps(result, indent=1) + "\n")
    draw_comparison(series, out / "compare.png")
    if options.json:
        print(json.dumps(result))
        return DONE
    if not result["battery_told"]:
        print(
            f"battery: the log does not tell; {result['battery_charge']:.2f} of a full one agrees "
            "best (--battery sets it)"
        )
    print(f"{name}: {result['windows']} windows of {result['horizon_s']:g} s; error at their ends:")
    for quantity, error in result["median_abs_error"].items():
        nothing = result["persistence"]["median_abs_error"][quantity]
        print(f"  {quantity:16} {error:8.3f}   (if nothing changed: {nothing:.3f})")
    print(f"picture: {out / 'compare.png'}")
    return DONE


def run_import(options: argparse.Namespace) -> int:
    """`import`."""
    from countersteer.runs.dart import import_dart
    from countersteer.runs.eth import import_eth

    importer = {"dart": import_dart, "eth": import_eth}[options.format]
    results = []
    for file in options.files:
        results.append(importer(file, options.out))
        if not options.json:
            print(f"{file.name} -> {options.out / file.stem}")
    if options.json:
        print(json.dumps({"runs": results}))
    return DONE


def run_tune(options: argparse.Namespace) -> int:
    """`tune`."""
    from countersteer.car.files import load_car
    from countersteer.runs.run import read_run
    from countersteer.simulator import keep_programs
    from countersteer.tuning.tune import other_floors

    if options.out.suffix != ".toml":
        raise InputError(f"--out {options.out}: name a .toml file")
    try:
        options.out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {options.out}: {error.strerror}") from None
    keep_programs(blocks=True)
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
    from countersteer.viewing.tuning_page import write_tuning_page

    with jax.enable_x64(True):
        cars = tune.by_surface(base, car, others)
        logs = old = tune.read_logs(runs, cars, tune.EVERY["judged"], base)
        if new:
            since = tune.read_logs(new, cars, tune.EVERY["judged"], base)
            logs = old.joined(since)
        judged = (
            tune.read_logs(validation, cars, tune.EVERY["judged"], base) if validation else None
        )
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
    files = tune.write_cars(result, about, options.out)
    page = options.out.with_suffix(".html")
    write_tuning_page(page, about, drawn)
    short = {key: value for key, value in about.items() if key != "residuals"}
    short["cars"] = {name: str(path) for name, path in files.items()}
    options.out.with_suffix(".json").write_text(json.dumps(short, indent=1) + "\n")
    if options.json:
        print(json.dumps(short | {"page": str(page)}))
        return DONE
    for line in tune.table_lines(about):
        print(line)
    if new:
        print(about["new_runs"]["said"])
    print(f"cars: {', '.join(map(str, files.values()))}; page: {page}")
    return DONE


def tune_acceleration(options: argparse.Namespace, runs: list[Any], car: "Car") -> int:
    """The paper's adjuster: one parameter from steps of throttle."""
    from countersteer.car.files import save_car
    from countersteer.tuning.acceleration import draw_acceleration, fit_acceleration

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
    save_car(found.car, options.out, {"acceleration": json.dumps(about)})
    picture = options.out.with_suffix(".png")
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


def run_trials(options: argparse.Namespace) -> int:
    """`trials`."""
    from countersteer.evaluation.trials import LEVELS, read_levels, throttle_steps

    levels = LEVELS if options.levels is None else read_levels(options.levels)
    result = throttle_steps(options.out, levels, options.duration_s, options.rate_hz)
    if options.json:
        print(json.dumps(result))
    else:
        print((options.out / "README.txt").read_text(), end="")
    return DONE


def run_turns(options: argparse.Namespace) -> int:
    """`trials turns`."""
    from countersteer.car.files import load_car
    from countersteer.drivers.policy import load_policy
    from countersteer.evaluation import open_turns
    from countersteer.evaluation.population import load_population
    from countersteer.runs.recorder import new_folder
    from countersteer.simulator import keep_programs

    if options.runs:
        rows = [row for path in options.runs for row in open_turns.of_run(path)]
        tried, title = None, ", ".join(path.name for path in options.runs[:2])
        title += f" and {len(options.runs) - 2} more" if len(options.runs) > 2 else ""
        folder = new_folder(options.out, "turns")
    else:
        keep_programs(cores=os.cpu_count() or 1)
        car, turning = load_car(options.car, options.set), load_policy(options.driver).turning
        cars = load_population(options.cars) if options.cars else None
        charge = options.battery or (None if cars else (0.3, 1.0))
        seeds = range(options.seed, options.seed + options.trials)
        folder = new_folder(options.out, "turns")
        with Progress(options.json) as progress:
            rows = open_turns.trial(
                car, turning, cars, seeds, options.speed_mps, charge, progress.show
            )
        tried, title = options.trials, f"{options.car}, {options.trials} turns"
    table = open_turns.as_table(rows)
    open_turns.write_rows(folder / "turns.csv", rows)
    open_turns.draw_turns(table, folder / "turns.png", title)
    result: dict[str, Any] = (
        {"car": options.car} if tried else {"runs": [str(path) for path in options.runs]}
    )
    result |= open_turns.summary(table, tried)
    (folder / "turns.json").write_text(json.dumps(result, indent=1) + "\n")
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


def run_experiment(options: argparse.Namespace) -> int:
    """`experiment`."""
    from countersteer.car.files import load_car
    from countersteer.evaluation import experiments
    from countersteer.evaluation.experiments.found import write
    from countersteer.runs.recorder import new_folder
    from countersteer.runs.run import read_run
    from countersteer.simulator import keep_programs

    # Only the closed loop is worth its time in a compiler that makes a function of it.
    closed = options.name in ("control-rate", "linked-turns")
    keep_programs(blocks=closed, cores=os.cpu_count() or 1)
    module, car = experiments.load(options.name), load_car(options.car, options.set)
    if options.runs and not hasattr(module, "measure"):
        raise InputError(f"--from: {options.name} is simulated, and measures no run")
    folder = new_folder(options.out, options.name)
    with Progress(options.json) as progress:
        if options.runs:
            found = module.measure([read_run(path) for path in options.runs])
        else:
            found = module.simulate(car, Path(options.car).stem, progress.show)
    result = write(found, folder, options.name)
    if options.json:
        print(json.dumps(result | {"out": str(folder)}))
    else:
        print(f"{found.text}\ntable, picture: {folder}")
    return DONE


def run_learn_stop_angle(options: argparse.Namespace) -> int:
    """`learn stop-angle`."""
    from countersteer.evaluation import stop_regression
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


def run_learn_turn(options: argparse.Namespace) -> int:
    """`learn turn`."""
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import load_policy, save_policy
    from countersteer.evaluation.population import load_population
    from countersteer.learning.turning import Generation, search
    from countersteer.simulator import keep_programs

    if options.out.suffix != ".toml":
        raise InputError(f"--out {options.out}: name a .toml file")
    keep_programs(blocks=True, cores=os.cpu_count() or 1)
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


def run_export(options: argparse.Namespace) -> int:
    """`export`."""
    from countersteer.runs.run import read_run
    from countersteer.viewing.animation import Animation, Options, export

    kind, file = ("gif", options.gif) if options.gif else ("mp4", options.mp4)
    if file.is_dir():
        raise InputError(f"{file}: is a folder: name a file")
    if file.exists() and not options.force:
        raise InputError(f"{file}: is there already: give another name, or --force to replace it")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder")
    fps = options.fps or {"gif": 20.0, "mp4": 25.0}[kind]
    if kind == "gif" and fps > FASTEST_GIF:
        raise InputError(f"--fps must be at most {FASTEST_GIF} for a GIF: viewers slow others down")
    drawn = Options(
        options.width_px, fps, options.speed, options.follow, options.from_s, options.to_s
    )
    animation = Animation(read_run(options.source), drawn)
    # What was begun is taken away again: the exception has to come through.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Progress(options.json) as progress:
            export(animation, file, kind, progress.show)
    finally:
        signal.signal(signal.SIGINT, before)
    width, height = animation.size
    result = {
        "file": str(file),
        "frames": animation.count,
        "duration_s": animation.duration,
        "fps": fps,
        "width_px": width,
        "height_px": height,
    }
    if options.json:
        print(json.dumps(result))
    else:
        size = file.stat().st_size / 1e6
        print(f"{file}: {animation.count} frames, {animation.duration:.1f} s, {size:.1f} MB")
    return DONE


def run_bench(options: argparse.Namespace) -> int:
    """`bench`."""
    from countersteer.evaluation import bench

    if options.out and (options.out.suffix != ".md" or not options.out.parent.is_dir()):
        raise InputError(f"{options.out}: name a file .md in a folder that is there")
    with Progress(options.json) as progress:
        found = bench.measure(bench.QUICK if options.quick else bench.FULL, progress.show)
    if options.out:
        bench.write_page(found, options.out)
    print(json.dumps(found) if options.json else "\n".join(bench.lines(found)))
    return DONE


def run_list(options: argparse.Namespace) -> int:
    """`list`."""
    from countersteer import listing

    if options.car and options.what != "parameters":
        raise InputError("--car: goes with list parameters")
    found = {
        "cars": listing.cars,
        "courses": listing.courses,
        "drivers": lambda: [
            *listing.drivers(DRIVERS),
            *({"name": name, "description": text} for name, text in plans().items()),
        ],
        "parameters": lambda: listing.parameters(options.car),
    }[options.what]()
    if options.json:
        print(json.dumps({options.what: found}))
    else:
        print("\n".join(listing.lines(options.what, found)))
    return DONE


def run_completion(options: argparse.Namespace) -> int:
    """`completion`."""
    from countersteer.completion import script

    text = script(parser(), options.shell, [*DRIVERS, *plans()])
    print(json.dumps({"script": text}) if options.json else text)
    return DONE


def plans() -> dict[str, str]:
    """The plans of the library, and what they say of themselves."""
    from countersteer.drivers.plan import library

    return library()


INITIAL = ("x_m", "y_m", "heading_rad", "vx_mps", "vy_mps", "yaw_rate_radps")


def read_initial(text: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Pose and velocity from `vx_mps=2,…`; what is not named is 0."""
    values = dict.fromkeys(INITIAL, 0.0)
    for part in filter(None, text.split(",")):
        name, _, value = part.strip().partition("=")
        if name not in values:
            raise InputError(f"--initial: unknown state {name}; known: {', '.join(INITIAL)}")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(f"--initial: {name} must be a number, not {value!r}") from None
        if not abs(values[name]) <= 1000:
            raise InputError(f"--initial: {name} must be in [-1000, 1000]")
    x, y, heading, vx, vy, yaw_rate = values.values()
    return (x, y, heading), (vx, vy, yaw_rate)


def read_horizon(text: str) -> float:
    """The horizon of a comparison in seconds."""
    try:
        return float(number(0.05, 600)(text))
    except argparse.ArgumentTypeError as error:
        raise InputError(f"--horizon {error}, or the word run") from None


class Progress:
    """A progress bar on a terminal; nothing elsewhere, and nothing with `--json`."""

    def __init__(self, quiet: bool) -> None:
        """Quiet shows nothing."""
        self._quiet = quiet or not sys.stderr.isatty()
        self._bar: Any = None

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, done: float, of: float) -> None:
        """Moves the bar."""
        if self._quiet:
            return
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=of, leave=False, bar_format="{l_bar}{bar}| {elapsed}")
        self._bar.n = min(done, of)
        self._bar.refresh()


def print_result(result: dict[str, Any], folder: Path) -> None:
    """The summary for a person."""
    lap = f" in {result['lap_time_s']:.2f} s" if result["lap_time_s"] else ""
    touched = result["wall_contacts"]
    print(f"{result['status']}{lap}, {touched} wall contact{'s' if touched != 1 else ''}")
    for i, turn in enumerate(result["turns"], start=1):
        print(
            f"  turn {i}: in at {turn['entry_speed_mps']:.2f} m/s, "
            f"sideslip {turn['peak_sideslip_deg']:.0f}°, "
            f"yaw rate {turn['peak_yaw_rate_degps']:.0f} °/s, "
            f"{turn['heading_overshoot_deg']:.0f}° too far and back, "
            f"out {turn['heading_error_deg']:+.1f}° off after {turn['duration_s']:.2f} s"
        )
    print(f"report: {folder / 'report.html'}")


def entry() -> None:
    """The command: `main`, but that a Ctrl-C ends the process at once.

    Until a drive is under way there is nothing to save, and an exception might come where a
    compiler's callback swallows it.
    """

    def leave(*_: object) -> None:
        os.write(2, b"countersteer: interrupted\n")
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, leave)
    sys.exit(main())


if __name__ == "__main__":
    entry()
