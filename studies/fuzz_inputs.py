"""Valid small inputs of every format, each with the functions that the verbs read it by.

A reader goes as far as reading and checking do: to where a verb would compile, simulate or draw.
"""

import argparse
import contextlib
import dataclasses
import io
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from countersteer.batch.population import load_population
from countersteer.car.car import Car
from countersteer.car.files import car_tables, load_car
from countersteer.cli import listing
from countersteer.cli.replay import replayed
from countersteer.course.files import course_of_run, course_tables, load_course
from countersteer.drivers.policy import for_another_car
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.experiments.open_turns import read_turns, series_of, stops
from countersteer.judge_run import samples_of
from countersteer.pilot import pilot_of_run
from countersteer.runs.files import column_rows, command_rows, read_commands
from countersteer.runs.importers.csv import import_csv
from countersteer.runs.importers.dart import import_dart
from countersteer.runs.importers.donkeycar import import_donkeycar
from countersteer.runs.importers.eth import import_eth
from countersteer.runs.run import Run, read_run
from countersteer.text import toml_of
from countersteer.tuning import acceleration, fit, tune
from countersteer.tuning.windows import find_references, read_measured, window_starts
from countersteer.viewing.animation import Animation, Options
from countersteer.viewing.view import echoes, known_rows, motions
from countersteer.world.floor import floor_of_run

Files = dict[str, bytes]  # by their path in a folder


@dataclasses.dataclass(frozen=True)
class Format:
    """A valid input: files, those of them that are mutated, and the function that reads them."""

    name: str
    files: Files
    targets: tuple[str, ...]
    read: Callable[[Path], None]  # of the folder that holds the files


CAR = """base = "rx7"
description = "a car"
[body]
mass_kg = 1.5
[tires.rear]
friction = 0.4
[sensors.sonar]
firing = "in-turn"
[sensors.sonar.mounts.back]
x_m = -0.2
angle_deg = 180.0
[source]
body = "a scale"
"""
SEGMENTS = """name = "loop"
width_m = 1.2
closed = true
segments = [
  {straight_m = 4.0}, {turn_deg = -90.0, radius_m = 1.0},
  {straight_m = 4.0}, {turn_deg = -90.0, radius_m = 1.0},
  {straight_m = 4.0}, {turn_deg = -90.0, radius_m = 1.0},
  {straight_m = 4.0}, {turn_deg = -90.0, radius_m = 1.0},
]
[start]
distance_m = 1.5
offset_m = 0.1
[goal]
distance_m = 14.0
"""
OPEN = """width_m = 1.0
crosses = true
segments = [{length_m = 3.0}, {turn_deg = 90.0}, {straight_m = 2.0},
  {turn_deg = -60.0, radius_m = 0.5},
  {length_m = 2.0},
]
"""
WALLS = """name = "yard"
walls_m = [[[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]], [[1.5, 1.5], [2, 2]]]
[start]
x_m = 1.0
heading_deg = 10.0
"""
MAP = """image: map.png
resolution: 0.05
origin: [-3.0, -1.0, 0.0]
occupied_thresh: 0.65
free_thresh: 0.196
negate: 0
mode: trinary
"""
PLAN = """kind = "plan"
description = "two corners"
[[policy]]
does = "straighten"
speed_mps = 1.5
until = { driven_m = 1.0 }
[[policy]]
does = "commands"
commands = "steps.csv"
until = { time_s = 1.0, yaw_rate_degps = 20.0 }
[[policy]]
does = "commands"
throttle = 0.4
steering_deg = 10.0
from_m = 0.0
to_m = 3.0
[[policy]]
does = "drift"
turn_deg = -90.0
"""
MAPPING = """full_lock_deg = 25
time = { column = "vicon time", unit = "s" }
throttle = { column = "throttle", unit = "1" }
steering = { column = "steering", unit = "1" }
wheel_speed = { column = "vel encoder", unit = "m/s", within = [0, 20], held = true }
gyro = { column = "W (IMU)", unit = "rad/s" }
x = { column = "vicon x", unit = "m" }
y = { column = "vicon y", unit = "m" }
heading = { column = "vicon yaw", unit = "rad" }
armed = { column = "safety_value", above = 0.5 }
"""
POPULATION = """description = "a few"
[vary]
"body.mass_kg" = { within = 0.1 }
"tires.front.friction, tires.rear.friction" = { within = 0.1, plus = 0.01 }
"battery.wear" = { low = 0.0, high = 0.5 }
[start]
charge = [0.5, 1.0]
along_m = 0.1
heading_deg = 2.0
[floor]
deviation = 0.05
length_m = 0.5
"""


