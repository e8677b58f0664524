"""A first mapping for a CSV log, guessed from the names and the values of its columns.

Each guess stands beside what it was taken from. What cannot be known from the log is a line that
begins with `# doubt:`.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from countersteer.errors import InputError
from countersteer.reading.values import short
from countersteer.runs.importers.mapping import LONGEST
from countersteer.runs.importers.tables import TextTable
from countersteer.runs.importers.units import SIGNALS, UNITS, Unit

# Words of a column's name for each signal, the surest first, and words that speak against it.
WORDS = {
    "time": (
        r"time|stamp|^t$|^t[_ (]+[mun]?s|^s$|^secs?$|^ms$|clock|elapsed|millis|micros|epoch",
        r"lap|timer|timeout",
    ),
    "throttle": (r"throttle|^thr|^th$|gas|duty|accelerator|pwm_motor|esc", r"brake|temp|desc"),
    "speed": (
        r"(cmd|command|target|desired|ref|set).*(speed|vel|^v$)|^v$|drive.speed",
        r"ang|rate",
    ),
    "steering": (r"steer|^delta|servo|^rud|^st$|wheel_angle", r"rate|speed|vel|torque"),
    "direction": (r"direction|reverse|gear$", r"ratio"),
    "wheel_speed": (
        r"wheel.*(speed|vel)|encoder|erpm|rpm|odom|^speed|vehicle.*speed|^vel",
        r"cmd|command|target|desired|ref|count|ang|lat|gps|acc",
    ),
    "gyro": (
        r"yaw.?rate|gyro.*z|w.?z$|ang.*vel.*z|omega|^r$|^gz$|^w\b|gyro(?!.*[xy])",
        r"target|temp",
    ),
    "accel_x": (r"acc.*x|^a_?x$", r"gyro"),
    "accel_y": (r"acc.*y|^a_?y$", r"gyro"),
    "battery": (r"batt|volt|vbat|rxbt|^vi$|^v_in", r"percent|temp|cell"),
    "armed": (r"armed|dead.?man|safety|enable", r""),
    "x": (r"^x$|pos.*x|pose.*x|^x_?(m|pos)$|[._]x$", r"acc|gyro|vel|q|ang|mag"),
    "y": (r"^y$|pos.*y|pose.*y|^y_?(m|pos)$|[._]y$", r"acc|gyro|vel|q|ang|mag"),
    "heading": (r"^yaw$|heading|yaw(?!.*rate)|^psi$|^theta$", r"rate|vel|gyro|acc"),
}
# Words for a unit, in a name such as `speed (km/h)`, `yaw_rate_degps` or `t_ms`.
UNIT_WORDS = {
    "datetime": r"date",
    "km/h": r"km.?h|kph",
    "mph": r"mph",
    "cm/s": r"cm.?(p|/).?s",
    "mm/s": r"mm.?(p|/).?s",
    "m/s": r"m.?(p|/).?s$|m/s\b|mps",
    "erpm": r"erpm",
    "rpm": r"rpm",
    "deg/s": r"deg.?(p|/|_per_).?s|(?<!ra)dps",
    "rad/s": r"rad.?(p|/|_per_).?s",
    "deg": r"deg|°",
    "rad": r"rad",
    "ns": r"_ns$|\(ns\)|nano|nsec",
    "us": r"_us$|\(us\)|micro|usec|pulse|µs",
    "ms": r"_ms$|\(ms\)|milli|msec|^ms",
    "s": r"_s$|\(s\)|sec",
    "g": r"_g$|\(g\)",
    "m/s2": r"m.?s.?2|mps2",
    "mV": r"_mv$|\(mv\)|milli",
    "V": r"_v$|\(v\)|volt",
    "cm": r"_cm$|\(cm\)",
    "mm": r"_mm$|\(mm\)",
    "m": r"_m$|\(m\)",
    "%": r"%|percent|pct",
}
FASTEST_TURN = 35.0  # rad/s; a faster yaw rate is in degrees
STEEPEST = 0.8  # rad; a larger angle is in degrees, or it is no angle
# A log with a column for each wheel, and one whose clock is in two columns.
CORNER = re.compile(r"(fl|fr|rl|rr)\b|(front|rear).?(left|right)", re.IGNORECASE)
NANOSECONDS = re.compile(r"n(ano)?s(ec\w*)?", re.IGNORECASE)
MANY = 50  # turning rows that tell a sign


class Guess(NamedTuple):
    """One entry of the mapping."""

    column: str
    entry: dict[str, object]  # keys besides the column
    doubt: str = ""


class Column(NamedTuple):
    """The values of a column, as far as a guess needs them."""

    name: str
    known: np.ndarray  # sorted
    steps: np.ndarray  # between rows
    words: set[str]  # a few of its texts, where it has no numbers

    @property
    def most(self) -> float:
        """The largest magnitude, without the rarest thousandth."""
        return float(np.quantile(np.abs(self.known), 0.999)) if len(self.known) else 0.0


def guess_mapping(log: Path) -> tuple[str, list[str]]:
    """The text of a first mapping of a CSV log, and its doubts.

    Raises `InputError` if no column looks like a time, a throttle or a commanded speed.
    """
    table = TextTable(log)
    names = [name for name in dict.fromkeys(table.names) if len(name) <= LONGEST]
    columns = [_column(table, name) for name in names]
    guesses: dict[str, Guess] = {}
    taken: set[str] = set()
    for signal, (words, against) in WORDS.items():
        column = _named(columns, words, against, taken, signal)
        if column is not None and not (signal == "speed" and "throttle" in guesses):
            guesses[signal] = GUESSERS[SIGNALS[signal].dimension](column)
            taken.add(column.name)
            if signal in ("time", "wheel_speed"):
                taken |= _with_others(guesses[signal], columns)
    for signal, doing in (("time", "time"), ("throttle", "a throttle or a commanded speed")):
        if signal not in guesses and not (signal == "throttle" and "speed" in guesses):
            raise InputError(
                f"{log}: no column looks like {doing}: {short(', '.join(table.names))}"
            )
    if not {"x", "y", "heading"} <= guesses.keys():
        for signal in ("x", "y", "heading"):
            guesses.pop(signal, None)
    doubts = [f"{s}: {g.doubt}" for s, g in guesses.items() if g.doubt]
    doubts += _signs(table, guesses)
    return _text(log, table, guesses, doubts), doubts


def _column(table: TextTable, name: str) -> Column:
    try:
        values = table.numbers(name)
    except InputError:
        return Column(name, np.zeros(0), np.zeros(0), set(table.text(name)[:1000]))
    known = values[np.isfinite(values)]
    return Column(name, np.sort(known), np.diff(known), set())


def _named(
    columns: list[Column], words: str, against: str, taken: set[str], signal: str
) -> Column | None:
    """The first column that the surest word fits."""
    for word in _alternatives(words):
        for column in columns:
            name = column.name.lower()
            fits = re.search(word, name) and not (against and re.search(against, name))
            told = column.most > 0 or signal in ("direction", "time")
            if fits and told and column.name not in taken:
                return column
    return None


def _with_others(guess: Guess, columns: list[Column]) -> set[str]:
    """Add the columns that belong to the guess: other wheels, or the clock's nanoseconds."""
    names = [column.name for column in columns]
    if CORNER.search(guess.column):
        alike = [n for n in names if CORNER.sub("", n) == CORNER.sub("", guess.column)]
        if len(alike) > 1:
            guess.entry["columns"] = alike
    below = [n for n in names if NANOSECONDS.fullmatch(n)]
    if re.fullmatch(r"s(ec\w*)?", guess.column, re.IGNORECASE) and len(below) == 1:
        guess.entry.update(columns=[guess.column, *below], unit=["s", "ns"])
    return set(guess.entry.get("columns", ()))  # type: ignore[call-overload]  # a list of names


