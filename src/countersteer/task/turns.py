"""The turns of a drive."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.signals import Array, Motion, Scalar

STRAIGHT_RATE, STRAIGHT_SLIP = math.radians(30), math.radians(10)
STRAIGHT_FOR = 0.05  # s below both until a turn has ended
LONGEST = 2.0  # s after which a turn has ended whatever the car does
SLOW = 0.2  # m/s under which the direction of motion, and so sideslip, means nothing
ROUNDING = 1e-4  # s, of a time in 32 bits


class Turns(NamedTuple):
    """What is known of each turn; arrays of one number a turn. Times are inf until they come."""

    begin: Array
    end: Array
    stirred: Array  # 1 once the car has not gone straight in it
    calm_since: Array
    entry_speed: Array
    peak_sideslip: Array
    peak_yaw_rate: Array
    error: Array  # heading less the corridor's, at the end


@dataclasses.dataclass(frozen=True)
class TurnResult:
    """One turn; names and units are those of the JSON."""

    begin_s: float
    end_s: float
    entry_speed_mps: float
    peak_sideslip_deg: float
    peak_yaw_rate_degps: float
    heading_error_deg: float
    duration_s: float


def sideslip(vx: Array, vy: Array) -> Array:
    """Angle from the nose to the velocity (rad); 0 where the car all but stands."""
    own = jnp if isinstance(vx, jax.Array) else np  # NumPy's arrays keep their precision
    return own.where(vx**2 + vy**2 > SLOW**2, own.arctan2(vy, vx), 0.0)


def goes_straight(motion: Motion) -> Scalar:
    """Whether yaw rate and sideslip are both under what ends a turn."""
    slip = sideslip(motion.vx, motion.vy)
    return (jnp.abs(motion.yaw_rate) < STRAIGHT_RATE) & (jnp.abs(slip) < STRAIGHT_SLIP)


def before_any(count: int, dtype: Any) -> Turns:
    """So many turns, none of which has begun."""
    never, zero = np.full(count, np.inf, dtype), np.zeros(count, dtype)
    return Turns(never, never, zero, zero, zero, zero, zero, zero)


def follow(old: Turns, bearings: Array, motion: Motion, turn: Scalar, time: Scalar) -> Turns:
    """The turns with one sample more. `bearings` are those of the corridors behind them."""
    speed, rate = jnp.sqrt(motion.vx**2 + motion.vy**2), jnp.abs(motion.yaw_rate)
    slip, calm = jnp.abs(sideslip(motion.vx, motion.vy)), goes_straight(motion)
    begins = jnp.isinf(old.begin) & (jnp.arange(old.begin.shape[0]) < turn)
    begin = jnp.where(begins, time, old.begin)
    under_way = (begin <= time) & jnp.isinf(old.end)
    stirred = jnp.where(under_way & ~calm, 1.0, old.stirred)
    calm_since = jnp.where(calm & ~begins, old.calm_since, time)
    late = time - begin >= LONGEST - ROUNDING
    settled = (stirred > 0) & calm & (time - calm_since >= STRAIGHT_FOR - ROUNDING)
    ends = under_way & (late | settled)
    error = motion.heading - bearings
    error = error - 2 * math.pi * jnp.round(error / (2 * math.pi))
    return Turns(
        begin,
        jnp.where(ends, time, old.end),
        stirred,
        calm_since,
        jnp.where(begins, speed, old.entry_speed),
        jnp.where(under_way, jnp.maximum(old.peak_sideslip, slip), old.peak_sideslip),
        jnp.where(under_way, jnp.maximum(old.peak_yaw_rate, rate), old.peak_yaw_rate),
        jnp.where(under_way, error, old.error),
    )


def results(turns: Turns, time: float) -> list[TurnResult]:
    """Those that have begun. One that is under way ends at `time`, when the drive did."""
    begun = np.nonzero(np.isfinite(turns.begin))[0]
    found = []
    for i in begun.tolist():
        begin, end = float(turns.begin[i]), min(float(turns.end[i]), time)
        found.append(
            TurnResult(
                begin_s=begin,
                end_s=end,
                entry_speed_mps=float(turns.entry_speed[i]),
                peak_sideslip_deg=math.degrees(turns.peak_sideslip[i]),
                peak_yaw_rate_degps=math.degrees(turns.peak_yaw_rate[i]),
                heading_error_deg=math.degrees(turns.error[i]),
                duration_s=end - begin,
            )
        )
    return found
