"""The Gymnasium environment of one car: the ordinary simulator, stepped a decision at a time.

Each `reset` draws a new car, start and floor from a population. The car has its sensors, and its
link if one is asked for. Actuator lag and delay are the car's.
"""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from countersteer.batch.population import draw, load_population
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.files import load_course
from countersteer.course.way import start_of, way_of
from countersteer.drivers.ppo import (
    FAR,
    FEATURES,
    PAST,
    PERIOD,
    Past,
    Sight,
    features,
    full_lock,
)
from countersteer.envs.functional import DT, LONGEST, TICKS
from countersteer.envs.picture import Scene
from countersteer.errors import InputError
from countersteer.link.link import LINKS
from countersteer.sensing import all_sensors
from countersteer.signals import Command, flat
from countersteer.simulator import Loop, Simulator
from countersteer.task.judge import Outcome, Sample, Task
from countersteer.task.reward import DRIFTING, Reward, reward

OBSERVATIONS = ("state", "sensors")
CONTROLS = ("throttle", "steering")  # the order of an action's two numbers, each in ±1


class DriftEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Drive a course to its goal.

    Action (2,) in ±1: throttle (negative: brake, reverse), steering to the left (±1: full lock).
    Observation `state`: `drivers.ppo.features` of the true state. Observation `sensors`: the
    last value of each of the car's channels, in their order (`observation_names`), then the last
    16 throttles and steerings. `info` has the reward's `terms`, the `outcome`, the `turns`' peak
    sideslip and overshoot (rad), and at `reset` the `seed` that drew the car.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / PERIOD)}  # noqa: RUF012  # Gymnasium's form

    def __init__(
        self,
        course: str = "box",
        car: str = "rx7",
        cars: str | None = "around",
        observation: str = "state",
        weights: Reward = DRIFTING,
        link: str = "onboard",
        laps: int = 1,
        longest: float = LONGEST,
        render_mode: str | None = None,
    ) -> None:
        """`cars` is a population (None: always the nominal car). Raises `InputError`."""
        if observation not in OBSERVATIONS:
            raise InputError(f"observation must be one of {', '.join(OBSERVATIONS)}")
        configure_jax(batches=False, cores=2)
        self.course, self.car = load_course(course), load_car(car)
        self.course.check_laps(laps)
        self.population = None if cars is None else load_population(cars)
        self.link, self.weights, self.longest = LINKS[link], weights, longest
        self.render_mode, self._sees = render_mode, observation
        self._task = Task.of(self.course, laps, walls_end=True)
        self._way = way_of(self.course)
        self._lock = full_lock(self.car)
        self._channels = flat(all_sensors.channels(self.car))
        columns = [name for channel in self._channels for name in channel.columns]
        past = [f"{control}_{PAST - i}_ago" for control in CONTROLS for i in range(PAST)]
        self.observation_names = tuple(columns + past)
        self.action_space = spaces.Box(-1.0, 1.0, (len(CONTROLS),), np.float32)
        if observation == "state":
            self._ends = (np.full(FEATURES, -FAR, np.float32), np.full(FEATURES, FAR, np.float32))
        else:
            low, high = (
                [end for c in self._channels for end in [getattr(c, side)] * len(c.columns)]
                for side in ("low", "high")
            )
            one = np.ones(len(past))
            self._ends = (
                np.concatenate([np.minimum(low, 0.0), -one]).astype(np.float32),
                np.concatenate([high, one]).astype(np.float32),
            )
        self.observation_space = spaces.Box(*self._ends)
        self._scene: Scene | None = None

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002  # Gymnasium's form
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode. The same seed gives the same car, start, floor and noise."""
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31)) if seed is None else seed % 2**31
        start, charge, floor, car = None, 1.0, None, self.car
        if self.population is not None:
            drawn = draw(self.population, self.car, self.course, [number], np.float64)
            car, floor = jax.tree.map(lambda leaf: leaf[0], (drawn.cars, drawn.floor))
            charge = float(drawn.charge[0])
            x, y, heading = (float(part) for part in drawn.pose[0])
            start = (x, y, heading)
        self._simulator = Simulator.of(
            self.course, car, link=self.link, seed=number, charge=charge, start=start, floor=floor
        )
        self._loop: Loop = self._simulator.init()
        self._score: Any = self._task.init()
        self._place = start_of(self.course, self._way)
        self._past: Any = Past.none(np.float64)
        return self._observed(), {"seed": number}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One decision of 20 ms."""
        throttle, steering = (float(np.clip(part, -1.0, 1.0)) for part in action)
        given = Command(throttle, steering)
        command = Command(np.float64(throttle), np.float64(self._lock * steering))
        self._loop, _ = self._simulator.apply(self._loop, command, TICKS)
        before = self._score
        last = Command(float(self._past.throttle[-1]), float(self._past.steering[-1]))
        time = DT * int(self._loop.tick)
        motion = self._motion()
        events = self._simulator.world.events(self._loop.state)
        with jax.enable_x64(True):
            self._score = jax.tree.map(
                np.asarray, _judged(self._task, before, time, motion, *events)
            )
            found = _rewarded(self.weights, self._task, before, self._score, given, last)
            self._past = jax.tree.map(np.asarray, self._past.then(given, self._sight))
        terms = Reward(*map(float, found))
        outcome = Outcome.of(self._score.outcome)
        terminated = outcome is not Outcome.DRIVING
        truncated = not terminated and time >= self.longest - 1e-9
        info = {
            "terms": terms._asdict(),
            "outcome": outcome.value,
            "peak_sideslip": np.array(self._score.turns.peak_sideslip),
            "overshoot": np.array(self._score.turns.overshoot),
        }
        if self.render_mode == "human":
            self.render()
        return self._observed(), float(terms.total), terminated, truncated, info

    def _motion(self) -> Any:
        return jax.tree.map(np.asarray, self._simulator.world.motion(self._loop.state))

    def _observed(self) -> np.ndarray:
        m = self._motion()
        self._sight = Sight(m.x, m.y, m.heading, m.vx, m.vy, m.yaw_rate)
        if self._sees == "sensors":
            readings = flat(self._simulator.readings(self._loop))
            parts = [np.atleast_1d(np.asarray(reading.value)) for reading in readings]
            commands = (self._past.throttle, self._past.steering)
            values = np.concatenate([*parts, *commands]).astype(np.float32)
            # No echo is the largest distance; before its first report a sensor says 0.
            return np.clip(np.nan_to_num(values, posinf=np.inf), *self._ends)
        with jax.enable_x64(True):
            place, seen = _seen(self._way, self._place, self._sight, self._past)
        self._place = float(place)
        return np.asarray(seen, np.float32)

    def render(self) -> np.ndarray | None:
        """A picture from above (`rgb_array`), or a window of matplotlib (`human`)."""
        if self.render_mode is None:
            return None
        if self._scene is None:
            self._scene = Scene(self.course, self.car, window=self.render_mode == "human")
        m = self._motion()
        return self._scene.draw(float(m.x), float(m.y), float(m.heading), float(m.steering))

    def close(self) -> None:
        """Close the window."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None


@jax.jit
def _judged(task: Task, score: Any, time: Any, motion: Any, contacts: Any, rolled: Any) -> Any:
    return task.update(score, Sample(time, motion, contacts, rolled))


_rewarded = jax.jit(reward)


@jax.jit
def _seen(way: Any, place: Any, sight: Sight, past: Past) -> tuple[Any, Any]:
    place = way.follow(sight.x, sight.y, place)
    return place, features(way, place, sight, past)
