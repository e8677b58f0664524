"""Tables of values: grids, their interpolation, the solution, files and the page of a league."""

import dataclasses
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from countersteer import cli
from countersteer.batch import evaluate
from countersteer.batch.margin import Margin
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers import registry, stored, tabular
from countersteer.drivers.grid import Dimension, Grid, Table
from countersteer.errors import InputError
from countersteer.learning import online
from countersteer.learning import tabular as learning
from countersteer.learning.tabular import ARRIVED, FAILED, Job, Poses, Solver, Transitions
from countersteer.task.judge import Outcome, Task

BOX, RX7 = load_course("box"), load_car("rx7")
GRID = Grid(
    (
        Dimension("place_m", 0.0, 3.0, 4, wraps=True),
        Dimension("offset_m", -0.6, 0.6, 3),
        Dimension("heading_deg", -1.0, 1.0, 5),
    )
)


def test_a_simplex_has_weights_that_sum_to_1_and_reproduces_linear_functions():
    rng = np.random.default_rng(0)
    names = ("offset_m", "heading_deg", "vx_mps")
    grid = Grid(tuple(Dimension(n, -1.0, 1.0, k) for n, k in zip(names, (3, 4, 6), strict=True)))
    at = {d.word: jnp.asarray(rng.uniform(-1, 1, 50), jnp.float32) for d in grid.dimensions}
    at["offset"] = at["heading"]  # parts that are equal have an order too
    corners, weights = grid.simplex(*grid.locate(at))
    assert len(corners) == len(weights) == 4
    assert np.all(np.array(weights) >= -1e-6)
    np.testing.assert_allclose(np.sum(weights, axis=0), 1.0, atol=1e-6)
    nodes = grid.nodes()
    plane = 3.0 + nodes["offset"] - 2 * nodes["heading"] + 0.5 * nodes["vx"]
    found = sum(w * plane[np.asarray(c)] for c, w in zip(corners, weights, strict=True))
    told = 3.0 + at["offset"] - 2 * at["heading"] + 0.5 * at["vx"]
    np.testing.assert_allclose(found, told, atol=2e-3)


def test_a_dimension_wraps_and_others_end_at_their_ranges():
    at = {"place": jnp.float32(3.5), "offset": jnp.float32(0.9), "heading": jnp.float32(0.0)}
    base, parts = GRID.locate(at)
    assert int(base) == 0 * 15 + 1 * 5 + 2
    np.testing.assert_allclose(parts, [0.5, 1.0, 0.0], atol=1e-3)
    assert not bool(GRID.inside(at))
    assert bool(GRID.inside(at | {"offset": jnp.float32(0.6)}))
    # The last point is the first again.
    assert int(online.nearest(GRID, at | {"place": jnp.float32(2.9)})) == 2 * 5 + 2
    values = np.arange(2 * GRID.size, dtype=float).reshape(2, -1)
    table = online.unwrapped(GRID, values).reshape(2, *GRID.shape)
    np.testing.assert_array_equal(table[:, 3], table[:, 0])


def test_a_course_knows_its_repeated_part():
    assert tabular.repeats(BOX) == 4
    assert tabular.repeats(load_course("ess")) == 1
    table = learning.dimensions_of(["place_m=0.5", "offset_m=0.3", "heading_deg=-90:90:45",
                                    "speed_mps=0:2:1"], BOX)  # fmt: skip
    place, offset, heading = table.pose.dimensions
    assert (place.high, place.wraps, heading.wraps) == (pytest.approx(3.0), True, False)
    assert offset.low == -offset.high == pytest.approx(-0.6)
    assert heading.high == pytest.approx(math.pi / 2)
    assert table.size == 7 * 5 * 5 * 3


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["speed=1"], "give one of x_m, y_m"),
        (["speed_mps=fast"], "write speed_mps=STEP or speed_mps=LOW:HIGH:STEP"),
        (["speed_mps=2:1:1"], "needs LOW < HIGH"),
        (["speed_mps=0:2:0.001"], "2001 points, over 200"),
        (["x_m=0.1", "offset_m=0.1", "heading_deg=10", "speed_mps=1"], "a pose is place, offset"),
        (["place_m=1", "offset_m=1", "heading_deg=90", "vy_mps=1"], "either vx or speed"),
        (["place_m=0:2:1", "offset_m=1", "heading_deg=90", "speed_mps=1"], "write place_m=STEP"),
        (["place_m=0.1", "offset_m=0.01", "heading_deg=3", "vx_mps=0.1", "vy_mps=0.1"], "million"),
    ],
)
def test_wrong_dimensions_are_refused_in_one_line(words, says):
    with pytest.raises(InputError, match=says) as caught:
        learning.dimensions_of(words, BOX)
    assert "\n" not in str(caught.value)


