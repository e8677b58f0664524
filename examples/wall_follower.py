"""A driver of one's own: keeps to the middle between the walls, and slows down before one."""

from countersteer.car.files import load_car
from countersteer.course.files import load_course
from countersteer.drivers.driver import Command, Observation
from countersteer.simulator import Simulator


class WallFollower:
    """Any object with these two methods drives; `memory` is whatever it likes to keep."""

    def reset(self, key: object) -> float:
        """The memory at the start: how much farther the left wall is than the right one."""
        return 0.0

    def act(self, memory: float, observation: Observation) -> tuple[Command, float]:
        """Sonar: front, left, right, in metres. Steering in rad, positive to the left."""
        front, left, right = (heard.value for heard in observation.sonar)
        memory += 0.02 * (min(left, 2.0) - min(right, 2.0) - memory)
        steering = 0.4 * memory - observation.estimate.heading  # the corridor's is 0
        throttle = 0.35 if front > 1.5 and observation.wheel_speed.value < 1.5 else 0.0
        return Command(throttle, max(-0.4, min(0.4, steering))), memory


if __name__ == "__main__":
    simulator = Simulator(load_course("straight"), load_car("rx7"), WallFollower())
    for record in simulator.run(longest=3.0):
        motion = record.motion
        print(f"x {motion.x[-1]:5.2f} m   y {motion.y[-1]:+.2f} m   {motion.vx[-1]:.2f} m/s")
