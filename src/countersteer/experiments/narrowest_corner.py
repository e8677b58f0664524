"""The narrowest 90° corner that a car passes, and the time through it: by grip, and by drift.

The parameters of a law are drawn `DRAWS` times, with the same draws at every width. A width is
passed if any draw gets through without a touch. So the comparison is between the two ways with full
knowledge, not between drivers on sensors. Both begin 1.2 m before the corner at their speed. They
are through when the car is 1.2 m behind it, within 30° of the corridor.

By grip: wheels over by one angle, then back, so that the car leaves straight, at one speed. The
rear slip angle stays below 12°. By drift: the laws of drift-turn, with a sideslip of over 25°.
"""

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from countersteer.batch.engine import LANES
from countersteer.batch.open_drives import drives, repeated
from countersteer.car.car import Car
from countersteer.course.course import from_segments
from countersteer.drivers.corner import Corner
from countersteer.drivers.policy import library
from countersteer.drivers.straighten import holding_throttle
from countersteer.drivers.turning import Turning
from countersteer.experiments.result import Report, Result, silent
from countersteer.task.judge import DRIFT

DRAWS = 512
GATE = 1.2  # m before and behind the corner
WIDEST, RESOLUTION = 2.0, 0.01  # m
WIDTHS = (0.5, 0.6, 0.7, 0.8, 1.0, 1.2, 1.4)  # m, of compared times
WAYS = {False: "grip", True: "drift"}  # True: the car slides
LINED_UP = math.radians(30)
GRIP_SLIP = math.radians(12)
LONGEST = 4.5  # s
MARGIN = 0.03  # m from the outer wall at the start
# Ranges of the draws: speed (m/s), part of the free room towards the outer wall, distance from the
# turn-in to the corner (m), part of full lock (by drift: factor of the yaw rate), and throttle in a
# drift as a part of its range.
GRIP = ((0.6, 2.6), (0.0, 1.0), (-0.4, 1.0), (0.3, 1.0), (0.0, 1.0))
SLIDE = ((1.2, 3.0), (0.0, 1.0), (-0.4, 1.15), (0.7, 1.6), (0.0, 1.0))


class Tried(NamedTuple):
    """The results of the draws at a width; times are NaN for draws that did not pass."""

    time: np.ndarray
    entry_speed: np.ndarray
    peak_sideslip: np.ndarray
    track: np.ndarray  # (3, samples) x, y, heading of the fastest; empty if none passed


def attempt(car: Car, width: float, slides: bool, draws: int, lanes: int) -> Tried:
    """Drive all draws of one law at one width."""
    segments = [("straight", 3.0, 0.0), ("turn", math.pi / 2, 0.0), ("straight", 3.0, 0.0)]
    course = from_segments("corner", width, False, segments)
    ends = np.array(SLIDE if slides else GRIP)
    u = qmc.Sobol(len(ends), rng=0).random(draws)
    speed, room, before, lock, fifth = (ends[:, 0] + (ends[:, 1] - ends[:, 0]) * u).T
    limit = min(float(car.servo.limit_left), float(car.servo.limit_right))
    free = max(width / 2 - float(car.body.width) / 2 - MARGIN, 0.0)
    policy = library()
    drivers = [
        Corner(
            turning=_scaled(policy.turning, lock[i] if slides else 1.0),
            stop_angle=policy.stop_angle,
            slides=float(slides),
            speed=speed[i],
            begin=3.0 - before[i],
            lock=limit * lock[i],
            hold=holding_throttle(car, speed[i]) + float(car.motor.dead_zone),
            power=0.6 + 0.8 * fifth[i],
            limit=limit,
            front_axle=float(car.body.front_axle),
        )
        for i in range(draws)
    ]
    still = np.zeros(draws)
    pose = np.stack([3.0 - GATE + still, -room * free, still], axis=1)
    sampled = drives(
        repeated(car, draws),
        np.ones(draws, np.float32),
        drivers,
        np.stack([speed, still, still], axis=1),
        LONGEST,
        pose=pose,
        walls=course.walls,
        lanes=lanes,
    )
    m = sampled.motion
    through = (m.y >= GATE) & (np.abs(m.x - 3.0) < width / 2)
    at = np.argmax(through, axis=1)
    rows = np.arange(draws)
    before_gate = np.arange(m.x.shape[1])[None] <= at[:, None]
    slip = np.where(np.hypot(m.vx, m.vy) > 0.2, np.abs(np.arctan2(m.vy, m.vx)), 0.0)
    peak = np.max(np.where(before_gate, slip, 0.0), axis=1)
    rear = float(car.body.wheelbase - car.body.front_axle)
    axle = np.abs(np.arctan2(m.vy - rear * m.yaw_rate, np.maximum(m.vx, 0.2)))
    slid = np.max(np.where(before_gate, axle, 0.0), axis=1)
    passed = (
        np.any(through, axis=1)
        & (sampled.wall_contacts[rows, at] == 0)
        & (np.abs(m.heading[rows, at] - math.pi / 2) < LINED_UP)
        & ((peak > DRIFT) if slides else (slid < GRIP_SLIP))
    )
    # The car moves some millimetres between two samples. So the time at the gate is interpolated.
    earlier = np.maximum(at - 1, 0)
    part = (GATE - m.y[rows, earlier]) / np.maximum(m.y[rows, at] - m.y[rows, earlier], 1e-9)
    time = sampled.time[earlier] + np.clip(part, 0, 1) * (sampled.time[at] - sampled.time[earlier])
    time = np.where(passed, time, math.nan)
    track = np.zeros((3, 0))
    if np.any(passed):
        best = int(np.nanargmin(time))
        track = np.stack([m.x[best], m.y[best], m.heading[best]])[:, : at[best] + 1]
    return Tried(time, speed, peak, track)