def formats() -> dict[str, Format]:
    """The formats by name."""
    drive, steps = run_folder(), {"steps.csv": commands()}
    made = (
        Format("car", {"c.toml": CAR.encode()}, ("c.toml",), _car),
        Format("course", {"c.toml": SEGMENTS.encode()}, ("c.toml",), _course("c.toml")),
        Format("open-course", {"c.toml": OPEN.encode()}, ("c.toml",), _course("c.toml")),
        Format("walls", {"c.toml": WALLS.encode()}, ("c.toml",), _course("c.toml")),
        Format("centre-line", {"c.csv": centre_line()}, ("c.csv",), _course("c.csv")),
        Format(
            "map",
            {"m.yaml": MAP.encode(), "map.png": picture()},
            ("m.yaml", "map.png"),
            _course("m.yaml"),
        ),
        Format("run", drive, tuple(drive), _run),
        Format("commands", {"c.csv": commands()}, ("c.csv",), _commands),
        Format("turns", {"t.csv": turns()}, ("t.csv",), _turns),
        Format("dart", {"l.csv": dart()}, ("l.csv",), _import(import_dart, "l.csv")),
        Format("eth", {"l.npz": eth()}, ("l.npz",), _import(import_eth, "l.npz")),
        Format(
            "mapped",
            {"l.csv": dart(), "m.toml": MAPPING.encode()},
            ("l.csv", "m.toml"),
            _import(lambda log, out: import_csv(log, out, log.with_name("m.toml")), "l.csv"),
        ),
        Format(
            "tub",
            tub(),
            tuple(tub()),
            _import(lambda log, out: import_donkeycar(log, out, None), "manifest.json"),
        ),
        Format("policy", {"p.toml": policy()}, ("p.toml",), _driver),
        Format("plan", {"p.toml": PLAN.encode(), **steps}, ("p.toml", "steps.csv"), _driver),
        Format("population", {"s.toml": POPULATION.encode()}, ("s.toml",), _population),
    )
    return {one.name: one for one in made}


# -------------------------------------------------------------------------------------------------
# Files
# -------------------------------------------------------------------------------------------------


def table(columns: Mapping[str, np.ndarray]) -> bytes:
    """A CSV file."""
    rows = column_rows(columns.values())
    return "\n".join([",".join(columns), *map(",".join, rows), ""]).encode()


def circle(time: np.ndarray) -> tuple[np.ndarray, ...]:
    """x, y, heading and speed of a car that starts after half a second, on a circle of 1 m."""
    since = np.maximum(time - 0.5, 0.0)
    speed = np.minimum(since, 1.5)
    driven = np.where(since < 1.5, since**2 / 2, 1.125 + 1.5 * (since - 1.5))
    return np.sin(driven), 1 - np.cos(driven), driven, speed


def commands() -> bytes:
    """A `commands.csv`."""
    time = np.round(np.arange(0, 4, 0.1), 3)
    throttle = np.where(time < 0.5, 0.0, np.where(time < 3, 0.4, 0.0))
    rows = command_rows(time, throttle, np.where(time > 1.5, 0.2, 0.0))
    header = "time_s,throttle,direction,steering_deg"
    return "\n".join([header, *map(",".join, rows), ""]).encode()


