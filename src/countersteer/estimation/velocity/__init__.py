"""The car's velocity from gyroscope, accelerometer and encoder; `filter.py` is where to start."""
