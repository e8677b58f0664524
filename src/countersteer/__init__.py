"""Countersteer makes a radio-controlled car drift through a course by itself.

    import countersteer as cs

    run = cs.drive("box", car="rx7", driver="drift-turn", seed=1, set=["battery.wear=0.3"])
    run.outcome, run.turns, run.columns["x_m"]

| name | what it is |
| --- | --- |
| `drive`, `evaluate` | a recorded drive; a driver over random cars |
| `load_car`, `load_course`, `load_driver`, `load_run` | by a library name or a file's path |
| `Run` | a recorded drive: outcome, turns, columns; a notebook shows its report |
| `Simulator`, `Pilot`, `Task` | what is driven, what drives, what judges: step them yourself |
| `Observation`, `Command` | what a driver of your own is told, and returns |

Each is loaded as it is first asked for, and JAX is configured then. Errors in what you give are
`InputError`, with one line that says what to do. Units are in the names; inside all is SI and rad.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_NAMES = {
    "drive": "api",
    "evaluate": "api",
    "load_car": "car.files",
    "load_course": "course.files",
    "load_driver": "api",
    "load_run": "api",
    "Run": "api",
    "Simulator": "simulator",
    "Pilot": "pilot",
    "Task": "task.judge",
    "Command": "signals",
    "Observation": "drivers.driver",
    "InputError": "errors",
}
__all__ = list(_NAMES)


def __getattr__(name: str) -> Any:
    """A public name, from where it lives."""
    if name not in _NAMES:
        raise AttributeError(f"module 'countersteer' has no attribute {name!r}")
    if name in ("Simulator", "Pilot"):
        from countersteer.compiling import configure_jax

        configure_jax(batches=False)
    found = getattr(importlib.import_module(f"countersteer.{_NAMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The public names."""
    return [*__all__, "__version__"]
