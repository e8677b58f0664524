"""The data for a run's report and picture, from the run's own files."""

import dataclasses
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import GRAVITY, Car, wheel_positions
from countersteer.errors import InputError
from countersteer.kept_programs import kept
from countersteer.runs.files import COVARIANCE, ROLLOUTS, Table, drive_column
from countersteer.runs.run import Run, drawn_car
from countersteer.signals import Array, Motion, Wheels
from countersteer.task.turns import sideslip
from countersteer.world import planar
from countersteer.world.floor import Floor, floor_of_run

PERIOD, MOST_SAMPLES = 0.01, 30_000  # s between two samples at least, and of a long run at most
LARGEST = 1e6  # of a number in truth.csv that is drawn
ROWS = 1024  # in each computation of forces; a fixed number, so that there is one program
UNJUDGED: dict[str, Any] = {"completed": False, "wall_contacts": None, "turns": []}
WHEELS = ("fl", "fr", "rl", "rr")
POSE = ("x_m", "y_m", "heading_rad")
VELOCITY = ("vx_mps", "vy_mps", "yaw_rate_radps")
COLUMNS = (*VELOCITY, "steering_rad", *(f"wheel_{wheel}_radps" for wheel in WHEELS))
ASKED = {"throttle": "throttle", "speed": "commanded_speed_mps"}  # key by column of commands
LATE = 1.5  # control periods without a command, from which on one counts as lost
ELLIPSE = 2.0  # standard deviations


def view_of(run: Run) -> dict[str, Any]:
    """The view of a run: texts, numbers and arrays, with units in the names.

    A quantity that the run does not tell has no entry. So only runs with ground truth or motion
    capture have `x_m`, `y_m` and `heading_rad`. Raises `InputError` if nothing can be drawn.
    """
    car = drawn_car(run.about)
    simulated = is_simulated(run)
    if run.truth is not None and len(run.truth):
        run = dataclasses.replace(run, truth=known_rows(run))
    motion = motion_of(run, car)
    time = motion["time_s"]
    period = max(PERIOD, float(time[-1] - time[0]) / MOST_SAMPLES)
    own = float(np.median(np.diff(time))) if len(time) > 1 else period
    every = slice(None, None, max(1, round(period / max(own, 1e-6))))
    command = np.maximum(np.searchsorted(run.commands["time_s"], time + 1e-9, "right") - 1, 0)
    drive = drive_column(run.commands)
    shown = motion | {
        "steering_command_deg": np.degrees(run.commands["steering"][command]),
        ASKED[drive]: run.commands[drive][command],
    }
    course = run.about.get("course", {})
    return {
        "title": title(run),
        "name": run.path.name,
        "facts": facts(run),
        "summary": UNJUDGED | {"outcome": run.outcome} | _unfinished(run, time) | run.summary,
        "walls_m": course.get("walls_m", []),
        "car": outline(car),
        "sonar": echoes(run, car) if course else [],
        "wheels": wheel_views(car, motions(run, car), floor_of_run(run.about), every)
        if simulated
        else [],
        "estimate": estimated(run),
        "events": events(run),
        "rollouts": planned(run),
    } | {name: values[every] for name, values in shown.items()}


def title(run: Run) -> str:
    """What was driven, in a line."""
    about = run.about
    if "log_format" in about:
        return f"{run.path.name}, a log of {about.get('car_name')}"
    place = about.get("course", {}).get("name", "open floor")
    return f"{place}, {about.get('driver')}, {about.get('car_name')}, seed {about.get('seed')}"


def facts(run: Run) -> list[tuple[str, str]]:
    """What the run says of itself, as names and texts."""
    about, link = run.about, run.about.get("link", {})
    log = about.get("log_format")
    rows = [
        ("Command", about.get("command")),
        ("Log", f"{about.get('source')}, format {log}" if log else None),
        ("Course", about.get("course", {}).get("name")),
        ("Car", about.get("car_name")),
        ("Driver", about.get("driver")),
        ("Estimate", about.get("estimate")),
        ("Link", link.get("name")),
        ("Seed", about.get("seed")),
        ("Battery charge", about.get("battery_charge")),
    ]
    return [(name, str(value)) for name, value in rows if value is not None]


