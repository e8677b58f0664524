"""Drivers: each computes commands from observations. One driver a file."""

DRIVERS = (
    "drift-turn",
    "straighten",
    "pursuit",
    "ppo",
    "tabular",
)  # of the library; `plan.library` names its plans
