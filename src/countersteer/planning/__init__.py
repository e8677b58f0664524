"""Planners that know the car's model."""
