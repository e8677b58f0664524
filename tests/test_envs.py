"""The environments: Gymnasium's contract, and that they are the simulator."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.ppo import FEATURES
from countersteer.signals import Command
from countersteer.task.judge import STALLED, Outcome
from countersteer.task.reward import DRIFTING, PAPER, Reward, reward

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")

from countersteer import envs  # noqa: E402  # it needs gymnasium
from countersteer.envs.functional import Environment, Own, owns  # noqa: E402  # after the skip
from countersteer.envs.single import DriftEnv  # noqa: E402  # after the skip
from countersteer.envs.vector import DriftVectorEnv  # noqa: E402  # after the skip
from countersteer.world import planar  # noqa: E402  # after the skip

CARS = load_population("around")


@pytest.fixture(scope="module")
def env():
    made = DriftEnv("box")
    yield made
    made.close()


def test_registering_imports_no_jax_and_finds_every_course():
    code = (
        "import countersteer.envs, gymnasium, sys; "
        "names = [n for n in gymnasium.registry if 'Countersteer' in n]; "
        "assert 'jax' not in sys.modules; print(*names)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert {f"Countersteer-{name}-lap-v0" for name in envs.courses()} == set(done.stdout.split())
    assert "Countersteer-box-lap-v0" in done.stdout


@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes")
@pytest.mark.parametrize("observation", ["state", "sensors"])
def test_gymnasiums_checker_passes(observation):
    from gymnasium.utils.env_checker import check_env

    made = DriftEnv("box", observation=observation, render_mode="rgb_array")
    check_env(made)
    assert made.render().shape == (400, 400, 3)
    made.close()


def test_a_seed_repeats_an_episode_exactly_and_another_differs(env):
    def episode(seed):
        first, _ = env.reset(seed=seed)
        return np.array([first, *(env.step(np.array([0.4, -0.1]))[0] for _ in range(20))])

    np.testing.assert_array_equal(episode(5), episode(5))
    assert np.any(episode(5) != episode(6))


def test_throttle_comes_first_and_steering_is_positive_to_the_left(env):
    env.reset(seed=1)
    for _ in range(40):
        seen, *_ = env.step(np.array([0.3, 0.8]))
    assert seen[0] > 0.05  # forward
    assert seen[2] > 0.02  # yaw rate, to the left


def test_a_touch_terminates_and_time_truncates(env):
    env.reset(seed=2)
    for _ in range(400):
        _, _, terminated, truncated, info = env.step(np.array([0.6, 0.0]))
        if terminated:
            break
    assert terminated
    assert not truncated
    assert info["outcome"] == Outcome.TOUCHED.value
    assert info["terms"]["road"] == pytest.approx(DRIFTING.road)
    short = DriftEnv("box", longest=0.1)
    short.reset(seed=2)
    ends = [short.step(np.zeros(2))[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]


def test_sensors_are_seen_by_their_channels():
    made = DriftEnv("box", observation="sensors")
    seen, _ = made.reset(seed=4)
    assert len(made.observation_names) == len(seen)
    for _ in range(30):
        seen, *_ = made.step(np.array([0.4, 0.0]))
    told = dict(zip(made.observation_names, seen, strict=True))
    assert 0.1 < told["sonar_left_m"] < 1.4
    assert told["wheel_speed_mps"] > 0.1
    assert told["throttle_1_ago"] == pytest.approx(0.4)


def test_the_functional_environment_is_the_simulator():
    """The same nominal car and commands, in 64 bits: the same motion, rewards and end."""
    with jax.enable_x64(True):
        car, course = load_car("rx7"), load_course("box")
        slots = planar.delay_slots(car, 0.001)
        made = Environment.of(course, car, DRIFTING, slots, dtype=np.float64)
        own = Own(car, None, jnp.float64(1.0), jnp.asarray(course.start, jnp.float64))
        lane, seen = jax.jit(made.reset)(own, jax.random.key(0), 0)
        env = DriftEnv("box", cars=None)
        first, _ = env.reset(seed=0)
        np.testing.assert_allclose(np.asarray(seen), first, atol=1e-6)
        step = jax.jit(made.step)
        for k in range(90):
            action = np.array([0.5, -0.9 if k > 45 else 0.05 * np.sin(k)])
            lane, seen, terms, ended = step(lane, action, k * made.ticks)
            theirs, reward, terminated, _, _ = env.step(action)
            np.testing.assert_allclose(np.asarray(seen), theirs, atol=2e-5)
            assert float(terms.total) == pytest.approx(reward, abs=1e-5)
            assert bool(ended) == terminated
            if terminated:
                break
        assert k > 50


def test_what_the_critic_is_told_of_the_judge_is_what_the_reward_depends_on():
    car, course = load_car("rx7"), load_course("box")
    made = Environment.of(course, car, DRIFTING, planar.delay_slots(car, 0.001))
    own = Own(car, None, jnp.float32(1.0), jnp.asarray(course.start, jnp.float32))
    lane, _ = made.reset(own, jax.random.key(0), 0)
    turns = lane.score.turns._replace(
        begin=jnp.array([1.0, 2.0, jnp.inf, jnp.inf]),
        peak_sideslip=jnp.radians(jnp.array([20.0, 40.0, 0.0, 0.0])),
        overshoot=jnp.array([0.1, 0.2, 0.0, 0.0]),
    )
    far = lane.score.furthest + 5
    score = lane.score._replace(furthest=far, turns=turns, time=3.0, furthest_at=2.0)
    none = Command(0.0, 0.0)
    terms = reward(DRIFTING, made.task, lane.score, score, none, none)
    before, after = (made.judged(lane._replace(score=one)) for one in (lane.score, score))
    assert before.shape == (3 + 5 * 4,)
    left, waited, reached = after[:3]
    gone = (float(before[0]) - left) / 4 * (course.lap_end(1) - course.start_distance)
    assert float(terms.progress) == pytest.approx(DRIFTING.progress * float(gone), rel=1e-5)
    assert float(waited) == pytest.approx(1 / STALLED)
    assert reached == 0
    begun, ended, slips, drifts, overshoots = np.asarray(after[3:]).reshape(5, 4)
    np.testing.assert_array_equal(begun, [1, 1, 0, 0])
    np.testing.assert_array_equal(ended, 0)
    assert float(terms.sideslip) == pytest.approx(DRIFTING.sideslip * np.sum(np.minimum(slips, 1)))
    assert float(terms.drift) == DRIFTING.drift * np.sum(drifts) == DRIFTING.drift
    assert float(terms.overshoot) == pytest.approx(DRIFTING.overshoot * np.sum(overshoots))


def test_the_terms_of_the_reward_add_up_to_what_the_judge_says():
    """A lap by keys is not needed: any drive's sums are those of its last score."""
    weights = Reward(*[1.0] * len(Reward._fields))
    env = DriftEnv("box", weights=weights)
    env.reset(seed=3)
    sums = dict.fromkeys(Reward._fields, 0.0)
    for k in range(300):
        *_, terminated, _, info = env.step(np.array([0.5, -0.8 if 40 < k < 70 else 0.0]))
        for name, term in info["terms"].items():
            sums[name] += term
        if terminated:
            break
    assert terminated
    assert sums["overshoot"] == pytest.approx(float(np.sum(info["overshoot"])))
    assert sums["sideslip"] == pytest.approx(
        float(np.sum(np.minimum(info["peak_sideslip"], np.radians(32)))) / np.radians(32)
    )
    assert sums["time"] == pytest.approx(0.02 * (k + 1))
    assert sums["road"] == 1.0
    assert PAPER.progress == PAPER.sideslip == 0.0  # the paper's reward knows time, road, goal


