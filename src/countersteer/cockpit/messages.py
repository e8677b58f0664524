"""The messages of the socket `/ws`: each is declared once, with types, ranges and lengths.

A message is a JSON object whose `kind` is its class's name in snake case. `parse` reads one of the
page's and trusts nothing in it. `encode` writes one of the server's. `messages_js` is the same
declarations as a JavaScript module. Units are in the names; left is positive.
"""

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar, dataclass_transform

from countersteer.errors import InputError
from countersteer.reading import values
from countersteer.reading.documents import json_object
from countersteer.reading.values import short, shown

LARGEST = 65_536  # characters of a message of the page
DEEPEST = 6  # lists and objects within each other
MOST_PATCHES, MOST_SEGMENTS, MOST_LINES, MOST_POINTS = 16, 200, 100, 500
PRECISION = 5  # decimals of a number to the page

DRIVES, WATCHES = "drives", "watches"
PERSON, DRIVER = "person", "driver"
SENSOR_STATES = ("on", "off", "noisier", "failing")
MARKS = ("good", "bad", "none")
SOURCES = ("keys", "pad", "touch")
_BRACKET = re.compile(r"[\[\]{}]")


class Kind(NamedTuple):
    """The declared type of a field."""

    name: str  # number, whole, flag, text, choice, list, object or anything
    low: float = -math.inf  # of a number; the least length of a list
    high: float = math.inf  # of a number; the largest length of a text or list
    choices: tuple[str, ...] = ()
    of: Any = None  # `Kind` of a list's items, class of an object
    nullable: bool = False


def _field(kind: Kind, default: Any = dataclasses.MISSING) -> Any:
    return dataclasses.field(default=default, metadata={"kind": kind})


def number(low: float, high: float, default: Any = dataclasses.MISSING, null: bool = False) -> Any:
    """A finite number in a range."""
    return _field(Kind("number", low, high, nullable=null), default)


def whole(low: int, high: int, default: Any = dataclasses.MISSING) -> Any:
    """A whole number in a range."""
    return _field(Kind("whole", low, high), default)


def flag(default: Any = dataclasses.MISSING) -> Any:
    """True or false."""
    return _field(Kind("flag"), default)


def text(longest: int, default: Any = dataclasses.MISSING) -> Any:
    """A printable text of at most so many characters."""
    return _field(Kind("text", high=longest), default)


def choice(choices: tuple[str, ...], default: Any = dataclasses.MISSING) -> Any:
    """One of some words."""
    return _field(Kind("choice", choices=choices), default)


def several(of: Any, most: int, least: int = 0, default: Any = dataclasses.MISSING) -> Any:
    """A list of objects of a class, or of items of a `Kind`."""
    inner = of if isinstance(of, Kind) else Kind("object", of=of)
    return _field(Kind("list", least, most, of=inner), default)


def one(of: type, null: bool = False, default: Any = dataclasses.MISSING) -> Any:
    """An object of a class."""
    return _field(Kind("object", of=of, nullable=null), default)


def measured(default: Any = dataclasses.MISSING) -> Any:
    """A number of the server; null where it is unknown or infinite."""
    return _field(Kind("number", nullable=True), default)


def column() -> Any:
    """A list of numbers of the server."""
    return _field(Kind("list", of=Kind("number", nullable=True)))


def anything(default: Any = dataclasses.MISSING) -> Any:
    """Plain data of the server, as another part of the package gives it."""
    return _field(Kind("anything"), default)


