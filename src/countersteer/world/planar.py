"""The planar world: one tick takes a car from one instant to the next.

`step` runs the `STAGES` in their order. The stage `move` is the physics. A contact's force is -k
times its slip velocity; the tyre law gives k >= 0. The equation of motion is

    M dv/dt = -(Gᵀ K G + D) v + a

v holds the velocities of body and wheels. G maps them to slip velocities. M holds the inertias, K
the values of k, D >= 0 the resistance of drag and back-EMF, and a is the motor's torque.

`move` predicts the middle of the tick with one implicit Euler step. It computes all coefficients
there and holds them over the tick, in the body's axes at the middle. Two implicit Euler stages of
gamma h solve the resulting linear system (Alexander's L-stable method of second order). The
velocity is rotated exactly, into those axes before and out of them after. So the scheme is of
second order where the motion is smooth. Wheels, differentials, rotor and back-EMF are eliminated
in closed form. A 3 x 3 system is left for the body.

If a contact's slip keeps its direction (`steady`), its force follows the tangent of the tyre law.
Otherwise it follows the chord: -k times the slip at the end of the stage. Chords alone remove
energy at any step h and any k >= 0: the held system is symmetric, and all its modes are damped.
Tangents do not guarantee this. So `guarded` compares the kinetic energy at the end of a tick with
that at its start plus the supply of the motor. If it is larger, only a part of the tick's change
is applied, and the next tick uses chords, which always make progress. This costs order, but
contacts cannot add energy.

Source of the method: R. Alexander, SIAM J. Numer. Anal. 14, 1977.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, wheel_positions
from countersteer.car.parameter import pytree
from countersteer.signals import AnyCommand, Array, Command, Motion, Scalar, Wheels
from countersteer.world import (
    battery,
    chassis,
    drivetrain,
    motor,
    servo,
    speed_controller,
    tyre,
    walls,
)
from countersteer.world.angle import cosine_sine
from countersteer.world.chassis import Symmetric, Vector, combine, dot, times
from countersteer.world.floor import Floor, under_wheels
from countersteer.world.state import State
from countersteer.world.world import Events

ROLL_OVER_TIME = 0.1  # s with a pair of wheels in the air; then the car counts as rolled over
FEW = 32  # slots; a delay line of up to so many is read without an index
TANGENT = Wheels(1.0, 1.0, 1.0, 1.0)
GAMMA = 1 - math.sqrt(0.5)  # of the two-stage method
TOUCH_TIME = 0.2  # s without contact after which the next one is a new touch


class Tick(NamedTuple):
    """The input of a stage of a tick, besides the state."""

    car: Car
    walls: jax.Array  # (n, 4): x, y of both ends, m; rows of NaN are padding
    command: AnyCommand  # as it reaches the car now
    asked: AnyCommand  # as it reaches motor and servo, after their delays
    count: Scalar  # ticks since the start, an integer
    dt: float
    floor: Floor | None = None  # None: uniform friction
    start: Motion | None = None  # at the start of the tick, for `collide`


def initial_state(
    car: Car,
    dt: float,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    charge: float = 1.0,
    slots: int | None = None,
) -> State:
    """A car at x, y, heading with velocity vx, vy, yaw rate. Its wheels roll.

    The delay lines hold zeros. `slots` is their length in ticks, by default `delay_slots`.
    """
    dtype = jnp.result_type(car.body.mass)
    zero = dtype.type(0)
    if slots is None:
        slots = delay_slots(car, dt)
    vx, _, yaw_rate = velocity
    speeds = Wheels(
        *(
            (vx - yaw_rate * y) / tire.radius
            for y, tire in zip(wheel_positions(car.body)[1], tires_by_wheel(car), strict=True)
        )
    )
    motion = Motion(*pose, *velocity, speeds, zero, zero, zero, zero, charge)
    motion = jax.tree.map(
        lambda leaf: leaf if isinstance(leaf, jax.Array) else dtype.type(leaf), motion
    )
    line = np.zeros(slots, dtype)
    return State(motion, line, line, zero, zero, zero, zero, zero)


def delay_slots(car: Car, dt: float) -> int:
    """Length of the delay lines in ticks: a power of two, so that similar cars share a program."""
    longest = max(float(np.max(car.motor.delay)), float(np.max(car.servo.delay)))
    return 1 << math.ceil(math.log2(longest / dt + 3))


def tires_by_wheel(car: Car) -> Wheels:
    """The tyre on each wheel."""
    front, rear = car.tires.front, car.tires.rear
    return Wheels(front, front, rear, rear)


def tires_on(car: Car, friction: Wheels | None) -> Wheels:
    """The tyre on each wheel, with its friction scaled by the floor under it."""
    tires = tires_by_wheel(car)
    return tires if friction is None else Wheels(*map(tyre.scaled, tires, friction))


def step(
    car: Car,
    around: jax.Array,
    state: State,
    command: AnyCommand,
    count: Scalar,
    dt: float,
    floor: Floor | None = None,
) -> State:
    """One tick of dt seconds. Pure; works under `jit`, `vmap` (the count unbatched) and `grad`.

    Throttle is in [-1, 1], steering in rad, a commanded speed in m/s. Precision is that of the
    car's leaves. Without a `floor`, friction is uniform and costs no computation.
    """
    tick = Tick(car, around, command, command, count, dt, floor, state.motion)
    for stage in STAGES:
        state, tick = stage(state, tick)
    return state


def delay(state: State, tick: Tick) -> tuple[State, Tick]:
    """Apply the pure delays of throttle and steering, with interpolation between ticks."""
    asked, steered = tick.command
    throttle_line, asked = _delayed(state.throttle_line, asked, tick.car.motor.delay, tick)
    steering_line, steering = _delayed(state.steering_line, steered, tick.car.servo.delay, tick)
    state = state._replace(throttle_line=throttle_line, steering_line=steering_line)
    return state, tick._replace(asked=type(tick.command)(asked, steering))


def _delayed(line: Array, now: Scalar, time: Scalar, tick: Tick) -> tuple[Array, Scalar]:
    slots = line.shape[0]
    slot = jnp.arange(slots)
    # In a batch, a choice by slot stays in place; an update by index would transpose the line.
    line = jnp.where(slot == tick.count % slots, jnp.asarray(now, line.dtype), line)
    ticks = jnp.clip(time / tick.dt, 0.0, slots - 2)
    whole = jnp.floor(ticks)
    newest = tick.count - whole.astype(jnp.int32)
    part = ticks - whole
    if slots > FEW:
        return line, (1 - part) * line[newest % slots] + part * line[(newest - 1) % slots]
    # Indexing is slow in a batch.
    share = jnp.where(slot == newest % slots, 1 - part, 0.0)
    share = jnp.where(slot == (newest - 1) % slots, part, share)
    return line, sum(share[i] * line[i] for i in range(slots))


def move(state: State, tick: Tick) -> tuple[State, Tick]:
    """The motion over the tick: coefficients at its middle, then two implicit stages."""
    car, h, start = tick.car, tick.dt, state.motion
    goal = speed_controller.goals(car, tick.asked, start.wheels)
    velocity = Vector(start.vx, start.vy, start.yaw_rate)
    friction = under_wheels(tick.floor, car.body, start, h / 2)
    at_start = grip(car, start, friction)
    ahead, wheels = implicit(car, at_start, TANGENT, velocity, start.wheels, h / 2)
    middle = loaded(
        car, follow(car, start, goal, h / 2), start, combine(1.0, ahead, -1.0, velocity), h / 2
    )
    ahead = rotated(ahead, h / 2 * start.yaw_rate)
    middle = middle._replace(vx=ahead.x, vy=ahead.y, yaw_rate=ahead.yaw, wheels=wheels)

    held = grip(car, middle, friction)
    before = rotated(velocity, h / 2 * start.yaw_rate)  # in the axes of the tick's middle
    tangent_weight = Wheels(*(w * (1 - state.energy_limited) for w in steady(at_start, held)))
    after, wheels = two_stages(car, held, tangent_weight, before, start.wheels, h)
    (after, wheels), energy_limited = guarded(car, held, (before, start.wheels), (after, wheels), h)

    end = loaded(car, follow(car, start, goal, h), start, combine(1.0, after, -1.0, before), h)
    turn = h * (start.yaw_rate + after.yaw) / 2
    angle = start.heading + h / 2 * start.yaw_rate
    cosine, sine = cosine_sine(angle)
    forward, left = h * (before.x + after.x) / 2, h * (before.y + after.y) / 2
    after = rotated(after, h / 2 * after.yaw)
    motion = end._replace(
        x=start.x + cosine * forward - sine * left,
        y=start.y + sine * forward + cosine * left,
        heading=start.heading + turn,
        vx=after.x,
        vy=after.y,
        yaw_rate=after.yaw,
        wheels=wheels,
        charge=battery.drained(car.battery, start.charge, h * held.drive.battery_current),
    )
    return state._replace(motion=motion, energy_limited=energy_limited), tick


def guarded(
    car: Car,
    held: "Grip",
    before: tuple[Vector, Wheels],
    after: tuple[Vector, Wheels],
    h: Scalar,
) -> tuple[tuple[Vector, Wheels], Scalar]:
    """The velocities after a tick without a gain of energy, and 1 if they were limited, else 0.

    Only the motor supplies energy. Its power is P. After a part p of the change d, the energy is
    E + p g + p² K(d). If the whole change gains more than h P, half of p = (h P - g) / K(d) is
    applied. At that p, the gain equals the supply p h P.
    """
    power = jnp.maximum(*(motor_power(car, held.drive, wheels) for _, wheels in (before, after)))
    change = jax.tree.map(lambda a, b: a - b, after, before)
    energy, slope = kinetic_energy(car, *before), kinetic_product(car, before, change)
    curvature = kinetic_energy(car, *change)
    gain = slope + curvature
    precision = jnp.finfo(jnp.result_type(energy))
    # A gain within rounding is none, nor is one that is as good as 0: squares of speeds underflow.
    gains = gain > h * power + 4 * precision.eps * energy + precision.tiny / precision.eps
    most = 2 * jnp.where(gains & (curvature > 0), curvature, 1.0)
    part = jnp.clip((h * power - slope) / most, 0.0, 1.0)
    limited = jax.tree.map(lambda b, d, a: jnp.where(gains, b + part * d, a), before, change, after)
    return limited, jnp.asarray(gains, jnp.result_type(energy))


def two_stages(
    car: Car, held: "Grip", tangent_weight: Wheels, velocity: Vector, wheels: Wheels, h: Scalar
) -> tuple[Vector, Wheels]:
    """Velocities after h seconds, by Alexander's two implicit stages with constant `Grip`."""
    first, first_wheels = implicit(car, held, tangent_weight, velocity, wheels, GAMMA * h)
    lifted, lifted_wheels = jax.tree.map(
        lambda v, w: v + (1 - GAMMA) / GAMMA * (w - v), (velocity, wheels), (first, first_wheels)
    )
    return implicit(car, held, tangent_weight, lifted, lifted_wheels, GAMMA * h)


