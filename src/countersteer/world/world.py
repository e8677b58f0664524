"""What every world is asked: a car in it, a tick at a time."""

from typing import Any, NamedTuple, Protocol

from countersteer.car.car import Car
from countersteer.signals import Command, Motion, Scalar


class Events(NamedTuple):
    """What has happened to the car so far."""

    wall_contacts: Scalar  # separate touches of walls
    rolled_over: Scalar  # 1 from the moment the car counts as rolled over


class World(Protocol):
    """A car in its surroundings; a pytree, whose methods are pure and can be traced by JAX.

    What a state is, is the world's own business. A world that has forces to show whoever looks has
    `forces(motion)` as well.
    """

    @property
    def car(self) -> Car:
        """The car that is simulated; its leaves decide the precision."""
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
        """The car at x, y, heading with velocity vx, vy, yaw rate, its wheels rolling."""
        ...

    def step(self, state: Any, command: Command, tick: Scalar) -> Any:
        """The state a tick later; `tick` counts those before it and is shared by a batch."""
        ...

    def motion(self, state: Any) -> Motion:
        """All that sensors can look at."""
        ...

    def events(self, state: Any) -> Events:
        """What a judge looks at besides."""
        ...