def _alternatives(words: str) -> list[str]:
    """The words between the bars that are in no bracket."""
    return re.split(r"\|(?![^(]*\))", words)


def _unit(column: Column, dimension: str) -> str | None:
    """The unit that the name tells, if it is one of the dimension."""
    for unit, word in UNIT_WORDS.items():
        if unit in UNITS[dimension] and re.search(word, column.name.lower()):
            return unit
    return None


def _time(column: Column) -> Guess:
    told = _unit(column, "time")
    if not len(column.known):
        return Guess(column.name, {"unit": "datetime"})
    steps = column.steps[column.steps > 0]
    step = float(np.median(steps)) if len(steps) else 1.0
    likely = "s" if step < 1 else "ms" if step < 1e3 else "us" if step < 1e6 else "ns"
    doubt = (
        f"rows are {step:g} apart, which looks like {likely}" if told not in (None, likely) else ""
    )
    return Guess(column.name, {"unit": told or likely}, doubt)


def _share(column: Column) -> Guess:
    known, most = column.known, column.most
    if _unit(column, "share") == "us" or (len(known) and known[0] > 700 and most < 2400):
        # A stick rests more often than it is anywhere else.
        pulses, counts = np.unique(np.round(known), return_counts=True)
        rest = float(pulses[np.argmax(counts)])
        zero, why = 1500.0, "zero and span are a servo's usual pulses"
        if 0 < abs(rest - 1500) <= 150:
            zero, why = rest, "zero is the most frequent pulse, and span a servo's usual one"
        entry: dict[str, object] = {"unit": "us", "zero": round(zero), "span": 500}
        return Guess(column.name, entry, why)
    if most <= 1.05:
        return Guess(column.name, {"unit": "1"})
    if known[0] >= 0 and most <= 105 and abs(float(known[0]) - 50) < abs(float(known[0])):
        entry = {"unit": "%", "zero": 50, "span": 50}
        return Guess(column.name, entry, "it never falls far below 50, so 50 is taken as neutral")
    if most <= 105:
        return Guess(column.name, {"unit": "%"}, "" if "%" in column.name else "1 or %?")
    span = 1024 if most <= 1100 else 2 ** int(np.ceil(np.log2(most)))
    return Guess(column.name, {"unit": "counts", "span": span}, f"full scale {span} is a guess")


