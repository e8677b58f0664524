"""Files of learned policies: arrays of plain numbers, and what they say about themselves.

A file is an `.npz`. Its array `about` is JSON: kind, format, course, car, task, what it cost to
learn, and digests of the course and the car that it is for.
"""

import hashlib
import importlib.resources
import io
import json
import math
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.errors import InputError
from countersteer.reading.values import short, shown

LARGEST = 100_000_000  # bytes of a file, also once it is unpacked
# What a damaged file raises: in its folder, its packing, its arrays' heads, its JSON.
BROKEN = (
    OSError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, ValueError,
    KeyError, TypeError, AttributeError,
)  # fmt: skip


def packed(arrays: Mapping[str, Any], about: Mapping[str, Any]) -> bytes:
    """The content of a policy's file."""
    told = np.frombuffer(json.dumps(dict(about)).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=told, **arrays)
    return buffer.getvalue()


def about_of(path: Path) -> dict[str, Any]:
    """What a file says, without its other arrays. Raises `InputError` in one line."""
    where = short(str(path))
    try:
        _check_size(path)
        with np.load(path) as file:
            about = json.loads(file["about"].tobytes().decode())
        if not isinstance(about["kind"], str):
            raise ValueError("it names no kind")
    except BROKEN as error:
        raise InputError(f"{where}: is no policy of 'learn': {error}") from None
    return dict(about)


def read(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of a file of this kind, and what it says. Raises `InputError` in one line."""
    where, about = short(str(path)), about_of(path)
    if about["kind"] != kind:
        raise InputError(f"{where}: is no policy of 'learn {kind}'")
    try:
        with np.load(path) as file:
            return {name: file[name] for name in file.files if name != "about"}, about
    except BROKEN as error:
        raise InputError(f"{where}: is no policy of 'learn {kind}': {error}") from None


def _check_size(path: Path) -> None:
    """Raises `InputError` for a file that is too large, packed or unpacked."""
    size = path.stat().st_size
    if size <= LARGEST:
        with zipfile.ZipFile(path) as file:
            size = sum(part.file_size for part in file.infolist())
    if size > LARGEST:
        raise InputError(f"{short(str(path))}: over {LARGEST / 1e6:.0f} MB, which no policy is")


def fingerprint(course: Course, car: Car) -> dict[str, str]:
    """Digests of what a policy is for: the course, and the car without its sensors."""
    goal = math.nan if course.goal_distance is None else course.goal_distance
    place = np.array([*course.start, course.start_distance, goal])
    parts = (car.body, car.tires, car.drivetrain, car.motor, car.battery, car.servo)
    return {
        "course": _digest([course.walls, course.line, place]),
        "car": _digest([leaf for leaf in jax.tree.leaves(parts) if not isinstance(leaf, str)]),
    }


def _digest(arrays: Sequence[Any]) -> str:
    """A digest of numbers, to nine decimals: they come from decimal files."""
    found = hashlib.sha256()
    for array in arrays:
        found.update((np.round(np.asarray(array, np.float64), 9) + 0.0).tobytes())
    return found.hexdigest()[:16]


def check_for(where: str, about: Mapping[str, Any], course: Course, car: Car) -> None:
    """Refuse a policy of another course or car, with one line."""
    mine, theirs = fingerprint(course, car), about.get("fingerprint", {})
    for key in ("course", "car"):
        if not isinstance(theirs, Mapping) or theirs.get(key) != mine[key]:
            raise InputError(
                f"{where}: was learned for the {key} {shown(about.get(key))}, which this is not; "
                f"learn one: {_how(about.get('kind'), course)}"
            )


def policy_for(kind: str, course: Course, car: Car) -> Path:
    """The library's policy for a course and a car. Raises `InputError` if there is none."""
    mine = fingerprint(course, car)
    for path in library():
        about = about_of(path)
        if about["kind"] == kind and about.get("fingerprint") == mine:
            return path
    raise InputError(
        f"no policy is stored for the course {course.name} with this car; "
        f"learn one: {_how(kind, course)}, then give --driver POLICY.npz"
    )


def _how(kind: Any, course: Course) -> str:
    """The command that learns a policy."""
    return f"countersteer learn {kind} {course.name} --out POLICY.npz"


def library() -> list[Path]:
    """The files of the library's policies."""
    folder = Path(str(importlib.resources.files("countersteer.drivers") / "policies"))
    return sorted(folder.glob("*.npz"))
