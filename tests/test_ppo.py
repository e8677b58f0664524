"""PPO: its parts against plain loops, tiny environments whose values are known, and a restart."""

import dataclasses
import itertools
import json
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("optax", reason="optax is not installed")

from countersteer import cli
from countersteer.batch import engine
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.car.parameter import pytree
from countersteer.course.files import load_course
from countersteer.drivers import ppo as network
from countersteer.drivers.ppo import FEATURES, Layer, read_network
from countersteer.drivers.stored import fingerprint
from countersteer.envs.functional import owns
from countersteer.errors import InputError
from countersteer.learning import checkpoint, ppo
from countersteer.learning.ppo import Job, Met, Settings, Trainer, advantages
from countersteer.task.judge import Outcome
from countersteer.task.reward import DRIFTING, Reward, weights_of


class Turned(NamedTuple):
    peak_sideslip: Any


class Judged(NamedTuple):
    time: Any
    outcome: Any
    goal_time: Any
    turns: Turned


class TinyLane(NamedTuple):
    at: Any
    rolling: Any
    score: Judged


@pytree
class Tiny:
    """One number moves by 0 or 1; `prize` is paid each decision, less the square of an error."""

    prize: Any
    wanted: Any  # action that costs nothing
    ends_after: Any  # decisions; inf: never
    ticks: int = dataclasses.field(default=1, metadata={"static": True})

    def reset(self, own, key, tick):
        del key, tick
        zero = jnp.zeros_like(own)
        score = Judged(zero, jnp.int32(0), zero + jnp.inf, Turned(jnp.zeros(1)))
        lane = TinyLane(zero, zero, score)
        return lane, self.observe(lane)

    def observe(self, lane):
        del lane
        return jnp.zeros(FEATURES)  # only the critic is told how far it has come

    def judged(self, lane):
        return lane.at[None] / 10

    def step(self, lane, action, tick):
        del tick
        at = lane.at + 1
        ended = jnp.where(at >= self.ends_after, 1.0, 0.0)
        outcome = jnp.where(ended > 0, Outcome.REACHED.code, Outcome.DRIVING.code)
        score = lane.score._replace(time=at, outcome=outcome.astype(jnp.int32))
        paid = self.prize - jnp.sum((action - self.wanted) ** 2)
        terms = Reward(*[0.0 * paid] * (len(Reward._fields) - 1), paid)
        after = lane._replace(at=at, score=score)
        return after, self.observe(after), terms, ended

    def renewed(self, lane, done, even, tick):
        new, _ = self.reset(lane.rolling, None, tick)
        del even
        return jax.tree.map(
            lambda a, b: jnp.where(done > 0, jnp.asarray(a, jnp.result_type(b)), b), new, lane
        )


def tiny(iterations: int, longest: float, **environment: float) -> tuple[Trainer, Any]:
    made = Tiny(**jax.tree.map(np.float32, environment))
    settings = Settings(
        lanes=64,
        steps=8,
        epochs=4,
        batches=4,
        rate=3e-3,
        discount=0.9,
        longest=longest,
        entropy=0.0,
    )
    trainer = Trainer(made, settings, iterations, 1, np.zeros((64, 0), np.float32))
    state = trainer.begin(jnp.zeros(64), 0)
    for _ in range(iterations):
        state, _ = trainer.iterate(state)
    return trainer, jax.tree.map(np.asarray, state)


def value(state: Any, at: float) -> float:
    return float(ppo.worth(state.policy, jnp.zeros(FEATURES), jnp.array([at / 10])))


def test_a_limit_of_time_is_no_end():
    """A prize of 1 for ever is worth 1 / (1 - discount) = 10, though lanes are stopped early."""
    _, state = tiny(150, longest=7.0, prize=1.0, wanted=0.0, ends_after=np.inf)
    noise = 2 * np.mean(np.exp(2 * state.policy.log_scatter))  # what the actions' scatter costs
    for at in (0.0, 3.0, 6.0):
        assert value(state, at) == pytest.approx((1 - noise) / (1 - 0.9), rel=0.12)


def test_an_end_is_an_end():
    """With the end after 5 decisions, the prizes left are worth sums of powers of the discount."""
    _, state = tiny(150, longest=np.inf, prize=1.0, wanted=0.0, ends_after=5.0)
    noise = 2 * np.mean(np.exp(2 * state.policy.log_scatter))
    for at in range(5):
        left = sum(0.9**k for k in range(5 - at)) * (1 - noise)
        assert value(state, at) == pytest.approx(left, abs=0.35)