def _unfinished(run: Run, time: np.ndarray) -> dict[str, str]:
    """The verdict on a drive that was recorded up to a time (s) and has no summary."""
    verdict = f"{run.outcome}: the record ends at {time[-1]:.2f} s"
    return {"verdict": verdict} if run.outcome == "not finished" else {}


def known_rows(run: Run) -> Table:
    """The rows of `truth.csv` whose numbers can all be drawn.

    Of a real car, only the pose has to be known. Raises `InputError` if there is no such row.
    """
    truth = run.truth
    assert truth is not None
    names = (*POSE, *COLUMNS) if set(COLUMNS) <= truth.keys() else POSE
    known = np.all(np.abs([truth[name] for name in names]) <= LARGEST, axis=0)  # false for NaN too
    if not np.any(known):
        raise InputError(f"{run.path}/truth.csv: holds no row of numbers that can be drawn")
    return Table({name: column[known] for name, column in truth.items()})


def is_simulated(run: Run) -> bool:
    """Whether the run tells the whole motion, down to each wheel."""
    return bool(run.truth is not None and len(run.truth) and {*POSE, *COLUMNS} <= run.truth.keys())


def motion_of(run: Run, car: Car) -> dict[str, np.ndarray]:
    """Pose, speed, sideslip, yaw rate and voltage over time, as far as the run tells them.

    Sideslip is 0 below 0.5 m/s and backwards. What is unknown at an instant is NaN.
    """
    return _simulated(run) if is_simulated(run) else _measured(run, car)


def _simulated(run: Run) -> dict[str, np.ndarray]:
    """The motion of a simulated run, at each row of its `truth.csv`."""
    truth = run.truth
    assert truth is not None
    vx, vy = truth["vx_mps"], truth["vy_mps"]
    shown = {name: truth[name] for name in ("time_s", *POSE)} | {
        "speed_mps": np.hypot(vx, vy),
        "sideslip_deg": np.degrees(sideslip(vx, vy)),
        "yaw_rate_degps": np.degrees(truth["yaw_rate_radps"]),
        "steering_deg": np.degrees(truth["steering_rad"]),
    }
    return shown | ({"battery_v": truth["battery_v"]} if "battery_v" in truth else {})


def _measured(run: Run, car: Car) -> dict[str, np.ndarray]:
    """The motion of a real run: by motion capture, or else by the car's encoder and gyroscope."""
    # It needs SciPy's filters, whose import takes longer than the page of a simulated drive.
    from countersteer.tuning.windows import read_measured

    measured, truth = read_measured(run, car), run.truth
    shown: dict[str, np.ndarray] = {}
    if truth is not None and len(truth):
        time = truth["time_s"]
        shown = {name: truth[name] for name in ("time_s", *POSE)}
        shown["heading_rad"] = np.unwrap(shown["heading_rad"])
    else:
        table = run.telemetry if run.telemetry is not None and len(run.telemetry) else run.commands
        time = table["time_s"]
        shown = {"time_s": time}
    if measured.vx is not None and measured.vy is not None and measured.yaw_rate is not None:
        vx, vy, rate = (s.at(time) for s in (measured.vx, measured.vy, measured.yaw_rate))
        shown["speed_mps"] = np.hypot(vx, vy)
        shown["sideslip_deg"] = np.degrees(np.where(np.isnan(vx), vx, sideslip(vx, vy)))
        shown["yaw_rate_degps"] = np.degrees(rate)
    else:
        if measured.encoder is not None:
            shown["speed_mps"] = measured.encoder.at(time)
        if measured.gyro is not None:
            shown["yaw_rate_degps"] = np.degrees(measured.gyro.at(time))
    told = run.telemetry if run.telemetry is not None else Table()
    if "battery_v" in told and np.any(known := np.isfinite(told["battery_v"])):
        shown["battery_v"] = np.interp(time, told["time_s"][known], told["battery_v"][known])
    return {name: np.where(np.abs(v) <= LARGEST, v, math.nan) for name, v in shown.items()}


