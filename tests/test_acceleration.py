"""The acceleration of a car is found again from its runs, by each reader of speed."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from conftest import step_run
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.errors import InputError
from countersteer.runs.files import Table
from countersteer.runs.importers.dart import import_dart
from countersteer.runs.run import Run, read_run
from countersteer.tuning.acceleration import (
    NEVER_MOVES,
    PARAMETER,
    Acceleration,
    fit_acceleration,
)
from countersteer.viewing.acceleration import draw_acceleration

WALL = 'name = "wall"\nwalls_m = [[[4.0, -1.5], [4.0, 1.5]]]\n[start]\nx_m = 0.6\ny_m = 0.0\n'
LEVELS = (0.03, 0.25, 0.3, 0.36, 0.42, 0.5, 0.58, 0.66, 0.8, 1.0)  # the first moves no car
SETTINGS = [
    "sensors.line_detector.lines=across-x",
    "sensors.line_detector.spacing_m=0.05",
]
TRUE = 1.5  # ohm, of rx7
OFF = (0.6, 1.4)  # factors that the fit begins with
SOURCES = ("encoder", "sonar", "lines")

STEPS = Path(__file__).parents[2] / "shared/data/dart/throttle_steps_rubber_floor"
needs_data = pytest.mark.skipif(not STEPS.is_dir(), reason="the DART logs are not here")


def resistance(factor: float) -> str:
    return f"motor.resistance_ohm={TRUE * factor}"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Ten steps of a second, then none, towards a wall, over lines on the floor."""
    folder = tmp_path_factory.mktemp("steps")
    (folder / "wall.toml").write_text(WALL)
    course, car = load_course(str(folder / "wall.toml")), load_car("rx7", SETTINGS)
    found = []
    for seed, level in enumerate(LEVELS):
        found.append(step_run(folder / f"{level}", course, car, level, 1.0, 1.3, seed=seed))
    return found


def said(run: Run, **columns: np.ndarray) -> Run:
    """The run with other readings, and nothing beside them that could tell."""
    table = Table(dict(run.telemetry) | columns)
    return dataclasses.replace(run, telemetry=table, truth=None)


def _until(table: Table, end: float) -> Table:
    return Table({name: column[table["time_s"] <= end] for name, column in table.items()})


@pytest.mark.parametrize("factor", OFF)
@pytest.mark.parametrize("source", SOURCES)
def test_the_resistance_is_found_again(runs, source, factor):
    found = fit_acceleration(runs, load_car("rx7", [resistance(factor)]), source)
    assert found.parameter == PARAMETER
    assert found.before == pytest.approx(TRUE * factor)
    assert found.converged
    assert not found.at_bound
    assert found.iterations <= 12
    assert abs(found.after - TRUE) < 3 * found.deviation
    assert found.after == pytest.approx(TRUE, rel=0.05)
    assert found.deviation < 0.05 * TRUE
    assert float(found.car.motor.resistance) == found.after
    assert found.rms_after < found.rms_before
    assert len(found.series) == len(LEVELS) - 1
    assert [one.level for one in found.series] == sorted(one.level for one in found.series)


@pytest.mark.parametrize("source", SOURCES)
def test_a_level_that_moves_no_car_is_named(runs, source):
    found = fit_acceleration(runs, load_car("rx7"), source)
    assert [(one.level, one.reason) for one in found.unused] == [(0.03, NEVER_MOVES)]


def test_both_starts_end_at_one_place(runs):
    ends = [fit_acceleration(runs, load_car("rx7", [resistance(f)])).after for f in OFF]
    assert ends[0] == pytest.approx(ends[1], rel=3e-3)


def test_the_error_is_that_of_the_series(runs):
    found = fit_acceleration(runs, load_car("rx7", [resistance(0.6)]))
    for before, told in (("before", found.rms_before), ("after", found.rms_after)):
        off = np.concatenate([one.measured - getattr(one, before) for one in found.series])
        assert told == pytest.approx(math.sqrt(np.mean(off**2)))


def test_an_encoder_that_is_stuck_at_nothing_is_named(runs):
    dead = said(runs[5], wheel_speed_mps=0.0 * runs[5].telemetry["wheel_speed_mps"])
    found = fit_acceleration([*runs[1:5], dead], load_car("rx7"))
    assert len(found.series) == 4
    (unused,) = found.unused
    assert unused.level == LEVELS[5]
    assert "no motion, though the car moves at 0.25: stuck?" in unused.reason