def test_the_best_action_is_found():
    trainer, state = tiny(150, longest=7.0, prize=0.0, wanted=0.6, ends_after=np.inf)
    for layers in (state.policy.actor, state.mean.actor):
        out = np.asarray(network.network(layers, jnp.zeros(FEATURES)))
        np.testing.assert_allclose(out, 0.6, atol=0.08)
    # Any scatter costs here, so it falls as far as it may.
    assert trainer.settings.scatter < ppo.BEGIN_SCATTER
    scatter = np.exp(state.policy.log_scatter)
    np.testing.assert_allclose(scatter, trainer.settings.scatter, rtol=1e-5)


def test_the_critics_errors_do_not_slow_the_actor():
    trainer, state = tiny(1, longest=7.0, prize=0.0, wanted=0.0, ends_after=np.inf)
    slope = jax.tree.map(np.ones_like, state.policy)
    steep = slope._replace(critic=jax.tree.map(lambda leaf: 1e4 * leaf, slope.critic))
    changes = [
        trainer.optimiser.update(one, trainer.optimiser.init(state.policy), state.policy)[0]
        for one in (slope, steep)
    ]
    for one, other in zip(*(jax.tree.leaves(change.actor) for change in changes), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_critic_is_told_what_differs_among_cars():
    own, _ = owns(load_population("around"), load_car("rx7"), load_course("box"), range(50))
    told = ppo.numbers_of(own)
    assert told.shape[0] == 50
    assert told.shape[1] > 10
    np.testing.assert_allclose(told.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(told.std(axis=0), 1, atol=1e-5)
    friction = np.asarray(own.car.tires.rear.friction)
    assert np.abs(np.corrcoef(friction, told, rowvar=False)[0, 1:]).max() > 0.999


def test_of_cars_that_are_all_alike_the_critic_is_told_nothing():
    own, _ = owns(load_population("around"), load_car("rx7"), load_course("box"), [7] * 4)
    assert ppo.numbers_of(own).shape == (4, 0)


def test_numbers_of_a_block_come_back_as_they_were():
    """Also keys, of which a number of 32 bits would not hold the last digits."""
    rng = np.random.default_rng(0)
    block = {
        "key": rng.integers(2**32, size=(8, 2), dtype=np.uint32),
        "speed": rng.normal(size=8).astype(np.float32),
        "line": rng.normal(size=(8, 3, 2)).astype(np.float32),
    }
    arrays = engine.packed(block)
    assert [array.shape for array in arrays] == [(7, 8), (2, 8)]
    jax.tree.map(np.testing.assert_array_equal, engine.unpacking(block)(arrays), block)


def test_what_is_alike_among_lanes_is_one_number_and_comes_back():
    lanes = {
        "alike": np.full(5, 2.5, np.float32),
        "differs": np.arange(5.0),
        "line": np.tile(np.arange(3), (5, 1)),
    }
    apart, once = engine.parted(lanes)
    assert apart["alike"] is apart["line"] is once["differs"] is None
    assert once["alike"] == np.float32(2.5)
    for lane in range(5):
        own = jax.tree.map(lambda leaf, at=lane: leaf[at], apart)
        expected = jax.tree.map(lambda leaf, at=lane: leaf[at], lanes)
        jax.tree.map(np.testing.assert_array_equal, engine.joined(own, once), expected)


def test_no_two_decisions_draw_the_same_noise():
    trainer, state = tiny(1, longest=7.0, prize=0.0, wanted=0.0, ends_after=np.inf)
    noises = []
    for iteration in range(4):
        _, met, *_ = trainer._drive(
            (state.lanes, state.keys, trainer.cars),
            state.policy,
            trainer.environment,
            0,
            np.int32(iteration),
        )
        mean = network.network(state.policy.actor, met.seen)
        noises.append(np.asarray((met.action - mean) / np.exp(state.policy.log_scatter)))
    drawn = np.round(np.stack(noises)[..., 0].ravel(), 4)
    lanes_steps = 64 * trainer.settings.steps
    assert drawn.size == 4 * lanes_steps
    # Rounded normal numbers meet by chance now and then; one in two did when draws were shared.
    assert len(np.unique(drawn)) > 0.9 * drawn.size


def test_advantages_are_those_of_a_plain_loop():
    rng = np.random.default_rng(0)
    reward, values = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    ended, last = rng.uniform(size=(7, 3)) < 0.3, rng.normal(size=3)
    none = jnp.zeros((7, 3))
    met = Met(
        none, none, none, none, jnp.asarray(values), jnp.asarray(reward), jnp.asarray(ended, float)
    )
    found, goal = advantages(met, jnp.asarray(last), 0.95, 0.9)
    expected, running = np.zeros((7, 3)), np.zeros(3)
    for k in reversed(range(7)):
        after = last if k == 6 else values[k + 1]
        error = reward[k] + 0.95 * ~ended[k] * after - values[k]
        running = error + 0.95 * 0.9 * ~ended[k] * running
        expected[k] = running
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(goal, expected + values, atol=1e-5)


SMALL = Settings(lanes=16, steps=4, epochs=2, batches=2)


def job(samples: int = 64 * 20) -> Job:
    return Job(
        load_course("box"),
        "rx7",
        load_car("rx7"),
        "around",
        load_population("around"),
        DRIFTING,
        3,
        samples,
    )


def test_a_training_that_is_stopped_goes_on_to_the_same_curve(tmp_path):
    whole, cut = tmp_path / "whole.npz", tmp_path / "cut.npz"
    curve = ppo.train(job(), whole, 1, settings=SMALL)

    class KilledError(Exception):
        pass

    def kill(_):
        raise KilledError

    with pytest.raises(KilledError):
        ppo.train(job(), cut, 1, kill, settings=SMALL)
    assert cut.with_suffix(".checkpoint.npz").exists()
    assert not cut.exists()
    resumed = ppo.train(job(), cut, 1, settings=SMALL)
    assert not cut.with_suffix(".checkpoint.npz").exists()
    clocks = ("cpu_s", "samples_per_s", "left_s")
    assert len(curve) == len(resumed) == 2
    for one, other in zip(curve, resumed, strict=True):
        for name in set(one) - set(clocks):
            np.testing.assert_equal(one[name], other[name], err_msg=name)
    for a, b in zip(read_network(whole)[0], read_network(cut)[0], strict=True):
        np.testing.assert_array_equal(a.weight, b.weight)
    for suffix in (".csv", ".png"):
        assert cut.with_suffix(suffix).stat().st_size > 100
    # A checkpoint of another job is refused.
    with pytest.raises(KilledError):
        ppo.train(job(), tmp_path / "again.npz", 1, kill, settings=SMALL)
    other = job()._replace(seed=4)
    with pytest.raises(InputError, match="is of a training with seed 3, not 4"):
        ppo.train(other, tmp_path / "again.npz", 1, settings=SMALL)


def test_a_policy_drives_in_the_simulator_and_is_refused_elsewhere(tmp_path, capsys):
    rng = np.random.default_rng(1)
    sizes = (FEATURES, 8, 2)
    layers = tuple(
        Layer(rng.normal(0, 0.05, (a, b)).astype(np.float32), np.zeros(b, np.float32))
        for a, b in itertools.pairwise(sizes)
    )
    about = {"course": "box", "car": "rx7", "task": "lap",
             "fingerprint": fingerprint(load_course("box"), load_car("rx7"))}  # fmt: skip
    path = tmp_path / "mine.npz"
    path.write_bytes(network.network_file(layers, about))
    words = ["--driver", str(path), "--estimate", "truth", "--json"]
    assert cli.main(["drive", "box", *words, "--out", str(tmp_path / "run")]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["outcome"] != "lost its state"
    assert cli.main(["drive", "ess", *words]) == 2
    assert "was learned for the course 'box'" in capsys.readouterr().err
    assert cli.main(["drive", "box", *words, "--car", "jetracer-tape"]) == 2
    assert "was learned for the car 'rx7'" in capsys.readouterr().err
    assert cli.main(["drive", "straight", "--driver", "ppo"]) == 2
    assert "learn ppo straight" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda held: held.pop("bias_1"), "its last layer has 4 outputs"),
        (lambda held: held.update(weight_1=np.zeros((3, 2), np.float32)), "does not fit"),
        (lambda held: held.update(weight_0=held["weight_0"] * np.nan), "not finite"),
        (lambda held: held.update(about=np.zeros(3, np.uint8)), "is no policy"),
        (lambda held: held.update(weight_0=np.array([{}], object)), "is no policy"),
    ],
)
def test_a_damaged_policy_is_refused_in_one_line(tmp_path, change, says):
    layers = (
        Layer(np.zeros((FEATURES, 4), np.float32), np.zeros(4, np.float32)),
        Layer(np.zeros((4, 2), np.float32), np.zeros(2, np.float32)),
    )
    path = tmp_path / "p.npz"
    path.write_bytes(network.network_file(layers, {"course": "box"}))
    with np.load(path) as file:
        held = dict(file)
    change(held)
    np.savez(path, allow_pickle=True, **held)
    with pytest.raises(InputError, match=says) as caught:
        read_network(path)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_that_is_none_is_refused(tmp_path):
    path = tmp_path / "c.npz"
    path.write_bytes(b"PK not a zip")
    with pytest.raises(InputError, match="is no checkpoint"):
        checkpoint.load(path, {}, (np.zeros(2),))


def test_the_weights_of_the_reward_are_read():
    assert weights_of(["sideslip=5"], DRIFTING).sideslip == 5.0
    with pytest.raises(InputError, match="there is no term 'slip'"):
        weights_of(["slip=5"], DRIFTING)
    with pytest.raises(InputError, match="is not a number"):
        weights_of(["sideslip=much"], DRIFTING)
