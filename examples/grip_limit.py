"""A driver of one's own that laps closed courses at the limit of grip, without drifting.

It steers by the true state (the estimator `truth`), not by sensors: a yardstick, not a robot. Try

    python examples/grip_limit.py TRACK.csv --laps 2
"""

import argparse
import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from countersteer.car.car import GRAVITY, Car, Tire
from countersteer.car.files import load_car
from countersteer.car.parameter import pytree
from countersteer.compiling import configure_jax
from countersteer.course.course import Course, progress
from countersteer.course.files import load_course
from countersteer.drivers.driver import Observation
from countersteer.errors import InputError
from countersteer.pilot import Pilot
from countersteer.signals import Array, Command, Scalar
from countersteer.simulator import Simulator
from countersteer.world import motor

POINTS = 1024  # of the line: always as many, so that all tracks share a compiled program
SMOOTH = 0.3  # m: standard deviation of the filter along the line
FASTEST = 20.0  # m/s


@pytree
class GripLimit:
    """Pure pursuit of the middle of the corridor, at the speed that grip and motor allow there."""

    line: Array  # (POINTS, 2), evenly spaced, m
    speed: Array  # (POINTS,), m/s
    duty: Array  # (POINTS,), of the motor, that makes the car follow that speed
    spacing: Scalar  # m
    wheelbase: Scalar  # m
    rear_axle: Scalar  # behind the centre of mass, m
    dead_zone: Scalar  # of the throttle
    span: Scalar  # of the throttle, from the dead zone to full duty
    lag: Scalar  # s between a throttle and its effect
    gain: Scalar = 0.5  # duty per speed that is missing, s/m
    ahead: Scalar = 0.35  # m that it looks ahead, ...
    ahead_time: Scalar = 0.15  # ... and so many seconds

    def reset(self, key: jax.Array) -> tuple[()]:
        """Nothing to remember."""
        return ()

    def act(self, memory: tuple[()], observation: Observation) -> tuple[Command, tuple[()]]:
        """Steers along the arc that leads through a point of the line ahead."""
        car = observation.estimate
        cosine, sine = jnp.cos(car.heading), jnp.sin(car.heading)
        rear = jnp.stack([car.x - self.rear_axle * cosine, car.y - self.rear_axle * sine])
        here = jnp.argmin(jnp.sum((jnp.asarray(self.line) - rear) ** 2, axis=1))

        def index(distance: Scalar) -> Scalar:
            return (here + jnp.round(distance / self.spacing).astype(here.dtype)) % POINTS

        to = jnp.asarray(self.line)[index(self.ahead + self.ahead_time * car.vx)] - rear
        aside = cosine * to[1] - sine * to[0]
        steering = jnp.arctan(2 * self.wheelbase * aside / jnp.sum(to**2))
        soon = index(self.rear_axle + self.lag * car.vx)
        missing = jnp.asarray(self.speed)[soon] - car.vx
        duty = jnp.clip(jnp.asarray(self.duty)[soon] + self.gain * missing, -1.0, 1.0)
        throttle = jnp.sign(duty) * (self.dead_zone + self.span * jnp.abs(duty))
        return Command(throttle, steering), memory


def grip_limit(course: Course, car: Car, share: float = 0.85) -> GripLimit:
    """For a closed course and a nominal car; `share` is the part of the grip that it uses."""
    if not course.closed:
        raise InputError(f"{course.name}: there is no lap to drive on an open course")
    line = middle(course)
    steps = np.roll(line, -1, axis=0) - line
    spacing = float(np.mean(np.hypot(*steps.T)))
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turned = np.angle(np.exp(1j * (heading - np.roll(heading, 1))))
    axles = car.tires.front, car.tires.rear
    grip = share * GRAVITY * min(peak_friction(tire) for tire in axles)
    # Where the wheels spin alike, each axle pulls as much as it holds along its wheels.
    pulls = share * GRAVITY * np.mean([t.longitudinal_ratio * peak_friction(t) for t in axles])
    speed, duty = profile(car, np.abs(turned) / spacing, spacing, grip, min(1.0, pulls / grip))
    return GripLimit(
        line=line,
        speed=speed,
        duty=duty,
        spacing=spacing,
        wheelbase=car.body.wheelbase,
        rear_axle=car.body.wheelbase - car.body.front_axle,
        dead_zone=car.motor.dead_zone,
        span=car.motor.full_throttle - car.motor.dead_zone,
        lag=car.motor.lag + car.motor.delay,
    )


