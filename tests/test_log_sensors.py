"""A log's own sensors: what was put into a simulated log is recovered from it."""

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.cli import main
from countersteer.errors import InputError
from countersteer.runs.declared import moved_to_centre, telemetry_in_si
from countersteer.runs.defects import refuse
from countersteer.runs.files import (
    COMMANDS,
    Table,
    TableWriter,
    command_rows,
    merged_rows,
    read_table,
    write_table,
)
from countersteer.runs.run import Run, read_run
from countersteer.tuning import log_sensors, windows
from countersteer.tuning.charge import from_voltmeter
from countersteer.tuning.log_sensors import common_step, resolve
from countersteer.world import battery, motor, planar

X, Y, OFFSET = -0.043, 0.016, 2.3  # m, m, degrees: where the marker is
ENCODER_LAG, GYRO_LAG, OVER, STEP = 0.085, 0.037, 0.1, 0.0413
CAR, DT = "jetracer", 0.002


class Driven(NamedTuple):
    """A simulated drive; a value for each tick of `DT`."""

    commands: Table
    time: np.ndarray
    pose: np.ndarray  # (3, ticks)
    motion: dict[str, dict[str, np.ndarray]]  # vx, vy, yaw rate, wheel speed, by the encoder's place


@pytest.fixture(scope="module")
def driven() -> Driven:
    """Half a minute of slow and faster turns to both hands, with straights between."""
    car = load_car(CAR)
    time = np.arange(0, 30, 0.05)
    block = np.floor(time).astype(int)
    rng = np.random.default_rng(4)
    throttle = np.where(time < 0.3, 0, np.where(rng.random(30) < 0.3, 0, 0.3)[block])
    steering = np.radians(np.repeat(np.tile([0, 18, -15, 0, -22], 3), 2)[block])
    commands = Table(time_s=time, throttle=throttle, steering=steering)
    ticks = round(29.9 / DT)
    with jax.enable_x64(True):
        state = jax.tree.map(lambda leaf: np.asarray(leaf)[None], planar.initial_state(car, DT))
        motion = {
            on: {
                name: values[0]
                for name, values in windows.simulate(
                    car, state, commands, np.array([0]), ticks, DT, windows.shares(on, car)
                ).items()
            }
            for on in ("shaft", "front-left")
        }
    seen = motion["shaft"]
    heading = np.cumsum(seen["yaw_rate_radps"]) * DT
    cosine, sine = np.cos(heading), np.sin(heading)
    x = np.cumsum(cosine * seen["vx_mps"] - sine * seen["vy_mps"]) * DT
    y = np.cumsum(sine * seen["vx_mps"] + cosine * seen["vy_mps"]) * DT
    return Driven(commands, DT * np.arange(ticks + 1), np.stack([x, y, heading]), motion)


def as_logged(driven: Driven, on: str = "shaft", **about: object) -> Run:
    """The drive as a real car logs it: captured at a marker, by sensors that are late."""
    rng = np.random.default_rng(2)
    seen = driven.motion[on]

    def at(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.interp(time, driven.time, values)

    frames = np.arange(0.1, driven.time[-1] - 0.1, 0.01)
    x, y, heading = (at(frames, line) for line in driven.pose)
    cosine, sine = np.cos(heading), np.sin(heading)
    noise = 3e-4 * rng.normal(size=(3, len(frames)))
    truth = Table(
        time_s=frames,
        x_m=x + cosine * X - sine * Y + noise[0],
        y_m=y + sine * X + cosine * Y + noise[1],
        heading_rad=heading + math.radians(OFFSET) + 3 * noise[2],
    )
    board = np.arange(0.2, frames[-1], 0.05)
    spans = (board - ENCODER_LAG)[:, None] + OVER * (np.arange(21) / 20 - 0.5)
    wheel = np.mean(at(spans, seen["wheel_speed_mps"]), axis=1)
    gyro = at(board - GYRO_LAG, seen["yaw_rate_radps"]) + 0.02 * rng.normal(size=len(board))
    telemetry = Table(
        time_s=board, wheel_speed_mps=STEP * np.rint(wheel / STEP), gyro_radps=gyro
    )
    return Run(Path("log"), {"sensors": {"encoder": {"over_s": OVER}}} | about, driven.commands,
               telemetry, truth)


def numbers(run: Run) -> dict[tuple[str, str], log_sensors.Estimate]:
    found = resolve(run, load_car(CAR), DT).estimates
    return {(one.kind.sensor, one.kind.key): one for one in found}


def test_what_was_put_in_is_recovered(driven):
    found = numbers(as_logged(driven))
    for sensor, key, true, within in (
        ("capture", "x_m", X, 0.005),
        ("capture", "y_m", Y, 0.005),
        ("capture", "yaw_offset_deg", OFFSET, 0.5),
        ("encoder", "lag_s", ENCODER_LAG, 0.005),
        ("gyroscope", "lag_s", GYRO_LAG, 0.005),
        ("encoder", "step_mps", STEP, 1e-9),
    ):
        one = found[sensor, key]
        assert abs(one.value - true) < within, one
        assert one.sure