def test_a_pose_of_the_grid_is_seen_where_it_is():
    frame = tabular.frame_of(BOX)
    at = {"place": jnp.float32(7.3), "offset": jnp.float32(-0.2), "heading": jnp.float32(0.4)}
    seen = frame.seen(frame.pose(at), at["place"] + 0.1)
    for word, value in at.items():
        assert float(seen[word]) == pytest.approx(float(value), abs=0.02)


def small_job(weights=learning.WEIGHTS) -> Job:
    """Two motions and two actions on the grid of three dimensions."""
    motion = Grid((Dimension("speed_mps", 0.0, 1.0, 2),))
    return Job(BOX, "rx7", RX7, Table(GRID, motion), (0.0, 1.0), (0.0,), 0.1, 1.0, weights, 0.03)


def chain(job: Job) -> tuple[Transitions, Poses]:
    """From each pose to the next one; the last arrives. Action 0 stays, and fails at motion 1."""
    size, count = job.table.pose.size, job.table.motion.size
    pose = np.zeros((count, 2, size), np.int32)
    pose[:, 0], pose[:, 1] = np.arange(size), np.arange(size) + 1
    pose[1, 0] = FAILED
    pose[:, 1, -1] = ARRIVED
    motions = np.zeros((count, 2, 2), np.int32)
    motions[..., 1] = 1
    table = Transitions(
        motions,
        np.tile(np.float32([0.25, 0.75]), (count, 2, 1)),
        pose,
        np.zeros((count, 2, 3, size), np.uint8),
        np.zeros((count, 2, size), np.float16),
    )
    nothing = jnp.zeros(size)
    return table, Poses(nothing, nothing, nothing, nothing, jnp.zeros(size, bool))


def test_the_solution_of_a_chain_is_the_discounted_goal():
    job = small_job()
    table, poses = chain(job)
    found = Solver(job, table, poses, 1).solve()
    left = np.arange(job.table.pose.size)[::-1]
    # The motion behind does not matter, as both go on alike.
    told = job.weights.goal * job.discount**left
    np.testing.assert_allclose(found.values, np.tile(told, (2, 1)), atol=0.3)
    near = left < 20  # where the values have settled
    np.testing.assert_allclose(found.values[:, near], np.tile(told[near], (2, 1)), rtol=1e-5)
    assert np.all(found.best == 1)
    assert found.curve[-1]["change"] < learning.SETTLED <= found.curve[-2]["change"]


def test_a_failure_counts_and_so_does_time():
    job = small_job(learning.WEIGHTS._replace(goal=-30.0, time=-1.0))
    table, poses = chain(job)
    touches = jnp.zeros(job.table.pose.size, bool).at[3].set(True)
    found = Solver(job, table, poses._replace(touches=touches), 1).solve()
    # The same by plain value iteration over the poses before the touch.
    values = np.full((2, 4), -10.0)
    for _ in range(200):
        onward = -0.1 + job.discount * (np.array([0.25, 0.75]) @ values)
        moves = onward[1:]
        values[:, :3] = np.maximum(moves, [onward[:3], np.full(3, -0.1 - 10.0)])
    assert found.values[:, :4] == pytest.approx(values, abs=0.1)
    assert np.all(found.best[0, :2] == 0)  # to stand is best, though it may fail
    assert found.values[:, 3] == pytest.approx(-10.0)


