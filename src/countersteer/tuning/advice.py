"""Advice on the next log: manoeuvres that determine the parameters that a fit left open."""

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from typing import Any

WEAK = 0.25  # deviation over value; above it, a parameter is known only roughly
TRIM = 2.0  # degrees; the least divisor of an angle's deviation, since an angle may be zero
MOST = 5  # lines of advice

LOGS = {  # a log: the parameters that it determines
    "hard launches and hard braking in a straight line, with motion capture": (
        "tires.*.longitudinal_stiffness",
    ),
    "circles that gather speed until the car slides, to both sides, with motion capture": (
        "tires.*.friction",
    ),
    "circles well below the limit of grip, at several speeds, to both sides, with motion capture": (
        "tires.*.cornering_stiffness",
    ),
    "long slides: full throttle at full lock, held and then let go, with motion capture": (
        "tires.*.sliding_ratio",
        "tires.*.longitudinal_ratio",
        "body.front_roll_share",
    ),
    "steady circles at several speeds, and straights at the same throttles": (
        "tires.*.cornering_drag",
    ),
    "any of these again, with battery_charge in its run.toml": ("battery.charge",),
    "quick changes of steering from side to side below the limit of grip, yaw rate at 50 Hz or "
    "more": ("body.yaw_inertia",),
    "steps of throttle up and down, logged at 50 Hz or more": ("motor.delay", "motor.lag"),
    "launches that spin the wheels, wheel speed at 50 Hz or more": ("motor.rotor_inertia",),
    "releases of the throttle while rolling fast, dead-man switch closed": ("motor.neutral_brake",),
    "throttle raised slowly from 0 until the car rolls, several times": ("motor.dead_zone",),
    "constant throttle at 0.7, 0.8, 0.9 and 1, each until the speed is steady": (
        "motor.full_throttle",
    ),
    "constant throttle at many levels from barely rolling to full, each from rest until the speed "
    "is steady": (
        "motor.resistance",
        "motor.torque_constant",
        "motor.conduction",
        "drivetrain.drag",
        "drivetrain.drag_viscous",
    ),
    "steps of throttle in reverse, each from rest until the speed is steady": ("motor.reverse",),
    "steps of commanded speed up and down, from rest and while rolling": ("speed_controller.*",),
    "slow circles at full lock to both sides": ("servo.limit_left", "servo.limit_right"),
    "slow circles at a quarter and at half lock to both sides": (
        "servo.gain_left",
        "servo.gain_right",
    ),
    "steps of steering to both sides at a constant, low speed, yaw rate at 50 Hz or more": (
        "servo.lag",
        "servo.delay",
    ),
    "a long straight run with steering 0": ("servo.trim",),
}
OTHER = "longer runs, of more kinds of manoeuvre than these"


def next_log(parameters: Sequence[Mapping[str, Any]]) -> str:
    """The logs that would help, one line each, the most helpful first; at most `MOST` lines.

    Each of `parameters` has `path`, `surface` (or None), `value`, `deviation`, `unit` and
    `determined`, as in the result of a tuning, in the units of files. Parameters that are not
    determined come first, then those above `WEAK`. Both groups are sorted by `doubt`.
    """
    wanted: dict[tuple[str, str | None], list[Mapping[str, Any]]] = {}
    for parameter in sorted(parameters, key=_rank, reverse=True):
        if not parameter["determined"] or doubt(parameter) > WEAK:
            log = log_for(parameter["path"])
            wanted.setdefault((log, parameter["surface"]), []).append(parameter)
    if not wanted:
        return (
            "None is missing: these logs determine every parameter that was fitted. A log of "
            "another manoeuvre, kept for --validate, would tell most about how far the car holds."
        )
    lines = []
    for (log, surface), tells in list(wanted.items())[:MOST]:
        where = f"on {surface}: " if surface else ""
        paths = ", ".join(dict.fromkeys(parameter["path"] for parameter in tells))
        said = f"{where}{log}"
        lines.append(f"{said[0].upper()}{said[1:]} (for {paths}).")
    return "\n".join(lines)


def doubt(parameter: Mapping[str, Any]) -> float:
    """The deviation over the magnitude of the value. An angle counts as at least `TRIM`."""
    deviation, value = parameter["deviation"], abs(parameter["value"])
    if not math.isfinite(deviation):
        return math.inf
    if parameter["unit"] == "deg":
        value = max(value, TRIM)
    if value == 0:
        return math.inf if deviation > 0 else 0.0
    return float(deviation / value)


def log_for(path: str) -> str:
    """The log of `LOGS` that determines a parameter, else `OTHER`."""
    for log, patterns in LOGS.items():
        if any(fnmatch(path, pattern) for pattern in patterns):
            return log
    return OTHER


def _rank(parameter: Mapping[str, Any]) -> tuple[bool, float]:
    return not parameter["determined"], doubt(parameter)
