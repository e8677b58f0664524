"""Drivers: from what the sensors tell to what the car is asked for. One driver a file."""