def steady(start: "Grip", middle: "Grip") -> Wheels:
    """1 for each contact whose slip turns by less than 90° in the first half of the tick, else 0.

    Such a contact follows its tangent: the force of a sliding contact is nearly constant.
    """
    return Wheels(
        *(
            jnp.where(a.slip_x * b.slip_x + a.slip_y * b.slip_y > 0, 1.0, 0.0)
            for a, b in zip(start.contacts, middle.contacts, strict=True)
        )
    )


def motor_power(car: Car, drive: motor.Drive, wheels: Wheels) -> Scalar:
    """Power that the motor supplies at these wheel speeds (W), at least 0."""
    driven = drivetrain.driven_speed(car, wheels)
    return jnp.maximum((drive.torque - drive.slope * driven) * driven, 0.0)


def follow(car: Car, motion: Motion, goal: Command, h: Scalar) -> Motion:
    """The motion with steering and duty h seconds later, as they approach `goal`."""
    return motion._replace(
        steering=servo.turn(car.servo, motion.steering, goal.steering, h),
        duty=motion.duty - (goal.throttle - motion.duty) * jnp.expm1(-h / car.motor.lag),
    )


def loaded(car: Car, motion: Motion, start: Motion, change: Vector, h: Scalar) -> Motion:
    """The motion with `load_ax` and `load_ay` after h seconds with this change of velocity."""
    follows = -jnp.expm1(-h / car.body.load_lag)
    return motion._replace(
        load_ax=start.load_ax + follows * (change.x / h - start.load_ax),
        load_ay=start.load_ay + follows * (change.y / h - start.load_ay),
    )


