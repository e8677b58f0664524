"""The models that were published with the DART and the ETH logs, beside which ours is judged.

Both are single-track models of the body's three velocities, with tyres that make lateral force
only:

    m (dvx/dt - w vy) = Fx - Ff sin(d)          Fx in front too, turned by d, if it is driven
    m (dvy/dt + w vx) = Fr + Ff cos(d)
    J dw/dt           = lf Ff cos(d) - lr Fr

vx, vy (m/s) and w (rad/s) are those of the centre of mass in the body's axes, d (rad) is the angle
of the front wheels, and Ff, Fr (N) are the lateral forces of the axles. They have no wheels, so
their wheel speed is vx. All arrays have one entry for each window.

Sources. DART: Lyons, Ferranti, "DART, Delft's Autonomous-driving Robotic Testbed", and the
numbers of `System_identification/dart_dynamic_models.py` in github.com/Lorenzo-Lyons/DART. ETH:
Rothfuss et al., "Bridging the Sim-to-Real Gap with Bayesian Inference", and the model of
`sim_transfer/sims/dynamics_models.py` in github.com/lasgroup/simulation_transfer. Both have the MIT
licence. The equations are theirs; the code is ours.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.signal import lfilter

from countersteer.car.car import GRAVITY
from countersteer.tuning.windows import QUANTITIES

Array = np.ndarray


class Velocity(NamedTuple):
    """Velocity of the centre of mass (m/s), and yaw rate (rad/s)."""

    vx: Array
    vy: Array
    yaw_rate: Array

    def moved(self, rate: "Velocity", time: float) -> "Velocity":
        """The velocity after `time` seconds at a constant rate of change."""
        return Velocity(*(one + time * slope for one, slope in zip(self, rate, strict=True)))


class Model(Protocol):
    """A published model."""

    def inputs(self, throttle: Array, steering: Array, dt: float) -> tuple[Array, Array]:
        """Drive and steering as they act in each tick of a log; commands are in [-1, 1]."""

    def rates(self, now: Velocity, drive: Array, steering: Array) -> Velocity:
        """The rate of change of the velocity under what `inputs` returns."""


@dataclass(frozen=True)
class Dart:
    """The model of the DART car on its floor of good grip.

    drive force = (strength - back v) max(throttle - dead zone, 0), shared by the axles as the load;
    its resistances are those of `resistance`. Tyre: F = -load D sin(C atan(B slip angle)).
    """

    mass: float = 1.58  # kg
    load_front: float = 0.847  # kg
    load_rear: float = 0.733  # kg
    wheelbase: float = 0.1735  # m
    width: float = 0.08  # m; with the wheelbase, of the box that has the yaw inertia
    strength: float = 25.36  # N
    back: float = 4.815  # N s/m
    dead_zone: float = 0.164
    throttle_lag: float = 0.0843  # s
    steering_lag: float = 0.1285  # s
    steering_zero: float = 0.027  # command at which the wheels point ahead
    left: tuple[float, float] = (0.3658, 1.3929)  # rad, 1: limit and slope of the steering
    right: tuple[float, float] = (0.5148, 1.0230)
    front: tuple[float, float, float] = (8.598, 0.8407, 0.8407)  # B, C, D
    rear: tuple[float, float, float] = (11.549, 0.9591, 0.8547)

    def inputs(self, throttle: Array, steering: Array, dt: float) -> tuple[Array, Array]:
        """Both commands through a lag of first order, from 0 at the log's start."""
        return lagged(throttle, self.throttle_lag, dt), lagged(steering, self.steering_lag, dt)

    def rates(self, now: Velocity, drive: Array, steering: Array) -> Velocity:
        """See the module's equations."""
        vx, vy, yaw_rate = now
        front, rear = (
            self.wheelbase * part / self.mass for part in (self.load_rear, self.load_front)
        )
        inertia = self.mass * (self.wheelbase**2 + self.width**2) / 12
        angle = self.angle(steering)
        cosine, sine = np.cos(angle), np.sin(angle)
        force = (self.strength - self.back * vx) * np.maximum(drive - self.dead_zone, 0.0)
        force = force - self.resistance(vx, angle)
        at_front = vy + front * yaw_rate
        slip_front = slip_angle(cosine * vx + sine * at_front, cosine * at_front - sine * vx)
        slip_rear = slip_angle(vx, vy - rear * yaw_rate)
        lateral_front = -GRAVITY * self.load_front * magic(slip_front, *self.front)
        lateral_rear = -GRAVITY * self.load_rear * magic(slip_rear, *self.rear)
        drive_front = force * self.load_front / self.mass
        drive_rear = force - drive_front
        ahead = drive_rear + drive_front * cosine - lateral_front * sine
        aside_front = drive_front * sine + lateral_front * cosine
        return Velocity(
            ahead / self.mass + yaw_rate * vy,
            (aside_front + lateral_rear) / self.mass - yaw_rate * vx,
            (front * aside_front - rear * lateral_rear) / inertia,
        )

    def angle(self, steering: Array) -> Array:
        """The angle of the front wheels (rad) at a command in [-1, 1]."""
        asked = steering - self.steering_zero
        to_left = 0.5 * (np.tanh(30 * asked) + 1)
        by_side = (limit * np.tanh(slope * asked) for limit, slope in (self.left, self.right))
        left, right = by_side
        return to_left * left + (1 - to_left) * right

    def resistance(self, vx: Array, angle: Array) -> Array:
        """Rolling resistance, and what steering adds to it (N)."""
        rolling = 1.266 * np.tanh(7.666 * vx) + 0.7393 * vx - 0.1123 * vx**2
        moves = 0.5 + 0.5 * np.tanh(20 * (vx - 0.3))
        steered = -0.1183 + 5.916 * angle * np.tanh(30 * angle)
        return rolling + moves * (0.7793 + 0.2262 * (vx - 0.5)) * steered


