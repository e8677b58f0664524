"""Where along a course, turns by the pose, and plans: policies indexed by space."""

import json
import math
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import conftest
from conftest import judged
from countersteer import cli
from countersteer.car.files import load_car
from countersteer.course.course import place, progress
from countersteer.course.files import load_course
from countersteer.course.position import legs_of, line_of
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.driver import Heard, Observation
from countersteer.drivers.plan import library, plan
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.estimation.estimate import Estimate
from countersteer.runs.files import read_commands

CAR = load_car("rx7")
STEP, STEPS = 0.005, 400


@pytest.mark.parametrize("name", ["box", "bends"])
def test_the_distance_along_a_course_is_that_of_progress(name):
    course = load_course(name)
    line = line_of(course)
    rng = np.random.default_rng(1)
    along = np.arange(course.start_distance, 1.2 * course.length, 0.05)
    along = along if course.closed else along[along < course.length]
    xs, ys, _ = np.array([place(course, d) for d in along]).T
    xs, ys = xs + 0.2 * rng.normal(size=len(xs)), ys + 0.2 * rng.normal(size=len(ys))

    def one(last, at):
        found = line.follow(*at, last)
        return found.distance, found

    _, found = jax.lax.scan(one, jnp.asarray(course.start_distance), (xs, ys))
    np.testing.assert_allclose(found.distance, progress(course, xs, ys, along[0]), atol=1e-9)


@pytest.mark.parametrize("name", ["box", "bends"])
def test_a_place_left_of_the_line_is_found_again(name):
    course = load_course(name)
    line = line_of(course)
    for distance in (0.7, 2.9, 4.6, 7.3):
        x, y, bearing = place(course, distance)
        np.testing.assert_allclose(line.at(distance), (x, y), atol=1e-9)
        x, y = x - 0.1 * math.sin(bearing), y + 0.1 * math.cos(bearing)
        found = line.follow(x, y, distance - 0.3)
        # On a rounded corner the line is of chords, and the foot on one of two.
        assert found.distance == pytest.approx(distance, abs=0.01)
        assert found.offset == pytest.approx(0.1, abs=1e-3)
        assert found.bearing == pytest.approx(bearing, abs=math.radians(5.1))


def test_a_pose_that_jumps_is_followed_to_where_it_is():
    course = load_course("box")
    line = line_of(course)
    x, y, _ = place(course, 7.5)
    assert line.follow(x, y, 1.5).distance != pytest.approx(7.5, abs=0.5)
    assert line.find(x, y, 1.5).distance == pytest.approx(7.5)
    assert line.find(x, y, 26.0).distance == pytest.approx(31.5), "the nearest round"


def test_legs_run_to_where_the_straights_beside_a_corner_meet():
    legs = legs_of(load_course("bends"), 1)
    np.testing.assert_allclose(legs.x[:3], [4.0, 4.0, 8.5], atol=0.01)
    np.testing.assert_allclose(legs.y[:3], [0.0, 4.5, 4.5], atol=0.01)
    seen = legs.seen(1, 3.9, 2.5, math.pi / 2 + 0.1 + 2 * math.pi)
    np.testing.assert_allclose(seen, (2.0, 0.1, 0.1), atol=0.01)


def test_the_corner_is_told_by_the_wall_where_one_stands_ahead():
    box, bends = load_course("box"), load_course("bends")
    assert drift_turn(box, CAR).by == "wall"
    assert drift_turn(bends, CAR).by == "pose"
    assert drift_turn(box, CAR, by="pose").by == "pose"


def driven(course, driver, seconds):
    """Turns, places, and whether a wall was touched, of the nominal car that knows its state."""
    record = conftest.driven(course, CAR, driver, seconds, estimate="truth")
    turns, motion = judged(course, record)[1], record.motion
    distance = progress(course, motion.x[::20], motion.y[::20], course.start_distance)
    return turns, distance[-1], record.wall_contacts[-1]


def test_curves_are_drifted_where_no_wall_stands_ahead():
    course = load_course("bends")
    turns, distance, contacts = driven(course, drift_turn(course, CAR), 16.0)
    assert contacts == 0
    assert distance > course.goal_distance
    assert len(turns) == 4
    assert all(turn.peak_sideslip_deg > 25 for turn in turns)
    assert all(abs(turn.heading_error_deg) < 15 for turn in turns)