def rotated(v: Vector, angle: Scalar) -> Vector:
    """The velocity v in axes that are turned by a small angle (rad). Its length is kept exactly.

    The rotation is by 2 atan(a), which differs from `angle` by terms of fifth order.
    """
    a = angle / 2 * (1 + angle**2 / 12)
    c, s = (1 - a**2) / (1 + a**2), 2 * a / (1 + a**2)
    return Vector(c * v.x + s * v.y, c * v.y - s * v.x, v.yaw)


class Steered(NamedTuple):
    """Cosine and sine of each front wheel's angle."""

    left: tuple[Scalar, Scalar]
    right: tuple[Scalar, Scalar]


class Grip(NamedTuple):
    """The forces on the car at an instant, as coefficients of its velocities."""

    steered: Steered
    contacts: Wheels  # a tyre.Contact each
    drag: Wheels  # N m s
    drive: motor.Drive


@jax.jit
def grip(car: Car, motion: Motion, friction: Wheels | None = None) -> Grip:
    """Contacts, drag and drive at an instant. `friction` is the floor's factor at each contact."""
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)
    steered = Steered(*servo.directions(car.body, car.servo, motion.steering))
    rolls, slides = contact_directions(car, steered)
    loads = chassis.wheel_loads(car.body, motion.load_ax, motion.load_ay)
    found, drag = [], []
    for tire, load, speed, roll, slide in zip(
        tires_on(car, friction), loads, motion.wheels, rolls, slides, strict=True
    ):
        rim = tire.radius * speed
        found.append(tyre.contact(tire, load, dot(roll, velocity) - rim, dot(slide, velocity), rim))
        drag.append(drivetrain.drag(car, tire, found[-1].force_y, speed))
    driven = drivetrain.driven_speed(car, motion.wheels)
    return Grip(
        steered,
        Wheels(*found),
        Wheels(*drag),
        motor.drive(car.motor, car.drivetrain, car.battery, motion.duty, motion.charge, driven),
    )


