"""The vocabulary of mappings: the signals of a log, and the units of its columns."""

import math
from typing import NamedTuple

from countersteer.car.car import GRAVITY
from countersteer.runs.keys import GYRO_UNITS, VOLT_UNITS

TURN = 2 * math.pi


class Signal(NamedTuple):
    """A signal that a mapping can name."""

    dimension: str
    column: str  # of the run's tables; empty: the signal takes part in others
    meaning: str


COMMANDS = {
    "throttle": Signal("share", "throttle", "of the motor, -1 to 1; negative is reverse or brake"),
    "speed": Signal("speed", "speed_mps", "commanded speed, in place of a throttle"),
    "steering": Signal("angle", "steering_deg", "commanded, positive to the left"),
    "direction": Signal("word", "", "of a throttle or speed without sign"),
}
TELEMETRY = {
    "wheel_speed": Signal("speed", "wheel_speed_mps", "of the wheels' rims"),
    "encoder_counts": Signal("count", "encoder_counts", "regions passed since the start"),
    "gyro": Signal("rate", "gyro_radps", "yaw rate, positive to the left"),
    "accel_x": Signal("acceleration", "accel_x_mps2", "forward"),
    "accel_y": Signal("acceleration", "accel_y_mps2", "to the left"),
    "battery": Signal("voltage", "battery_v", "of the battery under load"),
    "armed": Signal("switch", "armed", "dead-man switch: 1 while the motor follows the throttle"),
}
TRUTH = {
    "x": Signal("length", "x_m", "of motion capture"),
    "y": Signal("length", "y_m", "of motion capture"),
    "heading": Signal("angle", "heading_rad", "of motion capture, positive to the left"),
    "vx": Signal("speed", "vx_mps", "forward, in the car's axes"),
    "vy": Signal("speed", "vy_mps", "to the left, in the car's axes"),
    "yaw_rate": Signal("rate", "yaw_rate_radps", "of motion capture, positive to the left"),
}
TIME = Signal("time", "time_s", "of a row")
SIGNALS = {"time": TIME, **COMMANDS, **TELEMETRY, **TRUTH}


class Unit(NamedTuple):
    """A unit: value = (raw - zero) · factor / span. NaN: the mapping has to give it."""

    factor: float = 1.0
    zero: float = 0.0
    span: float = 1.0
    needs: tuple[str, ...] = ()  # numbers of the mapping that the factor is taken with


_SHARE = {  # of full throttle or full lock
    "1": Unit(),
    "%": Unit(span=100.0),
    "us": Unit(zero=1500.0, span=500.0),
    "counts": Unit(span=math.nan),
}
UNITS: dict[str, dict[str, Unit]] = {
    "time": {"s": Unit(), "ms": Unit(1e-3), "us": Unit(1e-6), "ns": Unit(1e-9), "datetime": Unit()},
    "share": _SHARE,
    "angle": {
        "rad": Unit(),
        "deg": Unit(TURN / 360),
        "quaternion": Unit(),
        **{name: unit._replace(needs=("full_lock_deg",)) for name, unit in _SHARE.items()},
    },
    "speed": {
        "m/s": Unit(),
        "cm/s": Unit(0.01),
        "mm/s": Unit(0.001),
        "km/h": Unit(1 / 3.6),
        "mph": Unit(0.44704),
        "knots": Unit(1.852 / 3.6),
        "rad/s": Unit(needs=("wheel_radius_m",)),  # of the wheel
        "rpm": Unit(TURN / 60, needs=("wheel_radius_m", "gear_ratio")),  # of the motor
        "erpm": Unit(TURN / 60, needs=("wheel_radius_m", "gear_ratio", "pole_pairs")),
    },
    "rate": {name: Unit(factor) for name, factor in GYRO_UNITS.items()},
    "acceleration": {"m/s2": Unit(), "g": Unit(GRAVITY)},
    "length": {"m": Unit(), "cm": Unit(0.01), "mm": Unit(0.001)},
    "voltage": {name: Unit(factor) for name, factor in VOLT_UNITS.items()},
    "count": {"counts": Unit()},
}


def factor_of(unit: Unit, numbers: dict[str, float]) -> float:
    """The factor with the mapping's own numbers: m/s of a motor's turns, or rad of a full lock."""
    found = unit.factor
    for name in unit.needs:
        number = numbers[name]
        found *= {
            "full_lock_deg": math.radians(number),
            "wheel_radius_m": number,
            "gear_ratio": 1 / number,
            "pole_pairs": 1 / number,
        }[name]
    return found
