"""Write a run folder: `commands.csv` and `telemetry.csv`, here of a car that drives a slalom.

Put your own car in place of the two functions. Then: countersteer import run mine --out runs
"""

import math
import time
from pathlib import Path


def ask(t: float) -> tuple[float, float]:
    """Throttle, -1 to 1, and steering in degrees, positive to the left."""
    return 0.3, 15 * math.sin(2 * t)


def measure(t: float) -> tuple[float, float]:
    """Wheel speed in m/s and yaw rate in rad/s, positive to the left."""
    return 2.0, 1.5 * math.sin(2 * t)


Path("mine").mkdir(exist_ok=True)
with open("mine/commands.csv", "w") as commands, open("mine/telemetry.csv", "w") as telemetry:
    print("time_s,throttle,direction,steering_deg", file=commands)
    print("time_s,wheel_speed_mps,gyro_radps", file=telemetry)
    for t in (time.time() + 0.02 * i for i in range(250)):  # any clock, the same in both files
        throttle, steering = ask(t)
        direction = "reverse" if throttle < 0 else "forward"
        print(f"{t:.4f},{abs(throttle)},{direction},{steering:.2f}", file=commands)
        print(f"{t:.4f},{measure(t)[0]:.3f},{measure(t)[1]:.4f}", file=telemetry)
