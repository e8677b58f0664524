"""A log's own sensors: what was put into a simulated log is recovered from it."""

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.errors import InputError
from countersteer.runs.declared import moved_to_centre, telemetry_in_si, truth_at_centre
from countersteer.runs.defects import find_defects, refuse
from countersteer.runs.files import Table, merged_rows, read_table, write_table
from countersteer.runs.run import Run
from countersteer.tuning import log_sensors, windows
from countersteer.tuning.charge import from_voltmeter
from countersteer.tuning.compare import compare
from countersteer.tuning.log_sensors import common_step, resolve
from countersteer.world import motor, planar

X, Y, OFFSET = -0.043, 0.016, 2.3  # m, m, degrees: where the marker is
ENCODER_LAG, GYRO_LAG, OVER, STEP = 0.085, 0.037, 0.1, 0.0413
CAR, DT = "jetracer", 0.002


class Driven(NamedTuple):
    """A simulated drive; a value for each tick of `DT`."""

    commands: Table
    time: np.ndarray
    pose: np.ndarray  # (3, ticks)
    motion: dict[
        str, dict[str, np.ndarray]
    ]  # vx, vy, yaw rate, wheel speed, by the encoder's place


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
    telemetry = Table(time_s=board, wheel_speed_mps=STEP * np.rint(wheel / STEP), gyro_radps=gyro)
    return Run(
        Path("log"),
        {"sensors": {"encoder": {"over_s": OVER}}} | about,
        driven.commands,
        telemetry,
        truth,
    )


def numbers(run: Run) -> dict[tuple[str, str], log_sensors.Estimate]:
    found = resolve(run, load_car(CAR), DT).estimates
    return {(one.kind.sensor, one.kind.key): one for one in found}


def test_what_was_put_in_is_recovered(driven):
    """The lags to what half a minute at 20 Hz carries: 5 ms; the point to 5 mm, the yaw to 0.5°."""
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
    assert found["capture", "x_m"].contradicts
    assert found["encoder", "lag_s"].used == "estimated"


def test_a_declared_point_is_taken_off_and_found_again(driven):
    logged = as_logged(driven)
    declared = {"encoder": {"over_s": OVER, "lag_s": ENCODER_LAG, "step_mps": STEP},
                "gyroscope": {"lag_s": GYRO_LAG},
                "capture": {"x_m": X, "y_m": Y, "yaw_offset_deg": OFFSET}}  # fmt: skip
    about = {"sensors": declared}
    run = dataclasses.replace(logged, about=about, truth=truth_at_centre(about, logged.truth))
    true = np.interp(run.truth["time_s"], driven.time, driven.pose[0])
    assert np.max(np.abs(run.truth["x_m"] - true)) < 3e-3
    found = resolve(run, load_car(CAR), DT)
    one = {(e.kind.sensor, e.kind.key): e for e in found.estimates}["capture", "x_m"]
    assert abs(one.value - X) < 0.005
    assert one.declared == X
    assert found.warnings == []
    assert found.run.about["sensors"]["encoder"]["lag_s"] == ENCODER_LAG


def test_an_encoder_on_another_wheel_than_declared_is_named(driven):
    logged = as_logged(driven, "front-left")
    capture = {"x_m": X, "y_m": Y, "yaw_offset_deg": OFFSET}

    def warnings(on: str) -> list[str]:
        encoder = {"over_s": OVER, "lag_s": ENCODER_LAG, "step_mps": STEP, "on": on}
        gyro = {"lag_s": GYRO_LAG}
        about = {"sensors": {"encoder": encoder, "gyroscope": gyro, "capture": capture}}
        run = dataclasses.replace(logged, about=about, truth=truth_at_centre(about, logged.truth))
        return resolve(run, load_car(CAR), DT).warnings

    assert warnings("front-left") == []
    # In these turns the rear left wheel is as fast.
    assert any("front-left or rear-left" in line for line in warnings("shaft"))


def test_velocities_move_with_the_point():
    table = Table(
        time_s=np.zeros(1), x_m=np.zeros(1), y_m=np.zeros(1), heading_rad=np.zeros(1),
        vx_mps=np.ones(1), vy_mps=np.zeros(1), yaw_rate_radps=np.full(1, 2.0),
    )  # fmt: skip
    moved = moved_to_centre(table, 0.1, 0.2, 0.0)
    assert moved["vx_mps"][0] == pytest.approx(1 + 2 * 0.2)
    assert moved["vy_mps"][0] == pytest.approx(-2 * 0.1)
    turned = moved_to_centre(table, 0.0, 0.0, 0.1)
    assert np.arctan2(turned["vy_mps"], turned["vx_mps"])[0] == pytest.approx(0.1)


