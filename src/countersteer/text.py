"""The TOML files of the project: their library, their format, and words that are like others."""

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w

from countersteer.errors import InputError
from countersteer.reading.content import read_text, reading
from countersteer.reading.documents import toml
from countersteer.reading.values import short, shown

LARGEST_TOML = 2  # MB, of a file that is written by hand; the parser reads some MB a second
FORMAT = 1  # of the files that this version writes, and the latest that it reads


def read_toml(name: str, shelf: Any, kind: str, files: str = ".toml") -> tuple[dict[str, Any], str]:
    """The tables of a library entry or of a file, and their name in messages.

    Raises `InputError` if there is none (the message names the allowed `files`), if it is not
    TOML, or if its format is later than `FORMAT`.
    """
    path = Path(name)
    with reading(short(name)):  # a name may be too long for a file
        entry = shelf / f"{name}.toml"
        known = "/" not in name and entry.is_file()
    if known:
        return tables_of(read_text(entry), name), name
    if path.suffix == ".toml":
        return tables_of(read_text(path, LARGEST_TOML), str(path)), str(path)
    names = sorted(p.name.removesuffix(".toml") for p in shelf.iterdir())
    raise InputError(
        f"no {kind} {short(name)}{nearest(name, names)}: give one of {', '.join(names)}, or the "
        f"path of a {files} file"
    )


def counted(number: int, noun: str) -> str:
    """`1 turn`, `2 turns`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean …?)`, where one of the known words is like it."""
    found = difflib.get_close_matches(word[:100], list(known), n=1, cutoff=0.6)
    return f" (did you mean {found[0]}?)" if found else ""


def tables_of(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text without their `format`. Raises `InputError`, naming `where`."""
    return checked_format(toml(text, where), where)


def checked_format(tables: dict[str, Any], where: str) -> dict[str, Any]:
    """The tables without their `format`. Raises `InputError` if it is later than `FORMAT`."""
    found = tables.pop("format", FORMAT)
    if type(found) is not int or found < 1:
        raise InputError(f"{where}: format must be a whole number from 1 on, not {shown(found)}")
    if found > FORMAT:
        raise InputError(
            f"{where}: format {shown(found)} is later than {FORMAT}, the latest that this "
            "version of Countersteer reads: install a newer one"
        )
    return tables


def toml_of(tables: Mapping[str, Any]) -> str:
    """The text of a TOML file, with its `format`."""
    return tomli_w.dumps({"format": FORMAT, **tables})
