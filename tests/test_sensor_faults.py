"""Sensors that die, stick or spike for a while, and a driver that goes on regardless."""

import itertools
import json
import re
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

from conftest import STEADY, driven
from countersteer import cli
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.link.link import RADIO
from countersteer.pilot import Pilot
from countersteer.sensing import all_sensors, faults
from countersteer.sensing.faults import KINDS, SensorFault
from countersteer.signals import Reading, Readings, flat, pairs
from countersteer.simulator import Record, Simulator, scan

COURSE = load_course("box")
CAR = load_car(
    "rx7",
    (
        "sensors.lidar.beams=8",
        "sensors.position.reports=pose",
        "sensors.line_detector.lines=across-x",
    ),
)
CHANNELS = all_sensors.channels(CAR)
PARTS = tuple(dict.fromkeys(c.sensor for c in flat(CHANNELS) if "sonar" not in c.sensor))
SENSORS = ("sonar", "sonar_left", *PARTS)
EVERY = tuple(itertools.product(SENSORS, KINDS))
DT, LATE = 1e-3, 1e6
START, END = 0.8, 1.3  # s: the car drives straight on, at speed


def failing(*which: tuple[str, str]) -> tuple[SensorFault, ...]:
    """A fault of every sensor and kind, so that there is one program; only these come to pass."""
    return tuple(
        SensorFault(
            sensor=sensor,
            kind=kind,
            start=START if (sensor, kind) in which else LATE,
            duration=END - START,
        )
        for sensor, kind in EVERY
    )


def drive(which: tuple[SensorFault, ...], seconds: float = 2.0, **more: object) -> Record:
    driver = drift_turn(COURSE, load_car("rx7"), None, 1, *STEADY)
    return driven(COURSE, CAR, driver, seconds, faults=which, **more)


@pytest.fixture(scope="module")
def sound() -> Record:
    """A drive in which nothing fails."""
    return drive(failing())


def fields(readings: Readings, sensor: str) -> list[Reading]:
    return [r for c, r in pairs(CHANNELS, readings) if c.sensor.startswith(sensor)]


@pytest.mark.parametrize(("sensor", "kind"), EVERY)
def test_the_driver_never_commands_nan(sensor: str, kind: str, sound: Record) -> None:
    record = drive(failing((sensor, kind)))
    for command in record.command:
        assert np.all(np.isfinite(command))
    assert np.all(np.abs(record.command.throttle) <= 1)
    assert np.all(np.isfinite(record.motion.x))
    before = record.tick < round(START / DT)
    for a, b in zip(jax.tree.leaves(record), jax.tree.leaves(sound), strict=True):
        np.testing.assert_array_equal(a[before], b[before])
    window = (record.tick >= round(START / DT)) & (record.tick < round(END / DT))
    for own in fields(record.readings, sensor):
        taken = window & (own.tick == record.tick)
        held = own.value[np.argmax(window) - 1]
        if kind == "dead":
            assert not np.any(taken)
            assert np.all(own.value[window] == held)
        elif kind == "stuck":
            assert np.all(own.value[window] == held)
            assert taken.sum() >= 4
        else:
            spikes = np.unique(own.value[taken], axis=0)
            assert len(spikes) == taken.sum() >= 4, "each is drawn anew"
            assert np.all(np.isfinite(spikes))
    after = own.tick[record.tick == record.tick[-1]]
    assert after >= round(END / DT), "it is well again"
    others = [r for s in PARTS for r in fields(record.readings, s) if s != sensor]
    assert all(np.any(window & (r.tick == record.tick)) for r in others), "no other fails"


def test_faults_that_never_come_change_nothing(sound: Record) -> None:
    plain = drive(())
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(sound), strict=True):
        np.testing.assert_array_equal(a, b)


def test_without_faults_there_is_nothing_of_them_in_the_loop() -> None:
    simulator = Simulator.of(COURSE, CAR)
    loop = simulator.init()
    assert loop.faulty is None
    assert simulator.faults == ()
    assert loop.readings is loop.sensors.readings


def test_faults_come_before_the_radio() -> None:
    dead = (SensorFault(sensor="sonar", kind="dead", start=0.0, duration=np.inf),)
    pilot = Pilot.of(drift_turn(COURSE, CAR, None, 1, *STEADY), COURSE, CAR, link=RADIO)
    simulator = Simulator.of(COURSE, CAR, link=RADIO, faults=dead)
    with jax.enable_x64(True):
        loop, memory = simulator.init(), pilot.init(simulator.root)
        loop, memory, _ = scan(simulator, pilot, 500, loop, memory)
        _, told = pilot.observe(memory, simulator.readings(loop), loop.tick)
    assert all(np.isinf(heard.age) for heard in told.sonar)
    assert 0 < float(told.gyroscope.age) < 0.2


def test_spikes_are_another_draw_for_another_seed() -> None:
    key, tick = jax.random.key(0), np.int32(10)
    told = [
        float(faults.spike(CHANNELS.gyroscope, np.float64(0.0), jax.random.fold_in(key, tick + i)))
        for i in range(200)
    ]
    reach = float(CAR.sensors.gyroscope.reach)
    assert len(set(told)) == 200
    assert np.abs(told).max() <= reach
    assert np.std(told) == pytest.approx(reach / np.sqrt(3), rel=0.15)


def test_a_fault_is_given_on_the_command_line_and_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    status = cli.main(
        ["drive", "box", "--json", "--out", str(out), "--fault", "gyroscope stuck 2.0 0.5"]
    )
    assert status in (cli.DONE, cli.FAILED)
    json.loads(capsys.readouterr().out)
    about = tomllib.loads((out / "run.toml").read_text())
    assert about["faults"] == [
        {"sensor": "gyroscope", "kind": "stuck", "start_s": 2.0, "duration_s": 0.5}
    ]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("gyroscope stuck 2.0", "write SENSOR KIND START DURATION"),
        ("gyroscope stuck two 0.5", "write SENSOR KIND START DURATION"),
        ("gyroscope stuck nan 0.5", "START must be in"),
        ("gyroscope stuck 2.0 0", "DURATION above 0 s"),
        ("gyroscope asleep 2.0 0.5", "dead, stuck, spike, not asleep"),
        ("lidar dead 2.0 0.5", "sonar_right, encoder, gyroscope, .*not lidar"),
    ],
)
def test_a_wrong_fault_is_refused_in_one_line(
    text: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert cli.main(["drive", "box", "--out", str(out), "--fault", text]) == cli.WRONG_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(says, line)
    assert not out.exists()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sensor", ["sonar", "encoder", "gyroscope", "accelerometer"])
def test_the_car_keeps_off_the_walls(sensor: str, kind: str) -> None:
    """On a straight. That it knows no place from outside makes it the plain car."""
    record = drive(failing((sensor, kind)), 8.0, nominal=load_car("rx7"))
    assert not np.any(record.wall_contacts)
    assert record.status.turn[-1] >= 3