@pytest.mark.parametrize("decimals", [2, 4, 12])
@pytest.mark.parametrize("step", [0.0516, 0.0413, 0.33])
def test_a_step_is_found_through_rounded_decimals(step, decimals):
    counts = np.random.default_rng(1).integers(0, 40, 200)
    found, deviation = common_step(np.round(step * counts, decimals))
    assert found == pytest.approx(step, abs=max(4 * deviation, 1e-9))
    assert found == pytest.approx(step, rel=0.003)


def test_readings_without_a_step_have_none():
    found, _ = common_step(np.random.default_rng(1).uniform(0, 2, 300))
    assert math.isnan(found) or found < 1e-5


def test_declared_units_are_converted():
    table = Table(time_s=np.zeros(1), gyro_radps=np.array([180.0]), battery_v=np.array([3900.0]))
    about = {"sensors": {"gyroscope": {"unit": "deg/s"}, "voltmeter": {"unit": "mV", "cells": 2}}}
    found = telemetry_in_si(about, table)
    assert found["gyro_radps"][0] == pytest.approx(math.pi)
    assert found["battery_v"][0] == pytest.approx(7.8)
    assert telemetry_in_si({}, table)["gyro_radps"][0] == 180.0


# -------------------------------------------------------------------------------------------------
# The voltmeter
# -------------------------------------------------------------------------------------------------


def with_voltmeter(driven: Driven, charge: float, scale: float = 1.0, **about: object) -> Run:
    """The log with a voltmeter at 10 Hz that reads 0.05 s late, with a noise of 0.02 V."""
    run, car = as_logged(driven, **about), load_car(CAR)
    time = np.arange(1, 29, 0.1)
    shaft = np.interp(time - 0.05, driven.time, driven.motion["shaft"]["wheel_speed_mps"])
    ticks = np.arange(len(driven.time))
    commands = windows.asked(run.commands, ticks, DT)
    duty = windows.actuators(car, windows.read_measured(run, car), commands, DT)[1]
    duty = np.interp(time - 0.05, driven.time, duty)
    radius = float(car.tires.rear.radius)
    volts = motor.drive(car.motor, car.drivetrain, car.battery, duty, charge, shaft / radius)
    noise = 0.02 * np.random.default_rng(3).normal(size=len(time))
    telemetry = merged_rows(
        Table(
            {
                name: np.concatenate([values, at])[order]
                for name, values, at in (
                    *((n, v, np.full(len(time), math.nan)) for n, v in run.telemetry.items()
                      if n != "time_s"),
                    ("time_s", run.telemetry["time_s"], time),
                    ("battery_v", np.full(len(run.telemetry), math.nan),
                     scale * (np.asarray(volts.battery_voltage) + noise)),
                )
                for order in [np.argsort(np.concatenate([run.telemetry["time_s"], time]),
                                         kind="stable")]
            }
        )
    )  # fmt: skip
    return dataclasses.replace(run, telemetry=telemetry)


def test_the_charge_is_the_voltmeter_s(driven):
    run = with_voltmeter(driven, 0.4)
    run.about["sensors"]["voltmeter"] = {"lag_s": 0.05}
    found = resolve(run, load_car(CAR), DT)
    assert found.charge_from == "voltmeter"
    assert found.run.about["battery_charge"] == pytest.approx(0.4, abs=0.05)
    assert found.run.about["battery_charge_end"] < found.run.about["battery_charge"]
    stated = dataclasses.replace(run, about=run.about | {"battery_charge": 0.9})
    found = resolve(stated, load_car(CAR), DT)
    assert found.run.about["battery_charge"] == 0.9
    assert any("battery_v tells 0.4" in line for line in found.warnings)


@pytest.mark.parametrize(
    ("scale", "words"), [(1000.0, "millivolts"), (1 / 3, "cells = 3"), (1.4, "more than a full")]
)
def test_a_voltmeter_that_cannot_be_of_this_pack_is_not_used(driven, scale, words):
    run = with_voltmeter(driven, 0.4, scale)
    car = load_car(CAR)
    charge, why = from_voltmeter(run, car, windows.read_measured(run, car), DT)
    assert charge is None
    assert words in why


# -------------------------------------------------------------------------------------------------
# Logs that are refused, or read right
# -------------------------------------------------------------------------------------------------


def own_log(**changes: object) -> Run:
    """A log of a car's own: at rest for half of it, then a slow curve, encoder and gyroscope."""
    time = np.arange(0, 20, 0.05)
    speed = np.where(time < 10, 0.0, 0.8)
    steering = np.where(time < 12, 0.0, np.where(time < 16, 0.14, -0.2))
    rate = speed * np.tan(np.interp(time - 0.1, time, steering)) / 0.3
    noise = 0.01 * np.random.default_rng(0).normal(size=len(time))
    values = {"steering": steering, "wheel_speed_mps": speed, "gyro_radps": rate + noise} | changes
    commands = Table(time_s=time, throttle=0.2 * (speed > 0), steering=values["steering"])
    names = [n for n in ("wheel_speed_mps", "gyro_radps") if values[n] is not None]
    telemetry = Table({"time_s": time} | {name: values[name] for name in names})
    return Run(Path("log"), {}, commands, telemetry, None)


