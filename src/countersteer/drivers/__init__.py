"""Drivers: from what the sensors tell to what the car is asked for. One driver a file."""

DRIVERS = ("drift-turn", "straighten")  # of the library; plans have their names beside these
