"""The paper's measurements, one in each file. Each gives a table, a picture and a paragraph.

A module has `simulate(car, name, report)`. It also has `measure(runs)` if run folders suffice.
"""

import importlib
from typing import Any

NAMES = {
    "turn-rate": "yaw rate over the wheels' angle without slip",
    "drift-threshold": "wheels over without throttle: at which energy it drifts",
    "stop-time": "time and angle until a turn is stopped, over its yaw rate",
    "drift-turn": "one turn in all its signals",
    "control-rate": "10 Hz by radio or 1000 Hz on board, open or closed loop, two batteries",
    "battery": "the same commands at four charges and three wears",
    "linked-turns": "four turns in a row without straightening: how far the heading drifts",
    "action-spread": "a corner open loop by a novice's keys, the planner's commands and the best",
    "planner-rollouts": "what the planner sees: its sequences at six instants of a lap",
    "narrowest-corner": "the narrowest corner passed, and how fast, by grip and by drift",
}


def load(name: str) -> Any:
    """The module of an experiment."""
    return importlib.import_module(f"{__name__}.{name.replace('-', '_')}")