def test_the_vector_environment_steps_begins_again_and_repeats():
    made = DriftVectorEnv(12, longest=1.0)
    first, _ = made.reset(seed=9)
    assert first.shape == (12, FEATURES)
    ahead = np.tile(np.float32([0.9, 0.0]), (12, 1))
    ends, seen, rewards = [], [], []
    for _ in range(80):
        observed, reward, terminated, truncated, infos = made.step(ahead)
        assert not np.any(terminated & truncated)
        ends.append(terminated | truncated)
        seen.append(observed)
        rewards.append(reward)
    ended = np.array(ends)
    assert np.all(ended.any(axis=0))
    # The step after an end begins anew, and its action and reward count for nothing.
    for lane in range(12):
        at = int(np.argmax(ended[:, lane]))
        assert rewards[at + 1][lane] == 0.0
        assert not ended[at + 1, lane]
        np.testing.assert_allclose(seen[at + 1][lane], first[lane], atol=1e-5)
    assert set(Reward._fields) < set(infos)
    again, _ = made.reset(seed=9)
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(made.step(ahead)[0], seen[0])
    assert np.any(made.reset(seed=10)[0] != first)


@pytest.mark.parametrize("cores", [1, 3])
def test_the_number_of_threads_changes_no_car(cores):
    command = np.random.default_rng(2).uniform(-1, 1, (12, 2)).astype(np.float32)
    found = []
    for one in (cores, 2):
        made = DriftVectorEnv(12, cores=one)
        made.reset(seed=9)
        found.append([made.step(command) for _ in range(5)][-1][:2])
        made.close()
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_a_start_in_motion_is_on_the_course_and_rolls():
    course, car = load_course("box"), load_car("rx7")
    own, slots = owns(CARS, car, course, range(64))
    made = Environment.of(course, car, DRIFTING, slots, rolling=1.0)
    lanes, _ = jax.vmap(made.reset, (0, 0, None))(
        own, jax.random.split(jax.random.key(1), 64), jnp.int32(0)
    )
    m = lanes.state.motion
    within = (np.abs(m.x - 1.5) < 2.2) & (np.abs(m.y + 1.5) < 2.2)
    inside = (np.abs(m.x - 1.5) < 0.8) & (np.abs(m.y + 1.5) < 0.8)
    assert np.all(within & ~inside)
    assert np.ptp(m.vx) > 1.0
    assert np.all(np.asarray(lanes.score.distance) >= course.start_distance - 1e-3)
