"""A world of one's own, a car that never slips, behind the same sensors, link and pilot."""

import dataclasses

import jax.numpy as jnp

import countersteer as cs
from countersteer.car.car import Car
from countersteer.car.parameter import pytree
from countersteer.signals import Command, Motion, Scalar, Wheels
from countersteer.world.world import Events


@pytree
class Kinematic:
    """A bicycle that goes where its wheels point; its state is the motion that sensors see."""

    car: Car
    dt: float = dataclasses.field(metadata={"static": True})

    def init(self, pose: tuple, velocity: tuple, charge: Scalar) -> Motion:
        """The car where it starts."""
        real, zero = self.car.body.mass.dtype.type, self.car.body.mass * 0
        spin = Wheels(*(real(velocity[0]) / self.car.tires.rear.radius,) * 4)
        x, y, heading, vx, vy, turn = map(real, (*pose, *velocity))
        return Motion(x, y, heading, vx, vy, turn, spin, zero, zero, zero, zero, real(charge))

    def step(self, state: Motion, command: Command, tick: Scalar) -> Motion:
        """Euler's step: 6 m/s² at full throttle, a drag of 2 /s, and the rear axle's path."""
        body, h = self.car.body, self.dt
        vx = state.vx + h * (6.0 * command.throttle - 2.0 * state.vx)
        turn = vx * jnp.tan(command.steering) / body.wheelbase
        vy, heading = turn * (body.wheelbase - body.front_axle), state.heading + h * turn
        x = state.x + h * (vx * jnp.cos(heading) - vy * jnp.sin(heading))
        y = state.y + h * (vx * jnp.sin(heading) + vy * jnp.cos(heading))
        spin = Wheels(*(vx / self.car.tires.rear.radius,) * 4)
        return Motion(x, y, heading, vx, vy, turn, spin, command.steering, *state[8:])

    def motion(self, state: Motion) -> Motion:
        """The same."""
        return state

    def events(self, state: Motion) -> Events:
        """Nothing ever happens: its walls are for the sonar alone."""
        return Events(0.0 * state.x, 0.0 * state.x)


if __name__ == "__main__":
    course, car = cs.load_course("straight"), cs.load_car("rx7")
    pilot = cs.Pilot.of(cs.load_driver("straighten", course, car), course, car)
    world = lambda car, walls, floor, dt: Kinematic(car=car, dt=dt)  # noqa: E731  # one line
    simulator = cs.Simulator.of(course, car, world=world, start=(0.5, 0.2, 0.1))
    for m in (record.motion for record in simulator.run(pilot, longest=2.5)):
        print(f"x {m.x[-1]:5.2f} m   y {m.y[-1]:+.3f} m   {m.vx[-1]:.2f} m/s")