def _angle(column: Column) -> Guess:
    told, most = _unit(column, "angle"), column.most
    if told in ("deg", "rad"):
        wrong = told == "rad" and most > 2 * np.pi + 0.1
        return Guess(column.name, {"unit": told}, "too large for radians" if wrong else "")
    heading = re.search(r"yaw|heading|psi|theta", column.name.lower())
    if heading or most <= STEEPEST:
        unit = "deg" if most > 2 * np.pi + 0.1 else "rad"
        return Guess(column.name, {"unit": unit}, "its name tells no unit")
    if most <= 1.05:
        return Guess(column.name, {"unit": "1"}, "full_lock_deg at 1 is a guess")
    if 1.05 < most <= 45:
        return Guess(column.name, {"unit": "deg"}, "its name tells no unit")
    share = _share(column)
    return share._replace(doubt=f"full_lock_deg is a guess. {share.doubt}".strip())


def _speed(column: Column) -> Guess:
    told = _unit(column, "speed")
    if told in ("erpm", "rpm"):
        doubt = "wheel_radius_m, gear_ratio and pole_pairs are guesses: fill in your car's"
        return Guess(column.name, {"unit": told}, doubt)
    return Guess(column.name, {"unit": told or "m/s"}, "" if told else "its name tells no unit")


def _rate(column: Column) -> Guess:
    likely = "deg/s" if column.most > FASTEST_TURN else "rad/s"
    told = _unit(column, "rate")
    doubt = "" if told == likely else f"it reaches {column.most:.3g}, which looks like {likely}"
    return Guess(column.name, {"unit": told or likely}, doubt)


def _acceleration(column: Column) -> Guess:
    told, likely = _unit(column, "acceleration"), "g" if column.most < 3 else "m/s2"
    return Guess(column.name, {"unit": told or likely}, "" if told else "its name tells no unit")


