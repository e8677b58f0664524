"""The interface of every world: it moves one car, tick by tick."""

from typing import Any, NamedTuple, Protocol

from countersteer.car.car import Car
from countersteer.signals import AnyCommand, Motion, Scalar


class Events(NamedTuple):
    """Events of the drive so far."""

    wall_contacts: Scalar  # separate touches of walls
    rolled_over: Scalar  # 1 from the moment the car counts as rolled over


class World(Protocol):
    """A car in its surroundings: a pytree with pure methods that JAX can trace.

    Each world defines its own state. A world with contact forces to show has `forces(motion)` too.
    """

    @property
    def car(self) -> Car:
        """The simulated car. Its leaves decide the precision."""
        ...

    @property
    def dt(self) -> float:
        """Length of a tick (s)."""
        ...

    def init(
        self,
        pose: tuple[Scalar, Scalar, Scalar],
        velocity: tuple[Scalar, Scalar, Scalar],
        charge: Scalar,
    ) -> Any:
        """The state of a car at x, y, heading with velocity vx, vy, yaw rate. Its wheels roll."""
        ...

    def step(self, state: Any, command: AnyCommand, tick: Scalar) -> Any:
        """The state one tick later. `tick` counts the ticks before it, the same in a batch."""
        ...

    def motion(self, state: Any) -> Motion:
        """The car's motion: all that sensors can measure."""
        ...

    def events(self, state: Any) -> Events:
        """The events that a judge needs besides the motion."""
        ...
