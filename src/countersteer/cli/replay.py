"""`replay`: commands in, motion out; or a log against the simulator."""

import argparse
import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.cli.options import DONE, Verbs, number, physics
from countersteer.cli.recorded import record, set_up
from countersteer.errors import InputError
from countersteer.reading.content import reading
from countersteer.reading.values import shown

if TYPE_CHECKING:
    from countersteer.car.car import Car
    from countersteer.recorded_drive import Drive
    from countersteer.runs.run import Run


INITIAL = ("x_m", "y_m", "heading_rad", "vx_mps", "vy_mps", "yaw_rate_radps")


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    replay = verbs.verb("replay", "commands in, motion out; or a log against the simulator", run)
    meaning = "a commands.csv, or a run's folder"
    replay.add_argument("source", type=Path, metavar="COMMANDS_OR_RUN", help=meaning)
    physics(replay, None)
    meaning = 'such as "vx_mps=2,yaw_rate_radps=1"'
    replay.add_argument("--initial", default="", metavar="STATES", help=meaning)
    meaning = (
        "charge, 0 to 1 (default: the run's battery_charge, or else 1; with --compare, or else "
        "what agrees best)"
    )
    replay.option("--battery", "F", number(0, 1), None, meaning)
    replay.add_argument("--compare", action="store_true", help="measured against simulated")
    meaning = (
        "seconds that are predicted at a time, or run: the whole of it (with --compare; default "
        "1.0)"
    )
    replay.option("--horizon", "S|run", str, None, meaning)


def run(options: argparse.Namespace) -> int:
    """`replay`."""
    if not options.compare:
        set_up(options)
    from countersteer.runs.run import read_run

    if options.horizon and not options.compare:
        raise InputError("--horizon is of a comparison: give --compare as well")
    if options.initial and options.compare:
        raise InputError("--initial: --compare starts from what was measured")
    with reading(options.source):
        run = read_run(options.source) if options.source.is_dir() else None
        if run is None and not options.source.exists():
            raise InputError(f"{options.source}: no such run folder or commands.csv")
    if options.battery is not None and run is not None:
        about = {**run.about, "battery_charge": options.battery}
        run = dataclasses.replace(run, about=about)
    cars = cars_of(options, run)
    if options.compare:
        if run is None:
            raise InputError("--compare needs a run folder, such as import makes")
        return run_compare(options, run, cars)
    if len(cars) > 1:
        raise InputError("--car: several cars are for --compare: give one")
    ((name, car),) = cars.items()
    return record(options, replayed(options, run, car, name), options.source.stem)


def cars_of(options: argparse.Namespace, run: "Run | None") -> "dict[str, Car]":
    """The cars of `--car` by name, or else the run's own."""
    from countersteer.car.files import load_car

    if options.car is None and run is not None and run.car is not None and not options.set:
        return {str(run.about.get("car_name", "its own car")): run.car}
    names = options.car or [str(run.about.get("car_name", "rx7")) if run else "rx7"]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise InputError(f"--car {twice[0]}: is given twice")
    return {name: load_car(name, options.set) for name in names}


def replayed(options: argparse.Namespace, run: "Run | None", car: "Car", name: str) -> "Drive":
    """The drive that replays a run's commands, or those of a `commands.csv`."""
    from countersteer.car.files import require_speed_controller
    from countersteer.course.files import course_of_run
    from countersteer.drivers.registry import replay
    from countersteer.estimation.dead_reckoning import DeadReckoning
    from countersteer.pilot import Pilot
    from countersteer.recorded_drive import Drive, about_run
    from countersteer.runs.files import LONGEST, read_commands
    from countersteer.simulator import Simulator
    from countersteer.world.floor import floor_of_run

    commands = run.commands if run else read_commands(options.source)
    if "speed" in commands:
        require_speed_controller(car, str(options.source))
    pose, velocity = read_initial(options.initial)
    if run is not None and not options.initial:
        begin = run.about.get("start") or run.about.get("course", {}).get("start")
        begin = begin or measured_start(run)
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
    if times[-1] > LONGEST:
        raise InputError(f"{options.source}: commands go on to {times[-1]:g} s, over an hour")
    last = float(times[-1] - times[-2]) if len(times) > 1 else 1.0
    longest, laps = float(times[-1]) + last, int(run.about.get("laps", 1)) if run else 1
    about = about_run(simulator, pilot, course, "replay", name, laps, car, {"kind": "replay"})
    return Drive(simulator, pilot, course, about, longest)