@jax.jit
def implicit(
    car: Car, held: "Grip", tangent_weight: Wheels, velocity: Vector, wheels: Wheels, h: Scalar
) -> tuple[Vector, Wheels]:
    """Velocities after h seconds, by one implicit Euler step with constant `Grip`.

    Solves (M + h C) v' = M v + h a, where a - C v are the forces of contacts, drag and drive.
    A contact's force follows its chord where `tangent_weight` is 0, its tangent where it is 1.
    """
    body, tires = car.body, tires_by_wheel(car)
    rolls, slides = contact_directions(car, held.steered)
    along, across, push_x, push_y = [], [], [], []
    for c, w in zip(held.contacts, tangent_weight, strict=True):
        along.append(c.k_x + w * (c.tangent_x - c.k_x))
        across.append(c.k_y + w * (c.tangent_y - c.k_y))
        push_x.append(w * c.push_x)
        push_y.append(w * c.push_y)
    # Torque impulse per slip speed, J + h b, and J + h (R² k + b) of each wheel.
    pull = [h * tire.radius * k for tire, k in zip(tires, along, strict=True)]
    bare = [tire.inertia + h * b for tire, b in zip(tires, held.drag, strict=True)]
    own = [b + p * tire.radius for b, p, tire in zip(bare, pull, tires, strict=True)]

    # Wheels, differentials and rotor, linear in the hubs' speeds at the end of the step.
    lock = car.drivetrain
    front = drivetrain.axle(lock.front_lock, own[0], own[1], h)
    rear = drivetrain.axle(lock.rear_lock, own[2], own[3], h)
    coupled = drivetrain.shaft(
        car, front, rear, held.drive, drivetrain.driven_speed(car, wheels), h
    )
    free = Wheels(
        *(
            tire.inertia * speed - h * tire.radius * push
            for tire, speed, push in zip(tires, wheels, push_x, strict=True)
        )
    )
    standing = _speeds(front, rear, coupled, free)  # wheel speeds with hubs at rest

    # The body: (inertia + contacts' resistance) velocity' = momentum + impulse of the wheels.
    matrix = Symmetric(body.mass, body.mass, body.yaw_inertia, 0.0, 0.0, 0.0)
    momentum = Vector(
        body.mass * velocity.x, body.mass * velocity.y, body.yaw_inertia * velocity.yaw
    )
    for i in range(4):
        matrix = matrix.plus(h * across[i], slides[i])
        push = pull[i] * standing[i] + h * push_x[i]
        momentum = combine(1.0, momentum, push, rolls[i])
        momentum = combine(1.0, momentum, h * push_y[i], slides[i])
    pulls = []
    for axle, left, right in ((front, 0, 1), (rear, 2, 3)):
        for this, other_own in ((left, axle.own_right), (right, axle.own_left)):
            # h k - pull² A⁻¹ (A: `drivetrain.Axle`), in a form without cancellation
            resists = bare[this] * (other_own + axle.link) + axle.link * other_own
            matrix = matrix.plus(h * along[this] * resists * axle.inverse, rolls[this])
        mixed = -pull[left] * pull[right] * axle.link * axle.inverse
        matrix = matrix.plus_mixed(mixed, rolls[left], rolls[right])
        pulls.append(
            combine(
                pull[left] * axle.share_left,
                rolls[left],
                pull[right] * axle.share_right,
                rolls[right],
            )
        )
    matrix = matrix.plus(coupled.front_front, pulls[0]).plus(coupled.rear_rear, pulls[1])
    matrix = matrix.plus_mixed(coupled.front_rear, pulls[0], pulls[1])
    least = Vector(body.mass, body.mass, body.yaw_inertia)
    after = chassis.solve(matrix, momentum, least)
    pushed = Wheels(*(free[i] + pull[i] * dot(rolls[i], after) for i in range(4)))
    return after, _speeds(front, rear, coupled, pushed)