def test_a_car_touches_where_its_rectangle_is_in_a_wall():
    table = learning.dimensions_of(["place_m=1", "offset_m=0.6", "heading_deg=-90:90:90",
                                    "speed_mps=0:2:1"], BOX)  # fmt: skip
    job = Job(BOX, "rx7", RX7, table, (0.0,), (0.0,), 0.1, 1.0, learning.WEIGHTS, 0.0)
    touch = learning.touching(job, tabular.frame_of(BOX))

    def at(place, offset, heading):
        values = {"place": place, "offset": offset, "heading": heading}
        return bool(touch.at({k: jnp.float32(v) for k, v in values.items()}))

    assert not at(1.5, 0.0, 0.0)
    assert not at(1.5, 0.55, 0.0)  # a hand's breadth from the wall, along it
    assert at(1.5, 0.6, math.pi / 2)  # and across


def test_the_margin_is_the_distance_of_rectangle_and_walls():
    rng = np.random.default_rng(2)
    walls = shapely.multilinestrings(shapely.linestrings(BOX.walls.reshape(-1, 2, 2)))
    margin = Margin.of(BOX)
    body = RX7.body
    motion = tabular.planar.initial_state(RX7, 0.001).motion
    clear = jax.jit(lambda x, y, h: margin.clear(body, motion._replace(x=x, y=y, heading=h)))
    compared = 0
    for x, y, heading in rng.uniform([-1, -4, -4], [4, 1, 4], (60, 3)):
        ahead, left = float(body.length) / 2, float(body.width) / 2
        ring = np.array([(ahead, left), (ahead, -left), (-ahead, -left), (-ahead, left)])
        ring = ring + np.array([float(body.center), 0.0])
        turn = np.array([[math.cos(heading), math.sin(heading)],
                         [-math.sin(heading), math.cos(heading)]])  # fmt: skip
        told = shapely.distance(shapely.Polygon(ring @ turn + [x, y]), walls)
        if told > 0:
            assert float(clear(x, y, heading)) == pytest.approx(told, abs=1e-5)
            compared += 1
    assert compared > 20


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """The file of a table that promises more further on."""
    job = small_job()
    values = np.tile(GRID.nodes()["place"].astype(np.float32), (2, 1))
    path = tmp_path / "mine.npz"
    cost = {"samples": 4.0, "cpu_s": 1.5}
    path.write_bytes(learning.policy_file(job, values, {"method": "by hand"}, cost))
    return path


def test_a_policy_says_what_it_is_for_and_cost(policy):
    arrays, about, table = tabular.read_table(policy)
    assert table == small_job().table
    assert about["learned_with"]["method"] == "by hand"
    np.testing.assert_allclose(arrays["values"][0], GRID.nodes()["place"], atol=learning.KEPT)
    assert registry.learned_at({"kind": "tabular", "file": str(policy)}) == {
        "samples": 4.0,
        "cpu_s": 1.5,
    }
    assert registry.learned_at({"kind": "straighten"}) == {}
    driver = registry.learned("tabular", policy, BOX, RX7)
    assert driver.decision == pytest.approx(0.1)


def test_a_policy_is_refused_elsewhere_in_one_line(policy, capsys):
    words = ["--driver", str(policy), "--estimate", "truth"]
    assert cli.main(["drive", "ess", *words]) == 2
    assert "was learned for the course 'box'" in capsys.readouterr().err
    assert cli.main(["drive", "box", *words, "--speed-mps", "2"]) == 2
    assert "has its own speed" in capsys.readouterr().err
    assert cli.main(["drive", "ess", "--driver", "tabular"]) == 2
    assert "learn tabular ess --out" in capsys.readouterr().err


def change(path: Path, **parts) -> None:
    """Write the policy anew with parts of its `about` or arrays changed."""
    with np.load(path) as file:
        held = dict(file)
    about = json.loads(held.pop("about").tobytes().decode())
    for key, value in parts.items():
        (held if isinstance(value, np.ndarray) else about)[key] = value
    path.write_bytes(stored.packed(held, about))


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        ({"format": 99}, "is of another version"),
        ({"pose": [["place_m", 0.0, 3.0, 4, True]]}, "a pose is place, offset, heading or"),
        ({"pose": "no list"}, "pose is no grid"),
        ({"motion": [["speed_mps", 1.0, 0.0, 2, False]]}, "motion is no grid"),
        ({"motion": [["speed_mps", 0.0, 1e999, 2, False]]}, "motion is no grid"),
        ({"motion": [["speed_mps", 0.0, 1.0, 3, False]]}, "values is missing, or does not fit"),
        ({"decision_s": 0.0}, "decision_s must be in"),
        ({"reward": {}}, "reward must hold the numbers"),
        ({"values": np.full((2, GRID.size), np.nan)}, "not finite"),
        ({"kind": "ppo"}, "is no policy of 'learn tabular'"),
    ],
)
def test_a_damaged_policy_is_refused_in_one_line(policy, parts, says):
    change(policy, **parts)
    with pytest.raises(InputError, match=says) as caught:
        tabular.read_table(policy)
    assert "\n" not in str(caught.value)


