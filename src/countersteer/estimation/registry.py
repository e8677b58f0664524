"""Estimators by their names on the command line."""

from collections.abc import Callable

import numpy as np

from countersteer.car.car import Car
from countersteer.course.course import Course
from countersteer.estimation.dead_reckoning import DeadReckoning
from countersteer.estimation.estimator import Estimator, Truth
from countersteer.estimation.pose import PoseEstimator, PoseFilter
from countersteer.estimation.velocity.filter import VelocityFilter
from countersteer.world.walls import padded

Make = Callable[[Course | None, Car, float], Estimator]


def start_of(course: Course | None) -> tuple[float, float, float]:
    """The assumed start: x, y (m), heading (rad). Zeros without a course."""
    return (0.0, 0.0, 0.0) if course is None else course.start


def velocity_filter(course: Course | None, car: Car, dt: float) -> VelocityFilter:
    """The velocity filter for the nominal car, at the course's start."""
    return VelocityFilter(car=car, start=start_of(course), dt=dt)


def pose_estimator(course: Course | None, car: Car, dt: float) -> PoseEstimator:
    """The velocity filter with a particle filter on the course's walls."""
    dtype = np.asarray(car.body.mass).dtype
    walls = padded(np.zeros((0, 4)) if course is None else course.walls, dtype)
    place = PoseFilter(walls=walls, sonar=car.sensors.sonar)
    return PoseEstimator(moving=velocity_filter(course, car, dt), place=place)


ESTIMATORS: dict[str, Make] = {
    "filter": velocity_filter,
    "pose": pose_estimator,
    "reckoning": lambda course, _, dt: DeadReckoning(start=start_of(course), dt=dt),
    "truth": lambda course, *_: Truth(start=start_of(course)),
}
