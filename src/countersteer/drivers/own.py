"""Drivers of one's own: a class in a Python file, or one that an installed package offers.

Only a person names code, as `FILE.py:CLASS` on the command line or in a call. No file that is read
can: `run.toml`, policies and plans hold plain data.
"""

import importlib.metadata
import importlib.util
import inspect
import sys
import traceback
from pathlib import Path
from typing import Any

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.errors import InputError

GROUP = "countersteer.drivers"  # of entry points


def is_code(name: str) -> bool:
    """Whether a driver's name is `FILE.py:CLASS`, or a file without its class."""
    return name.endswith(".py") or ".py:" in name


def installed() -> list[str]:
    """The names of the drivers that installed packages offer."""
    return sorted(point.name for point in importlib.metadata.entry_points(group=GROUP))


def described(name: str) -> str:
    """What an installed driver's class says of itself, in a line."""
    return (inspect.getdoc(_installed(name)) or "").partition("\n")[0]


def own_driver(name: str, course: Course, car: Car, speed: float | None, laps: int) -> Any:
    """The driver of a class that a person named.

    The class gets those of `course`, `car` (the nominal one), `speed` (m/s or None) and `laps` that
    its `__init__` has parameters for. Raises `InputError` with one line if there is no such class,
    or if it cannot be made.
    """
    made = _from_file(name) if is_code(name) else _installed(name)
    given = {"course": course, "car": car, "speed": speed, "laps": laps}
    try:
        wanted = inspect.signature(made).parameters
        everything = any(p.kind is p.VAR_KEYWORD for p in wanted.values())
        driver = made(**{k: v for k, v in given.items() if everything or k in wanted})
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{name}: cannot be made: {told_in_a_line(error)}") from error
    for method in ("reset", "act"):
        if not callable(getattr(driver, method, None)):
            raise InputError(
                f"{name}: has no method {method}: a driver has reset(key) and "
                "act(memory, observation); 'countersteer new driver NAME' writes one"
            )
    return driver


def told_in_a_line(error: BaseException) -> str:
    """An exception of somebody's code in a line, with the place where it arose."""
    frames = traceback.extract_tb(error.__traceback__)
    words = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(error, SyntaxError) and error.filename:
        return f"{words.split(' (')[0]} ({error.filename}, line {error.lineno})"
    return f"{words} ({frames[-1].filename}, line {frames[-1].lineno})" if frames else words


def _from_file(name: str) -> Any:
    file, _, wanted = name.rpartition(":") if ".py:" in name else (name, "", "")
    path = Path(file)
    if not path.is_file():
        raise InputError(f"{name}: there is no file {file}")
    spec = importlib.util.spec_from_file_location(f"_driver_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{file}: {told_in_a_line(error)}") from error
    classes = [k for k, v in vars(module).items() if inspect.isclass(v) and hasattr(v, "act")]
    known = f"it has {', '.join(classes)}" if classes else "it has no class with a method act"
    if not wanted:
        example = classes[0] if classes else "CLASS"
        raise InputError(f"{name}: name the class as well, as in {file}:{example} ({known})")
    if not hasattr(module, wanted):
        raise InputError(f"{file}: has no {wanted}: {known}")
    return getattr(module, wanted)


def _installed(name: str) -> Any:
    (point,) = importlib.metadata.entry_points(group=GROUP, name=name)
    try:
        return point.load()
    except Exception as error:
        raise InputError(f"{name}: {told_in_a_line(error)}") from error
