"""Cars that are commanded in m/s: the speed controller, and logs of such cars."""

import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from countersteer import cli
from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.car.parameter import changed
from countersteer.course.files import load_course
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.link.link import RADIO
from countersteer.pilot import Pilot, bounded, checked
from countersteer.runs.files import read_commands
from countersteer.runs.run import Run, read_run
from countersteer.signals import AnyCommand, Command, SpeedCommand
from countersteer.simulator import Simulator, begin, tick
from countersteer.tuning import fit, shooting
from countersteer.tuning.compare import compare
from countersteer.viewing.view import motion_of
from countersteer.world import plant, speed_controller
from countersteer.world.planar import initial_state

CASE = Path(__file__).parents[2] / "shared" / "cases" / "speed-commanded"
DT, SECONDS = 0.002, 5


def controlled(**numbers: float) -> Car:
    """The library's car with a speed controller."""
    car = load_car("rx7")
    for name, value in ({"gain": 1.0, "feed_forward": 0.22} | numbers).items():
        car = changed(car, f"speed_controller.{name}", np.float64(value))
    return car


@jax.jit
def _driven(car: Car, command: AnyCommand) -> jax.Array:
    state = jax.tree.map(jnp.asarray, initial_state(car, DT, slots=1))
    return plant.rollout(car, state, command, 50, DT, lambda s: s.motion)[1]


def driven(
    car: Car, drive: list[float], kind: type[AnyCommand] = SpeedCommand, steering: float = 0.0
) -> Any:
    """The motion each 0.1 s, with a commanded speed or throttle for each second; the last holds."""
    held = [*drive, *drive[-1:] * (SECONDS - len(drive))]  # one length: one compiled program
    line = np.repeat(np.array(held), round(1 / DT))
    with jax.enable_x64(True):
        motion = _driven(car, kind(line, np.full(len(line), steering)))
    return jax.tree.map(np.asarray, motion)


def test_the_car_reaches_the_commanded_speed_keeps_it_and_brakes_to_the_next():
    vx = driven(controlled(), [2.0, 2.0, 1.0, 0.0]).vx
    assert vx[19] == pytest.approx(2.0, rel=0.05)
    assert vx[29] == pytest.approx(1.0, rel=0.05)
    assert abs(vx[-1]) < 0.02
    assert np.all(vx > -0.02)


def test_a_commanded_speed_and_its_mirror_image_are_the_same():
    ahead = driven(controlled(), [1.0, 2.0], steering=0.2)
    right = driven(controlled(), [1.0, 2.0], steering=-0.2)
    np.testing.assert_allclose(ahead.vx, right.vx, rtol=1e-9)
    np.testing.assert_allclose(ahead.yaw_rate, -right.yaw_rate, rtol=1e-9)
    back = driven(controlled(), [-1.0, -1.0])
    assert back.vx[-1] == pytest.approx(-1.0, rel=0.1)


def test_more_gain_leaves_less_error_and_a_limit_holds():
    ends = [
        driven(controlled(gain=gain, feed_forward=0.0), [2.0, 2.0, 2.0]).vx[-1]
        for gain in (0.2, 0.5, 2.0)
    ]
    assert ends[0] < ends[1] < ends[2] < 2.0
    slow = driven(controlled(throttle_limit=0.1), [2.0] * 3)
    assert np.max(slow.duty) <= 0.1 + 1e-12
    coasting = driven(controlled(brake_limit=0.0), [2.0, 2.0, 0.0])
    assert np.min(coasting.duty) >= 0.0


def test_throttles_pass_the_controller_by():
    plain, with_controller = load_car("rx7"), controlled(gain=5.0)
    a, b = (driven(car, [0.4, -0.2], Command) for car in (plain, with_controller))
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.array_equal(one, other)
    # The program of a throttle does not even look at the wheels.
    with jax.enable_x64(True):
        traced = jax.make_jaxpr(
            lambda car, wheels: speed_controller.goal_duty(car, Command(0.3, 0.0), wheels)
        )(with_controller, (1.0, 1.0, 1.0, 1.0))
    used = {str(v) for equation in traced.eqns for v in equation.invars}
    assert not used & {str(v) for v in traced.jaxpr.invars[-4:]}


