"""The pilot stands alone: what it is told is all that it needs, and all that it can reach."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conftest import driven
from countersteer import cli
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.drift_turn import drift_turn
from countersteer.errors import InputError
from countersteer.estimation.registry import ESTIMATORS
from countersteer.pilot import Pilot, pilot_of_run
from countersteer.runs.files import read_commands
from countersteer.runs.run import read_run
from countersteer.runs.telemetry import readings_at
from countersteer.sensing.all_sensors import channels
from countersteer.signals import Command, Motion
from countersteer.simulator import Simulator, scan
from countersteer.world.state import State

COURSE, CAR = load_course("box"), load_car("rx7")
EXAMPLES = Path(__file__).parents[1] / "examples"
LIDAR = (
    "sensors.lidar.beams=8",
    "sensors.lidar.rate_hz=7.7",  # at no whole number of rows
    "sensors.line_detector.lines=across-x",
    "sensors.position.reports=pose",
)


@pytest.mark.parametrize(
    "words",
    [
        ("box",),
        ("ess", "--seed", "3", "--speed-mps", "1.9"),
        ("box", "--set", "sensors.position.reports=pose"),
        ("box", *(word for path in LIDAR for word in ("--set", path))),
        ("box", "--cars", "around", "--seed", "17"),
        ("box", "--driver", "box-plan"),
    ],
    ids=lambda words: " ".join(words)[:40],
)
def test_a_run_s_files_are_enough_to_run_its_pilot_again(words, tmp_path):
    """Telemetry in, the very commands out: there is no simulator here."""
    assert cli.main(["drive", *words, "--out", str(tmp_path / "run"), "--json"]) in (0, 1)
    run = read_run(tmp_path / "run")
    pilot = pilot_of_run(run.about, read_commands)
    ticks = np.rint(run.commands["time_s"] / pilot.dt).astype(np.int32)
    assert np.all(np.diff(ticks) == pilot.control)
    told = readings_at(run.telemetry, channels(run.car), ticks, pilot.dt)
    asked = pilot.rerun(run.about["seed"], told, ticks)
    np.testing.assert_allclose(asked.throttle, run.commands["throttle"], atol=1e-9)
    np.testing.assert_allclose(asked.steering, run.commands["steering"], atol=1e-9)


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_ground_truth_reaches_the_estimator_truth_alone(name):
    """A truth that is no number spoils what is asked for where it is looked at, and only there."""
    pilot = Pilot.of(drift_turn(COURSE, CAR), COURSE, CAR, name)
    simulator = Simulator.of(COURSE, CAR)
    with jax.enable_x64(True):
        loop, memory = simulator.init(), pilot.init(simulator.root)
        loop, memory, _ = scan(simulator, pilot, 300, loop, memory)
        readings = simulator.readings(loop)
        nothing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), readings.truth)
        sound = pilot.act(memory, readings, loop.tick)
        spoilt = pilot.act(memory, readings._replace(truth=nothing), loop.tick)
    leaves = zip(jax.tree.leaves(sound), jax.tree.leaves(spoilt), strict=True)
    assert all(np.array_equal(*map(plain, pair)) for pair in leaves) == (name != "truth")


def plain(leaf):
    """A key as its numbers."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


def test_no_state_of_a_world_is_in_what_the_pilot_is_given_or_keeps():
    simulator = Simulator.of(COURSE, CAR)
    loop = simulator.init()
    for name in ESTIMATORS:
        pilot = Pilot.of(drift_turn(COURSE, CAR), COURSE, CAR, name)
        with jax.enable_x64(True):
            readings = simulator.readings(loop)
            memory = pilot.init(simulator.root)
            _, observation = pilot.observe(memory, readings, loop.tick)
        for given in (readings._replace(truth=None), memory, observation, pilot):
            found: list[object] = []
            true = lambda node: isinstance(node, State | Motion)  # noqa: E731  # used twice
            jax.tree.map(found.append, given, is_leaf=true)
            assert not any(map(true, found))


@pytest.mark.parametrize("room", ["estimation", "drivers", "pilot.py"])
def test_what_drives_does_not_import_a_world_s_state(room):
    package = Path(__file__).parents[1] / "src" / "countersteer"
    path = package / room
    assert path.exists()
    for file in [path] if path.suffix else path.rglob("*.py"):
        assert "world.state" not in file.read_text(), file
        assert "world import state" not in file.read_text(), file
        assert "simulator" not in file.read_text().replace("A simulator", ""), file


def by_hand(simulator, pilot, seconds):
    """The loop as anyone would write it."""
    loop, memory = simulator.init(), pilot.init(simulator.root)
    path = []
    for _ in range(round(seconds / simulator.dt / pilot.control)):
        command, memory = pilot.act(memory, simulator.readings(loop), loop.tick)
        loop, record = simulator.apply(loop, command, pilot.control)
        path.append(jax.tree.map(np.asarray, (record.motion, record.command)))
    return jax.tree.map(lambda *pieces: np.concatenate(pieces), *path)


def test_the_loop_by_hand_is_the_loop_of_run_to_the_digit():
    """With a driver that is scanned: `run` compiles the whole loop, a hand its two halves."""
    driver = drift_turn(COURSE, CAR)
    pilot, simulator = Pilot.of(driver, COURSE, CAR), Simulator.of(COURSE, CAR, seed=3)
    record = simulator.record(pilot, 1.6)
    stepped = by_hand(simulator, pilot, 1.6)
    for one, other in zip(
        jax.tree.leaves((record.motion, record.command)), jax.tree.leaves(stepped), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["my_world", "wall_follower"])
def test_the_examples_run_as_they_stand(name, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py")],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    last = done.stdout.splitlines()[-1].split()
    x, y = (float(last[last.index(name) + 1]) for name in ("x", "y"))
    assert x > 2.4
    assert abs(y) < 0.05


def test_another_world_is_shorter_than_sixty_lines():
    assert len((EXAMPLES / "my_world.py").read_text().splitlines()) < 60


class Counted:
    """Asks for nothing, and counts how often it is asked."""

    def __init__(self, answer=None):
        self.calls, self.answer = 0, answer

    def reset(self, key):
        return 0

    def act(self, memory, observation):
        self.calls += 1
        return (Command(0.0, 0.0), memory) if self.answer is None else self.answer


@pytest.mark.parametrize(("period", "calls"), [(None, 101), (0.001, 501), (0.02, 26)])
def test_a_driver_in_python_decides_200_times_a_second_unless_it_says_otherwise(period, calls):
    driver = Counted()
    if period is not None:
        driver.period = period
    record = driven(None, CAR, driver, 0.5)
    assert driver.calls == pytest.approx(calls, abs=2)
    assert np.all(np.diff(np.nonzero(record.fresh)[0]) == round(1000 * (period or 0.005)))


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (Command(0.1, 0.0), "must return .Command.throttle, steering., memory."),
        ((Command(0.1, 0.0), 1, 2), "must return"),
        ((0.3, None), "must return a Command"),
        ((Command("fast", 0.0), None), "throttle must be a finite number, not 'fast'"),
        ((Command(0.1, float("nan")), None), "steering must be a finite number, not nan"),
        ("go", "must return"),
    ],
)
def test_a_wrong_answer_of_a_driver_is_told_in_one_line(answer, says):
    with pytest.raises(InputError, match=f"Counted.act.*{says}") as raised:
        driven(None, CAR, Counted(answer), 0.1)
    assert len(str(raised.value).splitlines()) == 1