def run_folder() -> Files:
    """A run as the simulator writes it."""
    car, course = load_car("rx7"), load_course("box")
    driver = make_driver("drift-turn", course, car, None, 1, read_commands)[1]
    about = {
        "driver": "drift-turn", "car_name": "rx7", "seed": 0, "laps": 1, "estimate": "filter",
        "battery_charge": 0.9, "rates": {"dt_s": 0.001}, "link": {"name": "onboard"},
        "precision_bits": 64, "line_spacing_m": 0.05, "velocity_lag_s": 0.01,
        "start": {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0},
        "initial": {"vx_mps": 0.1, "vy_mps": 0.0, "yaw_rate_radps": 0.0},
        "sensors": {"encoder": {"lag_s": 0.05}, "gyroscope": {"lag_s": 0.01}},
        "floor": {"amplitude": 0.01, "waves": [{"x_radpm": 1.0, "y_radpm": 2.0, "phase_rad": 0.1}]},
        "pilot": driver, "car": car_tables(car), "nominal": car_tables(car),
        "course": course_tables(course),
    }  # fmt: skip
    turn = {"begin_s": 1.0, "end_s": 2.0, "entry_speed_mps": 1.5, "peak_sideslip_deg": 30.0}
    summary = {
        "completed": True, "success": True, "outcome": "goal reached", "verdict": "goal reached",
        "wall_contacts": 0, "lap_time_s": 3.5, "drifts": 1, "turns": [turn],
    }  # fmt: skip
    time = np.round(np.arange(0, 4, 0.025), 3)
    x, y, heading, speed = circle(time)
    told = {
        "time_s": time,
        "wheel_speed_mps": speed,
        "encoder_counts": np.floor(100 * heading),
        "line_crossings": np.floor(20 * heading),
        "gyro_radps": speed,
        "sonar_front_m": np.where(time > 3, np.inf, 4.0 - heading / 3),
    }
    wheels = {f"wheel_{place}_radps": speed / 0.03 for place in ("fl", "fr", "rl", "rr")}
    truth = {
        "time_s": time, "x_m": x, "y_m": y, "heading_rad": heading, "vx_mps": speed,
        "vy_mps": 0.0 * speed, "yaw_rate_radps": speed, **wheels, "steering_rad": 0.2 + 0.0 * speed,
    }  # fmt: skip
    return {
        "run.toml": toml_of(about).encode(),
        "summary.json": json.dumps(summary, indent=1).encode(),
        "commands.csv": commands(),
        "telemetry.csv": table(told),
        "truth.csv": table(truth),
    }


def centre_line() -> bytes:
    """A ring, in the manner of F1TENTH."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    row = np.stack([3 * np.cos(angle), 2 * np.sin(angle), 0 * angle + 0.5, 0 * angle + 0.6])
    lines = [", ".join(f"{v:.4f}" for v in one) for one in row.T]
    return "\n".join(["# x_m, y_m, w_tr_right_m, w_tr_left_m", *lines, ""]).encode()


def picture() -> bytes:
    """The map of a ring of 1 m around the point 2 m to the left of the origin."""
    image = Image.new("L", (120, 120), 0)
    draw = ImageDraw.Draw(image)
    draw.ellipse((10, 10, 110, 110), fill=254)
    draw.ellipse((35, 35, 85, 85), fill=0)
    content = io.BytesIO()
    image.save(content, "PNG")
    return content.getvalue()


def turns() -> bytes:
    """A table of stopped turns."""
    names = ("entry_speed_mps", "kill_speed_mps", "kill_yaw_rate_degps", "time_to_stop_s")
    lines = [",".join(("hand", *names, "angle_to_stop_deg"))]
    lines += [f"left,{1 + i / 20},1.2,{200 + 10 * i},0.{30 + i},{40 + i}" for i in range(12)]
    return "\n".join([*lines, ""]).encode()


def dart() -> bytes:
    """A recording with motion capture."""
    time = np.arange(0, 3, 0.02)
    x, y, heading, moves = circle(time)
    zero = 0.0 * time
    columns = {
        "elapsed time sensors": np.floor(10 * time) / 10 + 100, "current": zero, "voltage": zero,
        "acc x (IMU)": zero, "acc y (IMU)": zero, "W (IMU)": moves, "vel encoder": moves,
        "safety_value": zero + 1, "throttle": 0.2 * moves, "steering": zero + 0.5,
        "vicon time": 1725446070.0 + np.round(time, 3), "vicon x": x, "vicon y": y,
        "vicon yaw": (heading + np.pi) % (2 * np.pi) - np.pi,
    }  # fmt: skip
    return table(columns)


def tub() -> dict[str, bytes]:
    """A tub of Donkeycar."""
    records = [
        {"_index": i, "_timestamp_ms": 1700000000000 + 50 * i}
        | {"user/angle": 0.1, "user/throttle": 0.3, "enc/speed": 0.1 * i}
        for i in range(20)
    ]
    paths = {"paths": ["catalog_0.catalog"], "deleted_indexes": [3]}
    lines: list[Any] = [["user/angle", "user/throttle"], ["float", "float"], {}, {}, paths]
    return {
        "manifest.json": "\n".join(map(json.dumps, lines)).encode(),
        "catalog_0.catalog": "".join(json.dumps(one) + "\n" for one in records).encode(),
    }


def eth() -> bytes:
    """A recording of arrays."""
    time = 0.0336 * np.arange(40)
    x, y, heading, speed = circle(time)
    obs = np.zeros((40, 12))
    obs[:, 0], obs[:, 1], obs[:, 2], obs[:, 5] = x, y, heading, speed
    content = io.BytesIO()
    np.savez(content, obs=obs, action=np.full((40, 2), 0.4))
    return content.getvalue()


def policy() -> bytes:
    """The library's policy, as a file."""
    from countersteer.drivers.policy import LIBRARY

    return bytes((LIBRARY / "drift-turn.toml").read_bytes())


