"""The closed loop: drives from the command line, and drivers in and out of JAX."""

import dataclasses
import importlib.util
import json
import math
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
from countersteer.link.link import RADIO
from countersteer.pilot import Pilot
from countersteer.runs.files import read_commands, read_table
from countersteer.runs.run import read_run
from countersteer.signals import Command
from countersteer.simulator import Simulator, scan

EXAMPLE = Path(__file__).parents[1] / "examples" / "wall_follower.py"


def drive(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict]:
    """Exit status and the JSON that a verb printed."""
    capsys.readouterr()
    status = cli.main([*map(str, arguments), "--json"])
    return status, json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a drive of the box course."""
    folder = tmp_path_factory.mktemp("box") / "run"
    assert cli.main(["drive", "box", "--json", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize(("course", "seed"), [("box", 0), ("box", 5), ("ess", 0), ("ess", 7)])
def test_every_corner_is_drifted_and_no_wall_touched(course, seed, tmp_path, capsys):
    status, result = drive(capsys, "drive", course, "--seed", seed, "--out", tmp_path / "run")
    assert status == 0
    assert result["completed"]
    assert result["wall_contacts"] == 0
    assert len(result["turns"]) == 4
    for turn in result["turns"]:
        assert turn["peak_sideslip_deg"] > 25
        assert 180 < turn["peak_yaw_rate_degps"] < 300


def test_what_was_driven_can_be_replayed_to_the_same_motion(box, tmp_path, capsys):
    status, result = drive(capsys, "replay", box, "--out", tmp_path / "again")
    assert status == 0
    assert result["completed"]
    assert len(read_run(tmp_path / "again").walls) == 8
    first, again = read_run(box).truth, read_run(tmp_path / "again").truth
    rows = min(len(first), len(again))
    assert abs(len(first) - len(again)) <= 2
    for name in ("x_m", "y_m", "heading_rad", "vx_mps", "wheel_rl_radps"):
        np.testing.assert_allclose(again[name][:rows], first[name][:rows], atol=1e-7)


def test_a_run_tells_all_that_it_was_made_with(box):
    run = read_run(box)
    assert run.about["driver"] == "drift-turn"
    assert run.about["seed"] == 0
    assert run.about["rates"]["sonar_s"] == pytest.approx(0.025)
    assert jax.tree.all(jax.tree.map(np.isclose, run.car, load_car("rx7")))
    assert len(run.walls) == 8
    assert {"report.html", "report.png", "summary.json"} <= {p.name for p in box.iterdir()}


def test_telemetry_holds_only_what_is_new(box):
    table = read_table(box / "telemetry.csv", ("time_s",))
    period = 1 / 40
    heard = np.isfinite(table["sonar_left_m"]) | np.isinf(table["sonar_left_m"])
    assert np.diff(table["time_s"][heard]).min() == pytest.approx(period)
    assert np.median(np.diff(table["time_s"])) == pytest.approx(0.005)
    counts = table["encoder_counts"][np.isfinite(table["encoder_counts"])]
    assert np.all(np.diff(counts) >= 0)


def test_commands_come_at_the_rate_of_the_board(box):
    commands = read_commands(box / "commands.csv")
    assert np.allclose(np.diff(commands["time_s"]), 0.001)
    assert np.all(np.abs(commands["steering"]) <= math.radians(28) + 1e-9)


class Stepped:
    """A driver hidden from JAX: it is called from Python, as often as the other."""

    period = 0.001

    def __init__(self, inner):
        self.inner = inner
        self.act_compiled = jax.jit(inner.act)

    def reset(self, key):
        return jax.tree.map(np.asarray, self.inner.reset(key))

    def act(self, memory, observation):
        return self.act_compiled(memory, observation)

    def status(self, memory):
        return self.inner.status(memory)


def test_a_driver_stepped_in_python_equals_the_same_driver_scanned():
    course, car = load_course("box"), load_car("rx7")
    driver = drift_turn(course, car)
    scanned = driven(course, car, driver, 1.5, seed=3)
    stepped = driven(course, car, Stepped(driver), 1.5, seed=3)
    for one, other in zip(scanned.motion[:6], stepped.motion[:6], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    assert scanned.status.turn[-1] == stepped.status.turn[-1] == 1


def test_a_batch_of_drives_equals_a_loop():
    """Two cars that differ, each alone and both at once, over a second in 64 bits."""
    course = load_course("box")
    cars = [load_car("rx7"), load_car("rx7", ["body.mass_kg=1.7", "battery.wear=0.4"])]
    pilot = Pilot.of(drift_turn(course, cars[0]), course, cars[0])
    simulator = Simulator.of(course, cars[0])

    def with_car(car):
        world = dataclasses.replace(simulator.world, car=car)
        return dataclasses.replace(simulator, world=world)

    with jax.enable_x64(True):
        begun = simulator.init(), pilot.init(simulator.root)
        both = jax.tree.map(lambda *leaves: np.stack(leaves), *cars)
        batch = jax.jit(jax.vmap(lambda car, *at: scan(with_car(car), pilot, 500, *at)[:2]))
        loops = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), begun)
        for _ in range(2):
            loops = batch(both, *loops)
        for i, car in enumerate(cars):
            alone = begun
            for _ in range(2):
                alone = scan(with_car(car), pilot, 500, *alone)[:2]
            motion = loops[0].state.motion
            for one, other in zip(alone[0].state.motion, motion, strict=True):
                np.testing.assert_allclose(np.asarray(other)[..., i], np.asarray(one), atol=1e-9)


def test_over_the_radio_packets_come_late_and_get_lost():
    """Commands change every 0.1 s at most, 20 ms after they were given, and some never come."""

    class Wiggle:
        """Gives a new command each time it is asked."""

        def reset(self, key):
            return 0

        def act(self, memory, observation):
            self.ages = [*getattr(self, "ages", []), float(observation.gyroscope.age)]
            return Command(0.0, 0.01 * (memory + 1)), memory + 1

    driver = Wiggle()
    car = load_car("rx7")
    steering = driven(None, car, driver, 4.0, link=RADIO, seed=1).command.steering
    changes = np.nonzero(np.diff(steering))[0] + 1
    assert np.all(changes % 100 == 20)
    assert 25 <= len(changes) < 40  # of 40 sent, each lost with a chance of 5 %
    finite = [age for age in driver.ages if math.isfinite(age)]
    assert min(finite) >= 0.02
    assert max(finite) < 0.2


def test_a_car_that_hears_nothing_stops():
    """A radio that loses everything after the first packets: the throttle goes to 0."""

    class Full:
        def reset(self, key):
            return None

        def act(self, memory, observation):
            return Command(0.5, 0.0), None

    deaf = dataclasses.replace(RADIO, loss=0.97)
    record = driven(None, load_car("rx7"), Full(), 6.0, link=deaf)
    throttle = record.command.throttle
    arrived = record.fresh & (throttle > 0)
    last = np.nonzero(arrived)[0]
    assert len(last)
    for tick in last:
        silence = throttle[tick + 502 : tick + 520]
        heard_again = np.any((last > tick) & (last <= tick + 520))
        assert heard_again or np.all(silence == 0)


def test_the_example_drives_down_the_middle():
    spec = importlib.util.spec_from_file_location("wall_follower", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    course, car = load_course("straight"), load_car("rx7")
    record = driven(course, car, module.WallFollower(), 3.0, start=(0.5, 0.2, 0.0))
    assert record.motion.x[-1] > 2.5
    assert abs(record.motion.y[-1]) < 0.1
    assert record.wall_contacts[-1] == 0


def test_straighten_comes_back_to_the_middle(tmp_path, capsys):
    status, result = drive(
        capsys, "drive", "straight", "--driver", "straighten", "--out", tmp_path / "run"
    )
    assert status == 0
    assert result["turns"] == []
    truth = read_run(tmp_path / "run").truth
    assert np.abs(truth["y_m"]).max() < 0.15


def test_the_estimate_is_said_and_used(tmp_path, capsys):
    out = tmp_path / "run"
    status, _ = drive(capsys, "drive", "box", "--estimate", "truth", "--out", out)
    assert status == 0
    assert read_run(out).about["estimate"] == "truth"


def test_a_drive_is_one_program():
    """A loop whose types change in its first piece would be traced and compiled twice."""
    course, car = load_course("box"), load_car("rx7")
    simulator, pilot = Simulator.of(course, car), Pilot.of(drift_turn(course, car), course, car)
    with jax.enable_x64(True):
        begun = simulator.init(), pilot.init(simulator.root)
        before = jax.eval_shape(lambda *at: at, *begun)
        after = jax.eval_shape(lambda *at: scan(simulator, pilot, 2, *at)[:2], *begun)
    leaves = zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
    for (path, a), b in leaves:
        assert (a.dtype, a.weak_type) == (b.dtype, b.weak_type), path
