"""A course's plan: policies, the places where each holds, and the conditions that hand over.

A plan is read from a TOML file (docs/plans.md). Open-loop and closed-loop policies mix. All share
one estimate of the car's place in the corridor. It is updated whichever policy steers.
"""

import dataclasses
import importlib.resources
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from countersteer.car.car import Car
from countersteer.car.parameter import pytree, unknown_key
from countersteer.course.course import Course
from countersteer.course.position import Line, Place, line_of
from countersteer.drivers import drift_turn
from countersteer.drivers.drift_turn import DriftTurn
from countersteer.drivers.driver import Observation, Status, paced
from countersteer.drivers.pursuit import pursued
from countersteer.drivers.straighten import Straighten
from countersteer.errors import InputError
from countersteer.estimation import spikes
from countersteer.reading.content import reading
from countersteer.reading.values import number, shown
from countersteer.reading.values import path as checked_path
from countersteer.signals import Array, Command, Scalar
from countersteer.text import read_toml

LIBRARY = importlib.resources.files("countersteer.drivers") / "library"
KINDS = STRAIGHTEN, COMMANDS, DRIFT, CURVE = range(4)
NAMES = ("straighten", "commands", "drift", "curve")
ASTRAY = 0.5  # m outside its place, beyond which a policy has missed its hand-over
ALIGNED = 0.3  # rad to the corridor, within which the front sonar sees the corridor's end
REVERSE = 0.05  # m/s by which the car may approach a wall faster than its forward speed


class Until(NamedTuple):
    """Conditions on which a policy hands over; one is enough. SI; infinite: never met."""

    driven: Array  # m since it began, by odometry
    turned: Array  # rad since it began, to the left
    time: Array  # s since it began
    wall: Array  # m to the wall ahead, or less; never: -inf
    passes: Array  # m along the centre line
    yaw_rate: Array  # rad/s, or less, after it has been above
    speed: Array  # m/s, or more


class Policies(NamedTuple):
    """All policies of a plan: each array has a row for each policy, in their order."""

    does: Array  # one of `KINDS`
    speed: Array  # m/s
    angle: Array  # by which the corridor turns where the policy begins, rad
    begin: Array  # place where it holds, m along the centre line; infinite: everywhere
    end: Array
    until: Until
    times: Array  # (n, m) times of its commands since it began, s; infinite after the last
    throttle: Array
    steering: Array  # rad


class SequenceMemory(NamedTuple):
    """The driver between two decisions."""

    number: Scalar  # of the current policy
    begun: Scalar  # 1 once it has begun
    turn: Scalar  # turns begun
    since: Scalar  # time at which it began, s
    heading: Scalar  # at that time, rad
    distance: Scalar  # at that time, along the centre line, m
    driven: Scalar  # m since then
    stirred: Scalar  # 1 if the yaw rate has been above its limit since then
    along: Scalar  # distance along the centre line, m
    echo: spikes.SpikeMemory
    drift: drift_turn.DriftTurnMemory  # includes the place in the corridor

    @property
    def time(self) -> Scalar:
        """Time of the last decision (s)."""
        return self.drift.time

    @property
    def command(self) -> Command:
        """The last command."""
        return self.drift.command


