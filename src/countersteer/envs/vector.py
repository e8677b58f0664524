"""The Gymnasium vector environment: thousands of cars, stepped on all cores.

Each core has a thread, which runs the same program for its share of the cars and lays out what they
tell as Gymnasium has it.

Each sub-environment has a car of its own, drawn at `reset`, and keeps it. Autoreset is
`NEXT_STEP`: the step after an episode's end begins a new one, ignores the action, and returns a
reward of 0. `terminated` is the judge's end; `truncated` the limit of time.
"""

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from countersteer.batch import engine
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.drivers.ppo import FAR, FEATURES, PERIOD
from countersteer.envs.functional import LONGEST, Environment, Lane, Own, owns
from countersteer.signals import Array, Scalar
from countersteer.task.reward import DRIFTING, Reward


class DriftVectorEnv(VectorEnv[np.ndarray, np.ndarray, Any]):
    """Many cars on one course, with the true state as observation. See `single.DriftEnv`."""

    metadata = {  # noqa: RUF012  # Gymnasium's form
        "render_modes": [],
        "render_fps": round(1 / PERIOD),
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1024,
        course: str = "box",
        car: str = "rx7",
        cars: str = "around",
        weights: Reward = DRIFTING,
        laps: int = 1,
        longest: float = LONGEST,
        cores: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Raises `InputError` for a wrong name. `cores` are all by default."""
        if render_mode is not None:
            raise ValueError("a vector environment is not rendered: make one of its cars alone")
        all_cores = os.cpu_count() or 1
        configure_jax(blocks=True, cores=all_cores)
        cores = cores or all_cores
        self.num_envs, self.longest = num_envs, longest
        self.course, self.car = load_course(course), load_car(car)
        self.course.check_laps(laps)
        self.population, self._weights, self._laps = load_population(cars), weights, laps
        self.single_observation_space = spaces.Box(-FAR, FAR, (FEATURES,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        block = min(engine.CACHED_LANES, max(1, num_envs // cores))
        # Whole blocks on each core: the lanes beyond the wanted ones are driven and not shown.
        self._lanes = engine.whole_blocks(num_envs, block, cores)
        self._block = block
        each = self._lanes // block // cores
        self._shares = [slice(i * each, (i + 1) * each) for i in range(cores)]  # of the blocks
        self._threads = ThreadPoolExecutor(cores)
        self._form: Any = None  # of what a step is compiled for
        self._reset = jax.jit(jax.vmap(Environment.reset, (None, 0, 0, None)))
        self._pack = jax.jit(jax.vmap(engine.packed))

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002  # Gymnasium's form
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a car for each sub-environment, and begin. The same seed repeats all exactly."""
        super().reset(seed=seed)
        first = int(self.np_random.integers(2**30)) if seed is None else seed * self._lanes
        seeds = [(first + i) % 2**31 for i in range(self._lanes)]
        own: Own
        own, slots = owns(self.population, self.car, self.course, seeds)
        self._environment = Environment.of(self.course, self.car, self._weights, slots, self._laps)
        root = jax.random.key(first % 2**31)
        keys = jax.random.split(root, self._lanes)
        state, seen = self._reset(self._environment, own, keys, np.int32(0))
        self._tick = 0
        # What a car is stays; how it moves goes in and out of each step, in one piece.
        nothing: Any = ()
        apart, once = engine.parted(own)
        same = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (self._environment, once))
        self._same = engine.packed(same)
        parts = [
            engine.in_blocks(tree, self._block) for tree in (apart, state._replace(own=nothing))
        ]
        self._own, self._state = (
            [jax.tree.map(lambda leaf, of=of: leaf[of], packed) for of in self._shares]
            for packed in map(self._pack, parts)
        )
        form = slots, jax.tree.structure(apart)
        if form != self._form:
            own_of, lane_of = (
                engine.unpacking(jax.tree.map(lambda leaf: leaf[0], part)) for part in parts
            )
            stepped = functools.partial(_step, own_of, lane_of, engine.unpacking(same))
            self._step = engine.on_blocks(stepped)
            self._form = form
        self._done = np.zeros(self._lanes, np.float32)
        return np.asarray(seen)[: self.num_envs], {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One decision of 20 ms of all cars; `infos` has the reward's terms and the outcomes."""
        asked = np.zeros((self._lanes, 3), np.float32)
        asked[: self.num_envs, :2], asked[:, 2] = actions, self._done
        asked = engine.in_blocks(asked, self._block)
        seen = np.empty((*asked.shape[:2], FEATURES), np.float32)
        told = np.empty((TOLD, *asked.shape[:2]), np.float32)

        def drive(core: int) -> None:
            share = self._shares[core]
            block = (self._own[core], self._state[core], asked[share])
            self._state[core], found = self._step(block, self._same, np.int32(self._tick))
            found = np.asarray(found)
            seen[share] = found[:, :FEATURES].transpose(0, 2, 1)
            told[:, share] = found[:, FEATURES:].transpose(1, 0, 2)

        # As a list, it waits for all, and raises what was raised in a thread.
        list(self._threads.map(drive, range(len(self._shares))))
        self._tick += self._environment.ticks
        *terms, ended, time, outcome = told.reshape(TOLD, self._lanes)
        over = ended > 0
        late = (time >= self.longest - 1e-4) & ~over
        self._done = (late | over).astype(np.float32)
        n = self.num_envs
        infos = {name: one[:n] for name, one in zip(Reward._fields, terms, strict=True)}
        infos["outcome"] = outcome[:n].astype(np.int32)
        seen = seen.reshape(self._lanes, FEATURES)[:n]
        return seen, np.sum(terms, axis=0)[:n], over[:n], late[:n], infos

    def close_extras(self, **_: Any) -> None:
        """End the threads."""
        self._threads.shutdown()


# What a step tells of a car beside its observation: the reward's terms, end, s of the episode,
# outcome.
TOLD = len(Reward._fields) + 3


def _step(
    own_of: Callable[[Any], Own],
    lane_of: Callable[[Any], Lane],
    same_of: Callable[[Any], tuple[Environment, Own]],
    block: tuple[Any, Any, Array],
    same: Any,
    tick: Scalar,
) -> tuple[Any, Array]:
    """A block's decision. Lanes that had ended begin a new episode instead.

    A lane is asked for its action, and has a 1 behind it if it had ended. `same` is the
    environment, and what all cars have alike. Returns the packed lanes, and what is told of each:
    its observation and `TOLD` more, in rows.
    """
    none: Any = ()  # what a car is does not change
    environment, once = jax.tree.map(lambda leaf: leaf[0], same_of(same))

    def one(own: Own, lane: Lane, asked: Array) -> tuple[Lane, Array]:
        lane, done = lane._replace(own=engine.joined(own, once)), asked[2]
        after, _, terms, ended = environment.step(lane, asked[:2], tick)
        # All begin at the start (`Environment.rolling` is 0): no random numbers are needed.
        even = jnp.zeros(5, jnp.float32)
        after = environment.renewed(after, done, even, tick + environment.ticks)
        paid = (1 - done) * jnp.stack(terms)
        rest = jnp.stack([(1 - done) * ended, after.score.time, after.score.outcome])
        told = jnp.concatenate([environment.observe(after), paid, rest])
        return after._replace(own=none), told

    own, state, asked = block
    lanes, told = jax.vmap(one, out_axes=(0, 1))(own_of(own), lane_of(state), asked)
    return engine.packed(lanes), told
