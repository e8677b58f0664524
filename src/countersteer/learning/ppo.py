"""PPO: a network learns to drive a course, in the functional environment, on all cores.

An iteration drives all lanes for `steps` decisions, then takes `epochs` passes of Adam over what
they met. A lane that has driven for too long is stopped only between iterations. There the value
of where it stands is known, so a limit of time counts as no end. The learning rate falls to 0, and
the policy that is kept is a running mean of the last parameters: neighbouring ones differ much.
Actions never scatter less than `scatter`: where they hardly do, what a decision was worth is lost
in the noise of what follows, and a long training gets worse again.

The critic is only needed to learn. So it is told what the actor has to guess, the car of the lane,
and what else the reward depends on: how far the goal is, and what the turns have been paid. Without
that it expects to be paid for a slide again, and every arrival at the goal seems a loss.

Sources: J. Schulman et al., Proximal Policy Optimization Algorithms, arXiv:1707.06347, 2017, and
High-Dimensional Continuous Control Using Generalized Advantage Estimation, arXiv:1506.02438, 2015;
L. Pinto et al., Asymmetric Actor Critic for Image-Based Robot Learning, arXiv:1710.06542, 2017.
"""

import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import PartitionSpec

from countersteer.batch import engine, evaluate
from countersteer.batch.population import Population
from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.drivers.ppo import (
    FEATURES,
    PERIOD,
    Layer,
    network,
    network_driver,
    network_file,
    read_network,
)
from countersteer.drivers.stored import fingerprint
from countersteer.envs.functional import LONGEST, Environment, Lane, Own, owns
from countersteer.learning import checkpoint
from countersteer.learning.curves import save
from countersteer.signals import Array, Scalar
from countersteer.task.judge import DRIFT, Outcome
from countersteer.task.reward import Reward
from countersteer.writing import write_whole

UNITS = (64, 64)
BEGIN_SCATTER = 0.5  # standard deviation of the first actions, in full commands
CREEP = 0.3  # throttle of the first actions' mean


@dataclasses.dataclass(frozen=True)
class Settings:
    """The numbers of the algorithm."""

    lanes: int = 2048
    steps: int = 32  # decisions of a lane in an iteration
    epochs: int = 4
    batches: int = 8  # of an epoch
    rate: float = 1e-3  # first learning rate
    clip: float = 0.2
    discount: float = 0.995  # a decision
    trace: float = 0.95  # lambda of the advantages
    entropy: float = 0.002
    value: float = 0.5  # weight of the value's loss
    norm: float = 0.5  # largest norm of the actor's gradient
    scatter: float = 0.2  # least standard deviation of actions, in full commands
    mean: float = 0.02  # part of the running mean that the newest parameters are
    longest: float = LONGEST  # s of an episode


class Policy(NamedTuple):
    """What is learned."""

    actor: tuple[Layer, ...]
    critic: tuple[Layer, ...]
    log_scatter: Array  # (2,)


class Told(NamedTuple):
    """Sums over what happened in an iteration."""

    reward: Reward  # each term
    ended: Scalar  # episodes
    begun_at_start: Scalar  # of them, those that began at the course's start
    reached: Scalar  # of those, the ones that reached the goal
    drifted: Scalar  # of these, the ones with a drift in every turn
    lap: Scalar  # s, of these


class Training(NamedTuple):
    """All that training goes on from: a checkpoint."""

    policy: Policy
    mean: Policy  # running mean of the policy
    optimiser: Any
    lanes: Lane  # (lanes, …)
    keys: Array  # (lanes, …) of each lane, as plain numbers
    iteration: Scalar


class Met(NamedTuple):
    """What a lane met: leaves (steps, …)."""

    seen: Array
    privileged: Array  # what the critic alone is told: the car, and what the judge keeps
    action: Array
    log_chance: Array
    value: Array
    reward: Scalar
    ended: Scalar


def layers(key: Array, sizes: tuple[int, ...], last: float) -> tuple[Layer, ...]:
    """Orthogonal weights; those of the last layer times `last`."""
    found = []
    keys = jax.random.split(key, len(sizes) - 1)
    for i, (a, b) in enumerate(itertools.pairwise(sizes)):
        gain = last if i == len(sizes) - 2 else math.sqrt(2)
        weight = jax.nn.initializers.orthogonal(gain)(keys[i], (a, b), jnp.float32)
        found.append(Layer(weight, jnp.zeros(b, jnp.float32)))
    return tuple(found)