def test_an_own_log_in_order_is_not_refused():
    refuse(own_log())
    slides = own_log()
    slides.telemetry["gyro_radps"] *= -2.5  # turned back hard in a drift
    slides.telemetry["wheel_speed_mps"] *= 3
    refuse(slides)
    backs = own_log()  # an encoder has no sign
    backs.telemetry["gyro_radps"] *= -1
    backs.commands["throttle"] *= -1
    refuse(backs)


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("gyro_radps", 180 / math.pi, "in degrees"),
        ("gyro_radps", -1.0, "opposite signs"),
        ("steering", math.pi / 180, "in radians"),
    ],
)
def test_units_and_signs_are_told_without_motion_capture(column, factor, words):
    good = own_log()
    table = good.commands if column == "steering" else good.telemetry
    with pytest.raises(InputError, match=words):
        refuse(own_log(**{column: factor * table[column]}))
    with pytest.raises(InputError, match=words):
        compare(own_log(**{column: factor * table[column]}), load_car(CAR))


def test_a_log_without_a_speed_signal_is_told_so():
    with pytest.raises(InputError, match=r"no speed signal: wheel_speed_mps is missing"):
        compare(own_log(wheel_speed_mps=None), load_car(CAR))
    still = own_log(wheel_speed_mps=np.full(400, 0.1))
    still.commands["throttle"][:] = 0
    with pytest.raises(InputError, match=r"stays below 0.2 m/s"):
        compare(still, load_car(CAR))


def test_two_clocks_are_refused():
    run = own_log()
    run.telemetry["time_s"] = run.telemetry["time_s"] + 100
    with pytest.raises(InputError, match="one clock"):
        refuse(run)


def test_rows_of_one_time_are_merged_where_they_agree():
    nothing = math.nan
    table = Table(
        time_s=np.array([0.0, 0.0, 0.1, 0.1, 0.2, 0.2]),
        wheel_speed_mps=np.array([1.0, nothing, 2.0, 2.0, 3.0, 4.0]),
        gyro_radps=np.array([nothing, 5.0, nothing, nothing, nothing, 6.0]),
    )
    found = merged_rows(table)
    assert found["time_s"].tolist() == [0.0, 0.1, 0.2, 0.2]
    assert found["wheel_speed_mps"].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert found["gyro_radps"][0] == 5.0


def test_a_coarse_clock_is_refused():
    run = own_log()
    run.telemetry["time_s"] = np.round(run.telemetry["time_s"], 1)
    with pytest.raises(InputError, match="more decimals"):
        refuse(run)


@pytest.mark.parametrize(
    ("factor", "begin", "words"),
    [
        (1.0, 1.7e9, "Unix time: .countersteer import run"),
        (1e3, 1.7e9, "Unix time, in milliseconds"),
        (1e9, 1.7e9, "Unix time, in nanoseconds"),
        (1e6, 10.0, "in microseconds"),
        (1e9, 0.0, "in nanoseconds"),
    ],
)
def test_a_clock_in_another_unit_is_named(factor, begin, words, tmp_path):
    time = factor * (begin + np.arange(0, 5, 0.05))
    write_table(tmp_path / "telemetry.csv", {"time_s": time})
    with pytest.raises(InputError, match=words):
        read_table(tmp_path / "telemetry.csv", ())


def test_noise_of_poses_is_no_collision():
    """A particle filter at 20 Hz: noise of 12 mm that grows to 40 mm in curves, with long tails."""
    rng = np.random.default_rng(5)
    time = np.arange(0, 60, 0.05)
    rate = 1.5 * np.sin(0.6 * time)
    heading = np.cumsum(rate) * 0.05
    noise = (0.012 + 0.02 * (np.abs(rate) > 1)) * rng.standard_t(4, size=(2, len(time)))
    x, y = (np.cumsum(2.0 * f(heading)) * 0.05 for f in (np.cos, np.sin))
    truth = Table(time_s=time, x_m=x + noise[0], y_m=y + noise[1], heading_rad=heading)
    commands = Table(time_s=time, throttle=np.full(len(time), 0.2), steering=0 * time)
    run = Run(Path("log"), {}, commands, None, truth)
    hits = [fault for fault in find_defects(run) if "collision" in fault.what]
    assert len(hits) <= 1  # of a minute
    assert any("noise" in line for line in log_sensors.noise_warning(run))
    thrown = Table(truth | {"y_m": truth["y_m"] + 6.0 * np.maximum(time - 30.0, 0)})
    found = find_defects(dataclasses.replace(run, truth=thrown))
    assert any("collision" in one.what and abs(one.start - 30) < 0.5 for one in found)