def _scaled(turning: Turning, factor: float) -> Turning:
    """The laws with their held yaw rate scaled, for tighter or wider corners."""
    return dataclasses.replace(turning, rate=factor * turning.rate)


def simulate(
    car: Car, name: str, report: Report = silent, draws: int = DRAWS, lanes: int = LANES
) -> Result:
    """Find the narrowest width of both laws by bisection, and times over a range of widths."""
    tried, narrowest = search(car, report, draws, lanes)
    order = sorted(tried)
    best = {key: _best(tried[key]) for key in order}
    # A drive through a narrow corridor is also one through a wider corridor of the same middle.
    fastest = {
        (s, w): float(
            np.nanmin([best[key][0] for key in order if key[0] == s and key[1] <= w] + [np.inf])
        )
        for s, w in order
    }
    table: dict[str, list[Any]] = {
        "way": [WAYS[slides] for slides, _ in order],
        "width_m": [width for _, width in order],
        "draws": [draws] * len(order),
        "passed": [int(np.isfinite(tried[key].time).sum()) for key in order],
        "best_time_s": [best[key][0] for key in order],
        "best_time_up_to_width_s": [
            fastest[key] if np.isfinite(fastest[key]) else math.nan for key in order
        ],
        "entry_speed_mps": [best[key][1] for key in order],
        "peak_sideslip_deg": [best[key][2] for key in order],
    }
    found: dict[str, dict[str, Any]] = {}
    for slides, way in WAYS.items():
        width = narrowest[slides]
        figures = (None,) * 4 if math.isnan(width) else (width, *best[slides, width])
        names = ("narrowest_m", "time_s", "entry_speed_mps", "peak_sideslip_deg")
        found[way] = dict(zip(names, figures, strict=True))
    figures_of_all = {
        "car": name,
        "draws": draws,
        "resolution_m": RESOLUTION,
        "gates_m": 2 * GATE,
        **found,
    }
    tracks = {
        slides: np.zeros((3, 0)) if math.isnan(width) else tried[slides, width].track
        for slides, width in narrowest.items()
    }
    return Result(
        table,
        figures_of_all,
        _text(name, draws, found, fastest),
        partial(_paint, name, car, fastest, narrowest, tracks),
        (12.0, 4.2),
    )


def search(
    car: Car, report: Report, draws: int, lanes: int
) -> tuple[dict[tuple[bool, float], Tried], dict[bool, float]]:
    """The results at each tried width, and the narrowest width passed (NaN: none), by way."""
    low, high = float(car.body.width), WIDEST
    halvings = math.ceil(math.log2((high - low) / RESOLUTION))
    steps = 2 * (halvings + len(WIDTHS) + 1)
    tried: dict[tuple[bool, float], Tried] = {}

    def passes(slides: bool, width: float) -> bool:
        tried[slides, width] = attempt(car, width, slides, draws, lanes)
        report(len(tried), steps)
        return bool(np.any(np.isfinite(tried[slides, width].time)))

    narrowest: dict[bool, float] = {}
    for slides in WAYS:
        narrowest[slides] = math.nan
        for width in WIDTHS:
            passes(slides, width)
        if passes(slides, high):
            bottom, top = low, high
            while top - bottom > RESOLUTION:
                middle = (top + bottom) / 2
                if passes(slides, middle):
                    top = middle
                else:
                    bottom = middle
            narrowest[slides] = top
    return tried, narrowest


