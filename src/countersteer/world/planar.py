"""The planar world: one tick takes a car from one instant to the next.

`step` runs the named `STAGES` in their order. The stage `move` is the physics proper. Within it,
`substep` is a first-order step in which every velocity is linearly implicit: each contact's force
is -k times its slip velocity *at the end* of the step, with k >= 0 from the tyre law at its
start. Wheels, differentials, rotor and back-EMF are eliminated in closed form, and a 3 x 3 system
is left for the body. With G the matrix that maps velocities v to slips and M the inertias,

    M (v' - v) = -h Gᵀ K G v'   =>   ½ v'ᵀ M v' <= ½ vᵀ M v

for any step h and any k >= 0: contacts cannot put energy in. Velocities are solved in the axes of
the step's start, an inertial frame, then rotated exactly. `move` extrapolates one such step
against two halves, which is of second order where the motion is smooth, and keeps the two halves
wherever the extrapolation would hold more kinetic energy than the motor has put in.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car, Wheels, wheel_positions
from countersteer.car.parameter import Scalar
from countersteer.world import battery, chassis, drivetrain, motor, servo, tyre, walls
from countersteer.world.chassis import Symmetric, Vector, combine, dot
from countersteer.world.state import Motion, State

ROLL_OVER_TIME = 0.1  # s that a pair of wheels is in the air until the car counts as rolled over
TOUCH_TIME = 0.2  # s without contact after which the next one is a new touch


class Command(NamedTuple):
    """What a driver asks for."""

    throttle: Scalar  # -1 to 1; negative is reverse or brake
    steering: Scalar  # angle of the front wheels, rad, positive to the left


class Tick(NamedTuple):
    """What a stage of a tick works with, besides the state."""

    car: Car
    walls: jax.Array  # (n, 4): x, y of both ends, m; rows of NaN are padding
    command: Command  # as it reaches the car now
    asked: Command  # as it reaches motor and servo, after their delays
    count: Scalar  # ticks since the start, an integer
    dt: float


def initial_state(
    car: Car,
    dt: float,
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    charge: float = 1.0,
    slots: int | None = None,
) -> State:
    """A car at x, y, heading with velocity vx, vy, yaw rate, its wheels rolling, no command under way.

    `slots` is the length of the delay lines in ticks; by default what the car's delays need.
    """
    dtype = np.asarray(car.body.mass).dtype
    zero = dtype.type(0)
    if slots is None:
        slots = delay_slots(car, dt)
    vx, vy, yaw_rate = velocity
    speeds = Wheels(
        *(
            jnp.asarray((vx - yaw_rate * y) / tire.radius, dtype)
            for y, tire in zip(wheel_positions(car.body)[1], tires_by_wheel(car), strict=True)
        )
    )
    motion = Motion(*pose, *velocity, speeds, zero, zero, zero, zero, charge)  # type: ignore[arg-type]
    motion = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), motion)
    line = jnp.zeros(slots, dtype)
    return State(motion, line, line, *[jnp.asarray(zero)] * 4)


def delay_slots(car: Car, dt: float) -> int:
    """Ticks that a delay line must hold; a power of two, so that like cars share a program."""
    longest = max(float(np.max(car.motor.delay)), float(np.max(car.servo.delay)))
    return 1 << math.ceil(math.log2(longest / dt + 3))


def tires_by_wheel(car: Car) -> Wheels:
    """The tyre on each wheel."""
    front, rear = car.tires.front, car.tires.rear
    return Wheels(front, front, rear, rear)  # type: ignore[arg-type]  # a tyre each, not a number


def step(
    car: Car, around: jax.Array, state: State, command: Command, count: Scalar, dt: float
) -> State:
    """One tick of dt seconds. Pure; works under `jit`, `vmap` (the count unbatched) and `grad`.

    Throttle in [-1, 1], steering in rad. Precision is that of the car's leaves.
    """
    tick = Tick(car, around, command, command, count, dt)
    for stage in STAGES:
        state, tick = stage(state, tick)
    return state


def delay(state: State, tick: Tick) -> tuple[State, Tick]:
    """Pure delays of throttle and steering, to fractions of a tick by interpolation."""
    throttle_line, throttle = _delayed(
        state.throttle_line, tick.command.throttle, tick.car.motor.delay, tick
    )
    steering_line, steering = _delayed(
        state.steering_line, tick.command.steering, tick.car.servo.delay, tick
    )
    state = state._replace(throttle_line=throttle_line, steering_line=steering_line)
    return state, tick._replace(asked=Command(throttle, steering))


def _delayed(
    line: jax.Array, now: Scalar, time: Scalar, tick: Tick
) -> tuple[jax.Array, Scalar]:
    slots = line.shape[0]
    line = jax.lax.dynamic_update_index_in_dim(
        line, jnp.asarray(now, line.dtype), tick.count % slots, 0
    )
    ticks = jnp.clip(time / tick.dt, 0.0, slots - 2)
    whole = jnp.floor(ticks)
    newest = tick.count - whole.astype(jnp.int32)
    part = ticks - whole
    return line, (1 - part) * line[newest % slots] + part * line[(newest - 1) % slots]


def move(state: State, tick: Tick) -> tuple[State, Tick]:
    """The motion over the tick: one substep extrapolated against two halves."""
    goal = Command(
        motor.duty(tick.car.motor, tick.asked.throttle),
        servo.target(tick.car.servo, tick.asked.steering),
    )
    start = state.motion
    whole, _ = substep(tick.car, start, goal, tick.dt)
    middle, work_1 = substep(tick.car, start, goal, tick.dt / 2)
    halves, work_2 = substep(tick.car, middle, goal, tick.dt / 2)
    better = jax.tree.map(lambda two, one: 2 * two - one, halves, whole)
    bound = kinetic_energy(tick.car, start) + jnp.maximum(work_1 + work_2, 0.0)
    holds = kinetic_energy(tick.car, better) <= bound
    motion = jax.tree.map(lambda a, b: jnp.where(holds, a, b), better, halves)
    return state._replace(motion=motion), tick


@jax.jit
def substep(car: Car, motion: Motion, goal: Command, h: Scalar) -> tuple[Motion, Scalar]:
    """A first-order step of h seconds, and the work of the motor in it (J).

    `goal` is the duty and the angle that speed controller and servo are heading for.
    """
    body, speeds = car.body, motion.wheels
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)
    rolls, slides = contact_directions(car, motion.steering)
    loads = chassis.wheel_loads(body, motion.load_ax, motion.load_ay)
    tires = tires_by_wheel(car)

    along, across, own = [], [], []
    for tire, load, speed, roll, slide in zip(tires, loads, speeds, rolls, slides, strict=True):
        rim = tire.radius * speed
        k_x, k_y = tyre.stiffness(tire, load, dot(roll, velocity) - rim, dot(slide, velocity), rim)
        along.append(h * tire.radius * k_x)  # torque impulse per slip speed
        across.append(h * k_y)
        own.append(tire.inertia + along[-1] * tire.radius + h * drivetrain.drag(car, speed))

    # Wheels, differentials and rotor as a linear function of the hubs' speeds to come.
    lock = car.drivetrain
    front = drivetrain.axle(lock.front_lock, own[0], own[1], h)
    rear = drivetrain.axle(lock.rear_lock, own[2], own[3], h)
    driven = drivetrain.driven_speed(car, speeds)
    drive = motor.drive(car.motor, lock, car.battery, motion.duty, motion.charge, driven)
    coupled = drivetrain.shaft(car, front, rear, drive, driven, h)
    free = Wheels(*(tire.inertia * speed for tire, speed in zip(tires, speeds, strict=True)))
    standing = _speeds(front, rear, coupled, free)  # if the hubs stood still

    # The body: (inertia + what the contacts resist with) velocity' = momentum + what wheels push.
    zero = 0.0 * body.mass
    matrix = Symmetric(body.mass, body.mass, body.yaw_inertia, zero, zero, zero)
    momentum = Vector(
        body.mass * motion.vx, body.mass * motion.vy, body.yaw_inertia * motion.yaw_rate
    )
    for i in range(4):
        matrix = matrix.plus(across[i], slides[i])
        momentum = combine(1.0, momentum, along[i] * standing[i], rolls[i])
    pulls = []
    for axle, left, right in ((front, 0, 1), (rear, 2, 3)):
        for this, other, other_own in ((left, right, axle.own_right), (right, left, axle.own_left)):
            # along/R - along² (inverse of the axle's matrix), without its cancellation
            kept = own[this] - along[this] * tires[this].radius
            resists = (kept * (other_own + axle.link) + axle.link * other_own) / axle.determinant
            matrix = matrix.plus(along[this] / tires[this].radius * resists, rolls[this])
        mixed = -along[left] * along[right] * axle.link / axle.determinant
        matrix = matrix.plus_mixed(mixed, rolls[left], rolls[right])
        pulls.append(
            combine(
                along[left] * axle.share_left,
                rolls[left],
                along[right] * axle.share_right,
                rolls[right],
            )
        )
    matrix = matrix.plus(coupled.front_front, pulls[0]).plus(coupled.rear_rear, pulls[1])
    matrix = matrix.plus_mixed(coupled.front_rear, pulls[0], pulls[1])
    after = chassis.solve(matrix, momentum)

    pushed = Wheels(*(free[i] + along[i] * dot(rolls[i], after) for i in range(4)))
    turned = _speeds(front, rear, coupled, pushed)
    driven_after = drivetrain.driven_speed(car, turned)
    work = h * (drive.torque - drive.slope * driven_after) * driven_after
    return _advance(car, motion, goal, after, turned, drive, h), work


def _speeds(
    front: drivetrain.Axle, rear: drivetrain.Axle, coupled: drivetrain.Shaft, momenta: Wheels
) -> Wheels:
    to_front, to_rear = drivetrain.shaft_impulses(coupled, front, rear, momenta)
    return Wheels(
        *drivetrain.wheel_speeds(front, momenta.front_left, momenta.front_right, to_front),
        *drivetrain.wheel_speeds(rear, momenta.rear_left, momenta.rear_right, to_rear),
    )


def _advance(
    car: Car,
    motion: Motion,
    goal: Command,
    after: Vector,
    speeds: Wheels,
    drive: motor.Drive,
    h: Scalar,
) -> Motion:
    """Everything else over the step, given the velocities at its end in the axes of its start."""
    cosine, sine = jnp.cos(motion.heading), jnp.sin(motion.heading)
    forward, left = h * (motion.vx + after.x) / 2, h * (motion.vy + after.y) / 2
    turned = h * (motion.yaw_rate + after.yaw) / 2
    # An exact rotation by 2 atan(a), which is `turned` to the fifth order.
    a = turned / 2 * (1 + turned**2 / 12)
    c, s = (1 - a**2) / (1 + a**2), 2 * a / (1 + a**2)
    follows = -jnp.expm1(-h / car.body.load_lag)
    ax, ay = (after.x - motion.vx) / h, (after.y - motion.vy) / h
    return Motion(
        motion.x + cosine * forward - sine * left,
        motion.y + sine * forward + cosine * left,
        motion.heading + turned,
        c * after.x + s * after.y,
        c * after.y - s * after.x,
        after.yaw,
        speeds,
        servo.turn(car.servo, motion.steering, goal.steering, h),
        motion.duty - (goal.throttle - motion.duty) * jnp.expm1(-h / car.motor.lag),
        motion.load_ax + follows * (ax - motion.load_ax),
        motion.load_ay + follows * (ay - motion.load_ay),
        motion.charge - h * drive.battery_current / battery.capacity(car.battery),
    )


def contact_directions(car: Car, steering: Scalar) -> tuple[Wheels, Wheels]:
    """How the body's velocities move each contact: along its wheel, and to the wheel's left."""
    xs, ys = wheel_positions(car.body)
    left, right = servo.directions(car.body, car.servo, steering)
    ahead = (1.0, 0.0)
    rolls, slides = [], []
    for x, y, (cosine, sine) in zip(xs, ys, (left, right, ahead, ahead), strict=True):
        rolls.append(Vector(cosine, sine, x * sine - y * cosine))
        slides.append(Vector(-sine, cosine, x * cosine + y * sine))
    return Wheels(*rolls), Wheels(*slides)  # type: ignore[arg-type]  # a vector each


def kinetic_energy(car: Car, motion: Motion) -> Scalar:
    """Of the body, the wheels' spin and the rotor's (J)."""
    energy = (
        car.body.mass * (motion.vx**2 + motion.vy**2) + car.body.yaw_inertia * motion.yaw_rate**2
    )
    for tire, speed in zip(tires_by_wheel(car), motion.wheels, strict=True):
        energy = energy + tire.inertia * speed**2
    driven = drivetrain.driven_speed(car, motion.wheels)
    return (energy + drivetrain.rotor_inertia(car) * driven**2) / 2


def collide(state: State, tick: Tick) -> tuple[State, Tick]:
    """Walls: the deepest contact of the tick is pushed out and takes its impulse."""
    motion, touches = walls.collide(tick.car.body, tick.walls, state.motion)
    fresh = touches * jnp.where(state.touching <= 0, 1.0, 0.0)
    touching = jnp.where(touches > 0, TOUCH_TIME, jnp.maximum(state.touching - tick.dt, 0.0))
    return (
        state._replace(
            motion=motion, touching=touching, wall_contacts=state.wall_contacts + fresh
        ),
        tick,
    )


def judge(state: State, tick: Tick) -> tuple[State, Tick]:
    """Notes a car that has two wheels in the air for too long."""
    loads = chassis.wheel_loads(tick.car.body, state.motion.load_ax, state.motion.load_ay)
    up = chassis.pair_in_air(loads)
    airborne = up * (state.airborne + tick.dt)
    over = jnp.where(airborne >= ROLL_OVER_TIME, 1.0, state.rolled_over)
    return state._replace(airborne=airborne, rolled_over=over), tick


STAGES: tuple[Callable[[State, Tick], tuple[State, Tick]], ...] = (delay, move, collide, judge)


class Contact(NamedTuple):
    """A wheel's contact, for pictures and tests: force in the wheel's own axes."""

    force_x: Scalar  # N
    force_y: Scalar
    limit: Scalar  # largest force that the tread can hold at this load, N
    slip: Scalar  # speed of the contact over the ground, m/s
    angle: Scalar  # of the wheel, rad


def contacts(car: Car, motion: Motion) -> Wheels:
    """The four contacts at an instant."""
    velocity = Vector(motion.vx, motion.vy, motion.yaw_rate)
    loads = chassis.wheel_loads(car.body, motion.load_ax, motion.load_ay)
    found = []
    for tire, load, speed, roll, slide in zip(
        tires_by_wheel(car),
        loads,
        motion.wheels,
        *contact_directions(car, motion.steering),
        strict=True,
    ):
        rim = tire.radius * speed
        slip_x, slip_y = dot(roll, velocity) - rim, dot(slide, velocity)
        k_x, k_y = tyre.stiffness(tire, load, slip_x, slip_y, rim)
        found.append(
            Contact(
                -k_x * slip_x,
                -k_y * slip_y,
                tire.friction * load,
                jnp.sqrt(slip_x**2 + slip_y**2),
                jnp.arctan2(roll.y, roll.x),
            )
        )
    return Wheels(*found)  # type: ignore[arg-type]  # a contact each