def measured_start(run: "Run") -> dict[str, float] | None:
    """The first pose that was measured of a real car; None without."""
    names = ("x_m", "y_m", "heading_rad")
    poses = zip(*(run.truth[name].tolist() for name in names), strict=True) if run.truth else ()
    known = (pose for pose in poses if all(map(math.isfinite, pose)))
    first = next(known, None)
    return None if first is None else dict(zip(names, first, strict=True))


def run_compare(options: argparse.Namespace, run: "Run", cars: "dict[str, Car]") -> int:
    """`replay --compare`. With several cars, the picture is of the one that fits best."""
    from countersteer.compiling import configure_jax
    from countersteer.tuning import belief
    from countersteer.tuning.compare import compare
    from countersteer.viewing.comparison import draw_comparison
    from countersteer.writing import whole, write_whole

    configure_jax()
    horizon = None if options.horizon == "run" else read_horizon(options.horizon or "1.0")
    compared = {name: compare(run, car, horizon, options.dt) for name, car in cars.items()}
    results = {name: result for name, (result, _) in compared.items()}
    best = belief.best(results)
    told = results[best]
    if len(cars) > 1:
        scores = {name: belief.score(result) for name, result in results.items()}
        told = {"best": best, "rule": belief.RULE, "scores": scores, "cars": results}
    out = options.out or run.path
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise InputError(f"--out {out}: cannot be made: {reason.strerror}") from None
    with whole(out / "compare.json") as file:
        write_whole(file, json.dumps(told, indent=1) + "\n")
        draw_comparison(compared[best][1], out / "compare.png")
    if options.json:
        print(json.dumps(told))
        return DONE
    several = len(cars) > 1
    lines = ranking_lines(results, best) if several else comparison_lines(results[best], best)
    print("\n".join([*lines, f"picture: {out / 'compare.png'}"]))
    return DONE


def ranking_lines(results: "dict[str, dict[str, Any]]", best: str) -> list[str]:
    """What several comparisons say: their warnings, and a table of the cars, the best first."""
    from countersteer.tuning import belief

    lines = [
        f"warning: {name}: {line}"
        for name, result in results.items()
        for line in result["warnings"]
    ]
    still, quantities = "if nothing changed", [*results[best]["median_abs_error"]]
    width = max(map(len, [*results, still]))

    def row(name: str, cells: list[str]) -> str:
        return f"{name:{width}} " + " ".join(f"{cell:>15}" for cell in cells)

    lines.append(row("", [*quantities, "battery_charge", "score"]))
    for name in sorted(results, key=lambda name: (name != best, belief.score(results[name]))):
        errors, charge = results[name]["median_abs_error"], results[name]["battery_charge"]
        numbers = (*(errors[q] for q in quantities), charge, belief.score(results[name]))
        lines.append(row(name, [f"{number:.3f}" for number in numbers]))
    errors = results[best]["persistence"]["median_abs_error"]
    lines.append(row(still, [f"{errors[q]:.3f}" for q in quantities]))
    return [*lines, f"{best} fits best: {belief.RULE}"]


def comparison_lines(result: dict[str, Any], name: str) -> list[str]:
    """What a comparison says of the log's battery and sensors, its warnings and its errors."""
    charge = f"{result['battery_charge']:.2f} of a full one"
    lines = {
        "fit": [f"battery: the log does not tell; {charge} agrees best (--battery sets it)"],
        "voltmeter": [f"battery: {charge}, by the log's voltmeter (--battery sets it)"],
    }.get(result["battery_from"], [])
    for one in result["sensors"]:
        if one["determined"]:
            deviation = f" ± {one['deviation']:.2g}" if one["deviation"] else ""
            lines.append(
                f"log: {one['sensor']}.{one['key']} {one['estimated']:.4g}{deviation} "
                f"({one['declared_by']}: {one['declared']:.4g})"
            )
    lines += [f"warning: {line}" for line in result["warnings"]]
    windows = f"{result['windows']} windows of {result['horizon_s']:g} s"
    lines.append(f"{name}: {windows}; error at their ends:")
    for quantity, error in result["median_abs_error"].items():
        nothing = result["persistence"]["median_abs_error"][quantity]
        lines.append(f"  {quantity:16} {error:8.3f}   (if nothing changed: {nothing:.3f})")
    return lines


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
            raise InputError(f"--initial: {name} must be a number, not {shown(value)}") from None
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