def outline(car: Car) -> dict[str, Any]:
    """The size of a car, and the places of its wheels."""
    body, tires = car.body, planar.tires_by_wheel(car)
    return {
        "length_m": float(body.length),
        "width_m": float(body.width),
        "center_x_m": float(body.center),
        "wheels": [
            {
                "x_m": float(x),
                "y_m": float(y),
                "radius_m": float(tire.radius),
                "width_m": float(tire.width),
            }
            for x, y, tire in zip(*wheel_positions(body), tires, strict=True)
        ],
    }


def estimated(run: Run) -> dict[str, np.ndarray] | None:
    """What the driver took for its motion, with the ellipse of its place; None: not recorded.

    The ellipse is of `ELLIPSE` standard deviations. `ellipse_rad` is the angle of its longer axis
    in the world's axes. It has no size where the estimator knows no uncertainty.
    """
    table = run.estimate
    if table is None or not len(table) or run.about.get("estimate") == "truth":
        return None
    known = np.all(np.abs([table[name] for name in (*POSE, *VELOCITY)]) <= LARGEST, axis=0)
    if not np.any(known):
        return None
    table = Table({name: column[known] for name, column in table.items()})
    xx, xy, yy = (table[name] for name in COVARIANCE)
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    longer, shorter = (np.sqrt(np.maximum(middle + s * half, 0.0)) for s in (1, -1))
    return {name: table[name] for name in ("time_s", *POSE)} | {
        "speed_mps": np.hypot(table["vx_mps"], table["vy_mps"]),
        "sideslip_deg": np.degrees(sideslip(table["vx_mps"], table["vy_mps"])),
        "yaw_rate_degps": np.degrees(table["yaw_rate_radps"]),
        "longer_m": ELLIPSE * longer,
        "shorter_m": ELLIPSE * shorter,
        "ellipse_rad": np.arctan2(2 * xy, xx - yy) / 2,
    }


def events(run: Run) -> list[dict[str, Any]]:
    """Faults of sensors, lost commands and the released dead-man switch, each from and to (s)."""
    found = [
        _event("fault", f"{f['sensor']} {f['kind']}", f["start_s"], f["start_s"] + f["duration_s"])
        for f in run.about.get("faults", [])
    ]
    link, period = run.about.get("link", {}), run.about.get("rates", {}).get("control_s")
    if link.get("name", "onboard") != "onboard" and period:
        came = run.commands["time_s"]
        for i in np.nonzero(np.diff(came) > LATE * period)[0]:
            found.append(_event("lost", "command lost", came[i] + period, came[i + 1]))
    if run.telemetry is not None and "armed" in run.telemetry:
        from countersteer.runs.defects import released  # it imports SciPy as well

        found += [
            _event("released", "dead-man switch released", one.start, one.end)
            for one in released(run)
        ]
    return found


def _event(kind: str, label: str, begin: float, end: float) -> dict[str, Any]:
    # JSON has no infinity: a fault that lasts is one to the end of any run.
    return {"kind": kind, "label": label, "from_s": float(begin), "to_s": min(float(end), 1e9)}


def planned(run: Run) -> list[dict[str, Any]]:
    """What the planner looked at: its time (s), and paths with costs, of which 0 is the plan."""
    table, found = run.rollouts, []
    if table is None or not len(table):
        return []
    known = np.all(np.abs([table[name] for name in ROLLOUTS]) <= LARGEST, axis=0)
    time, which, cost, x, y = (table[name][known] for name in ROLLOUTS)
    for begin, end in _changes(time):
        paths = [
            {"cost": float(cost[begin + a]), "x_m": x[begin + a : begin + b],
             "y_m": y[begin + a : begin + b]}
            for a, b in _changes(which[begin:end])
        ]  # fmt: skip
        found.append({"time_s": float(time[begin]), "paths": paths})
    return found


def _changes(values: np.ndarray) -> list[tuple[int, int]]:
    """First and last index (past the end) of each stretch of equal values."""
    cuts = [0, *(np.nonzero(np.diff(values))[0] + 1).tolist(), len(values)]
    return list(itertools.pairwise(cuts)) if len(values) else []


