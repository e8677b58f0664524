"""The environments beside the bare physics: ticks a second, in turns in one run.

    python -m benchmarks.environment [LANES] [ROUNDS]

All sides drive the same random cars, with their floors and walls, in blocks on all cores. What the
cars have alike is one number for all (`engine.parted`), on every side. The sides are: bare physics
with a held command; the functional environment with a held action, and with a policy of two
layers of 64; and the Gymnasium vector environment, which goes through NumPy at each decision.
Beside them, where they are installed: the car of `countersteer bench` in MuJoCo, on all cores, and
the drift environment of Gym-Khana, one car in one process, as its users step it. Their steps are
not the same work: other cars, other laws, and 10 ms instead of 1 ms in Gym-Khana.
"""

import functools
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.batch import engine
from countersteer.batch.population import load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.drivers.ppo import FEATURES, Layer, network
from countersteer.envs.functional import DT, Environment, owns
from countersteer.envs.vector import DriftVectorEnv
from countersteer.signals import Command
from countersteer.task.reward import DRIFTING
from countersteer.world import planar

LANES, ROUNDS = 4096, 7
DECISIONS = 16  # in one call of a program
HELD = (0.3, -0.2)
KHANA_STEPS = 200
KHANA = {  # its documentation's choice for drifting
    "num_agents": 1,
    "model": "std",
    "control_input": ["accl", "steering_angle"],
    "observation_config": {"type": "drift"},
}


def programs(lanes: int, cores: int) -> dict[str, tuple[int, Callable[[], Any]]]:
    """What is timed, by name: the steps of a call, and the call."""
    course, car = load_course("box"), load_car("rx7")
    own, slots = owns(load_population("around"), car, course, range(lanes))
    environment = Environment.of(course, car, DRIFTING, slots)
    keys = jax.random.split(jax.random.key(0), lanes)
    begun = jax.jit(jax.vmap(Environment.reset, (None, 0, 0, None)))
    state, _ = begun(environment, own, keys, np.int32(0))
    apart, once = engine.parted(own)
    state = state._replace(own=apart)
    rng = np.random.default_rng(0)
    sizes = ((FEATURES, 64), (64, 64), (64, 2))
    layers = tuple(
        Layer(rng.normal(0, 0.1, s).astype(np.float32), np.zeros(s[1], np.float32)) for s in sizes
    )

    def bare(lanes: Any, environment: Environment, once: Any, layers: Any) -> Any:
        del layers
        command = Command(jnp.float32(HELD[0]), environment.lock * jnp.float32(HELD[1]))

        def tick(state: Any, count: Any) -> tuple[Any, None]:
            def one(own: Any, state: Any) -> Any:
                own = engine.joined(own, once)
                return planar.step(own.car, environment.walls, state, command, count, DT, own.floor)

            return jax.vmap(one)(lanes.own, state), None

        ticks = DECISIONS * environment.ticks
        return jax.lax.scan(tick, lanes.state, jnp.arange(ticks, dtype=jnp.int32))[0]

    def held(with_policy: bool) -> Any:
        def run(lanes: Any, environment: Environment, once: Any, layers: Any) -> Any:
            def step(lane: Any, action: Any, even: Any, now: Any) -> Any:
                whole = lane._replace(own=engine.joined(lane.own, once))
                after, _, terms, ended = environment.step(whole, action, now)
                after = environment.renewed(after, ended, even, now + environment.ticks)
                return after._replace(own=lane.own), environment.observe(after), terms.total

            def one(carry: Any, number: Any) -> tuple[Any, Any]:
                lanes, seen = carry
                action = jnp.broadcast_to(jnp.asarray(HELD, jnp.float32), (seen.shape[0], 2))
                if with_policy:
                    action = network(layers, seen)
                now = number * environment.ticks
                even = jnp.full((seen.shape[0], 5), 0.5, jnp.float32)
                lanes, seen, paid = jax.vmap(step, (0, 0, 0, None))(lanes, action, even, now)
                return (lanes, seen), paid

            begin = (lanes, jax.vmap(environment.observe)(lanes))
            (lanes, _), paid = jax.lax.scan(one, begin, jnp.arange(DECISIONS, dtype=jnp.int32))
            return lanes, paid.T

        return run

    found: dict[str, tuple[int, Callable[[], Any]]] = {}
    ticks = lanes * DECISIONS * environment.ticks
    sides = {"bare physics": bare, "environment": held(False), "environment, policy": held(True)}
    for name, run in sides.items():
        program = engine.in_one_program(run, cores=cores)
        found[name] = ticks, functools.partial(program, state, environment, once, layers)
    many = DriftVectorEnv(lanes)
    many.reset(seed=0)
    actions = np.tile(np.asarray(HELD, np.float32), (lanes, 1))
    found["Gymnasium, vector"] = ticks, lambda: [many.step(actions) for _ in range(DECISIONS)]
    if importlib.util.find_spec("mujoco") is not None:
        from countersteer.bench import mujoco_car

        cars, steps = 64, 320
        compiled = mujoco_car.model(car, course, DT)
        found["MuJoCo"] = cars * steps, mujoco_car.batch(compiled, cars, steps, cores)
    if importlib.util.find_spec("gymkhana") is not None:
        found["Gym-Khana, drift"] = KHANA_STEPS, gym_khana()
    return found


def gym_khana() -> Callable[[], Any]:
    """Gym-Khana's drift environment with a held action, reset where an episode ends."""
    import gymnasium
    from gymkhana.envs.gymkhana_env import GKEnv

    config = KHANA | {"params": GKEnv.f1tenth_std_drift_bias_params()}
    env = gymnasium.make("gymkhana:gymkhana-v0", config=config)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape or (), np.float32)

    def run() -> None:
        for _ in range(KHANA_STEPS):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return run


def main(lanes: int = LANES, rounds: int = ROUNDS) -> int:
    """Print steps a second, medians, and shares of the bare physics."""
    cores = os.cpu_count() or 1
    os.environ["XLA_FLAGS"] = engine.flags(cores)
    configure_jax(blocks=True, cores=cores)
    sides = programs(lanes, cores)
    times: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(rounds + 1):
        for name, (_, call) in sides.items():
            begun = time.perf_counter()
            jax.block_until_ready(call())
            if number:  # the first compiles
                times[name].append(time.perf_counter() - begun)
    rates = {name: sides[name][0] / float(np.median(spent)) for name, spent in times.items()}
    for name, rate in rates.items():
        share = 100 * rate / rates["bare physics"]
        print(f"{name:22} {rate:12,.0f} steps/s, {share:8.3f} %")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*map(int, sys.argv[1:])))
