"""The data for a run's report and picture, from the run's own files."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import GRAVITY, Car, wheel_positions
from countersteer.errors import InputError
from countersteer.kept_programs import kept
from countersteer.runs.files import Table, drive_column
from countersteer.runs.run import Run, drawn_car
from countersteer.signals import Array, Motion, Wheels
from countersteer.task.turns import sideslip
from countersteer.world import planar
from countersteer.world.floor import Floor, floor_of_run

PERIOD = 0.01  # s between two samples, at least
LARGEST = 1e6  # of a number in truth.csv that is drawn
ROWS = 1024  # in each computation of forces; a fixed number, so that there is one program
UNJUDGED: dict[str, Any] = {"completed": False, "wall_contacts": None, "turns": []}
WHEELS = ("fl", "fr", "rl", "rr")
MOTION = ("vx_mps", "vy_mps", "yaw_rate_radps", "steering_rad")
ASKED = {"throttle": "throttle", "speed": "commanded_speed_mps"}  # key by column of commands
COLUMNS = (*MOTION, *(f"wheel_{wheel}_radps" for wheel in WHEELS))


def view_of(run: Run) -> dict[str, Any]:
    """The view of a run: plain lists, with units in the names.

    Rows that do not say all of the motion are left out. Raises `InputError` if the run has no
    `truth.csv`, or one without a simulated car's columns.
    """
    run = dataclasses.replace(run, truth=known_rows(run))
    about, car, truth = run.about, drawn_car(run.about), run.truth
    assert truth is not None
    time = truth["time_s"]
    period = float(np.median(np.diff(time))) if len(time) > 1 else PERIOD
    every = slice(None, None, max(1, round(PERIOD / max(period, 1e-6))))
    command = np.maximum(np.searchsorted(run.commands["time_s"], time + 1e-9, "right") - 1, 0)
    drive = drive_column(run.commands)
    vx, vy, steering = truth["vx_mps"], truth["vy_mps"], truth["steering_rad"]
    shown = {
        "speed_mps": np.hypot(vx, vy),
        "sideslip_deg": np.degrees(sideslip(vx, vy)),
        "yaw_rate_degps": np.degrees(truth["yaw_rate_radps"]),
        "steering_deg": np.degrees(steering),
        "steering_command_deg": np.degrees(run.commands["steering"][command]),
        ASKED[drive]: run.commands[drive][command],
    } | {name: truth[name] for name in ("time_s", "x_m", "y_m", "heading_rad")}
    place = about.get("course", {}).get("name", "open floor")
    body, tires = car.body, planar.tires_by_wheel(car)
    return {
        "title": f"{place}, {about.get('driver')}, {about.get('car_name')}, "
        f"seed {about.get('seed')}",
        "summary": UNJUDGED | {"outcome": run.outcome} | _unfinished(run, time) | run.summary,
        "walls_m": about.get("course", {}).get("walls_m", []),
        "car": {
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
        },
        "sonar": echoes(run, car) if place != "open floor" else [],
        "wheels": wheel_views(car, motions(run, car), floor_of_run(about), every),
    } | {name: values[every].tolist() for name, values in shown.items()}


def _unfinished(run: Run, time: np.ndarray) -> dict[str, str]:
    """The verdict on a drive that was recorded up to a time (s) and has no summary."""
    verdict = f"{run.outcome}: the record ends at {time[-1]:.2f} s"
    return {"verdict": verdict} if run.outcome == "not finished" else {}


def known_rows(run: Run) -> Table:
    """The rows of `truth.csv` whose numbers can all be drawn.

    Raises `InputError` without one, or without a column of a simulated run.
    """
    if run.truth is None or len(run.truth) == 0:
        raise InputError(f"{run.path}: has no truth.csv to draw")
    for name in COLUMNS:
        if name not in run.truth:
            raise InputError(f"{run.path}/truth.csv: has no {name}: this page is of simulated runs")
    drawn = [run.truth[name] for name in ("time_s", "x_m", "y_m", "heading_rad", *COLUMNS)]
    known = np.all(np.abs(drawn) <= LARGEST, axis=0)  # false for NaN too
    if not np.any(known):
        raise InputError(f"{run.path}/truth.csv: holds no row of numbers that can be drawn")
    return Table({name: column[known] for name, column in run.truth.items()})


def warm_up(car: Car, floor: Floor | None = None) -> None:
    """Compile the program for a view of such a run, so that it is ready when the drive ends."""
    still = planar.initial_state(car, 1e-3, slots=1).motion
    motion = jax.tree.map(lambda leaf: np.zeros(1) + leaf, still)
    wheel_views(car, motion, floor, slice(None))


def echoes(run: Run, car: Car) -> list[dict[str, Any]]:
    """The reports of each sonar, with their times (s)."""
    sonar, found = car.sensors.sonar, []
    for name, mount in zip(sonar.mount_names, sonar.mounts, strict=True):
        table: Any = run.telemetry or {}
        heard = table.get(f"sonar_{name}_m", np.zeros(0))
        told = ~np.isnan(heard)
        found.append(
            {
                "name": name,
                "x_m": float(mount.x),
                "y_m": float(mount.y),
                "angle_deg": math.degrees(mount.angle),
                "half_angle_deg": math.degrees(sonar.half_angle),
                "time_s": table["time_s"][told].tolist() if len(heard) else [],
                "distance_m": [d if math.isfinite(d) else None for d in heard[told].tolist()],
            }
        )
    return found


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
) -> list[dict[str, list[float]]]:
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
        {name: getattr(forces, field).astype(float).tolist() for name, field in names.items()}
        for forces in found
    ]


@kept()
def _forces(car: Car, floor: Floor | None, motion: Motion) -> Array:
    forces = jax.vmap(lambda one: planar.forces(car, one, floor))(motion)
    return jax.tree.map(lambda leaf: leaf + jnp.zeros_like(motion.x), forces)