def _length(column: Column) -> Guess:
    told = _unit(column, "length")
    return Guess(column.name, {"unit": told or "m"}, "" if told else "its name tells no unit")


def _voltage(column: Column) -> Guess:
    return Guess(column.name, {"unit": "mV" if column.most > 200 else "V"})


def _switch(column: Column) -> Guess:
    return Guess(column.name, {"above": float(np.mean(column.known[[0, -1]]))})


def _word(column: Column) -> Guess:
    texts = sorted(column.words) or [f"{v:g}" for v in np.unique(column.known)[:10]]
    reverse = [t for t in texts if re.match(r"-|r|b", t.lower())]
    doubt = "" if reverse else f"which of {short(', '.join(texts))} is reverse?"
    return Guess(column.name, {"reverse": reverse or ["reverse"]}, doubt)


GUESSERS: dict[str, Callable[[Column], Guess]] = {
    "time": _time,
    "share": _share,
    "angle": _angle,
    "speed": _speed,
    "rate": _rate,
    "acceleration": _acceleration,
    "length": _length,
    "voltage": _voltage,
    "switch": _switch,
    "word": _word,
}


def _signs(table: TextTable, guesses: dict[str, Guess]) -> list[str]:
    """Doubts about signs. Steering gets the sign with which it turns as the gyroscope."""
    if "steering" not in guesses:
        return ["there is no steering: every command is straight ahead"]
    if "gyro" not in guesses:
        return ["steering: is it positive to the left? There is no gyroscope to tell"]
    steering, gyro = (table.numbers(guesses[name].column) for name in ("steering", "gyro"))
    steering = steering - float(guesses["steering"].entry.get("zero", 0))  # type: ignore[arg-type]  # a number
    with np.errstate(invalid="ignore"):
        turning = (np.abs(steering) > 0.3 * np.nanmax(np.abs(steering))) & (gyro != 0)
    if np.sum(turning) < MANY:
        return ["steering, gyro: hardly a turn is in the log, so the signs are not checked"]
    same = float(np.mean(np.sign(steering[turning]) == np.sign(gyro[turning])))
    if same < 0.5:
        guesses["steering"].entry["sign"] = -1
    return [
        f"steering, gyro: {'opposite' if same < 0.5 else 'equal'} signs in "
        f"{100 * max(same, 1 - same):.0f} % of the turning rows. Both must be positive to the "
        "left: if the car turned right where the gyroscope is positive, turn the sign of both"
    ]


FILL_IN = {  # numbers of the mapping that only the owner knows
    "full_lock_deg": "full_lock_deg = 25  # angle of the front wheels at full steering",
    "wheel_radius_m": "wheel_radius_m = 0.05",
    "gear_ratio": "gear_ratio = 10.0  # motor turns per wheel turn; 1 if it is the wheel's rpm",
    "pole_pairs": "pole_pairs = 2",
}


def _text(log: Path, table: TextTable, guesses: dict[str, Guess], doubts: list[str]) -> str:
    """The mapping as TOML with comments."""
    needs = {
        name
        for signal, guess in guesses.items()
        for name in UNITS.get(SIGNALS[signal].dimension, {})
        .get(str(guess.entry.get("unit")), Unit())
        .needs
    }
    lines = [f"# A first mapping of {short(log.name)}, guessed. Read each line, and every doubt."]
    lines += [line for name, line in FILL_IN.items() if name in needs]
    for signal, guess in guesses.items():
        column = {} if "columns" in guess.entry else {"column": guess.column}
        pairs = {**column, **guess.entry}
        inner = ", ".join(f"{key} = {json.dumps(value)}" for key, value in pairs.items())
        lines.append(f"{signal} = {{ {inner} }}")
    lines += [f"# doubt: {doubt}" for doubt in doubts]
    used = {guess.column for guess in guesses.values()}
    for guess in guesses.values():
        used |= set(guess.entry.get("columns", ()))  # type: ignore[call-overload]  # names
    rest = [name for name in table.names if name and name not in used]
    if rest:
        lines.append(f"# not used: {short(', '.join(rest))}")
    return "\n".join(lines) + "\n"
