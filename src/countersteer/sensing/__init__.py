"""Sensors: ground truth in, reports of the real part out."""