def first_policy(key: Array, privileged: int) -> Policy:
    """A policy that rolls on slowly, and tries much. `privileged`: the critic's own inputs."""
    a, c = jax.random.split(key)
    actor = layers(a, (FEATURES, *UNITS, 2), 0.01)
    rolls = Layer(actor[-1].weight, actor[-1].bias.at[0].set(CREEP))
    scatter = jnp.full(2, math.log(BEGIN_SCATTER), jnp.float32)
    return Policy((*actor[:-1], rolls), layers(c, (FEATURES + privileged, *UNITS, 1), 1.0), scatter)


def worth(policy: Policy, seen: Array, privileged: Array) -> Array:
    """The critic's values (…,) of observations and what it alone is told."""
    return network(policy.critic, jnp.concatenate([seen, privileged], axis=-1))[..., 0]


def log_chance(mean: Array, log_scatter: Array, action: Array) -> Array:
    """Logarithm of a normal density, summed over the controls."""
    off = (action - mean) * jnp.exp(-log_scatter)
    return jnp.sum(-0.5 * off**2 - log_scatter - 0.5 * math.log(2 * math.pi), axis=-1)


def advantages(met: Met, last: Array, discount: float, trace: float) -> tuple[Array, Array]:
    """Generalised advantages and returns (steps, …); `last` is the value after the last step."""

    def back(carry: tuple[Array, Array], one: Met) -> tuple[tuple[Array, Array], Array]:
        after, advantage = carry
        goes_on = 1 - one.ended
        error = one.reward + discount * goes_on * after - one.value
        advantage = error + discount * trace * goes_on * advantage
        return (one.value, advantage), advantage

    _, found = jax.lax.scan(back, (last, jnp.zeros_like(last)), met, reverse=True)
    return found, found + met.value


def loss(settings: Settings, policy: Policy, batch: tuple[Array, ...]) -> Scalar:
    """PPO's loss of a batch of decisions."""
    seen, privileged, action, before, advantage, goal = batch
    now = log_chance(network(policy.actor, seen), policy.log_scatter, action)
    ratio = jnp.exp(now - before)
    clipped = jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip)
    gain = jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value = worth(policy, seen, privileged)
    entropy = jnp.sum(policy.log_scatter)
    return settings.value * jnp.mean((value - goal) ** 2) - gain - settings.entropy * entropy