# -------------------------------------------------------------------------------------------------
# Commands in files
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "speed"),
    [
        ("time_s,speed_mps,steering_deg\n0,1.5,3\n1,-0.5,3\n", [1.5, -0.5]),
        (
            "time_s,speed_mps,direction,steering_deg\n0,1.5,forward,3\n1,.5,reverse,3\n",
            [1.5, -0.5],
        ),
    ],
)
def test_commanded_speeds_are_read(tmp_path, text, speed):
    (tmp_path / "commands.csv").write_text(text)
    table = read_commands(tmp_path / "commands.csv")
    assert table["speed"].tolist() == speed
    assert "throttle" not in table


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,throttle,direction,steering_deg\n0,1.5,forward,3\n", "a column speed_mps"),
        ("time_s,speed_mps,throttle,steering_deg\n0,1.5,0.1,3\n", "give one of the two"),
        ("time_s,speed_mps,direction,steering_deg\n0,-1,reverse,3\n", "give one of them"),
        ("time_s,speed_mps,steering_deg\n0,150,3\n", "speed_mps must be in [-100, 100]"),
        ("time_s,speed_mps,steering_deg\n0,,3\n", "speed_mps must be in"),
        ("time_s,steering_deg\n0,3\n", "column throttle is missing"),
        ("time_s,speed_mps\n0,3\n", "column steering_deg is missing"),
    ],
)
def test_wrong_commands_are_refused(tmp_path, text, says):
    (tmp_path / "commands.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_commands(tmp_path / "commands.csv")
    assert says in str(caught.value)


@pytest.mark.skipif(not CASE.is_dir(), reason="the cases are not here")
def test_the_case_of_a_car_commanded_in_metres_a_second(tmp_path, capsys):
    shutil.copy(CASE / "commands.csv", tmp_path / "commands.csv")
    file = tmp_path / "commands.csv"
    out = str(tmp_path / "run")
    assert cli.main(["replay", str(file), "--out", out]) == 2
    assert "a speed in m/s goes into a column speed_mps" in capsys.readouterr().err
    file.write_text(file.read_text().replace("throttle", "speed_mps"))
    assert cli.main(["replay", str(file), "--out", out]) == 2
    assert "the car has no speed controller" in capsys.readouterr().err
    car = tmp_path / "car.toml"
    car.write_text('base = "rx7"\n[speed_controller]\ngain_spm = 0.5\nfeed_forward_spm = 0.12\n')
    assert cli.main(["replay", str(file), "--car", str(car), "--out", out]) == 0
    run = read_run(Path(out))
    assert run.commands["speed"][0] == 1.478
    assert run.truth["vx_mps"][-1] > 0.9
    assert "Commanded speed" in (Path(out) / "report.html").read_text()


def test_a_driver_in_python_may_command_speeds():
    driver = SimpleNamespace(command_type=SpeedCommand)
    command, memory = checked(driver, (SpeedCommand(2.5, 0.1), 7))
    assert (type(bounded(command)), float(bounded(command).speed), memory) == (SpeedCommand, 2.5, 7)
    with pytest.raises(InputError, match="speed must be a finite number"):
        checked(driver, (SpeedCommand(math.nan, 0.1), 7))


def test_a_course_is_driven_by_commanded_speeds_on_board_and_not_over_a_radio(tmp_path):
    file = tmp_path / "commands.csv"
    file.write_text("time_s,speed_mps,steering_deg\n0,1.0,0\n")
    course, car = load_course("box"), controlled()
    driver, _ = make_driver(str(file), course, car, None, 1, read_commands)
    pilot, simulator = Pilot.of(driver, course, car), Simulator.of(course, car)
    # Traced only, as compiling it takes long: its filter follows the controller too.
    with jax.enable_x64(True):
        loop = jax.eval_shape(lambda: begin(simulator))
        memory = jax.eval_shape(lambda: pilot.init(simulator.root))
        after = jax.eval_shape(lambda *state: tick(simulator, pilot, *state), loop, memory)
    assert isinstance(after[2].command, SpeedCommand)
    with pytest.raises(InputError, match="radio sends throttles"):
        Pilot.of(driver, course, car, link=RADIO)
    with pytest.raises(InputError, match="no speed controller"):
        make_driver(str(file), course, load_car("rx7"), None, 1, read_commands)


# -------------------------------------------------------------------------------------------------
# Logs against the simulator
# -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Run:
    """A drive that was commanded in m/s, as its encoder and gyroscope tell it."""
    car = controlled()
    time = np.arange(0, 8, DT)
    asked = np.where(time // 1.5 % 2 == 0, 1.8, 0.8) * (time > 0.3)
    steering = 0.15 * np.sin(1.5 * time) * (time > 4)
    with jax.enable_x64(True):
        motion = _driven_finely(car, SpeedCommand(asked, steering))
    rims = np.mean([np.asarray(w) for w in motion.wheels], axis=0) * float(car.tires.rear.radius)
    folder = tmp_path_factory.mktemp("runs") / "log"
    folder.mkdir()
    step = 5  # of the sampled motion, 0.02 s
    rows = zip(time[::10], asked[::10], np.degrees(steering[::10]), strict=True)
    text = "".join(f"{t:.3f},{v},{d}\n" for t, v, d in rows)
    (folder / "commands.csv").write_text("time_s,speed_mps,steering_deg\n" + text)
    sampled = zip(time[1:][1::2][::step], rims[::step], np.asarray(motion.yaw_rate)[::step])  # noqa: B905  # the last differs
    text = "".join(f"{t:.3f},{v},{r}\n" for t, v, r in sampled)
    (folder / "telemetry.csv").write_text("time_s,wheel_speed_mps,gyro_radps\n" + text)
    (folder / "run.toml").write_text(
        "format = 1\nbattery_charge = 1.0\n"
        "sensors.encoder = { lag_s = 0, over_s = 0, step_mps = 0 }\n"
    )
    return read_run(folder)


@jax.jit
def _driven_finely(car: Car, command: SpeedCommand) -> jax.Array:
    state = jax.tree.map(jnp.asarray, initial_state(car, DT, slots=1))
    asked = plant.as_it_arrives(car, command, DT)
    return plant.rollout(car, state, asked, 2, DT, lambda s: s.motion)[1]


def test_a_log_of_the_same_car_agrees_and_another_controller_does_not(log):
    right = compare(log, controlled(), dt=0.005)[0]
    wrong = compare(log, controlled(gain=0.1, feed_forward=0.05), dt=0.005)[0]
    error, other, nothing = (
        found["rmse"]["wheel_speed_mps"] for found in (right, wrong, right["persistence"])
    )
    assert error < 0.05
    assert other > 3 * error
    assert nothing > 3 * error


def test_a_log_commanded_in_metres_a_second_needs_a_controller(log):
    with pytest.raises(InputError, match="no speed controller"):
        compare(log, load_car("rx7"))
    with pytest.raises(InputError, match="no speed controller"):
        fit.take_shots([log], {"rx7": load_car("rx7")}, ["rx7"], [[]])
    # To be looked at it needs none.
    assert np.nanmax(motion_of(log, load_car("rx7"))["speed_mps"]) > 0.5


def test_a_fit_starts_from_measured_speeds_and_tells_gains_apart(log):
    car = controlled()
    with jax.enable_x64(True):
        shots, _ = fit.take_shots([log], {"car": car}, ["car"], [[]], every=1.0)
        # It brakes from 1.8 to 0.8 m/s, and has settled before.
        shot = jax.tree.map(lambda leaf: jnp.asarray(leaf[1]), shots)
        predicted = jax.jit(lambda gain: _predicted(car, gain, shot))
        errors = [float(predicted(gain)) for gain in (0.2, 1.0, 5.0)]
    assert errors[1] < 0.05
    assert errors[1] < errors[0]
    assert errors[1] < errors[2]
    problem = fit.Problem({"car": car}, shots, (*fit.CONTROLLER, "motor.lag"))
    assert [p.path for p in problem.parameters][:2] == list(fit.CONTROLLER)


def _predicted(car: Car, gain: jax.Array, shot: shooting.Shots) -> jax.Array:
    """The RMS error of the wheel speed (m/s)."""
    found = shooting.predict(changed(car, "speed_controller.gain", gain), shot, DT)
    return jnp.sqrt(jnp.nanmean((found - shot.measured)[3] ** 2))


def test_logs_of_both_kinds_are_not_fitted_together(log, tmp_path):
    shutil.copytree(log.path, tmp_path / "other")
    commands = tmp_path / "other" / "commands.csv"
    lines = [line.split(",") for line in commands.read_text().splitlines()[1:]]
    commands.write_text(
        "time_s,throttle,direction,steering_deg\n"
        + "".join(f"{t},{float(v) / 5},forward,{d}\n" for t, v, d in lines)
    )
    other = read_run(tmp_path / "other")
    with pytest.raises(InputError, match="fit them apart"):
        fit.take_shots([log, other], {"car": controlled()}, ["car"] * 2, [[], []])
