"""What tests share: 64-bit floats, JAX's cache on disk, programs that compile once, a browser."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from countersteer.car.car import Car
from countersteer.car.parameter import changed
from countersteer.compiling import configure_jax
from countersteer.course.course import Course
from countersteer.drivers.policy import load_policy
from countersteer.drivers.replay import Replay
from countersteer.link.link import ONBOARD, Link
from countersteer.pilot import Pilot
from countersteer.recorded_drive import Drive as Recorded
from countersteer.recorded_drive import about_run
from countersteer.recorded_drive import drive as write_drive
from countersteer.runs.run import Run, read_run
from countersteer.signals import Command, Motion
from countersteer.simulator import Record, Simulator
from countersteer.task import turns
from countersteer.task.judge import PERIOD, Sample, Score, Task
from countersteer.world import planar
from countersteer.world.floor import Floor
from countersteer.world.state import State

LANES = 32  # cars in a batch: always as many, so that there is one program
PIECE = 100  # ticks that a call of it takes
ROWS = 8  # walls of each car
# The numbers of drift-turn where a drive is only what filters, faults or the judge are tried on.
STEADY = load_policy(str(Path(__file__).with_name("steady.toml")))
SLOTS = 512  # of the delay lines: 20 ms at the finest step
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


configure_jax()  # before anything computes: it sets how to compile


@pytest.fixture(scope="session", autouse=True)
def session() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


class Drive(NamedTuple):
    """What came of a batch: arrays of (ticks, cars)."""

    motion: Motion
    energy: np.ndarray  # J, after the tick
    airborne: np.ndarray
    wall_contacts: np.ndarray
    rolled_over: np.ndarray
    last: State  # the cars' states at the end, (cars, ...)


def stacked(trees: list) -> object:
    """A batch of like pytrees."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def varied(car: Car, changes: dict[str, float]) -> Car:
    """The car with parameters replaced by dotted name, in the units used inside."""
    for path, value in changes.items():
        car = changed(car, path, np.float64(value))
    return car


def start(car: Car, slots: int = SLOTS, **motion: object) -> State:
    """A car at rest with nothing under way, but for what `motion` says."""
    state = planar.initial_state(car, 1e-3, slots=slots)
    return state._replace(motion=state.motion._replace(**motion))


def _advance(cars, walls, state, throttle, steering, first, dt, floors):
    def tick(state, inputs):
        count, *command = inputs
        state = jax.vmap(planar.step, (0, 0, 0, 0, None, None, 0))(
            cars, walls, state, planar.Command(*command), count, dt, floors
        )
        return state, (state.motion, state.airborne, state.wall_contacts, state.rolled_over)

    counts = first + jnp.arange(throttle.shape[0], dtype=jnp.int32)
    state, (motion, *rest) = jax.lax.scan(tick, state, (counts, throttle, steering))

    def energy(car, motion):
        velocity = planar.Vector(motion.vx, motion.vy, motion.yaw_rate)
        return planar.kinetic_energy(car, velocity, motion.wheels)

    return state, (motion, jax.vmap(energy, (0, 1), 1)(cars, motion), *rest)


@pytest.fixture(scope="session")
def drive() -> Callable[..., Drive]:
    """Drives up to 32 cars at once: cars, states, commands, walls, step and number of ticks.

    A command is a number, an array by car, or an array (ticks, cars); walls are (n, 4) for all or
    (cars, n, 4); floors are one a car. `every` thins the record. There is one program for each
    precision, with floors and without.
    """
    program = jax.jit(_advance)

    def run(
        cars: list[Car],
        states: list[State],
        ticks: int,
        dt: float,
        throttle: object = 0.0,
        steering: object = 0.0,
        walls: np.ndarray | None = None,
        every: int = 1,
        floors: list[Floor] | None = None,
    ) -> Drive:
        count = len(cars)
        assert count <= LANES
        assert ticks % PIECE == 0
        dtype = np.asarray(cars[0].body.mass).dtype
        fill = [i % count for i in range(LANES)]
        batch = stacked([cars[i] for i in fill])
        state = jax.tree.map(jnp.asarray, stacked([states[i] for i in fill]))
        around = np.full((LANES, ROWS, 4), np.nan, dtype)
        if walls is not None:
            walls = np.broadcast_to(walls, (count, *np.shape(walls)[-2:]))
            around[:, : walls.shape[1]] = walls[fill]
        commands = [
            np.broadcast_to(np.asarray(command, dtype), (ticks, count))[:, fill]
            for command in (throttle, steering)
        ]
        ground = None if floors is None else stacked([floors[i] for i in fill])
        kept, seconds = [], jnp.asarray(dt, dtype)
        for piece in range(ticks // PIECE):
            span = slice(piece * PIECE, (piece + 1) * PIECE)
            state, record = program(
                batch,
                around,
                state,
                *(c[span] for c in commands),
                np.int32(span.start),
                seconds,
                ground,
            )
            first = -(span.start + 1) % every  # so that ticks every, 2 every, ... are kept
            kept.append(jax.tree.map(lambda leaf, n=first: np.asarray(leaf)[n::every], record))
        whole = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:, :count], *kept)
        last = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], state)
        return Drive(*whole, last)

    return run


