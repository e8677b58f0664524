"""From readings to an estimate of the car's motion."""