class Trainer:
    """PPO on an environment, compiled for all cores."""

    def __init__(
        self,
        environment: Environment,
        settings: Settings,
        iterations: int,
        cores: int,
        cars: np.ndarray,
    ) -> None:
        """`iterations` is the whole number: the learning rate falls to 0 with it.

        `cars` (lanes, n) is what the critic is told of each lane's car.
        """
        self.environment, self.settings, self.iterations = environment, settings, iterations
        self.mesh = engine.all_cores(cores)
        self.cars = engine.shared_out(cars, cores)
        schedule = optax.linear_schedule(
            settings.rate, 0.0, iterations * settings.epochs * settings.batches
        )
        adam = optax.adam(schedule, eps=1e-5)
        # Each by itself: the critic's gradient is a hundred times the actor's, and largest where
        # cars fail. With one norm for both, the actor would learn least from failures.
        each: tuple[Any, ...] = ("actor", "critic", "actor")
        self.optimiser = optax.partition(
            {"actor": optax.chain(optax.clip_by_global_norm(settings.norm), adam), "critic": adam},
            Policy(*each),
        )
        block = min(engine.CACHED_LANES, settings.lanes // cores)
        self._drive = engine.in_one_program(self._drive_block, lanes=block, cores=cores)
        self._learn = self._compiled_learn()
        self._begin = jax.jit(jax.vmap(environment.reset, (0, 0, None)))

    @property
    def samples(self) -> int:
        """Decisions of an iteration."""
        return self.settings.lanes * self.settings.steps

    def begin(self, own: Own, seed: int) -> Training:
        """Before the first iteration; leaves of `own` have a leading axis of lanes."""
        root = jax.random.key(seed)
        first = jax.jit(first_policy, static_argnums=1)
        keys = jax.random.split(jax.random.fold_in(root, 1), self.settings.lanes)
        lanes, _ = self._begin(own, keys, jnp.int32(0))
        privileged = jax.eval_shape(self._privileged, lanes, self.cars)
        policy = first(jax.random.fold_in(root, 0), privileged.shape[1])
        return self.placed(
            Training(
                policy,
                policy,
                self.optimiser.init(policy),
                lanes,
                jax.random.key_data(keys),
                np.int32(0),
            )
        )

    def placed(self, training: Training) -> Training:
        """The same on the cores: lanes cut, the rest on each."""
        lanes, keys = engine.shared_out((training.lanes, training.keys), self.mesh.size)
        apart: Any = None
        rest = training._replace(lanes=apart, keys=apart)
        same: Training = engine.on_each(rest, self.mesh.size)
        return same._replace(lanes=lanes, keys=keys)

    def iterate(self, training: Training) -> tuple[Training, dict[str, float]]:
        """One iteration, and its figures."""
        tick = np.int32(int(training.iteration) * self.settings.steps * self.environment.ticks)
        (lanes, met, last, told) = self._drive(
            (training.lanes, training.keys, self.cars),
            training.policy,
            self.environment,
            tick,
            training.iteration,
        )
        policy, mean, optimiser = self._learn(
            training.policy,
            training.mean,
            training.optimiser,
            met,
            last,
            training.iteration,
        )
        after = Training(
            policy, mean, optimiser, lanes, training.keys, training.iteration + np.int32(1)
        )
        return after, figures(jax.tree.map(lambda leaf: float(np.sum(leaf)), told), self.samples)

    def _privileged(self, lanes: Lane, cars: Array) -> Array:
        """What the critic alone is told (lanes, n)."""
        return jnp.concatenate([cars, jax.vmap(self.environment.judged)(lanes)], axis=1)

    def _drive_block(
        self,
        own: tuple[Lane, Array, Array],
        policy: Policy,
        environment: Environment,
        tick: Scalar,
        iteration: Scalar,
    ) -> tuple[Lane, Met, Array, Told]:
        """A block of lanes, driven for `steps` decisions."""
        lanes, keys, cars = own
        settings = self.settings
        number = iteration * (2 * settings.steps + 1)  # two draws a step, and one at the end

        def drawn(step: Scalar, shape: tuple[int, ...], kind: Any) -> Array:
            def one(key: Array) -> Array:
                own_key = jax.random.fold_in(jax.random.wrap_key_data(key), number + step)
                return kind(own_key, shape, jnp.float32)

            return jax.vmap(one)(keys)

        def one(carry: tuple[Lane, Array], step: Scalar) -> tuple[tuple[Lane, Array], Any]:
            lanes, seen = carry
            now = tick + step * environment.ticks
            mean = network(policy.actor, seen)
            noise = drawn(2 * step, (2,), jax.random.normal)
            action = mean + jnp.exp(policy.log_scatter) * noise
            privileged = self._privileged(lanes, cars)
            value = worth(policy, seen, privileged)
            lanes, _, terms, ended = jax.vmap(environment.step, (0, 0, None))(lanes, action, now)
            met = Met(
                seen,
                privileged,
                action,
                log_chance(mean, policy.log_scatter, action),
                value,
                terms.total,
                ended,
            )
            told = jax.vmap(happened)(lanes, terms, ended)
            even = drawn(2 * step + 1, (5,), jax.random.uniform)
            renewed = jax.vmap(environment.renewed, (0, 0, 0, None))
            lanes = renewed(lanes, ended, even, now + environment.ticks)
            return (lanes, jax.vmap(environment.observe)(lanes)), (met, told)

        begin = (lanes, jax.vmap(environment.observe)(lanes))
        (lanes, seen), (met, told) = jax.lax.scan(one, begin, jnp.arange(settings.steps))
        last = worth(policy, seen, self._privileged(lanes, cars))
        # A limit of time is no end: the value of where the lane stands has been taken.
        end = tick + settings.steps * environment.ticks
        late = jnp.where(lanes.score.time > settings.longest, 1.0, 0.0)
        even = drawn(2 * settings.steps, (5,), jax.random.uniform)
        lanes = jax.vmap(environment.renewed, (0, 0, 0, None))(lanes, late, even, end)
        first = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), met)
        return lanes, first, last, jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), told)

    def _compiled_learn(self) -> Any:
        """The epochs of an iteration, each core with its own lanes, gradients averaged."""
        settings, mesh = self.settings, self.mesh
        per_core = settings.lanes * settings.steps // mesh.size
        size = per_core // settings.batches

        def on_core(
            policy: Policy,
            mean: Policy,
            state: Any,
            met: Met,
            last: Array,
            iteration: Scalar,
        ) -> tuple[Policy, Policy, Any]:
            by_step = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), met)
            advantage, goal = advantages(by_step, last, settings.discount, settings.trace)
            off = jax.lax.pmean(jnp.mean(advantage), "core")
            wide = jnp.sqrt(jax.lax.pmean(jnp.mean((advantage - off) ** 2), "core")) + 1e-8
            columns = (
                by_step.seen,
                by_step.privileged,
                by_step.action,
                by_step.log_chance,
                (advantage - off) / wide,
                goal,
            )
            flat = [leaf.reshape(per_core, *leaf.shape[2:]) for leaf in columns]
            key = jax.random.fold_in(jax.random.key(0), iteration)

            def epoch(carry: Any, number: Scalar) -> tuple[Any, None]:
                order = jax.random.permutation(jax.random.fold_in(key, number), per_core)

                def batch(carry: Any, rows: Array) -> tuple[Any, None]:
                    policy, mean, state = carry
                    some = tuple(leaf[rows] for leaf in flat)
                    slope = jax.grad(functools.partial(loss, settings))(policy, some)
                    slope = jax.lax.pmean(slope, "core")
                    change, state = self.optimiser.update(slope, state, policy)
                    policy = optax.apply_updates(policy, change)
                    least = jnp.maximum(policy.log_scatter, math.log(settings.scatter))
                    policy = policy._replace(log_scatter=least)
                    return (policy, mean, state), None

                return jax.lax.scan(batch, carry, order.reshape(settings.batches, size))

            (policy, mean, state), _ = jax.lax.scan(
                epoch, (policy, mean, state), jnp.arange(settings.epochs)
            )
            # Of the newest alone at first.
            part = jnp.maximum(settings.mean, 1.0 / (1.0 + iteration))
            mean = jax.tree.map(lambda old, new: old + part * (new - old), mean, policy)
            return policy, mean, state

        same, cut = PartitionSpec(), PartitionSpec("core")
        return jax.jit(
            jax.shard_map(
                on_core,
                mesh=mesh,
                in_specs=(same, same, same, cut, cut, same),
                out_specs=same,
                check_vma=False,
            )
        )


