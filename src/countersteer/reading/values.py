"""Values that were read: checked conversions, and how messages show them."""

import math
import reprlib
from typing import Any

from countersteer.errors import InputError

MOST_SHOWN = 80  # characters of a value or a name in a message
MOST_DIGITS = 30  # of a whole number that is shown in full
LONGEST_NAME, LONGEST_PATH = 100, 250  # characters


class _Shortened(reprlib.Repr):
    """`repr` that looks at a part of a value only. A list may be huge, or hold itself."""

    def repr_int(self, x: int, level: int) -> str:  # noqa: ARG002  # the signature is reprlib's
        """A whole number; long ones by their size, as Python converts no more than 4300 digits."""
        if x.bit_length() < 3.3 * MOST_DIGITS:
            return repr(x)
        return f"a whole number of some {x.bit_length() * math.log10(2):.0f} digits"


_shortened = _Shortened()
_shortened.maxlevel, _shortened.maxstring, _shortened.maxother = 3, MOST_SHOWN, MOST_SHOWN


def shown(value: Any) -> str:
    """A value that was read, for a message: its `repr`, cut to `MOST_SHOWN` characters."""
    return short(_shortened.repr(value))


def short(text: str) -> str:
    """A text that was read, for a message: printable, in one line of `MOST_SHOWN` characters."""
    cut = text[: MOST_SHOWN + 1]
    if not cut.isprintable():
        cut = "".join(c if c.isprintable() else repr(c)[1:-1] for c in cut)
    return cut if len(cut) <= MOST_SHOWN else cut[: MOST_SHOWN - 1] + "…"


def as_float(value: Any) -> float:
    """The number as a float; ±inf if it is beyond the floats, NaN if it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def number(value: Any, where: str, low: float, high: float) -> float:
    """The number `value` in [low, high] as a float. Raises `InputError`; `where` has file and key.

    Booleans and NaN are no numbers. The comparison is one of floats.
    """
    read = as_float(value)
    if not low <= read <= high:
        raise InputError(f"{where} must be a number in [{low:g}, {high:g}], not {shown(value)}")
    return read


def whole(value: Any, where: str, low: int, high: int) -> int:
    """The whole number `value` in [low, high]. Raises `InputError`; `where` has file and key."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{where} must be a whole number in [{low}, {high}], not {shown(value)}")
    return value


def flag(value: Any, where: str) -> bool:
    """The boolean `value`. Raises `InputError`; `where` has file and key."""
    if not isinstance(value, bool):
        raise InputError(f"{where} must be true or false, not {shown(value)}")
    return value


def name(value: Any, where: str) -> str:
    """The text `value`, fit for messages and names of files. Raises `InputError`."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > LONGEST_NAME:
        raise InputError(
            f"{where} must be a text of at most {LONGEST_NAME} printable characters, "
            f"not {shown(value)}"
        )
    return value


def path(value: Any, where: str) -> str:
    """The text `value`, a name in a library or the path of a file. Raises `InputError`."""
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= LONGEST_PATH:
        raise InputError(f"{where} must be a name or a path, not {shown(value)}")
    return value