# -------------------------------------------------------------------------------------------------
# Readers
# -------------------------------------------------------------------------------------------------


def _car(folder: Path) -> None:
    """As `list parameters`."""
    listing.lines("parameters", listing.parameters(str(folder / "c.toml")))


def _course(name: str) -> Callable[[Path], None]:
    """As `drive` up to its drivers."""

    def read(folder: Path) -> None:
        course, car = load_course(str(folder / name)), load_car("rx7")
        toml_of({"course": course_tables(course)})
        for driver in ("pursuit", "drift-turn"):  # each is for some courses
            with contextlib.suppress(InputError):
                make_driver(driver, course, car, None, 1, read_commands)

    return read


def _turns(folder: Path) -> None:
    """As `learn stop-angle`."""
    read_turns(folder / "t.csv")


def _population(folder: Path) -> None:
    """As `evaluate`."""
    load_population(str(folder / "s.toml"))


def _driver(folder: Path) -> None:
    """As `drive` with a policy or a plan."""
    course, car = load_course("box"), load_car("rx7")
    _, tables = make_driver(str(folder / "p.toml"), course, car, None, 1, read_commands)
    for_another_car(tables, "rx7")
    toml_of({"pilot": tables})


def _commands(folder: Path) -> None:
    """As `replay` of a file."""
    replayed(options(folder / "c.csv"), None, load_car("rx7"), "rx7")


def options(source: Path) -> argparse.Namespace:
    """The options of `replay`, where none is given."""
    return argparse.Namespace(source=source, initial="", battery=None, dt=0.001, seed=0)


def _run(folder: Path) -> None:
    """As every verb that takes a run. One that refuses it does not keep it from the others."""
    run = read_run(folder)
    car = run.car or load_car("rx7")
    found = [error for use in USES for error in [_tried(use, run, car)] if error is not None]
    if found:
        raise found[0]


def _tried(use: Callable[[Run, Car], object], run: Run, car: Car) -> InputError | None:
    try:
        use(run, car)
    except InputError as error:
        return error
    return None


def _windows(run: Run, car: Car) -> None:
    """As `replay --compare`."""
    measured = read_measured(run, car)
    find_references(measured)
    window_starts(measured, run.commands, 1000, 0.001)


def _tuned(run: Run, car: Car) -> None:
    """As `tune`, up to its windows."""
    read = tune.read_logs([run], {"rx7": car}, 0.5, "rx7")
    fit.blocks(read.start, read.run)


def _drawn(run: Run, car: Car) -> None:
    """As the report, up to the forces, and as `export`."""
    Animation(run, Options())
    if run.truth is not None:
        shown = dataclasses.replace(run, truth=known_rows(run))
        motions(shown, car)
        echoes(shown, car)


def _accelerated(source: str) -> Callable[[Run, Car], None]:
    """As `tune --fit acceleration`."""

    def use(run: Run, _: Car) -> None:
        try:
            acceleration.take(run, source)
        except acceleration.UnusableError as error:
            raise InputError(str(error)) from None

    return use


USES: tuple[Callable[[Run, Car], object], ...] = (
    lambda run, car: replayed(options(run.path), run, car, "rx7"),
    lambda run, _: course_of_run(run.about),
    lambda run, _: floor_of_run(run.about),
    lambda run, _: pilot_of_run(run.about, read_commands),
    _windows,
    _tuned,
    *(_accelerated(source) for source in ("encoder", "sonar", "lines")),
    lambda run, _: stops(series_of(run)),
    lambda run, _: samples_of(run),
    _drawn,
)


def _import(take: Callable[[Path, Path], dict[str, Any]], name: str) -> Callable[[Path], None]:
    """As `import`, whole; what it writes is read again."""

    def read(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as out:
            read_run(Path(take(folder / name, Path(out))["run"]))

    return read