def test_a_stretch_in_which_the_encoder_is_stuck_is_left_out_by_name(runs):
    """Motion capture beside it tells that it is."""
    time, speed = runs[9].telemetry["time_s"], runs[9].telemetry["wheel_speed_mps"].copy()
    speed[np.isfinite(speed) & (time > 0.2)] = 0.0
    stuck = said(runs[9], wheel_speed_mps=speed)
    stuck = dataclasses.replace(stuck, truth=runs[9].truth)
    clean = fit_acceleration(runs[1:9], load_car("rx7", [resistance(1.4)]))
    found = fit_acceleration([*runs[1:9], stuck], load_car("rx7", [resistance(1.4)]))
    (line,) = found.masked
    assert str(stuck.path) in line
    assert "the encoder stays at 0.00 m/s under drive, slower than the car: stuck: left out" in line
    assert found.series[-1].time[-1] < 0.2
    assert found.after == pytest.approx(clean.after, rel=0.02)


def test_a_run_that_contradicts_the_others_is_named(runs):
    """Nothing beside a stuck encoder tells that it is, but the other runs do."""
    time, speed, counts = (
        runs[8].telemetry[name].copy() for name in ("time_s", "wheel_speed_mps", "encoder_counts")
    )
    there = np.flatnonzero(np.isfinite(speed) & (time > 0.1))
    speed[there], counts[there] = speed[there[0]], math.nan
    stuck = said(runs[8], wheel_speed_mps=speed, encoder_counts=counts)
    # The log ends with the throttle on: afterwards, an encoder that still turned would tell.
    stuck = dataclasses.replace(stuck, telemetry=_until(stuck.telemetry, 0.99))
    others = [*runs[1:8], runs[9]]
    clean = fit_acceleration(others, load_car("rx7", [resistance(1.4)]))
    found = fit_acceleration([*others, stuck], load_car("rx7", [resistance(1.4)]))
    (unused,) = found.unused
    assert unused.level == LEVELS[8]
    assert "off the car that the other runs agree on" in unused.reason
    assert found.after == clean.after


def test_a_few_false_readings_hardly_count(runs):
    wild = runs[4].telemetry["wheel_speed_mps"].copy()
    there = np.flatnonzero(np.isfinite(wild))
    wild[there[5::7]] = 8.0
    plain = fit_acceleration(runs, load_car("rx7"))
    found = fit_acceleration([*runs[:4], said(runs[4], wheel_speed_mps=wild), *runs[5:]], plain.car)
    assert found.after == pytest.approx(plain.after, rel=0.02)


def test_a_dead_man_switch_that_opens_ends_the_step(runs):
    time = runs[5].telemetry["time_s"]
    opens = said(runs[5], armed=np.where(time < 0.6, 1.0, 0.0))
    found = fit_acceleration([opens], load_car("rx7"))
    assert 0.5 < found.series[0].time[-1] < 0.6
    early = said(runs[5], armed=np.where(time < 0.2, 1.0, 0.0))
    with pytest.raises(InputError, match="no throttle is held"):
        fit_acceleration([early], load_car("rx7"))


def test_what_is_no_step_from_rest_is_refused(runs):
    commands = runs[5].commands
    bent = Table(dict(commands) | {"steering": np.full(len(commands), 0.3)})
    with pytest.raises(InputError, match="not straight: steering goes to 17°"):
        fit_acceleration([dataclasses.replace(runs[5], commands=bent)], load_car("rx7"))
    idle = Table(dict(commands) | {"throttle": np.zeros(len(commands))})
    with pytest.raises(InputError, match="no throttle in it"):
        fit_acceleration([dataclasses.replace(runs[5], commands=idle)], load_car("rx7"))
    with pytest.raises(InputError, match="no reader of speed radar"):
        fit_acceleration(runs, load_car("rx7"), "radar")
    with pytest.raises(InputError, match="none of 1 runs tells"):
        fit_acceleration(runs[:1], load_car("rx7"))


def test_the_picture_shows_every_level(runs, tmp_path):
    found = fit_acceleration(runs, load_car("rx7", [resistance(1.4)]), "lines")
    draw_acceleration(found, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


@needs_data
def test_the_ten_real_steps_are_fitted(tmp_path):
    logs = sorted(STEPS.glob("*.csv"))
    runs = [read_run(Path(import_dart(log, tmp_path)["run"])) for log in logs]
    ends: list[Acceleration] = []
    own = float(load_car("jetracer").motor.resistance)
    for factor in (0.6, 1.0, 1.4):
        car = load_car("jetracer", [f"motor.resistance_ohm={factor * own}"])
        ends.append(fit_acceleration(runs, car))
    for found in ends:
        assert found.converged
        assert len(found.series) == 10
        assert not found.unused
        assert found.rms_after < 0.08
        assert found.after == pytest.approx(ends[1].after, rel=0.02)
        # What all logs together say of it, within what the days differ by.
        assert found.after == pytest.approx(own, rel=0.2)
    for off in (ends[0], ends[2]):
        assert off.rms_after < 0.55 * off.rms_before