@pytree
class PolicySequence:
    """Policies in their order. If the pose is in the place of another, that one takes over.

    On a closed course the first follows the last. On an open one the last holds to the end.
    """

    policies: Policies
    drift: DriftTurn  # drives all drifts; all policies share its `straight`
    line: Line
    noise: Scalar  # of a sonar's distance, m
    wheelbase: Scalar
    rear_axle: Scalar  # behind the centre of mass, m

    @property
    def straight(self) -> Straighten:
        """The driver that keeps to the corridor's middle."""
        return self.drift.straight

    def reset(self, key: jax.Array) -> SequenceMemory:
        """Before the first policy has begun."""
        none = spikes.SpikeMemory(math.inf, math.inf, 0)
        start = self.line.start
        first = (0, 0, 0, 0.0, 0.0, start, 0.0, 0, start, none)
        return SequenceMemory(*first, self.drift.reset(key))

    def act(
        self, memory: SequenceMemory, observation: Observation
    ) -> tuple[Command, SequenceMemory]:
        """One control period."""
        return paced(self._think, memory, observation)

    def status(self, memory: SequenceMemory) -> Status:
        """The turns begun, and the estimated place in the corridor."""
        return self.drift.status(memory.drift)._replace(turn=memory.turn)

    def _think(self, memory: SequenceMemory, seen: Observation) -> tuple[Command, SequenceMemory]:
        dt, estimate = seen.time - memory.time, seen.estimate
        here = self.line.find(estimate.x, estimate.y, memory.along)
        speed = jnp.sqrt(estimate.vx**2 + estimate.vy**2 + 1e-12)
        heard = self._heard(memory.echo, seen, dt)
        before = self._policy(memory.number)
        over_limit = jnp.abs(estimate.yaw_rate) >= before.until.yaw_rate
        memory = memory._replace(
            driven=memory.driven + dt * speed,
            stirred=jnp.where(over_limit, 1, memory.stirred),
            along=here.distance,
            echo=heard,
        )
        number, begins = self._next(memory, before, seen, here)
        # An echo from before a hand-over says nothing about the wall ahead after it.
        memory = memory._replace(
            echo=heard._replace(
                believed=jnp.where(begins, jnp.inf, heard.believed),
                heard=jnp.where(begins, jnp.inf, heard.heard),
            )
        )
        own = self._policy(number)

        drifts = own.does == DRIFT
        angle = jnp.where(begins, own.angle, 0.0)
        last = memory.drift._replace(
            turn=1, phase=jnp.where(begins, drift_turn.STRAIGHT, memory.drift.phase)
        )
        # As a linked turn after the first (`turn=1`), a drift with an angle begins at once.
        angles = jnp.stack([0.0 * angle, jnp.where(drifts, angle, 0.0)])
        turning, drift = dataclasses.replace(self.drift, angles=angles).think(last, seen)
        straight = self.straight.turned(drift.straight, angle, begins & ~drifts)
        memory = memory._replace(
            number=number,
            begun=1,
            turn=memory.turn + (angle != 0),
            since=jnp.where(begins, seen.time, memory.since),
            heading=jnp.where(begins, estimate.heading, memory.heading),
            distance=jnp.where(begins, here.distance, memory.distance),
            driven=jnp.where(begins, 0.0, memory.driven),
            stirred=jnp.where(begins, 0, memory.stirred),
        )

        on = self.straight.command(straight, seen, own.speed)
        table = jnp.sum(own.times <= seen.time - memory.since + 1e-6) - 1
        steering, throttle = on.steering, on.throttle
        curve = pursued(self.line, here.distance, estimate, self.wheelbase, self.rear_axle)
        for which, lock, power in (
            (COMMANDS, own.steering[table], own.throttle[table]),
            (DRIFT, turning.steering, turning.throttle),
            (CURVE, curve, on.throttle),
        ):
            steering = jnp.where(own.does == which, lock, steering)
            throttle = jnp.where(own.does == which, power, throttle)
        limit = self.straight.limit
        command = Command(throttle, jnp.clip(steering, -limit, limit))
        drift = drift._replace(straight=straight._replace(command=command))
        return command, memory._replace(drift=drift)

    def _policy(self, number: Scalar) -> Policies:
        """The policy of this number."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[number], self.policies)

    def _next(
        self, memory: SequenceMemory, own: Policies, seen: Observation, here: Place
    ) -> tuple[Scalar, Scalar]:
        """The number of the policy from now on, and whether it begins now."""
        until, estimate, count = own.until, seen.estimate, len(self.policies.does)
        # On a closed course each round has the place. The one that counts lay ahead as the policy
        # began, or less than a quarter of a round behind.
        open_ended, behind = jnp.isinf(self.line.whole), memory.distance - self.line.whole / 4
        coming = behind + jnp.mod(until.passes - behind, self.line.whole)
        coming = jnp.where(open_ended, until.passes, coming)
        hand = jnp.sign(until.turned)
        aligned = jnp.abs(memory.drift.straight.error) < ALIGNED
        over = (
            (memory.driven >= until.driven)
            | (hand * (estimate.heading - memory.heading) >= jnp.abs(until.turned))
            | (seen.time - memory.since >= until.time - 1e-6)
            | (aligned & (memory.echo.believed <= until.wall))
            | (jnp.isfinite(until.passes) & (here.distance >= coming))
            | ((memory.stirred > 0) & (jnp.abs(estimate.yaw_rate) < until.yaw_rate))
            | (estimate.vx >= until.speed)
            | ((own.does == DRIFT) & (memory.drift.phase == drift_turn.STRAIGHT))
        ) & (memory.begun > 0)
        after = jnp.where(
            open_ended,
            jnp.minimum(memory.number + 1, count - 1),
            (memory.number + 1) % count,
        )
        # If the pose is known to half a metre and is outside the policy's place, a hand-over was
        # missed. A condition that is met outside the next policy's place is a false one.
        spread = estimate.pose_covariance
        sure = spread.xx + spread.yy < ASTRAY**2
        holds, inside = self._places(here.distance)
        over = over & (after != memory.number) & (holds[after] | ~sure)
        number = jnp.where(over, after, memory.number)
        in_order = (number + 1 + jnp.arange(count)) % count
        takes = in_order[jnp.argmax(inside[in_order])]
        mends = sure & ~holds[number] & jnp.any(inside)
        number = jnp.where(mends, takes, number)
        return number, over | mends | (memory.begun == 0)

    def _places(self, distance: Scalar) -> tuple[Array, Array]:
        """Masks (n,): policies that may hold at a distance, and those whose own place it is."""
        begin, end = jnp.asarray(self.policies.begin), jnp.asarray(self.policies.end)
        everywhere = jnp.isinf(begin)
        begin, end = jnp.where(everywhere, 0.0, begin), jnp.where(everywhere, 0.0, end)
        whole = jnp.where(jnp.isinf(self.line.whole), 1e7, self.line.whole)
        extent = jnp.mod(end - begin, whole)
        inside = jnp.mod(distance - begin, whole) <= extent
        near = jnp.mod(distance - begin + ASTRAY, whole) <= extent + 2 * ASTRAY
        return everywhere | near, ~everywhere & inside

    def _heard(
        self, memory: spikes.SpikeMemory, seen: Observation, dt: Scalar
    ) -> spikes.SpikeMemory:
        """The distance ahead by the front sonar, without spikes."""
        heard = seen.sonar[self.drift.front]
        tick = jnp.where(heard.came(dt), memory.tick + 1, memory.tick)
        nearer = dt * (jnp.abs(seen.estimate.vx) + REVERSE)
        return spikes.update(memory, spikes.Reading(heard.value, tick), nearer, self.noise)


class Key(NamedTuple):
    """A number in a file: its range there, and the SI value of one of its units."""

    low: float
    high: float
    unit: float = 1.0
    never: float = math.inf  # value if the key is absent


DEGREE = math.pi / 180
CONDITIONS = {
    "driven_m": Key(0, 1e4),
    "turned_deg": Key(-3600, 3600, DEGREE),
    "time_s": Key(0, 1e4),
    "wall_m": Key(0, 100, never=-math.inf),
    "passes_m": Key(0, 1e5),
    "yaw_rate_degps": Key(0, 1e4, DEGREE),
    "speed_mps": Key(0, 100),
}
PLACE = {"from_m": Key(0, 1e5), "to_m": Key(0, 1e5)}
ANYWHERE = {"turn_deg": Key(-180, 180, DEGREE), **PLACE}
TAKES: dict[str, dict[str, Key]] = {
    "straighten": {"speed_mps": Key(0.1, 20)},
    "commands": {"throttle": Key(-1, 1), "steering_deg": Key(-90, 90, DEGREE)},
    "drift": {},
    "curve": {"speed_mps": Key(0.1, 20)},
}
LEAST_DRIFT = 20  # degrees
MOST_POLICIES = 1000
Read = Callable[[Path], Mapping[str, np.ndarray]]  # a commands.csv as time_s, throttle, steering


def plan(
    tables: Mapping[str, Any],
    where: str,
    course: Course,
    car: Car,
    read: Read,
    speed: float | None = None,
    laps: int = 1,
) -> PolicySequence:
    """The driver for a course and a nominal car, from the tables of the file `where`.

    `read` reads a file of commands. `speed` (m/s) is for policies that name none. Raises
    `InputError` naming file, policy, key and range.
    """
    if not len(course.line):
        raise InputError(f"{course.name}: a plan needs a course with a centre line")
    known = ("kind", "description", "policy")
    for key in tables:
        if key not in known:
            raise unknown_key(where, key, dict.fromkeys(known))
    if not isinstance(tables.get("description", ""), str):
        raise InputError(f"{where}: description must be a text")
    rows = tables.get("policy")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{where}: a plan needs [[policy]] tables")
    if len(rows) > MOST_POLICIES:
        raise InputError(f"{where}: {len(rows)} policies, over {MOST_POLICIES}")
    speed = drift_turn.SPEED if speed is None else speed
    length = course.length
    with reading(where):
        read_rows = [
            _policy(row, f"{where}: policy {at}", speed, length, Path(where).parent, read)
            for at, row in enumerate(rows, start=1)
        ]
    most = max(len(row.times) for row in read_rows)
    padded = [
        row._replace(
            times=np.append(row.times, np.full(most - len(row.times), np.inf)),
            throttle=np.append(row.throttle, np.zeros(most - len(row.throttle))),
            steering=np.append(row.steering, np.zeros(most - len(row.steering))),
        )
        for row in read_rows
    ]
    # The plan gives the corners, so the course of its drifts has none.
    straight_on = dataclasses.replace(course, turns=(), closed=False)
    drift = drift_turn.drift_turn(straight_on, car, speed, laps, by="wall")
    return PolicySequence(
        policies=jax.tree.map(lambda *leaves: np.stack(leaves), *padded),
        drift=dataclasses.replace(drift, linked=1.0),
        line=line_of(course),
        noise=car.sensors.sonar.noise,
        wheelbase=car.body.wheelbase,
        rear_axle=car.body.wheelbase - car.body.front_axle,
    )


def library() -> dict[str, str]:
    """Names and descriptions of the plans that come with the package."""
    names = sorted(p.name.removesuffix(".toml") for p in LIBRARY.iterdir())
    tables = {name: read_toml(name, LIBRARY, "driver")[0] for name in names}
    return {n: str(t["description"]) for n, t in tables.items() if t["kind"] == "plan"}


def _policy(
    row: dict[str, Any], where: str, speed: float, length: float, folder: Path, read: Read
) -> Policies:
    """One policy from its table. `where` names file and policy; `folder` is the file's."""
    does = row.get("does")
    if not isinstance(does, str) or does not in NAMES:
        raise InputError(f"{where}: does must be one of {', '.join(NAMES)}, not {shown(does)}")
    takes = TAKES[does] | ANYWHERE
    others = {"does": 0, "until": 0} | ({"commands": 0} if does == "commands" else {})
    for key in row:
        if key not in takes and key not in others:
            raise unknown_key(where, key, {**takes, **others})
    numbers = {key: _number(row, key, span, where) for key, span in takes.items()}
    until = row.get("until", {})
    if not isinstance(until, dict):
        raise InputError(f"{where}: until must be a table such as {{ driven_m = 1.0 }}")
    for key in until:
        if key not in CONDITIONS:
            raise unknown_key(where, f"until.{key}", {f"until.{k}": 0 for k in CONDITIONS})
    conditions = [_number(until, key, span, where, "until.") for key, span in CONDITIONS.items()]
    for name, table in (("", row), ("until.", until)):
        for key in ("from_m", "to_m", "passes_m"):
            if key in table and table[key] > length:
                raise InputError(
                    f"{where}: {name}{key} must be on the course, in [0, {length:g}], "
                    f"not {shown(table[key])}"
                )
    if ("from_m" in row) != ("to_m" in row):
        raise InputError(f"{where}: from_m and to_m go together")
    if does == "drift" and not abs(row.get("turn_deg", 0)) >= LEAST_DRIFT:
        raise InputError(f"{where}: turn_deg must be in [{LEAST_DRIFT}, 180] to a side for a drift")
    times, throttle, steering = np.zeros(1), np.zeros(1), np.zeros(1)
    if does == "commands":
        inline = [key for key in ("throttle", "steering_deg") if key in row]
        if ("commands" in row) == bool(inline) or len(inline) == 1:
            raise InputError(f"{where}: give throttle and steering_deg, or commands, a file")
        if inline:
            throttle = np.array([numbers["throttle"]])
            steering = np.array([numbers["steering_deg"]])
        else:
            played = read(folder / checked_path(row["commands"], f"{where}: commands"))
            if "speed" in played:
                raise InputError(f"{where}: commands: a plan plays throttles, not speeds in m/s")
            times = np.asarray(played["time_s"]) - played["time_s"][0]
            throttle, steering = np.asarray(played["throttle"]), np.asarray(played["steering"])
    return Policies(
        does=np.array(NAMES.index(does)),
        speed=np.array(numbers["speed_mps"] if "speed_mps" in row else speed),
        angle=np.array(numbers["turn_deg"] if "turn_deg" in row else 0.0),
        begin=np.array(numbers["from_m"]),
        end=np.array(numbers["to_m"]),
        until=Until(*map(np.array, conditions)),
        times=times,
        throttle=throttle,
        steering=steering,
    )


def _number(table: dict[str, Any], key: str, span: Key, where: str, path: str = "") -> float:
    """A number in SI units, or `span.never` if the key is absent."""
    if key not in table:
        return span.never
    return number(table[key], f"{where}: {path}{key}", span.low, span.high) * span.unit
