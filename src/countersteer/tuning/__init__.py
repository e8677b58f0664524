"""Logs in, a car out."""