def _text(
    name: str,
    draws: int,
    found: dict[str, dict[str, Any]],
    fastest: dict[tuple[bool, float], float],
) -> str:
    """The figures in words."""

    def narrowest(way: str) -> str:
        one = found[way]
        if one["narrowest_m"] is None:
            return f"by {way} none of up to {WIDEST:g} m"
        return (
            f"by {way} {one['narrowest_m']:.2f} m, in {one['time_s']:.2f} s at an entry of "
            f"{one['entry_speed_mps']:.2f} m/s"
        )

    times = []
    for width in WIDTHS:
        both = [fastest[slides, width] for slides in WAYS]
        words = [f"{t:.2f} s" if math.isfinite(t) else "not passed" for t in both]
        times.append(f"{width:g} m {words[0]} and {words[1]}")
    return (
        f"The narrowest 90° corner that {name} passes, of {draws} draws of each law: "
        f"{narrowest('grip')}; {narrowest('drift')}. Fastest from 1.2 m before the corner to 1.2 m "
        f"behind it, by grip and by drift, over width: {'; '.join(times)}."
    )


def _paint(
    name: str,
    car: Car,
    fastest: dict[tuple[bool, float], float],
    narrowest: dict[bool, float],
    tracks: dict[bool, np.ndarray],
    figure: Any,
) -> None:
    """Draw times over width, and both ways through their narrowest corner."""
    left, *maps = figure.subplots(1, 3, width_ratios=(1.4, 1, 1))
    for ax, (slides, way), colour in zip(maps, WAYS.items(), ("tab:blue", "tab:red"), strict=True):
        mine = [(w, t) for (s, w), t in fastest.items() if s == slides and math.isfinite(t)]
        width = narrowest[slides]
        left.plot(
            *zip(*(mine or [(math.nan, math.nan)]), strict=True), ".-", color=colour, label=way
        )
        ax.set_aspect("equal")
        ax.set_title(f"by {way}: " + ("none" if math.isnan(width) else f"{width:.2f} m"))
        if not math.isnan(width):
            left.axvline(width, color=colour, linewidth=0.8, linestyle=":")
            _draw_track(ax, car, width, tracks[slides])
    left.set_xlabel("width of the corridor, m (dotted: the narrowest)")
    left.set_ylabel("best time between the gates, s")
    left.set_ylim(bottom=0)
    left.legend(frameon=False)
    figure.suptitle(f"narrowest-corner: {name}")


def _best(tried: Tried) -> tuple[float, float, float]:
    """Time, entry speed and peak sideslip (°) of the fastest draw."""
    if not np.any(np.isfinite(tried.time)):
        return math.nan, math.nan, math.nan
    i = int(np.nanargmin(tried.time))
    slip = math.degrees(float(tried.peak_sideslip[i]))
    return float(tried.time[i]), float(tried.entry_speed[i]), slip


def _draw_track(ax: Any, car: Car, width: float, track: np.ndarray) -> None:
    """Draw the corner with the car's outline every tenth of a second."""
    half = width / 2
    for sign in (1, -1):
        ax.plot([1.5, 3.0 - sign * half, 3.0 - sign * half], [sign * half] * 2 + [1.6], "k", lw=1)
    ahead, aside = float(car.body.length) / 2, float(car.body.width) / 2
    outline = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) * (ahead, aside)
    ax.plot(track[0], track[1], color="grey", lw=0.8)
    for x, y, heading in track[:, ::20].T:
        c, s = math.cos(heading), math.sin(heading)
        ax.plot(*(outline @ np.array([[c, s], [-s, c]]) + (x, y)).T, color="tab:blue", lw=0.7)
    ax.set_xlim(1.6, 3.0 + half + 0.1)
    ax.set_ylim(-half - 0.1, 1.6)
