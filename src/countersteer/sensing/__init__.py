"""Sensors: truth in, what the real part would report out."""
