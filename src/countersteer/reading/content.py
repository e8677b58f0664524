"""Bytes and text of a file: a regular file of limited size, or one line that says why not."""

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from countersteer.errors import InputError
from countersteer.reading.values import short

MOST = 256  # MB; an hour of commands at 1 kHz is 150


@contextlib.contextmanager
def reading(where: object) -> Iterator[None]:
    """A block that reads and checks `where`. Whatever fails in it becomes an `InputError`.

    It is for nothing else: outside of reading, an unexpected exception is a bug and has to be seen.
    An exception that no reader foresaw is the `__cause__` of the error.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        reason = error.strerror or short(str(error))
        raise InputError(f"{where}: cannot be read: {reason}") from None
    except RecursionError:
        raise InputError(f"{where}: cannot be read: it is nested too deeply") from None
    except Exception as error:
        reason = f"{type(error).__name__}: {short(str(error))}".rstrip(": ")
        raise InputError(f"{where}: cannot be read: {reason}") from error


def read_bytes(path: Path, most: float = MOST) -> bytes:
    """The content of a regular file of at most `most` MB.

    Raises `InputError` if the file is larger, is a device, a pipe or a folder, or is unreadable.
    """
    limit = int(most * 1e6)
    if "\0" in str(path):
        raise InputError(f"{short(str(path))}: cannot be read: no file has such a name")
    with reading(path):
        about = os.stat(path)
        if not stat.S_ISREG(about.st_mode):  # opening a pipe would wait, a device has no end
            kind = "a folder" if stat.S_ISDIR(about.st_mode) else "no regular file"
            raise InputError(f"{path}: cannot be read: it is {kind}")
        content = b""
        if about.st_size <= limit:
            with path.open("rb") as file:
                content = file.read(limit + 1)
        if max(about.st_size, len(content)) > limit:
            raise InputError(f"{path}: cannot be read: it is larger than {most:g} MB")
    return content


def read_text(path: Path, most: float = MOST) -> str:
    """The UTF-8 text of a file of at most `most` MB, without a byte order mark.

    Raises `InputError` as `read_bytes`, and if the file is not text.
    """
    content = read_bytes(path, most)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read: it is not text") from None
