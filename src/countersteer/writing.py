"""Files that are written whole or not at all, by one process at a time.

A file is written beside its place, under a name that starts with a dot and holds the process id,
and then takes its place in one step. A process that is killed, or a disk that is full, leaves what
was there before. What a dead process has left behind is removed by the next one that writes there.
"""

import contextlib
import errno
import hashlib
import itertools
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from countersteer.errors import InputError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_OWN = re.compile(r"\.(.*)\.(\d+)-\d+\.part|\.(.*)\.lock")  # our names, but for results
_LONGEST = 200  # bytes of a name that can be made longer; systems allow 255
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}
_count = itertools.count()
_mine: dict[Path, Path] = {}  # parts and locks that this process has made, and what they are for


class BusyError(InputError):
    """Another process writes there."""


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give the path of a part, to write a file to. It takes the place of `path` at the block's end.

    If the block raises an exception, the part is removed and `path` stays as it was. An `OSError`
    names `path`. A part needs no part of its own: of nested blocks, the inner file takes its place
    first, and an error keeps all of them. Raises `InputError` if `path` is something other than a
    file, such as a device.
    """
    if path in _mine:
        with naming(_mine[path]):
            yield path
        return
    place = Path(os.path.realpath(path))  # a link stays a link
    if place.exists() and not place.is_file():
        raise InputError(f"{path}: is there already and is not a file: give another name")
    with naming(path):
        if place.exists() and not os.access(place, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        part = new_part(place)
        _mine[part] = path
        try:
            yield part
            _flush(part)
            part.replace(place)
        finally:
            remove(part)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8. Raises `OSError` if it cannot be written, and keeps the old."""
    with whole(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def write_together(files: Mapping[Path, str | bytes]) -> None:
    """Write files that belong together: all or, on an error, none. The first is replaced last."""
    with contextlib.ExitStack() as stack:
        for path, content in files.items():
            part = stack.enter_context(whole(path))
            with naming(path):
                part.write_bytes(content.encode() if isinstance(content, str) else content)
                _flush(part)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an `OSError` of the block name `path`, unless it names another file than a part."""
    try:
        yield
    except OSError as error:
        names = () if error.filename is None else Path(str(error.filename)).parts
        if names and not any(map(_OWN.fullmatch, names)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def new_part(path: Path) -> Path:
    """A new name beside `path` for what will take its place. Remove those of dead processes."""
    name = _short(path.name)
    with contextlib.suppress(PermissionError):  # a folder may be written and not be read
        for other in path.parent.iterdir():
            found = _OWN.fullmatch(other.name)
            if found and found[1] == name and not _lives(int(found[2])):
                remove(other)
    part = path.with_name(f".{name}.{os.getpid()}-{next(_count)}.part")
    _mine[part] = path
    return part


def remove(part: Path) -> None:
    """Remove a part, which may be gone already."""
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)
    _mine.pop(part, None)


def clean_up() -> None:
    """Remove what this process has begun, for one that ends at once."""
    for path in tuple(_mine):
        with contextlib.suppress(OSError):
            remove(path)


def is_empty(folder: Path) -> bool:
    """Whether a folder holds no result: nothing, or parts and locks only."""
    return all(_OWN.fullmatch(entry.name) for entry in folder.iterdir())


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Keep other processes from writing `path`, a file or a folder, while the block runs.

    The lock is on a file `.NAME.lock` beside `path`. The system releases it when the process ends,
    however that happens. If the file cannot be made beside a folder, it is made inside. On a file
    system that has no locks, nothing is kept out. Raises `BusyError` if another process, or another
    block of this one, writes there, and `InputError` if nobody can.
    """
    place = Path(os.path.realpath(path))
    folders = (place.parent, place) if place.is_dir() else (place.parent,)
    for folder in folders:
        lock = folder / f".{_short(place.name)}.lock"
        try:
            file = _locked(lock)
            break
        except OSError as error:
            reason = error.strerror
    else:
        raise InputError(f"{path}: cannot be written: {reason}")
    if file is None:
        raise BusyError(f"{path}: another process is writing there")
    _mine[lock] = path
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # where an open file cannot be removed, it stays
            remove(lock)
        os.close(file)


def _locked(lock: Path) -> int | None:
    """The open and locked file; None if another process has it. Raises `OSError`."""
    while True:
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _try_lock(file):
                os.close(file)
                return None
            if os.path.samestat(os.fstat(file), os.stat(lock)):
                return file
        except FileNotFoundError:
            pass  # the process that had it has removed the file
        except OSError:
            os.close(file)
            raise
        os.close(file)


def _try_lock(file: int) -> bool:
    """Whether the open file is locked now. A file system without locks says yes."""
    try:
        if sys.platform == "win32":
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return True
        if error.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
            return False
        raise
    return True


def _lives(process: int) -> bool:
    """Whether a process with this id is running, as far as can be told."""
    if sys.platform == "win32":  # where the question would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _short(name: str) -> str:
    """The name, or a digest of one that is too long to be made longer."""
    encoded = os.fsencode(name)
    return name if len(encoded) <= _LONGEST else hashlib.sha256(encoded).hexdigest()


def _flush(part: Path) -> None:
    """Have the system write a file to the disk, so that no power cut leaves an empty one."""
    file = os.open(part, os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)