def test_a_file_with_wrong_bytes_is_refused_in_one_line(policy):
    whole, rng = policy.read_bytes(), np.random.default_rng(3)
    messages = []
    for _ in range(60):
        part = bytearray(whole)
        for at in rng.integers(0, len(part), 3):
            part[at] = rng.integers(256)
        policy.write_bytes(bytes(part[: rng.integers(1, len(part) + 1)]))
        try:
            tabular.read_table(policy)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > 50
    assert not any("\n" in message for message in messages)


def test_a_file_that_unpacks_to_too_much_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "LARGEST", 100_000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, about=np.zeros(200_000, np.uint8))
    assert path.stat().st_size < 2_000
    with pytest.raises(InputError, match="which no policy is"):
        stored.about_of(path)


def judged(trials: evaluate.Trials):
    """Scores as of a run: every third trial touches a wall."""
    count = len(trials.seeds)
    score = jax.tree.map(
        lambda leaf: np.broadcast_to(np.asarray(leaf), (count, *np.shape(leaf))).copy(),
        Task.of(trials.course, 1, dtype=np.float32).init(),
    )
    codes = (Outcome.TOUCHED.code, Outcome.REACHED.code, Outcome.REACHED.code)
    turns = score.turns._replace(
        begin=np.zeros_like(score.turns.begin), peak_sideslip=np.full_like(score.turns.begin, 0.4)
    )
    return score._replace(
        outcome=np.array(codes)[np.arange(count) % 3],
        goal_time=np.linspace(5, 6, count, dtype=np.float32),
        turns=turns,
    ), np.full(count, 0.07, np.float32)


def test_a_league_has_a_row_for_each_driver_and_estimate(monkeypatch, tmp_path, policy, capsys):
    def run(self, make, *_):
        make(None)
        return judged(self)

    monkeypatch.setattr(evaluate.Trials, "run_watched", run)
    words = ["evaluate", "box", "--driver", "straighten", str(policy), "mppi", "--json"]
    more = ["--estimate", "truth", "pose", "--trials", "6", "--slow-trials", "3", "--seed", "5"]
    assert cli.main([*words, *more, "--out", str(tmp_path / "league")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["estimate"] == ["truth", "pose"]
    assert list(told["drivers"]) == [
        f"{name}, {estimate}"
        for name in ("straighten", str(policy), "mppi")
        for estimate in ("truth", "pose")
    ]
    mine, slow = told["drivers"][f"{policy}, pose"], told["drivers"]["mppi, truth"]
    assert (mine["trials"], slow["trials"]) == (6, 3)
    assert mine["learned_at"] == {"samples": 4.0, "cpu_s": 1.5}
    assert mine["wall_margin_m_median"] == pytest.approx(0.07)
    page = (tmp_path / "league" / "evaluate.html").read_text()
    for one in told["drivers"].values():
        cli.parser().parse_args(one["command"].split()[1:])
        assert one["command"] in page
    assert "3 trials" in page
    assert page.count("<tr>") == 7


def test_the_stored_policy_is_for_the_box_and_its_car():
    path = stored.policy_for("tabular", BOX, RX7)
    arrays, about, table = tabular.read_table(path)
    assert arrays["values"].shape == (table.motion.size, table.pose.size)
    assert about["cost"]["cpu_s"] < 600
    other = dataclasses.replace(RX7, body=dataclasses.replace(RX7.body, mass=3.0))
    with pytest.raises(InputError, match="no policy is stored"):
        stored.policy_for("tabular", BOX, other)
