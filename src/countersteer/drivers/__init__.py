"""Drivers: each computes commands from observations. One driver a file."""

DRIVERS = (
    "drift-turn",
    "straighten",
    "pursuit",
    "ppo",
    "tabular",
    "optimum",
)  # of the library; `plan.library` names its plans
