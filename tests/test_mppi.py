"""The planner: its tables of a course, its cost, and a lap."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.course.way import SPACING, start_of, way_of
from countersteer.errors import InputError
from countersteer.pilot import Pilot
from countersteer.planning import mppi, optimum
from countersteer.planning.clearance import clearance_of
from countersteer.planning.mppi import KNOTS, Costs, Mppi, Problem, Search, problem_of
from countersteer.signals import Command, Motion, Wheels
from countersteer.simulator import Simulator
from countersteer.task.judge import Outcome, Task, samples

CAR = load_car("rx7")


@pytest.fixture(autouse=True)
def in_32_bits():
    with jax.enable_x64(False):
        yield


def problem(course: str = "box", **costs: float) -> Problem:
    made, _ = problem_of(load_course(course), CAR, 1, Costs(**costs), Search())
    return jax.tree.map(jnp.asarray, made._replace(lock=0.45, goal=math.inf))


def straight_on(x: float, y: float, vx: float, knots: int = KNOTS) -> Motion:
    """A drive along x at a speed."""
    at = mppi.KNOT * np.arange(1, knots + 1)
    zero = np.zeros(knots)
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32),
        Motion(x + vx * at, y + zero, zero, vx + zero, zero, zero, Wheels(*[zero] * 4),
               *[zero] * 4, 1 + zero),
    )  # fmt: skip


def resting() -> Command:
    return Command(jnp.zeros(KNOTS), jnp.zeros(KNOTS))


@pytest.mark.parametrize("name", ["box", "ess"])
def test_a_place_on_the_line_is_found_again(name: str) -> None:
    course = load_course(name)
    way = way_of(course)
    assert float(way.follow(*course.start[:2], start_of(course, way))) == pytest.approx(
        start_of(course, way), abs=SPACING
    )
    place = start_of(course, way)
    for row in range(int(place / SPACING), int(place / SPACING) + 200, 7):
        x, y = (table[row % max(int(way.last) + 1, 1)] for table in (way.x, way.y))
        place = float(way.follow(x, y, place))
        assert place == pytest.approx(SPACING * row, abs=2 * SPACING)


def test_the_bends_of_a_course_have_their_sign_and_their_way_out() -> None:
    way = way_of(load_course("box"))
    driven = slice(0, int(way.last) + 1)
    assert set(np.unique(way.bend[driven])) == {-1.0, 0.0}  # it turns to the right
    turned = way.along_x * way.out_y - way.along_y * way.out_x
    assert np.all(turned[driven][way.bend[driven] < 0] <= 1e-6)


def test_clearances_are_distances_to_the_walls_and_negative_beyond_them() -> None:
    course = load_course("box")
    way = way_of(course)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.6, 3.6, 300), rng.uniform(-3.6, 0.6, 300)
    ends, ways = course.walls[:, :2], course.walls[:, 2:] - course.walls[:, :2]
    part = np.sum((np.stack([x, y], 1)[:, None] - ends) * ways, -1) / np.sum(ways**2, -1)
    foot = ends + np.clip(part, 0, 1)[..., None] * ways
    away = np.linalg.norm(np.stack([x, y], 1)[:, None] - foot, axis=-1).min(axis=1)
    grid = clearance_of(course, way)
    found = np.asarray(grid.clear(x, y))
    np.testing.assert_allclose(np.abs(found), away, atol=1.5 * float(grid.cell))
    within = (np.abs(x - 1.5) < 0.7) & (np.abs(y + 1.5) < 0.7)  # the block in the middle
    assert np.all(found[within] < 0)
    assert np.all(found[~within & (away > 0.05) & (np.abs(x - 1.5) > 0.9)] > 0)


def test_each_term_of_the_cost_counts_what_it_says() -> None:
    none = dict.fromkeys(Costs._fields, 0.0) | {"margin": 0.08, "drift": 0.6}
    place = start_of(load_course("box"), way_of(load_course("box")))
    x, _, _ = load_course("box").start
    slow, fast = straight_on(x, 0, 0.5), straight_on(x, 0, 1.2)
    aside, through = straight_on(x, 0.55, 0.5), straight_on(x, 0.9, 0.5)

    def cost(motion: Motion, commands: Command | None = None, **weights: float) -> float:
        commands = resting() if commands is None else commands
        return float(mppi.cost(problem(**none | weights), jnp.float32(place), motion, commands))

    assert cost(fast) == 0
    assert cost(fast, progress=1) == pytest.approx(-1.2 * mppi.HORIZON, abs=0.05)
    assert cost(slow, clearance=1) == 0 < cost(aside, clearance=1)
    assert cost(aside, hit=1) == 0 < cost(through, hit=1)
    back = slow._replace(heading=slow.heading + math.pi)
    assert cost(slow, backwards=1) == 0 < cost(back, backwards=1)
    jerky = Command(jnp.tile(jnp.array([0.0, 1.0]), KNOTS // 2), jnp.zeros(KNOTS))
    assert cost(slow, smoothness=1) == 0
    turning = slow._replace(vy=-0.3 + slow.vy)
    assert cost(slow, sideslip=1, straight=1) == 0 < cost(turning, sideslip=1, straight=1)
    assert cost(slow, jerky, smoothness=1) == pytest.approx(KNOTS - 1)
    assert cost(fast, standing=1) == 0
    assert cost(straight_on(x, 0, 0.1), standing=1) == pytest.approx(1 - 0.2 / mppi.SLOW, abs=1e-3)
    assert cost(straight_on(x + 0.6, 0, -0.5), sideslip=1, straight=1) == 0  # it backs off
    assert cost(straight_on(x + 1, 0, -1.5), sideslip=1, straight=1) > 1  # after a spin


def test_commands_are_drawn_around_the_plan_within_their_limits() -> None:
    plan = Command(jnp.full(KNOTS, 0.2), jnp.full(KNOTS, -0.1))
    drawn = mppi.draw(problem(), jax.random.key(0), plan, 4000)
    np.testing.assert_allclose(drawn.throttle[0], 0.2)
    np.testing.assert_allclose(drawn.steering[0], -0.1)
    assert np.abs(drawn.throttle).max() <= 1
    assert np.abs(drawn.steering).max() <= 0.45 + 1e-6
    narrow = problem()._replace(search=Search(throttle=0.1, steering=0.1))
    drawn = mppi.draw(narrow, jax.random.key(1), plan, 4000)
    free = np.asarray(drawn.throttle)[1 : -len(mppi.HELD)] - 0.2
    assert free.std(axis=0) == pytest.approx(0.1, rel=0.1)
    lasting = np.mean(free[:, :-1] * free[:, 1:]) / np.mean(free**2)
    assert lasting == pytest.approx(Search().lasting, abs=0.02)


def test_a_command_reaches_the_motor_after_its_delay() -> None:
    made = problem()
    given = Command(jnp.full(mppi.HISTORY, 0.3), jnp.zeros(mppi.HISTORY))
    ticks = mppi.per_tick(made, given, resting(), mppi.STEP)
    late = float(CAR.motor.delay) / mppi.STEP
    assert late > 0
    np.testing.assert_allclose(ticks.throttle[: int(late)], 0.3, atol=1e-6)
    np.testing.assert_allclose(ticks.throttle[math.ceil(late) :], 0.0, atol=1e-6)


def test_free_walls_have_no_line_to_plan_along(tmp_path) -> None:
    (tmp_path / "w.toml").write_text("walls_m = [[[0, 0], [4, 0]]]\n")
    with pytest.raises(InputError, match="no centre line"):
        Mppi(load_course(str(tmp_path / "w.toml")), CAR)


def test_it_laps_the_box_in_a_drift() -> None:
    course = load_course("box")
    pilot = Pilot.of(Mppi(course, CAR, samples=512), course, CAR, "truth")
    simulator, task = Simulator.of(course, CAR, seed=3), Task.of(course)
    score = task.init()
    for record in simulator.run(pilot, 8.0):
        rows = np.nonzero(record.tick % 5 == 0)[0]
        score, _ = task.follow(score, samples(record, rows, 0.001))
        if score.outcome != Outcome.DRIVING.code:
            break
    assert Outcome.of(score.outcome) == Outcome.REACHED
    assert score.wall_contacts == 0
    assert score.goal_time < 5.0
    assert np.sum(score.turns.peak_sideslip > math.radians(25)) >= 2


def test_a_car_with_its_nose_to_a_wall_backs_off() -> None:
    course = load_course("box")
    front = float(CAR.body.center + CAR.body.length / 2)
    start = (1.5, 0.7 - 0.04 - front, math.pi / 2)  # 4 cm from the left wall of the first straight
    pilot = Pilot.of(Mppi(course, CAR), course, CAR, "truth")
    record = Simulator.of(course, CAR, start=start).record(pilot, 3.0)
    assert np.min(record.motion.vx) < -0.1
    assert np.hypot(record.motion.x[-1] - start[0], record.motion.y[-1] - start[1]) > 1.5
    assert np.max(record.wall_contacts) == 0


def test_changes_of_a_plan_stay_within_its_limits_and_the_first_is_the_plan() -> None:
    own = problem()
    plan = Command(jnp.linspace(-1.0, 1.0, 60), jnp.linspace(0.4, -0.4, 60))
    drawn = optimum.changed(own, jax.random.key(1), plan, 256)
    for line, lines, limit in zip(plan, drawn, (1.0, float(own.lock)), strict=True):
        assert np.allclose(lines[0], line, atol=1e-6)
        assert np.all(np.abs(lines) <= limit + 1e-6)
        assert np.mean(np.any(np.abs(lines - line) > 1e-3, axis=1)) > 0.5
    # Some change throttle and steering apart.
    moved = [np.any(np.abs(b - a) > 1e-6, axis=1) for a, b in zip(plan, drawn, strict=True)]
    assert np.any(moved[0] & ~moved[1])
    assert np.any(moved[1] & ~moved[0])


def test_a_plan_may_hold_a_command_throughout() -> None:
    own = problem()
    drawn = mppi.draw(own, jax.random.key(0), resting(), 64)
    held = np.asarray(mppi.HELD)
    assert np.allclose(drawn.throttle[-len(held) :], held[:, :1])
    assert np.allclose(drawn.steering[-len(held) :], own.lock * held[:, 1:])
    assert np.allclose(drawn.throttle[0], 0.0)