def _speeds(
    front: drivetrain.Axle, rear: drivetrain.Axle, coupled: drivetrain.Shaft, momenta: Wheels
) -> Wheels:
    to_front, to_rear = drivetrain.shaft_impulses(coupled, front, rear, momenta)
    return Wheels(
        *drivetrain.wheel_speeds(front, momenta.front_left, momenta.front_right, to_front),
        *drivetrain.wheel_speeds(rear, momenta.rear_left, momenta.rear_right, to_rear),
    )


def contact_directions(car: Car, steered: Steered) -> tuple[Wheels, Wheels]:
    """Rows that map the body's velocities to each hub's: along its wheel, and to its left."""
    xs, ys = wheel_positions(car.body)
    ahead = (1.0, 0.0)
    rolls, slides = [], []
    for x, y, (cosine, sine) in zip(xs, ys, (*steered, ahead, ahead), strict=True):
        rolls.append(Vector(cosine, sine, times(x, sine) - y * cosine))
        slides.append(Vector(-sine, cosine, x * cosine + times(y, sine)))
    return Wheels(*rolls), Wheels(*slides)


def kinetic_energy(car: Car, velocity: Vector, wheels: Wheels) -> Scalar:
    """Kinetic energy of the body, the wheels' spin and the rotor (J)."""
    return kinetic_product(car, (velocity, wheels), (velocity, wheels)) / 2


def kinetic_product(car: Car, a: tuple[Vector, Wheels], b: tuple[Vector, Wheels]) -> Scalar:
    """The product a · M b of velocities of body and wheels, M the matrix of inertias (J)."""
    (v, spins), (w, others) = a, b
    product = car.body.mass * (v.x * w.x + v.y * w.y) + car.body.yaw_inertia * v.yaw * w.yaw
    for tire, spin, other in zip(tires_by_wheel(car), spins, others, strict=True):
        product = product + tire.inertia * spin * other
    rotor = drivetrain.driven_speed(car, spins) * drivetrain.driven_speed(car, others)
    return product + drivetrain.rotor_inertia(car) * rotor


