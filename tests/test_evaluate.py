"""Drivers judged over randomised cars."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conftest import driven, judged
from countersteer.batch import trials
from countersteer.batch.evaluate import interval
from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.cli import main
from countersteer.course.files import load_course
from countersteer.course.position import line_of
from countersteer.drivers.drift_turn import drift_turn
from countersteer.errors import InputError
from countersteer.pilot import Pilot

SEEDS = range(400)


@pytest.fixture(scope="module")
def around():
    car = load_car("rx7")
    return car, draw(load_population("around"), car, load_course("box"), SEEDS, float, (1.5, 3.0))


@pytest.mark.parametrize(
    ("path", "within"),
    [
        ("tires.front.friction", 0.15),
        ("tires.rear.friction", 0.15),
        ("body.mass", 0.05),
        ("body.yaw_inertia", 0.10),
        ("motor.resistance", 0.05),
        ("servo.gain_left", 0.20),
        ("servo.rate", 0.20),
    ],
)
def test_parameters_are_drawn_evenly_around_the_nominal(around, path, within):
    car, drawn = around
    nominal, values = car, drawn.cars
    for name in path.split("."):
        nominal, values = getattr(nominal, name), getattr(values, name)
    relative = values / nominal - 1
    assert np.abs(relative).max() <= within + 1e-12
    # Of an even draw: its deviation, and no more than chance at its mean.
    assert np.std(relative) == pytest.approx(within / math.sqrt(3), rel=0.1)
    assert abs(np.mean(relative)) < 4 * within / math.sqrt(3 * len(SEEDS))


def test_parameters_of_one_line_share_a_draw_and_others_do_not(around):
    car, drawn = around
    left = drawn.cars.servo.gain_left / car.servo.gain_left
    assert left == pytest.approx(drawn.cars.servo.gain_right / car.servo.gain_right)
    front = drawn.cars.tires.front.friction
    assert abs(np.corrcoef(front, drawn.cars.tires.rear.friction)[0, 1]) < 0.2
    assert 0.3 <= drawn.charge.min() < drawn.charge.max() <= 1
    assert 1.5 <= drawn.speed.min() < drawn.speed.max() <= 3


def test_a_trial_is_its_seed_whatever_is_drawn_beside_it(around):
    car, drawn = around
    alone = draw(load_population("around"), car, load_course("box"), [7], float, (1.5, 3.0))
    for one, many in zip(jax.tree.leaves(alone), jax.tree.leaves(drawn), strict=True):
        assert np.array_equal(one[0], many[7])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[vary]\n"body.mass" = {within = 0.1}', "unknown parameter body.mass"),
        ('[vary]\n"body.mass_kg" = {within = 2}', "body.mass_kg.within must be a number in [0, 1]"),
        ('[vary]\n"body.mass_kg" = {low = 1}', "needs low and high together"),
        ('[vary]\n"body.mass_kg" = 3', "must be a table"),
        ("[start]\ncharge = 1", "start.charge must be [low, high]"),
        ("[flor]\ndeviation = 1", "unknown key flor; did you mean floor?"),
        ("[floor]\ndeviation = 0.9", "floor.deviation must be a number in"),
    ],
)
def test_a_wrong_set_is_told_in_one_line(tmp_path, text, said):
    file = tmp_path / "set.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=said.replace("[", r"\[").replace("?", r"\?")) as raised:
        load_population(str(file))
    assert str(file) in str(raised.value)


def test_intervals_are_wilsons():
    # By the formula: (p + z²/2n ± z sqrt(p(1-p)/n + z²/4n²)) / (1 + z²/n), z = 1.95996.
    assert interval(0, 10) == pytest.approx((0.0, 0.277533), abs=1e-5)
    assert interval(990, 1000) == pytest.approx((0.981695, 0.994558), abs=1e-5)


def test_a_batch_judges_as_a_recorded_drive_is_judged():
    """The cars of a batch, in 64 bits, beside each of them driven alone and recorded."""
    course, car, seeds = load_course("ess"), load_car("rx7"), range(4)
    drawn = draw(load_population("around"), car, course, seeds, np.float64)
    driver = drift_turn(course, car)
    score, _ = trials.run_trials(
        course, Pilot.of(driver, course, car), drawn, [driver] * 4, seeds, 1, 14.0, lanes=4
    )
    for i in seeds:
        one, floor = jax.tree.map(lambda leaf, i=i: leaf[i], (drawn.cars, drawn.floor))
        record = driven(
            course, one, driver, 14.0, nominal=car, seed=i, charge=float(drawn.charge[i]),
            start=tuple(map(float, drawn.pose[i])), floor=floor,
        )  # fmt: skip
        alone, turns = judged(course, record)
        assert len(turns) == 4
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(score), strict=True):
            np.testing.assert_allclose(a, b[i], atol=1e-6)


def test_evaluate_tells_what_the_design_says(tmp_path, capsys):
    out = tmp_path / "found"
    status = main(
        ["evaluate", "box", "--trials", "8", "--speed-mps", "1.5:3", "--json", "--out", str(out)]
    )
    told = json.loads(capsys.readouterr().out)
    assert status == 0
    one = told["drivers"]["drift-turn"]
    assert one["trials"] == 8
    assert one["successes"] + len(one["failed_seeds"]) == 8
    assert one["successes"] >= 6
    low, high = one["success_interval"]
    assert low < one["success_rate"] <= high
    assert 0 <= one["drift_share"] <= 1
    assert one["heading_error_rms_deg"] < 10
    assert 25 < one["peak_sideslip_deg_median"] < 60
    assert 5 < one["lap_time_s_median"] < 12
    assert json.loads((out / "evaluate.json").read_text())["drivers"] == told["drivers"]
    assert (out / "evaluate.png").stat().st_size > 5000


def test_wrong_questions_are_answered_in_one_line(capsys):
    for words, said in (
        (["evaluate", "box", "--speed-mps", "3:2"], "must rise"),
        (["evaluate", "box", "--cars", "nowhere"], "no set of cars nowhere"),
        (["drive", "box", "--speed-mps", "1:2"], "with --cars only"),
    ):
        assert main(words) == 2
        assert said in capsys.readouterr().err


def test_progress_along_the_line_is_that_of_the_course():
    from countersteer.course.course import progress

    course = load_course("ess")
    rng = np.random.default_rng(0)
    along = np.linspace(0.5, 15.0, 60)
    from countersteer.course.course import place

    xy = np.array([place(course, d)[:2] for d in along]) + rng.uniform(-0.3, 0.3, (60, 2))
    line = line_of(course, np.float32)
    last, found = jnp.float32(0.5), []
    for x, y in xy:
        last = line.follow(x, y, last).distance
        found.append(float(last))
    assert found == pytest.approx(progress(course, xy[:, 0], xy[:, 1], 0.5), abs=1e-4)
