"""A driver of one's own: keeps to the middle between the walls, and slows down before one."""

import sys

import countersteer as cs


class WallFollower:
    """Any object with these two methods drives; `memory` is whatever it likes to keep.

    It decides 200 times a second; with `period = 0.001` it would do so at every millisecond.
    """

    def reset(self, key: object) -> float:
        """The memory at the start: how much farther the left wall is than the right one."""
        return 0.0

    def act(self, memory: float, observation: cs.Observation) -> tuple[cs.Command, float]:
        """Sonar: front, left, right, in metres. Steering in rad, positive to the left."""
        front, left, right = (heard.value for heard in observation.sonar)
        memory += 0.1 * (min(left, 2.0) - min(right, 2.0) - memory)
        steering = 0.4 * memory - observation.estimate.heading  # the corridor's is 0
        throttle = 0.35 if front > 1.5 and observation.wheel_speed.value < 1.5 else 0.0
        return cs.Command(throttle, max(-0.4, min(0.4, steering))), memory


if __name__ == "__main__":
    course, car = cs.load_course("straight"), cs.load_car("rx7")
    pilot, simulator = cs.Pilot.of(WallFollower(), course, car), cs.Simulator.of(course, car)
    print("the first start compiles for some seconds", flush=True)
    try:
        for record in simulator.run(pilot, longest=3.0):
            t, m = simulator.dt * record.tick[-1], record.motion
            words = f"x {m.x[-1]:5.2f} m   y {m.y[-1]:+.2f} m   {m.vx[-1]:.2f} m/s"
            print(f"{t:4.1f} s   {words}", flush=True)
    except cs.InputError as error:
        sys.exit(str(error))
