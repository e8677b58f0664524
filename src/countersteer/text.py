"""Text files of the user, and the TOML files of the project."""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w

from countersteer.errors import InputError

MOST = 256  # MB; an hour of commands at 1 kHz is 150
LARGEST_TOML = 10  # MB, of a file that is written by hand
FORMAT = 1  # of the files that this version writes, and the latest that it reads


def read_text(path: Path, most: float = MOST) -> str:
    """The UTF-8 text of a file of at most `most` MB.

    Raises `InputError` if the file is larger (a device has no end), is not text or is unreadable.
    """
    limit = int(most * 1e6)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) > limit:
        raise InputError(f"{path}: cannot be read: it is larger than {most:g} MB")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read: it is not text") from None


def read_toml(name: str, shelf: Any, kind: str, files: str = ".toml") -> tuple[dict[str, Any], str]:
    """The tables of a library entry or of a file, and their name in messages.

    Raises `InputError` if there is none (the message names the allowed `files`), if it is not
    TOML, or if its format is later than `FORMAT`.
    """
    entry = shelf / f"{name}.toml"
    path = Path(name)
    if entry.is_file() and "/" not in name:
        return tables_of(read_text(entry), name), name
    if path.suffix == ".toml":
        return tables_of(read_text(path, LARGEST_TOML), str(path)), str(path)
    known = sorted(p.name.removesuffix(".toml") for p in shelf.iterdir())
    raise InputError(
        f"no {kind} {name}{nearest(name, known)}: give one of {', '.join(known)}, or the path of a "
        f"{files} file"
    )


def nearest(word: str, known: Iterable[str]) -> str:
    """` (did you mean …?)`, where one of the known words is like it."""
    found = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean {found[0]}?)" if found else ""


def tables_of(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text without their `format`. Raises `InputError`, naming `where`."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: not valid TOML: {error}") from None
    found = tables.pop("format", FORMAT)
    if type(found) is not int or found < 1:
        raise InputError(f"{where}: format must be a whole number from 1 on, not {found!r}")
    if found > FORMAT:
        raise InputError(
            f"{where}: format {found} is later than {FORMAT}, the latest that this version of "
            "Countersteer reads: install a newer one"
        )
    return tables


def toml_of(tables: Mapping[str, Any]) -> str:
    """The text of a TOML file, with its `format`."""
    return tomli_w.dumps({"format": FORMAT, **tables})