def middle(course: Course) -> np.ndarray:
    """The middle of the corridor, evenly spaced and smooth."""
    points, marks = course.line, course.marks
    if course.sides is not None:
        along = np.roll(points[:-1], -1, axis=0) - np.roll(points[:-1], 1, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        aside = (course.sides[:-1, 1:] - course.sides[:-1, :1]) / 2
        points = points[:-1] + aside * normal
        points = np.vstack([points, points[:1]])
    even = np.linspace(0.0, course.length, POINTS, endpoint=False)
    line = np.stack([np.interp(even, marks, points[:, i]) for i in (0, 1)], axis=1)
    return gaussian_filter1d(line, SMOOTH * POINTS / course.length, axis=0, mode="wrap")


def peak_friction(tire: Tire) -> float:
    """The most that a brush tyre gives."""
    ratio = tire.sliding_ratio
    return float(tire.friction * (4 - 3 * ratio) / (3 - 2 * ratio) ** 2)


def drag_of_turning(car: Car, across: Array) -> np.ndarray:
    """What brush tyres lose to their slip angles at this lateral acceleration (m/s²)."""
    behind = (car.body.wheelbase - car.body.front_axle) / car.body.wheelbase
    lost = []
    for tire, load in ((car.tires.front, behind), (car.tires.rear, 1 - behind)):
        part = np.clip(across / GRAVITY / tire.friction, 0.0, 1.0)
        slip = 3 * tire.friction * (1 - np.cbrt(1 - part)) / tire.cornering_stiffness
        lost.append(load * across * slip)
    return np.asarray(sum(lost))


def profile(
    car: Car, curvature: np.ndarray, spacing: float, grip: float, ratio: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """The highest speed at each point, and the motor's duty with which a car follows it.

    Across, v² |curvature| <= grip; along, what is left of the ellipse whose axis along is `ratio`
    of that across, and what the motor can do beside what turning costs.
    """
    speeds = np.linspace(0.0, FASTEST, 201)
    radius = float(car.tires.rear.radius)
    spin = 4 * car.tires.rear.inertia + car.motor.rotor_inertia * car.drivetrain.gear_ratio**2
    mass = float(car.body.mass + spin / radius**2)
    resists = (car.drivetrain.drag + car.drivetrain.drag_viscous * speeds / radius) / radius / mass

    def pull(duty: float) -> np.ndarray:
        """Acceleration at a duty, by speed (m/s²)."""
        made = motor.drive(car.motor, car.drivetrain, car.battery, duty, 1.0, speeds / radius)
        torque = np.asarray(made.torque - made.slope * speeds / radius)
        return torque / radius / mass - np.asarray(resists)

    full, rolls, brakes = pull(1.0), pull(0.0), pull(-1.0)
    top = float(np.interp(0.0, -full, speeds))
    v = np.minimum(np.sqrt(grip / np.maximum(curvature, 1e-6)), top)
    left = lambda i: ratio * np.sqrt(max(0.0, grip**2 - (v[i] ** 2 * curvature[i]) ** 2))  # noqa: E731  # used twice
    for i in [*range(POINTS)] * 2:  # twice round, as the lap has no beginning
        turning = drag_of_turning(car, v[i - 1] ** 2 * curvature[i - 1])
        gain = min(np.interp(v[i - 1], speeds, full) - turning, left(i - 1))
        v[i] = min(v[i], np.sqrt(max(0.0, v[i - 1] ** 2 + 2 * spacing * gain)))
    for i in [*reversed(range(POINTS))] * 2:
        loss = min(np.interp(v[i], speeds, -brakes), left(i))
        v[i - 1] = min(v[i - 1], np.sqrt(v[i] ** 2 + 2 * spacing * loss))
    wanted = (np.roll(v, -1) ** 2 - v**2) / (2 * spacing)
    back_emf = float(car.motor.torque_constant * car.drivetrain.gear_ratio) * v / radius
    resisted = drag_of_turning(car, v**2 * curvature)
    over = wanted + resisted - np.interp(v, speeds, rolls)
    needed = (wanted + resisted + np.interp(v, speeds, np.asarray(resists))) * mass * radius
    volts = back_emf + needed * float(
        car.motor.resistance
        / (car.motor.torque_constant * car.drivetrain.gear_ratio * car.drivetrain.efficiency)
    )
    braking = over / np.maximum(np.interp(v, speeds, rolls - brakes), 1e-6)
    return v, np.clip(np.where(over < 0, braking, volts / float(car.battery.full)), -1.0, 1.0)


def lap_times(course: Course, car: Car, laps: int, share: float = 0.85) -> tuple[list[float], int]:
    """Drives so many laps, or as far as it gets; the time of each, and how often walls were hit."""
    driver = grip_limit(course, car, share)
    simulator, pilot = Simulator.of(course, car), Pilot.of(driver, course, car, "truth")
    longest = 20.0 + 2 * laps * float(np.sum(driver.spacing / driver.speed))
    distance, contacts, ends = course.start_distance, 0, [0.0]
    for record in simulator.run(pilot, longest):
        every = slice(9, None, 10)
        along = progress(course, record.motion.x[every], record.motion.y[every], distance)
        distance, contacts = float(along[-1]), int(record.wall_contacts[-1])
        while len(ends) <= laps and np.any(done := along >= (course.lap_end(len(ends)) or 0.0)):
            ends.append(simulator.dt * float(record.tick[every][np.argmax(done)]))
        if len(ends) > laps:
            break
    return list(np.diff(ends)), contacts


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Laps a closed course at the limit of grip.")
    parser.add_argument("course", help="library name, .toml, centre line .csv, or map .yaml")
    parser.add_argument("--laps", type=int, default=1)
    parser.add_argument("--car", default="jetracer")
    parser.add_argument("--grip", type=float, default=0.85, help="part of it that is used")
    options = parser.parse_args()
    configure_jax(batches=False)
    try:
        times, contacts = lap_times(
            load_course(options.course), load_car(options.car), options.laps, options.grip
        )
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    for lap, time in enumerate(times, start=1):
        print(f"lap {lap}: {time:.2f} s")
    print(f"wall contacts: {contacts}" + ("" if len(times) == options.laps else ", not completed"))
    sys.exit(0 if len(times) == options.laps and not contacts else 1)


if __name__ == "__main__":
    main()
