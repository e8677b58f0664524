"""Messages of ROS as plain numbers: decoded by their definitions, without generated code.

The library `rosbags` reads bags and parses definitions. Its own decoder turns the definitions,
which come from the bag, into Python code and executes it. So messages are decoded here instead.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any

MOST_ITEMS = 64  # of an array that become columns; the rest is passed over
FORMATS = {
    "bool": "?",
    "byte": "B",
    "octet": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # kinds of fields in the library's definitions
PADDING = 3  # bytes that may be left at the end of a message of ROS 2

Types = Mapping[str, tuple[Any, Any]]  # by name: constants, and fields as (name, description)


class WrongMessageError(Exception):
    """A message does not fit its definition."""


def numbers_of(types: Types, name: str, data: bytes, ros2: bool) -> dict[str, float]:
    """The numbers of a message by their dotted paths, such as `twist.linear.x` or `axes.1`.

    Texts are left out. Raises `WrongMessageError`.
    """
    try:
        reader = _Reader(types, data, ros2)
        found = dict(reader.message(name, ""))
    except (struct.error, KeyError, IndexError) as error:
        raise WrongMessageError(f"a message does not fit its definition of {name}") from error
    left = len(data) - reader.at
    if not 0 <= left <= (PADDING if ros2 else 0):
        raise WrongMessageError(f"a message is longer than its definition of {name}")
    return found


class _Reader:
    """Reads one message from its start to its end."""

    def __init__(self, types: Types, data: bytes, ros2: bool) -> None:
        self.types, self.data, self.ros2 = types, data, ros2
        # A message of ROS 2 has a head of four bytes, and its numbers are aligned after it.
        self.at = 4 if ros2 else 0
        self.order = ">" if ros2 and not data[1] & 1 else "<"

    def message(self, name: str, path: str) -> Iterator[tuple[str, float]]:
        """The numbers of a message, or of one within another."""
        for field, description in self.types[name][1]:
            yield from self.field(description, f"{path}{field}")

    def field(self, description: Any, path: str) -> Iterator[tuple[str, float]]:
        """The numbers of one field."""
        kind, detail = int(description[0].value), description[1]
        if kind == BASE:
            if detail[0] in FORMATS:
                yield path, self.base(detail[0], 1)[0]
            else:
                self.skip_text(detail[0])
        elif kind == NAME:
            yield from self.message(detail, f"{path}.")
        else:
            inner, count = detail
            if kind == SEQUENCE:
                count = self.base("uint32", 1)[0]
            if count > len(self.data):
                raise WrongMessageError("an array is longer than its message")
            yield from self.items(inner, count, path)

    def items(self, inner: Any, count: int, path: str) -> Iterator[tuple[str, float]]:
        """The numbers of an array."""
        if int(inner[0].value) == BASE and inner[1][0] in FORMATS:
            if count:
                values = self.base(inner[1][0], count)
                yield from ((f"{path}.{i}", v) for i, v in enumerate(values[:MOST_ITEMS]))
            return
        for i in range(count):
            for item in self.field(inner, f"{path}.{i}"):
                if i < MOST_ITEMS:
                    yield item

    def base(self, kind: str, count: int) -> tuple[Any, ...]:
        """Numbers of one kind that follow each other."""
        letter = FORMATS[kind]
        size = struct.calcsize(f"={letter}")
        if self.ros2:
            self.at += -(self.at - 4) % size
        values = struct.unpack_from(f"{self.order}{count}{letter}", self.data, self.at)
        self.at += size * count
        return values

    def skip_text(self, kind: str) -> None:
        """Pass over a text."""
        length = self.base("uint32", 1)[0]
        self.at += length * (4 if kind == "wstring" else 1)
        if self.at > len(self.data):
            raise WrongMessageError("a text is longer than its message")


def bounded(decompressor: Callable[[], Any], most: int) -> Callable[..., bytes]:
    """A function that unpacks data of at most `most` bytes, as small data may unpack to huge ones.

    `decompressor` makes an object with the methods of `bz2.BZ2Decompressor`.
    """

    def unpack(data: bytes, _size: int = 0) -> bytes:
        unpacked: bytes = decompressor().decompress(data, max_length=most + 1)
        if len(unpacked) > most:
            raise WrongMessageError(f"a piece of it unpacks to over {most // 1_000_000} MB")
        return unpacked

    return unpack