def collide(state: State, tick: Tick) -> tuple[State, Tick]:
    """Move the car out of its deepest contact with a wall, apply the impulse, count new touches."""
    start = state.motion if tick.start is None else tick.start
    motion, touches = walls.collide(tick.car.body, tick.walls, start, state.motion)
    fresh = touches * jnp.where(state.touching <= 0, 1.0, 0.0)
    touching = jnp.where(touches > 0, TOUCH_TIME, jnp.maximum(state.touching - tick.dt, 0.0))
    return (
        state._replace(motion=motion, touching=touching, wall_contacts=state.wall_contacts + fresh),
        tick,
    )


def judge(state: State, tick: Tick) -> tuple[State, Tick]:
    """Mark a car as rolled over after `ROLL_OVER_TIME` with a pair of wheels in the air."""
    loads = chassis.wheel_loads(tick.car.body, state.motion.load_ax, state.motion.load_ay)
    up = chassis.pair_in_air(loads)
    airborne = up * (state.airborne + tick.dt)
    over = jnp.where(airborne >= ROLL_OVER_TIME - tick.dt / 2, 1.0, state.rolled_over)
    return state._replace(airborne=airborne, rolled_over=over), tick


STAGES: tuple[Callable[[State, Tick], tuple[State, Tick]], ...] = (delay, move, collide, judge)


class Forces(NamedTuple):
    """Force of one contact in the axes of its wheel, for pictures and tests."""

    force_x: Scalar  # N
    force_y: Scalar
    limit: Scalar  # upper limit of the force at this load, N (`tyre.limit`)
    slip: Scalar  # speed of the contact over the ground, m/s
    angle: Scalar  # of the wheel, rad


def forces(car: Car, motion: Motion, floor: Floor | None = None) -> Wheels:
    """The four contacts' forces at an instant."""
    friction = under_wheels(floor, car.body, motion)
    held = grip(car, motion, friction)
    rolls, _ = contact_directions(car, held.steered)
    loads = chassis.wheel_loads(car.body, motion.load_ax, motion.load_ay)
    return Wheels(
        *(
            Forces(
                c.force_x,
                c.force_y,
                tyre.limit(tire, load),
                jnp.sqrt(c.slip_x**2 + c.slip_y**2),
                jnp.arctan2(roll.y, roll.x),
            )
            for tire, load, roll, c in zip(
                tires_on(car, friction), loads, rolls, held.contacts, strict=True
            )
        )
    )


@pytree
class Planar:
    """The planar world as a `World`. `slots` is the length of its delay lines in ticks."""

    car: Car
    walls: Array  # (n, 4), padded with rows of NaN
    floor: Floor | None = None
    dt: float = dataclasses.field(metadata={"static": True})
    slots: int = dataclasses.field(metadata={"static": True})

    def init(
        self,
        pose: tuple[Scalar, Scalar, Scalar],
        velocity: tuple[Scalar, Scalar, Scalar] = (0.0, 0.0, 0.0),
        charge: Scalar = 1.0,
    ) -> State:
        """The car at x, y, heading with velocity vx, vy, yaw rate. See `initial_state`."""
        return initial_state(self.car, self.dt, pose, velocity, charge, self.slots)

    def step(self, state: State, command: AnyCommand, tick: Scalar) -> State:
        """One tick."""
        return step(self.car, self.walls, state, command, tick, self.dt, self.floor)

    def motion(self, state: State) -> Motion:
        """The car's motion."""
        return state.motion

    def events(self, state: State) -> Events:
        """Touches of walls so far, and 1 if the car has rolled over."""
        return Events(state.wall_contacts, state.rolled_over)

    def forces(self, motion: Motion) -> Wheels:
        """The four contacts' forces: `Forces` of each wheel."""
        return forces(self.car, motion, self.floor)


def planar(car: Car, walls: Array, floor: Floor | None, dt: float) -> Planar:
    """The planar world of a car. Its precision is that of the car's leaves."""
    return Planar(car=car, walls=walls, floor=floor, dt=dt, slots=delay_slots(car, dt))