@dataclass(frozen=True)
class Eth:
    """The model of the ETH car, driven at the rear.

    drive force = strength throttle - drag vx. Tyre: F = g D sin(C atan(B slip angle)), D in kg. At
    vx <= 0 the car follows its wheels: vy and yaw rate are those of rolling without slip.
    """

    mass: float = 1.65  # kg
    front_axle: float = 0.13  # m, to the centre of mass
    rear_axle: float = 0.17  # m
    inertia: float = 0.0685  # kg m2
    steering_limit: float = 0.634  # rad
    strength: float = 11.10  # N
    drag: float = 1.734  # N s/m
    front: tuple[float, float, float] = (1.90, 1.54, 0.597)  # B, C, D
    rear: tuple[float, float, float] = (6.29, 1.19, 0.427)
    settles: float = 1 / 90  # s, in which the rolling car follows its wheels

    def inputs(self, throttle: Array, steering: Array, _: float) -> tuple[Array, Array]:
        """Both commands as they are: the model has neither lag nor delay."""
        return throttle, steering

    def rates(self, now: Velocity, drive: Array, steering: Array) -> Velocity:
        """See the module's equations."""
        vx, vy, yaw_rate = now
        angle = self.steering_limit * np.clip(steering, -1, 1)
        cosine, sine = np.cos(angle), np.sin(angle)
        force = self.strength * np.clip(drive, -1, 1) - self.drag * vx
        ahead = np.maximum(vx, 1e-6)
        slip_front = angle - np.arctan((vy + self.front_axle * yaw_rate) / ahead)
        slip_rear = -np.arctan((vy - self.rear_axle * yaw_rate) / ahead)
        front = GRAVITY * magic(slip_front, *self.front)
        rear = GRAVITY * magic(slip_rear, *self.rear)
        slides = Velocity(
            (force - front * sine) / self.mass + yaw_rate * vy,
            (rear + front * cosine) / self.mass - yaw_rate * vx,
            (self.front_axle * front * cosine - self.rear_axle * rear) / self.inertia,
        )
        turn = vx * np.tan(angle) / (self.front_axle + self.rear_axle)
        rolls = Velocity(
            force / self.mass,
            (self.rear_axle * turn - vy) / self.settles,
            (turn - yaw_rate) / self.settles,
        )
        return Velocity(
            *(np.where(vx > 0, one, two) for one, two in zip(slides, rolls, strict=True))
        )


def magic(slip: Array, stiffness: float, shape: float, peak: float) -> Array:
    """The tyre curve D sin(C atan(B slip))."""
    return peak * np.sin(shape * np.arctan(stiffness * slip))


def slip_angle(along: Array, across: Array) -> Array:
    """DART's slip angle (rad) of a wheel, whose speed counts for more below 1 m/s."""
    return np.arctan2(across, along + np.exp(-3 * along**2))


def lagged(values: Array, lag: float, dt: float) -> Array:
    """Values through a lag of first order (s), from 0."""
    keep = math.exp(-dt / lag)
    return np.asarray(lfilter([0.0, 1 - keep], [1.0, -keep], values))


def predict(
    model: Model, start: Velocity, drive: Array, steering: Array, dt: float
) -> dict[str, Array]:
    """The quantities of `tuning.windows.QUANTITIES` from the start on: (windows, ticks + 1).

    `drive` and `steering` are what `inputs` returns, by window and tick. The scheme is Runge and
    Kutta's of fourth order. Every model's stiffest mode is slower than 1500 / s at 0.2 m/s.
    """
    now, trace = start, [start]
    for tick in range(drive.shape[1]):
        held = (drive[:, tick], steering[:, tick])
        first = model.rates(now, *held)
        second = model.rates(now.moved(first, dt / 2), *held)
        third = model.rates(now.moved(second, dt / 2), *held)
        fourth = model.rates(now.moved(third, dt), *held)
        for rate, share in ((first, 1), (second, 2), (third, 2), (fourth, 1)):
            now = now.moved(rate, dt * share / 6)
        trace.append(now)
    vx, vy, yaw_rate = (np.stack(one, axis=1) for one in zip(*trace, strict=True))
    return dict(zip(QUANTITIES, (vx, vy, yaw_rate, vx), strict=True))