def happened(lane: Lane, terms: Reward, ended: Scalar) -> Told:
    """What a lane's decision adds to the figures."""
    own = ended * (1 - lane.rolling)
    reached = own * jnp.where(lane.score.outcome == Outcome.REACHED.code, 1.0, 0.0)
    all_drift = jnp.all(lane.score.turns.peak_sideslip > DRIFT)
    return Told(
        terms,
        ended,
        own,
        reached,
        reached * jnp.where(all_drift, 1.0, 0.0),
        jnp.where(reached > 0, lane.score.goal_time, 0.0),
    )


def figures(told: Told, samples: int) -> dict[str, float]:
    """The figures of an iteration by name; rewards are a second."""
    seconds = samples * PERIOD

    def share(part: float, whole: float) -> float:
        return part / whole if whole else math.nan

    return {
        "reward_per_s": sum(told.reward) / seconds,
        **{f"{name}_per_s": term / seconds for name, term in told.reward._asdict().items()},
        "episodes": told.ended,
        "success_rate": share(told.reached, told.begun_at_start),
        "drift_share": share(told.drifted, told.reached),
        "lap_time_s": share(told.lap, told.reached),
    }


class Job(NamedTuple):
    """What is to be learned."""

    course: Course
    car_name: str
    car: Car
    cars: str  # the population's name
    population: Population
    weights: Reward
    seed: int
    samples: int


FIRST = 20_000_000  # seed of the first car that is trained with
APART = 100_000  # seeds between two trainings' cars
TOLD = 10  # iterations between two reports, which are also checkpoints
ROLLING = 0.5  # part of the episodes that begin in motion
PANELS = (  # of the picture
    ("success_rate", "drift_share"),
    ("lap_time_s",),
    tuple(f"{name}_per_s" for name in ("reward", *Reward._fields)),
    ("scatter",),
)


def checkpoint_of(out: Path) -> Path:
    """The checkpoint of a policy that is being learned."""
    return out.with_suffix(".checkpoint.npz")


