"""A step of a live drive: some ticks of the ordinary loop, called at little cost.

A call of compiled code costs some 20 µs for each array that it is given, and a simulator, a pilot
and their state are 600 of them. So they travel as one vector each, and a step's record as a matrix.
"""

import dataclasses
import math
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.cockpit.gyro import Assist, Hands
from countersteer.kept_programs import kept
from countersteer.pilot import Pilot, PilotMemory
from countersteer.signals import Array, Command
from countersteer.simulator import Loop, Record, Simulator, begin, scan, voltage

Tree: TypeAlias = Any


class Layout(NamedTuple):
    """Where the leaves of a tree are in a vector. Hashable, as a program is compiled for it."""

    tree: Any  # its structure
    leaves: tuple[tuple[str, tuple[int, ...]], ...]  # type and shape of each


class Said(NamedTuple):
    """What changes from step to step."""

    hands: Hands
    assist: Assist
    person: float  # 1: the person drives, 0: the driver
    given: Command  # of a driver that JAX cannot trace
    cut: float = 0.0  # 1: the person's throttle is zero at once


def layout_of(tree: Tree) -> Layout:
    """The layout of a tree of arrays and numbers."""
    leaves, structure = jax.tree.flatten(tree)
    types = (jax.dtypes.canonicalize_dtype(jnp.result_type(leaf)) for leaf in leaves)
    return Layout(
        structure, tuple((str(t), np.shape(leaf)) for t, leaf in zip(types, leaves, strict=True))
    )


def pack(tree: Tree) -> Array:
    """The leaves one after the other, as 64-bit floats. Whole numbers under 2**53 stay exact."""
    leaves = jax.tree.leaves(tree)
    own = jnp if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves) else np
    return own.concatenate([own.ravel(own.asarray(leaf)).astype(np.float64) for leaf in leaves])


def unpack(layout: Layout, vector: Array) -> Tree:
    """The inverse of `pack`. Of a matrix, leaves have its leading axis."""
    found, at = [], 0
    lead = vector.shape[:-1]
    for dtype, shape in layout.leaves:
        size = math.prod(shape)
        part = vector[..., at : at + size].reshape((*lead, *shape))
        found.append(part.astype(dtype))
        at += size
    return jax.tree.unflatten(layout.tree, found)


@kept(0, 1, 2)
def stretch(
    fixed: Layout, changing: Layout, ticks: int, constants: Array, state: Array, said: Array
) -> tuple[Array, Array, Array]:
    """Some ticks: the state after them, the record's rows, and the forces at the last row."""
    simulator, pilot = unpack(fixed, constants)
    loop, memory = unpack(changing, state)
    driver = dataclasses.replace(
        pilot.driver,
        hands=Hands(*said[:3]),
        assist=Assist(*said[3:6]),
        person=said[6],
        given=Command(*said[7:9]),
        cut=said[9],
    )
    pilot = dataclasses.replace(pilot, driver=driver)
    loop, memory, record = scan(simulator, pilot, ticks, loop, memory)
    last = jax.tree.map(lambda leaf: leaf[-1], record.motion)
    rows = jax.vmap(pack)(record)
    return pack((loop, memory)), rows, pack(simulator.world.forces(last))


class Stepper:
    """A simulator and a pilot with a `Shared` driver, stepped some ticks at a time.

    The world must have `forces`. The simulator may be replaced by one of the same structure.
    """

    def __init__(self, simulator: Simulator, pilot: Pilot, ticks: int) -> None:
        """Before the first tick."""
        self.simulator, self.pilot, self.ticks = simulator, pilot.typed(np.float64), ticks
        self.tick = 0
        with jax.enable_x64(True):
            loop, memory = begin(simulator), self.pilot.init(simulator.root)
            self._fixed, self._changing = (
                layout_of((simulator, self.pilot)),
                layout_of((loop, memory)),
            )
            first = self._first_record(loop, memory)
            self._rows = layout_of(first)
            self._record: Record = jax.tree.map(lambda leaf: np.asarray(leaf)[None], first)
            self._first, self._constants = pack((loop, memory)), pack((simulator, self.pilot))
            self._state: Array = self._first

    def _first_record(self, loop: Loop, memory: PilotMemory) -> Record:
        """A record with the types and shapes of one tick's."""
        world = self.simulator.world
        motion = world.motion(loop.state)
        return Record(
            loop.tick,
            motion,
            voltage(self.simulator.car, motion),
            memory.command,
            np.bool_(True),
            loop.readings,
            *world.events(loop.state),
            self.pilot.status(memory),
            self.pilot.estimate(memory),
        )

    def warm_up(self) -> None:
        """Have the program ready, before the first tick."""
        self.step(Said(Hands(), Assist(), 1.0, Command(0.0, 0.0)))
        self.reset()

    def reset(self) -> None:
        """Back to the first tick."""
        self.tick, self._state = 0, self._first

    def peek(self) -> Record:
        """The state before the first tick, as a record of one row."""
        return self._record

    def replace(self, simulator: Simulator) -> None:
        """Go on with another simulator of the same structure, such as another car's numbers."""
        with jax.enable_x64(True):
            if layout_of((simulator, self.pilot)) != self._fixed:
                raise ValueError("the simulator has another structure")
            self.simulator = simulator
            self._constants = pack((simulator, self.pilot))

    def step(self, said: Said) -> tuple[Record, np.ndarray]:
        """The record of the next ticks, and the forces at its end: (4, 5), as `planar.Forces`."""
        with jax.enable_x64(True):
            self._state, rows, forces = stretch(
                self._fixed,
                self._changing,
                self.ticks,
                self._constants,
                self._state,
                np.array(
                    [*said.hands, *said.assist, said.person, *said.given, said.cut], np.float64
                ),
            )
            record: Record = unpack(self._rows, np.asarray(rows))
        self.tick += self.ticks
        return record, np.asarray(forces).reshape(4, -1)

    def target(self) -> float:
        """The gyroscope's target of the yaw rate now (rad/s)."""
        with jax.enable_x64(True):
            memory: PilotMemory = unpack(self._changing, np.asarray(self._state))[1]
        return float(memory.driver.ramps.target)
