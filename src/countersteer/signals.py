"""The signals between driver and car: readings to the driver, a command to the car.

A `Channel` declares a quantity once: its name at every edge, its unit, its range and its shape.
Headers of tables, messages of MCAP files, ranges of sensor faults and help derive from it.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

# A number of Python, NumPy or JAX (traced). With leading axes it is a batch. These have no
# common type that arithmetic keeps, so the type is `Any`.
Scalar: TypeAlias = Any
Array: TypeAlias = Any  # the same with one axis or more


class Wheels(NamedTuple):
    """One value for each wheel, in the project's fixed order."""

    front_left: Scalar
    front_right: Scalar
    rear_left: Scalar
    rear_right: Scalar


class Command(NamedTuple):
    """The command of a driver."""

    throttle: Scalar  # -1 to 1; negative is reverse or brake
    steering: Scalar  # angle of the front wheels, rad, positive to the left


class SpeedCommand(NamedTuple):
    """The command of a driver to a car with a speed controller."""

    speed: Scalar  # m/s, of the driven wheels' rims; negative is reverse
    steering: Scalar  # as in `Command`


# `Command`, or `SpeedCommand` where the car has a speed controller. Few look at which it is.
AnyCommand: TypeAlias = Any


class Motion(NamedTuple):
    """The continuous state of a car. SI units, radians, ISO 8855 axes."""

    x: Scalar  # centre of mass, m
    y: Scalar
    heading: Scalar  # unwrapped
    vx: Scalar  # velocity of the centre of mass along the body's axes, m/s
    vy: Scalar
    yaw_rate: Scalar
    wheels: Wheels  # spin of each wheel, rad/s, positive forward
    steering: Scalar  # angle of an imaginary wheel midway between the front wheels
    duty: Scalar  # of the speed controller, -1 to 1; it lags the throttle
    load_ax: Scalar  # lagged accelerations that set the wheel loads, m/s²
    load_ay: Scalar
    charge: Scalar  # of the battery, 0 to 1


class Reading(NamedTuple):
    """A sensor's last report. `tick` is -1 before the first one."""

    value: Scalar
    tick: Scalar


class Readings(NamedTuple):
    """The last report of every sensor. SI units, radians."""

    sonar: tuple[Reading, ...]  # m, in the order of the car's mounts; inf: no echo
    counts: Reading  # regions of the encoder passed since the start
    wheel_speed: Reading  # m/s, never negative
    gyroscope: Reading  # rad/s
    accel_x: Reading  # m/s²
    accel_y: Reading
    battery: Reading  # V
    line_crossings: Reading | None = None  # lines entered since the start; None: no line detector
    line_speed: Reading | None = None  # m/s, line spacing over the time since the last line
    lidar: Reading | None = None  # (beams,), m, from right to left; inf: no echo; None: no lidar
    position_x: Reading | None = None  # m; None: no such sensor
    position_y: Reading | None = None
    position_heading: Reading | None = None  # rad; None: no heading
    truth: Motion | None = None  # ground truth, for the estimator `truth` only


class Channel(NamedTuple):
    """A quantity of a sensor, a state or a command."""

    name: str  # at every edge, with its unit
    unit: str  # internal
    low: Scalar  # range of its values in that unit; infinite if unbounded
    high: Scalar
    meaning: str
    sensor: str = ""  # the sensor that reports it; empty: none
    shape: tuple[int, ...] = ()
    whole: bool = False  # whether it is a count

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of its columns: one for a scalar, else one per number, numbered before the unit."""
        if not self.shape:
            return (self.name,)
        stem, _, unit = self.name.rpartition("_")
        digits = max(2, len(str(self.shape[0] - 1)))
        return tuple(f"{stem}_{i:0{digits}}_{unit}" for i in range(self.shape[0]))


INF = float("inf")
# Ground truth as `truth.csv` holds it: the simulated state, or motion capture of a real car.
TRUTH = (
    Channel("x_m", "m", -INF, INF, "centre of mass, east"),
    Channel("y_m", "m", -INF, INF, "centre of mass, north"),
    Channel("heading_rad", "rad", -INF, INF, "heading, unwrapped, positive to the left"),
    Channel("vx_mps", "m/s", -INF, INF, "velocity of the centre of mass, forward"),
    Channel("vy_mps", "m/s", -INF, INF, "velocity of the centre of mass, to the left"),
    Channel("yaw_rate_radps", "rad/s", -INF, INF, "yaw rate, positive to the left"),
    Channel("wheel_fl_radps", "rad/s", -INF, INF, "spin of the front left wheel"),
    Channel("wheel_fr_radps", "rad/s", -INF, INF, "spin of the front right wheel"),
    Channel("wheel_rl_radps", "rad/s", -INF, INF, "spin of the rear left wheel"),
    Channel("wheel_rr_radps", "rad/s", -INF, INF, "spin of the rear right wheel"),
    Channel("steering_rad", "rad", -INF, INF, "angle of a wheel between the front wheels"),
    Channel("battery_v", "V", 0.0, INF, "voltage of the battery under load"),
)


def truth_columns(motion: Motion, voltage: Array) -> tuple[Array, ...]:
    """The values of `TRUTH` for a motion."""
    return (*motion[:6], *motion.wheels, motion.steering, voltage)


def pairs(channels: Readings, readings: Readings) -> Iterator[tuple[Channel, Reading]]:
    """Each channel of a car's sensors with its reading, in the order of the tables."""
    yield from zip(flat(channels), flat(readings), strict=True)


def unflat(like: Readings, parts: Sequence[Any]) -> Readings:
    """The inverse of `flat`, for the sensors that `like` has."""
    rest = iter(parts)
    sonar = tuple(next(rest) for _ in like.sonar)
    others: list[Any] = [None if part is None else next(rest) for part in like[1:-1]]
    return Readings(*(sonar, *others, like.truth))


def flat(readings: Readings) -> Sequence[Any]:
    """The parts for the car's sensors, in the order of the tables, without the ground truth."""
    others = (part for part in readings[1:-1] if part is not None)
    return (*readings.sonar, *others)