def numbers_of(own: Own) -> np.ndarray:
    """What differs among the cars and their charges (lanes, n): mean 0, standard deviation 1."""
    lanes = np.shape(own.charge)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((own.car, own.charge))]
    found = [one for one in leaves if one.shape == lanes and one.std() > 1e-6 * np.abs(one).max()]
    scaled = [(leaf - leaf.mean()) / leaf.std() for leaf in found]
    return np.array(scaled, np.float32).reshape(len(found), *lanes).T


def train(
    job: Job,
    out: Path,
    cores: int,
    report: Callable[[dict[str, float]], None] = lambda _: None,
    settings: Settings = Settings(),
) -> list[dict[str, float]]:
    """Learn, and write the policy, its curves (`.csv`, `.png`) and checkpoints beside it.

    Returns the curves: figures (`figures`) every `TOLD` iterations. A checkpoint of the same job is
    gone on from, with the same result. It is removed at the end. Raises `InputError` if there is
    one of another job.
    """
    seeds = [(FIRST + APART * job.seed + i) % 2**31 for i in range(settings.lanes)]
    own, slots = owns(job.population, job.car, job.course, seeds)
    environment = Environment.of(job.course, job.car, job.weights, slots, rolling=ROLLING)
    iterations = math.ceil(job.samples / (settings.lanes * settings.steps))
    trainer = Trainer(environment, settings, iterations, cores, numbers_of(own))
    kept = checkpoint_of(out)
    about = {
        "fingerprint": fingerprint(job.course, job.car),
        "cars": job.cars,
        "reward": job.weights._asdict(),
        "seed": job.seed,
        "samples": job.samples,
        "settings": dataclasses.asdict(settings),
        "cores": cores,
    }
    state, curves = trainer.begin(own, job.seed), []
    before = checkpoint.load(kept, about, state)
    if before is not None:
        state, curves = trainer.placed(before[0]), before[1]
    spent = curves[-1]["cpu_s"] if curves else 0.0
    begun, cpu = time.monotonic(), time.process_time()
    first = int(state.iteration)
    recent: list[dict[str, float]] = []
    for number in range(first, iterations):
        state, told = trainer.iterate(state)
        recent.append(told)
        if (number + 1) % TOLD == 0 or number + 1 == iterations:
            pace = (time.monotonic() - begun) / (number + 1 - first)
            curves.append(
                {
                    "samples": float((number + 1) * trainer.samples),
                    "cpu_s": spent + time.process_time() - cpu,
                    "samples_per_s": trainer.samples / pace,
                    "left_s": pace * (iterations - number - 1),
                    **{name: _mean([one[name] for one in recent]) for name in told},
                    "scatter": float(np.mean(np.exp(state.policy.log_scatter))),
                }
            )
            recent = []
            checkpoint.save(kept, about, state, curves)
            report(curves[-1])
    source = {
        "course": job.course.name,
        "car": job.car_name,
        "task": "lap",
        "learned_with": {key: about[key] for key in ("cars", "reward", "seed", "samples")},
        "cost": {"samples": curves[-1]["samples"], "cpu_s": curves[-1]["cpu_s"]},
        "fingerprint": about["fingerprint"],
    }
    mean = jax.tree.map(np.asarray, state.mean)
    write_whole(out, network_file(mean.actor, source))
    title = f"learn ppo: {job.course.name}, {job.car_name}, seed {job.seed}"
    save(curves, out, title, "samples", ("million decisions", 1e6), PANELS)
    kept.unlink(missing_ok=True)
    return curves


def _mean(values: list[float]) -> float:
    """The mean of those that are numbers."""
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


def line(told: dict[str, float]) -> str:
    """A report as a line."""
    return (
        f"  {told['samples'] / 1e6:6.1f} M: reward {told['reward_per_s']:6.2f}/s, "
        f"{100 * told['success_rate']:3.0f} % get round, {100 * told['drift_share']:3.0f} % of "
        f"them drift every turn, lap {told['lap_time_s']:5.2f} s; "
        f"{told['samples_per_s'] / 1e3:.0f} k/s, {told['left_s'] / 60:.1f} min left"
    ).replace("nan", "-")


def verdict(job: Job, policy: Path, first: int, count: int = 256) -> dict[str, Any]:
    """The results of a policy's file, as `evaluate`'s with `--estimate truth`."""
    driver = network_driver(job.course, job.car, read_network(policy)[0])
    return evaluate.verdict(job.course, job.car, job.population, driver, first, count)