@pytest.mark.parametrize(("name", "drifted"), [("box", (1, 1, 1, 1)), ("bends", (1, 0, 1, 0))])
def test_the_plans_of_the_library_drive_their_courses(name, drifted):
    course = load_course(name)
    driver = make_driver(f"{name}-plan", course, CAR, None, 1, read_commands)[0]
    turns, distance, contacts = driven(course, driver, 11.5)
    assert contacts == 0
    assert distance > course.goal_distance
    slips = [turn.peak_sideslip_deg for turn in turns[:4]]
    assert [slip > 25 for slip in slips] == [bool(drift) for drift in drifted], slips
    assert all(abs(turn.heading_error_deg) < 15 for turn in turns[:4])


def observed(jump=0.0):
    """A car on `straight` for 2 s: ever faster, turned by half a radian from 1 s to 1.5 s.

    Its pose jumps forward at 0.5 s. A wall stands at 6 m, and the front sonar has a spike.
    """
    time = STEP * np.arange(1, STEPS + 1)
    x = 0.5 + time + 0.25 * time**2 + jump * (time > 0.5)
    turning = (time > 1.0) & (time <= 1.5)
    heading = np.clip(time - 1.0, 0, 0.5)
    age = np.where(np.arange(STEPS) % 5 == 0, 0.0, 0.02)
    zero, side = np.zeros(STEPS), np.full(STEPS, 0.62)
    wall = np.where(np.arange(STEPS) == 50, 0.3, 6.0 - x)
    never = Heard(zero, np.full(STEPS, np.inf))
    seen = Observation(
        time,
        tuple(Heard(distance, age) for distance in (wall, side, side)),
        *(never,) * 6,
        *(None,) * 6,
        Estimate(x, zero, heading, 1 + 0.5 * time, zero, 1.0 * turning),
    )  # fmt: skip
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (STEPS,)), seen)


@jax.jit
def thought(driver, seen):
    """The number of the policy that holds, and the throttle, at each step."""

    def one(memory, now):
        command, memory = driver.act(memory, now)
        return memory, (memory.number, command.throttle)

    first = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, np.int32 if isinstance(leaf, int) else float),
        driver.reset(jax.random.key(0)),
    )
    return jax.lax.scan(one, first, seen)[1]


def on_straight(text):
    return plan(
        tomllib.loads(f'kind = "plan"\n{text}'),
        "plan.toml",
        load_course("straight"),
        CAR,
        read_commands,
    )


@pytest.mark.parametrize(
    ("condition", "at"),
    [
        ("driven_m = 1.0", 0.83),
        ("turned_deg = 14.3", 1.25),
        ("time_s = 0.7", 0.7),
        ("wall_m = 4.5", 0.83),
        ("passes_m = 1.5", 0.83),
        ("yaw_rate_degps = 30.0", 1.5),
        ("speed_mps = 1.6", 1.2),
        ("time_s = 0.4, passes_m = 1.5", 0.4),
        ("turned_deg = -14.3", math.inf),
    ],
)
def test_a_policy_hands_over_when_its_condition_is_met(condition, at):
    driver = on_straight(
        f'[[policy]]\ndoes = "straighten"\nuntil = {{ {condition} }}\n'
        '[[policy]]\ndoes = "commands"\nthrottle = 0.33\nsteering_deg = 0.0\n'
    )
    numbers, throttle = map(np.asarray, thought(driver, observed()))
    handed = numbers > 0
    if math.isinf(at):
        assert not np.any(handed)
        return
    assert STEP * (1 + np.argmax(handed)) == pytest.approx(at, abs=0.035)  # a ping takes 25 ms
    assert np.all(np.diff(numbers) >= 0)
    np.testing.assert_allclose(throttle[handed], 0.33)


def test_the_policy_of_the_place_takes_over_after_a_lost_hand_over():
    driver = on_straight(
        '[[policy]]\ndoes = "straighten"\nfrom_m = 0.0\nto_m = 2.0\nuntil = { speed_mps = 90 }\n'
        '[[policy]]\ndoes = "commands"\nthrottle = 0.4\nsteering_deg = 0.0\n'
        "from_m = 2.0\nto_m = 8.0\n"
    )
    numbers, _ = thought(driver, observed(jump=3.0))
    assert STEP * (1 + np.argmax(numbers)) == pytest.approx(0.505, abs=1e-9)
    still, _ = thought(driver, observed())
    first = 0.5 + (t := STEP * (1 + np.argmax(still))) + 0.25 * t**2
    assert first == pytest.approx(2.5, abs=0.02), "half a metre beyond its end"