T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def message(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass, whose fields are declared as above."""
    return dataclasses.dataclass(frozen=True, kw_only=True)(cls)


POINT = Kind("list", 2, 2, of=Kind("number", -1e4, 1e4))


# ---- of the page ----


@message
class Hello:
    """The first message. `session` is the key of a `Welcome` before a reload, to drive on."""

    token: str = text(100, "")
    session: str = text(64, "")


@message
class Input:
    """What hands do, up to 60 times a second; also the sign that the page is alive."""

    seq: int = whole(0, 2**53 - 1)
    steer: float = number(-1, 1, 0.0)  # the axis of the keys or stick; left is positive
    throttle: float = number(0, 1, 0.0)
    brake: float = number(0, 1, 0.0)  # brakes, and reverses once the car stands
    source: str = choice(SOURCES, "keys")
    page_time_ms: float = number(0, 1e13, 0.0)


@message
class Control:
    """The clock. `slow` sets its rate to `value`; `step` advances a paused drive by one step."""

    action: str = choice(("reset", "pause", "go", "step", "slow"))
    value: float = number(0.05, 1, 1.0)


@message
class SetUp:
    """A new drive. An empty name keeps what is set; names are those of the menus of `World`."""

    course: str = text(100, "")
    car: str = text(100, "")
    driver: str = text(100, "")
    estimate: str = choice(("", "filter", "pose", "reckoning", "truth"), "")
    link: str = choice(("", "onboard", "radio"), "")
    seed: int = whole(-1, 2**31 - 1, -1)  # -1 keeps it
    laps: int = whole(0, 20, 0)  # 0 keeps them
    battery: float = number(-1, 1, -1.0)  # charge; below 0 keeps it


@message
class Gyro:
    """The steering gyroscope."""

    on: bool = flag()
    strength: float = number(0, 2, 1.0)  # over the usual gain


@message
class Parameter:
    """A parameter of the car, by the path and in the unit of `World`; null: as it was at first."""

    path: str = text(100)
    value: float | None = number(-1e9, 1e9, None, null=True)


@message
class Sensor:
    """The state of a sensor, or of the radio, by a name of `World`."""

    name: str = text(60)
    state: str = choice(SENSOR_STATES)


@message
class Patch:
    """A disc on the floor with another friction; it fades to 1 at the rim."""

    x_m: float = number(-1e4, 1e4)
    y_m: float = number(-1e4, 1e4)
    radius_m: float = number(0.05, 100)
    friction: float = number(0.1, 2)  # factor


@message
class Paint:
    """All patches on the floor, in place of those before. Where they overlap, factors multiply."""

    patches: list[Patch] = several(Patch, MOST_PATCHES)


@message
class HandOver:
    """Who drives from now on."""

    to: str = choice((PERSON, DRIVER))


@message
class Record:
    """Whether drives are kept as run folders. It holds from the next start on."""

    on: bool = flag()


@message
class Mark:
    """A mark on a run of `Runs`; `learn` leaves out those marked bad."""

    run: str = text(200)
    mark: str = choice(MARKS)


@message
class Trim:
    """A new run from one turn of a run, counted from 1; the old one stays."""

    run: str = text(200)
    turn: int = whole(1, 1000)


@message
class AskGhost:
    """A car to drive beside: that of a run, or the chosen driver on the same course."""

    of: str = choice(("none", "run", "driver"))
    run: str = text(200, "")


@message
class AskRollouts:
    """Whether the planner's paths are wanted, which costs it time."""

    on: bool = flag()


@message
class Segment:
    """A piece of a course: a straight (`turn_deg` 0) or a turn (`straight_m` 0)."""

    straight_m: float = number(0, 1000, 0.0)
    turn_deg: float = number(-350, 350, 0.0)
    radius_m: float = number(0, 1000, 0.0)


@message
class Line:
    """A free wall: points [x, y] in metres."""

    points_m: list[list[float]] = several(POINT, MOST_POINTS, least=2)


@message
class DrawCourse:
    """A drawn course, of segments or of free walls. `sketch` only looks at it (answer: `Sketch`).

    `save` keeps it as a TOML file of that name, and `drive` also drives it at once.
    """

    action: str = choice(("sketch", "save", "drive"))
    name: str = text(60, "")
    width_m: float = number(0.05, 100, 0.8)
    closed: bool = flag(False)
    crosses: bool = flag(False)  # whether it may cross itself
    segments: list[Segment] = several(Segment, MOST_SEGMENTS, default=())
    walls: list[Line] = several(Line, MOST_LINES, default=())
    start_distance_m: float = number(0, 1e4, 0.0)  # along the line, of segments
    start_offset_m: float = number(-100, 100, 0.0)
    start_x_m: float = number(-1e4, 1e4, 0.0)  # of free walls
    start_y_m: float = number(-1e4, 1e4, 0.0)
    start_heading_deg: float = number(-360, 360, 0.0)
    goal_distance_m: float | None = number(0, 1e4, None, null=True)  # null: the end


# ---- of the server ----


@message
class Welcome:
    """Who the page is: it drives or watches. Sent again when that changes."""

    role: str = choice((DRIVES, WATCHES))
    session: str = text(64)
    version: str = text(40)
    watching: int = whole(0, 10**6, 0)


@message
class Item:
    """An entry of a menu."""

    name: str = text(200)
    label: str = text(200)


@message
class Slider:
    """A parameter of the car, from its declaration."""

    path: str = text(100)
    unit: str = text(20)
    meaning: str = text(300)
    low: float = measured()
    high: float = measured()
    value: float = measured()
    first: float = measured()  # before any change
    live: bool = flag()  # false: a change starts a new drive


@message
class SensorState:
    """A sensor (or the radio), its state, and the states that it can have."""

    name: str = text(60)
    state: str = choice(SENSOR_STATES)
    states: list[str] = several(Kind("choice", choices=SENSOR_STATES), 4)


@message
class World:
    """What is driven, and all menus. Sent for each new drive and when a setting changes."""

    course: str = text(200)
    car: str = text(200)
    driver: str = text(200)
    estimate: str = text(20)
    link: str = text(20)
    seed: int = whole(0, 2**31 - 1)
    laps: int = whole(1, 1000)
    battery: float = measured()
    walls_m: list[list[float]] = anything()  # [x, y, x, y] each
    line_m: list[list[float]] = anything()  # centre line
    closed: bool = flag()
    start: dict[str, float] = anything()  # x_m, y_m, heading_rad
    goal_m: list[float] | None = anything(None)  # [x, y, x, y] of the goal's line
    outline: dict[str, Any] = anything()  # of the car, as the report's view has it
    sonar: list[dict[str, Any]] = anything()  # mounts, as the report's view has them
    limit_n: float = measured()  # a wheel's friction limit at rest, to draw forces by
    fastest_mps: float = measured()
    sliders: list[Slider] = several(Slider, 1000)
    sensors: list[SensorState] = several(SensorState, 100)
    patches: list[Patch] = several(Patch, MOST_PATCHES)
    gyro: dict[str, Any] = anything()  # on, strength
    recording: bool = flag()
    courses: list[Item] = several(Item, 1000)
    cars: list[Item] = several(Item, 1000)
    drivers: list[Item] = several(Item, 1000)


@message
class Wheel:
    """A wheel's forces, in its own axes."""

    force_x_n: float = measured()
    force_y_n: float = measured()
    limit_n: float = measured()
    slip_mps: float = measured()
    angle_rad: float = measured()


@message
class Believed:
    """The pilot's estimate, with the ellipse of its place (two deviations)."""

    x_m: float = measured()
    y_m: float = measured()
    heading_rad: float = measured()
    speed_mps: float = measured()
    sideslip_deg: float = measured()
    yaw_rate_degps: float = measured()
    longer_m: float = measured()
    shorter_m: float = measured()
    ellipse_rad: float = measured()


@message
class State:
    """The car now. Series have the names of the report's view."""

    tick: int = whole(0, 2**53)
    time_s: float = measured()
    x_m: float = measured()
    y_m: float = measured()
    heading_rad: float = measured()
    vx_mps: float = measured()  # along the body's axes
    vy_mps: float = measured()
    speed_mps: float = measured()
    sideslip_deg: float = measured()
    yaw_rate_degps: float = measured()
    yaw_target_degps: float | None = measured()  # of the gyroscope; null: off, or a driver drives
    steering_deg: float = measured()
    steering_command_deg: float = measured()
    throttle: float = measured()
    battery_v: float = measured()
    wheels: list[Wheel] = several(Wheel, 4)
    sonar_m: list[float | None] = several(Kind("number", nullable=True), 100)  # null: no echo
    sonar_new: list[bool] = several(Kind("flag"), 100)
    estimate: Believed | None = one(Believed, null=True)
    seq: int = whole(-1, 2**53)  # of the last `Input` that this state has felt
    page_time_ms: float = measured()  # of that input
    who: str = choice((PERSON, DRIVER))
    phase: str = choice(("ready", "drives", "paused", "ended"))
    rate: float = measured()  # of the clock: 1 is real time
    lag_s: float = measured()  # behind the wall clock
    keeps: float = measured()  # the fastest rate that this machine could keep, as measured
    silent: bool = flag()  # no input for 200 ms: the throttle is zero
    wall_contacts: int = whole(0, 10**9)
    touching: bool = flag()
    turn: int = whole(0, 10**6)  # turns begun
    recording: bool = flag()


@message
class Turn:
    """The figures of a turn that has ended, as the judge has them."""

    number: int = whole(1, 10**6)
    of: int = whole(0, 10**6)
    begin_s: float = measured()
    end_s: float = measured()
    entry_speed_mps: float = measured()
    peak_sideslip_deg: float = measured()
    peak_yaw_rate_degps: float = measured()
    heading_error_deg: float = measured()
    heading_overshoot_deg: float = measured()
    duration_s: float = measured()
    drift: bool = flag()  # over 25° of sideslip
    touched: bool = flag()
    who: str = choice((PERSON, DRIVER))


@message
class Ended:
    """The drive has ended. `run` is its folder's id; empty where it was not recorded."""

    outcome: str = text(200)
    verdict: str = text(300)
    success: bool = flag()
    wall_contacts: int = whole(0, 10**9)
    lap_time_s: float | None = measured()
    drifts: int = whole(0, 10**6)
    turns: int = whole(0, 10**6)
    run: str = text(200, "")


@message
class RunItem:
    """A recorded run."""

    id: str = text(200)
    title: str = text(300)
    course: str = text(200)
    driver: str = text(200)
    outcome: str = text(300)
    mark: str = choice(MARKS)
    turns: int = whole(0, 10**6)
    drifts: int = whole(0, 10**6)
    time_s: float = measured()  # of the lap; null: none
    simulated: bool = flag()


@message
class Runs:
    """All recorded runs, the newest first. `new` is one that has just come."""

    runs: list[RunItem] = several(RunItem, 500)
    new: str = text(200, "")


@message
class Ghost:
    """A car to draw beside, over the time of the drive; no rows: none."""

    name: str = text(300)
    time_s: list[float] = column()
    x_m: list[float] = column()
    y_m: list[float] = column()
    heading_rad: list[float] = column()
    sideslip_deg: list[float] = column()


@message
class Rollouts:
    """Paths that the planner looks at: a time and `paths`, as the report's view has them."""

    time_s: float = measured()
    paths: list[dict[str, Any]] = anything()


@message
class Sketch:
    """The walls of a drawn course."""

    walls_m: list[list[float]] = anything()
    line_m: list[list[float]] = anything()
    start: dict[str, float] = anything()
    length_m: float = measured()


@message
class Busy:
    """The server prepares something for a while; empty: it is done."""

    text: str = text(300)


@message
class Event:
    """Something has happened. `what` is for the page's code, `text` for the person."""

    what: str = choice(("silence", "heard", "lag", "role", "hand_over", "recording", "note"))
    text: str = text(300)


@message
class Error:
    """What was wrong with a message of the page."""

    text: str = text(300)


OF_PAGE = (
    Hello, Input, Control, SetUp, Gyro, Parameter, Sensor, Paint, HandOver, Record, Mark, Trim,
    AskGhost, AskRollouts, DrawCourse,
)  # fmt: skip
OF_SERVER = (
    Welcome, World, State, Turn, Ended, Runs, Ghost, Rollouts, Sketch, Busy, Event, Error,
)  # fmt: skip
PARTS = (Patch, Segment, Line, Item, Slider, SensorState, Wheel, Believed, RunItem)


def kind_of(cls: type) -> str:
    """The word `kind` of a message's class."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()


_OF_PAGE = {kind_of(cls): cls for cls in OF_PAGE}


def parse(line: str) -> Any:
    """The message of the page in a text. Raises `InputError` with one line.

    Its cost is in proportion to the text, of which at most `LARGEST` characters are looked at.
    """
    if len(line) > LARGEST:
        raise InputError(f"message: over {LARGEST} characters: send less at once")
    depth = 0
    for found in _BRACKET.finditer(line):
        depth += 1 if found[0] in "[{" else -1
        if depth > DEEPEST:
            raise InputError("message: it is nested too deeply")
    fields = json_object(line, "message")
    kind = fields.pop("kind", None)
    cls = _OF_PAGE.get(kind) if isinstance(kind, str) else None
    if cls is None:
        raise InputError(f"message: no kind {shown(kind)}")
    return _read(cls, fields, str(kind))


def _read(cls: Any, found: Mapping[str, Any], where: str) -> Any:
    known = {field.name: field for field in dataclasses.fields(cls)}
    for name in found:
        if name not in known:
            raise InputError(f"{where}: no field {short(name)}")
    for name, field in known.items():
        if name not in found and field.default is dataclasses.MISSING:
            raise InputError(f"{where}.{name} is missing")
    return cls(
        **{
            name: _value(known[name].metadata["kind"], value, f"{where}.{name}")
            for name, value in found.items()
        }
    )


def _value(kind: Kind, value: Any, where: str) -> Any:
    """A checked value. Raises `InputError`."""
    if value is None and kind.nullable:
        return None
    if kind.name == "number":
        return values.number(value, where, kind.low, kind.high)
    if kind.name == "whole":
        return values.whole(value, where, int(kind.low), int(kind.high))
    if kind.name == "flag":
        return values.flag(value, where)
    if kind.name == "text":
        if not isinstance(value, str) or len(value) > kind.high or not value.isprintable():
            raise InputError(
                f"{where} must be a text of at most {kind.high:g} printable characters, "
                f"not {shown(value)}"
            )
        return value
    if kind.name == "choice":
        if not isinstance(value, str) or value not in kind.choices:
            raise InputError(f"{where} must be one of {', '.join(kind.choices)}")
        return value
    if kind.name == "list":
        if not isinstance(value, list) or not kind.low <= len(value) <= kind.high:
            raise InputError(f"{where} must be a list of {kind.low:g} to {kind.high:g} items")
        return [_value(kind.of, item, f"{where}[{i}]") for i, item in enumerate(value)]
    if not isinstance(value, dict):
        raise InputError(f"{where} must be an object, not {shown(value)}")
    return _read(kind.of, value, where)


def encode(said: Any) -> str:
    """A message as JSON. Numbers are rounded; NaN and infinity become null."""
    plain = {"kind": kind_of(type(said))} | _plain(said)
    return json.dumps(plain, separators=(",", ":"), allow_nan=False)


def plain(part: Any) -> dict[str, Any]:
    """The fields of a message or a part of one, as plain data."""
    found: dict[str, Any] = _plain(part)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, PRECISION) if math.isfinite(value) else None
    if isinstance(value, str | int) or value is None:
        return value
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value):
        names = (field.name for field in dataclasses.fields(value))
        return {name: _plain(getattr(value, name)) for name in names}
    if hasattr(value, "tolist"):  # of NumPy
        return _plain(value.tolist())
    raise TypeError(f"no message holds a {type(value).__name__}")


def messages_js() -> str:
    """The declarations as a JavaScript module: a type for each, a builder for each of the page's.

    A builder takes an object with the fields, and fills in those that have a default.
    """
    parts = [
        "// Generated by `python -m countersteer.cockpit.messages`: do not edit.\n",
        _kinds("OF_PAGE", OF_PAGE),
        _kinds("OF_SERVER", OF_SERVER),
        *(_typedef(cls, said=False) for cls in PARTS),
        *(_typedef(cls, said=True) for cls in (*OF_PAGE, *OF_SERVER)),
        *(_builder(cls) for cls in OF_PAGE),
    ]
    return "\n".join(parts)


def _kinds(name: str, classes: tuple[type, ...]) -> str:
    lines = "".join(f'  {cls.__name__}: "{kind_of(cls)}",\n' for cls in classes)
    return f"/** Kinds of messages. */\nexport const {name} = Object.freeze({{\n{lines}}});\n"


def _typedef(cls: Any, said: bool) -> str:
    summary = str(cls.__doc__).splitlines()[0]
    lines = [f"/**\n * {summary}", f" * @typedef {{object}} {cls.__name__}"]
    if said:
        lines.append(f' * @property {{"{kind_of(cls)}"}} kind')
    for field in dataclasses.fields(cls):
        kind = field.metadata["kind"]
        lines.append(f" * @property {{{_type(kind)}}} {field.name}{_range(kind)}")
    return "\n".join([*lines, " */\n"])


def _type(kind: Kind) -> str:
    if kind.name == "list":
        inner = _type(kind.of)
        found = f"({inner})[]" if "|" in inner else f"{inner}[]"
    elif kind.name == "choice":
        found = "|".join(f'"{word}"' for word in kind.choices)
    elif kind.name == "object":
        found = kind.of.__name__
    else:
        words = {"flag": "boolean", "text": "string", "anything": "any"}
        found = words.get(kind.name, "number")
    return f"{found}|null" if kind.nullable else found


def _range(kind: Kind) -> str:
    if kind.name in ("number", "whole") and math.isfinite(kind.low):
        return f" in [{kind.low:.16g}, {kind.high:.16g}]"
    if kind.name in ("text", "list") and math.isfinite(kind.high):
        return f" of at most {kind.high:g}"
    return ""


def _builder(cls: Any) -> str:
    fields = []
    for field in dataclasses.fields(cls):
        default = "" if field.default is dataclasses.MISSING else f" = {json.dumps(field.default)}"
        fields.append(field.name + default)
    name = cls.__name__[0].lower() + cls.__name__[1:]
    given = f"{{ {', '.join(fields)} }}"
    if all("=" in field for field in fields):
        given += " = {}"
    names = ", ".join(field.name for field in dataclasses.fields(cls))
    return (
        f"/** @returns {{{cls.__name__}}} */\n"
        f"export const {name} = ({given}) =>\n"
        f'  ({{ kind: "{kind_of(cls)}", {names} }});\n'
    )


if __name__ == "__main__":
    print(messages_js(), end="")