def warm_up(car: Car, floor: Floor | None = None) -> None:
    """Compile the program for a view of such a run, so that it is ready when the drive ends."""
    still = planar.initial_state(car, 1e-3, slots=1).motion
    motion = jax.tree.map(lambda leaf: np.zeros(1) + leaf, still)
    wheel_views(car, motion, floor, slice(None))


def echoes(run: Run, car: Car) -> list[dict[str, Any]]:
    """The reports of each sonar that reported, with their times (s). No echo is infinite."""
    found = []
    table = run.telemetry if run.telemetry is not None else Table()
    for mount in mounts(car):
        heard = table.get(f"sonar_{mount['name']}_m", np.zeros(0))
        told = ~np.isnan(heard)
        if not np.any(told):
            continue
        found.append(mount | {"time_s": table["time_s"][told], "distance_m": heard[told]})
    return found


def mounts(car: Car) -> list[dict[str, Any]]:
    """Name, place and cone of each sonar of a car."""
    sonar = car.sensors.sonar
    return [
        {
            "name": name,
            "x_m": float(mount.x),
            "y_m": float(mount.y),
            "angle_deg": math.degrees(mount.angle),
            "half_angle_deg": math.degrees(sonar.half_angle),
        }
        for name, mount in zip(sonar.mount_names, sonar.mounts, strict=True)
    ]


def motions(run: Run, car: Car) -> Motion:
    """The motion at each row of `truth.csv`. The loads follow the acceleration between rows.

    The acceleration is limited to what friction allows. A hit on a wall exceeds that, but it is no
    force of a tyre. The planar world leaves it out too.
    """
    table = run.truth
    assert table is not None
    time, vx, vy, rate = (table[n] for n in ("time_s", "vx_mps", "vy_mps", "yaw_rate_radps"))
    reach = (
        1.2
        * GRAVITY
        * max(float(car.tires.front.peak_friction), float(car.tires.rear.peak_friction))
    )
    h = np.maximum(np.diff(time), 1e-9)
    loads = []
    for change, turning in ((np.diff(vx), -rate * vy), (np.diff(vy), rate * vx)):
        felt = change / h + (turning[1:] + turning[:-1]) / 2
        felt = np.clip(np.nan_to_num(felt), -reach, reach)
        load = [0.0]
        for push, part in zip(felt, -np.expm1(-h / float(car.body.load_lag)), strict=True):
            load.append(load[-1] + part * (push - load[-1]))
        loads.append(np.array(load))
    zero = np.zeros(len(time))
    wheels = Wheels(*(table[f"wheel_{wheel}_radps"] for wheel in WHEELS))
    places = (table[name] for name in ("x_m", "y_m", "heading_rad"))
    steering = table["steering_rad"]
    parts: Any = (*places, vx, vy, rate, wheels, steering, zero, *loads, zero + 1.0)
    return Motion(*parts)


def wheel_views(
    car: Car, motion: Motion, floor: Floor | None, every: slice
) -> list[dict[str, np.ndarray]]:
    """The forces at each wheel, in the wheel's own axes."""
    thin = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32)[every], motion)
    count, blocks = len(thin.x), []
    with jax.enable_x64(False):
        single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), (car, floor))
        for first in range(0, count, ROWS):
            rows = np.minimum(np.arange(first, first + ROWS), count - 1)
            blocks.append(_forces(*single, jax.tree.map(lambda leaf, r=rows: leaf[r], thin)))
    found = jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)
    names = {
        "force_x_n": "force_x",
        "force_y_n": "force_y",
        "limit_n": "limit",
        "slip_mps": "slip",
        "angle_rad": "angle",
    }
    return [
        {name: getattr(forces, field).astype(float) for name, field in names.items()}
        for forces in found
    ]


@kept()
def _forces(car: Car, floor: Floor | None, motion: Motion) -> Array:
    forces = jax.vmap(lambda one: planar.forces(car, one, floor))(motion)
    return jax.tree.map(lambda leaf: leaf + jnp.zeros_like(motion.x), forces)