@pytest.fixture(scope="session")
def drive_alone() -> Callable[..., Motion]:
    """One car, without a batch: the motion after each tick."""

    def advance(car, walls, state, throttle, steering, dt):
        def tick(state, inputs):
            count, *command = inputs
            state = planar.step(car, walls, state, planar.Command(*command), count, dt)
            return state, state.motion

        counts = jnp.arange(throttle.shape[0], dtype=jnp.int32)
        return jax.lax.scan(tick, state, (counts, throttle, steering))[1]

    program = jax.jit(advance)
    return lambda *arguments: jax.tree.map(np.asarray, program(*arguments))


def step_run(
    out: Path,
    course: Course,
    car: Car,
    level: float,
    seconds: float,
    longest: float,
    **more: object,
) -> Run:
    """A run of a throttle from rest, straight, and none after so many seconds."""
    driver = Replay(
        times=np.array([0.0, seconds]), commands=Command(np.array([level, 0.0]), np.zeros(2))
    )
    out.mkdir()
    return write_run(out, course, car, driver, longest, **more)


def write_run(
    out: Path, course: Course | None, car: Car, driver: object, longest: float, **more: object
) -> Run:
    """A drive as a run's folder."""
    simulator, pilot = Simulator.of(course, car, **more), Pilot.of(driver, course, car)
    about = about_run(simulator, pilot, course, "replay", "rx7", 1, car, {"kind": "replay"})
    write_drive(Recorded(simulator, pilot, course, about, longest), out)
    return read_run(out)


def driven(
    course: Course | None,
    car: Car,
    driver: object,
    seconds: float,
    *,
    nominal: Car | None = None,
    estimate: str = "filter",
    link: Link = ONBOARD,
    **more: object,
) -> Record:
    """The record of a drive; the pilot knows the car itself where no `nominal` one is given."""
    pilot = Pilot.of(driver, course, nominal or car, estimate, link, more.get("dt", 0.001))
    return Simulator.of(course, car, link=link, **more).record(pilot, seconds)


def judged(course: Course | None, record: Record, dt: float = 0.001) -> tuple[Score, list]:
    """What the judge makes of a drive, and of its turns."""
    task = Task.of(course)
    rows = np.arange(0, len(record.tick), round(PERIOD / dt))
    own = (record.motion, record.wall_contacts, record.rolled_over, record.status.turn)
    own = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], own)
    score, _ = task.follow(task.init(), Sample(dt * record.tick[rows], *own))
    return score, turns.results(score.turns, score.handover, float(score.time))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="no Playwright here: pip install 'countersteer[browser]'"
    )
    if CHROMIUM is None:
        pytest.skip("no Chromium here to open pages in")
    with playwright.sync_playwright() as driver:
        flags = ["--no-sandbox", "--disable-gpu"]
        launched = driver.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield launched
        launched.close()


@contextlib.contextmanager
def windows(browser: Any, *known: str) -> Iterator[Callable[..., Any]]:
    """Opens windows, each in a context of its own.

    In the end it fails if a page had an error, or asked for what begins with none of `known`.
    """
    contexts, troubles, asked = [], [], []

    def window(phone: bool = False) -> Any:
        context = browser.new_context(
            viewport=PHONE if phone else DESKTOP, has_touch=phone, is_mobile=phone
        )
        contexts.append(context)
        context.on("request", lambda one: asked.append(one.url))
        page = context.new_page()
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("dialog", lambda dialog: troubles.append(f"dialog {dialog.message}"))
        return page

    yield window
    for context in contexts:
        context.close()
    assert not troubles
    assert all(url.startswith(known) for url in asked)
