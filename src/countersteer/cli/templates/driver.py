"""A driver of your own: change it as you like.

These commands drive it, judge it, and compare it:

countersteer drive box --driver FILE:Driver
countersteer evaluate box --trials 64 --driver FILE:Driver
countersteer evaluate box --trials 64 --driver FILE:Driver drift-turn
"""

import countersteer as cs

SPEED = 1.0  # m/s
TURN_AT = 1.15  # m to the wall ahead at which the car turns
LOCK = 0.45  # rad of steering in a turn


class Driver:
    """Keeps to the middle between the walls, and turns where the wall ahead is near.

    A driver has two methods. What it remembers is whatever `reset` and `act` return.
    """

    period = 0.005  # s between two calls of `act`

    def __init__(self, course, laps):
        """Arguments are given by their names: course, car (the nominal one), speed, laps."""
        self.angles = [turn.angle for turn in course.turns_ahead(laps)]  # rad, left is positive
        self.bearing = course.start[2]  # of the first corridor, rad

    def reset(self, key):
        """The memory at the start: turns begun, the corridor's bearing, whether the car turns."""
        return (0, self.bearing, False)

    def act(self, memory, seen):
        """The command from now on, and the memory after it.

        `seen.sonar` is the distance to the wall (m) in front, to the left and to the right.
        `seen.estimate` has x, y (m), heading (rad), vx, vy (m/s) and yaw_rate (rad/s).
        Other readings: gyroscope, wheel_speed, accel_x, accel_y, battery. Each has `value`, `age`.
        """
        turns, bearing, turning = memory
        front, left, right = (heard.value for heard in seen.sonar)
        off = seen.estimate.heading - bearing  # rad to the left of the corridor

        if not turning and turns < len(self.angles) and front < TURN_AT and abs(off) < 0.4:
            turning, bearing = True, bearing + self.angles[turns]
            turns, off = turns + 1, seen.estimate.heading - bearing
        if turning and abs(off) < 0.3:
            turning = False

        if turning:
            steering = -LOCK if off > 0 else LOCK
        else:
            aside = (min(right, 1.2) - min(left, 1.2)) / 2  # m to the left of the middle
            steering = -0.4 * aside - 0.8 * off
        throttle = 0.25 + 0.5 * (SPEED - seen.wheel_speed.value)
        return cs.Command(max(0.0, min(throttle, 0.6)), max(-LOCK, min(steering, LOCK))), (
            turns,
            bearing,
            turning,
        )