def test_a_condition_is_not_heeded_where_the_next_policy_has_no_place():
    driver = on_straight(
        '[[policy]]\ndoes = "straighten"\nfrom_m = 0.0\nto_m = 5.0\nuntil = { time_s = 0.1 }\n'
        '[[policy]]\ndoes = "commands"\nthrottle = 0.4\nsteering_deg = 0.0\n'
        "from_m = 2.0\nto_m = 8.0\n"
    )
    numbers, _ = thought(driver, observed())
    first = 0.5 + (t := STEP * (1 + np.argmax(numbers))) + 0.25 * t**2
    assert first == pytest.approx(1.5, abs=0.02)


def test_open_loop_commands_may_come_from_a_file(tmp_path):
    (tmp_path / "steps.csv").write_text(
        "time_s,throttle,direction,steering_deg\n3.0,0.2,forward,0\n3.5,0.6,forward,10\n"
    )
    file = tmp_path / "file.toml"
    file.write_text('kind = "plan"\n[[policy]]\ndoes = "commands"\ncommands = "steps.csv"\n')
    driver = make_driver(str(file), load_course("straight"), CAR, None, 1, read_commands)[0]
    _, throttle = map(np.asarray, thought(driver, observed()))
    np.testing.assert_allclose(throttle[:99], 0.2)
    np.testing.assert_allclose(throttle[101:], 0.6)


GOOD = '[[policy]]\ndoes = "straighten"\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "a plan needs .*policy"),
        ("policies = 1\n" + GOOD, "unknown key policies; did you mean policy"),
        (GOOD + '[[policy]]\ndoes = "fly"\n', "policy 2: does must be one of straighten, .*'fly'"),
        (GOOD + "speed_mps = 99\n", r"policy 1: speed_mps must be a number in \[0.1, 20\], not 99"),
        (GOOD + "throttle = 1.0\n", "policy 1: unknown key throttle"),
        (GOOD + "until = { wall_m = -1 }\n", r"policy 1: until.wall_m must .* \[0, 100\], not -1"),
        (GOOD + "until = { wall = 1 }\n", "unknown key until.wall; did you mean until.wall_m"),
        (GOOD + "until = 1\n", "policy 1: until must be a table"),
        (GOOD + "from_m = 1.0\n", "policy 1: from_m and to_m go together"),
        (GOOD + "from_m = 1.0\nto_m = 50\n", r"policy 1: to_m must be on the course, in \[0, 12\]"),
        ('[[policy]]\ndoes = "drift"\n', "policy 1: turn_deg must be in"),
        ('[[policy]]\ndoes = "drift"\nturn_deg = nan\n', "policy 1: turn_deg must be a number"),
        ('[[policy]]\ndoes = "commands"\nthrottle = 1\n', "policy 1: give throttle and steering"),
        (
            '[[policy]]\ndoes = "commands"\ncommands = 3\n',
            "policy 1: commands must be a name or a path",
        ),
        ('[[policy]]\ndoes = "commands"\ncommands = "gone.csv"\n', "gone.csv"),
    ],
)
def test_a_bad_plan_is_refused_in_a_line_that_names_file_policy_and_key(text, says):
    with pytest.raises(InputError, match=says) as caught:
        on_straight(text)
    assert "\n" not in str(caught.value)
    assert "plan.toml" in str(caught.value) or "gone.csv" in str(caught.value)


def test_a_driver_file_is_a_plan_by_its_kind(tmp_path, capsys):
    assert set(library()) == {"bends-plan", "box-plan"}
    assert "box-plan" in library()
    assert "drift-turn" not in library()
    assert cli.main(["list", "drivers", "--json"]) == 0
    found = {d["name"]: d["description"] for d in json.loads(capsys.readouterr().out)["drivers"]}
    assert found["box-plan"].startswith("box: ")
    other = tmp_path / "other.toml"
    other.write_text('kind = "flight"\n')
    assert cli.main(["drive", "box", "--driver", str(other)]) == 2
    assert "kind must be" in capsys.readouterr().err
