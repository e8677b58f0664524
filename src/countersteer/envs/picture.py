"""A picture of a car on a course, from above, for `render`."""

import math
from typing import Any

import numpy as np

from countersteer.car.car import Car
from countersteer.course.course import Course

SIZE, DPI = (5.0, 5.0), 80


class Scene:
    """The walls, drawn once, and the car, drawn anew."""

    def __init__(self, course: Course, car: Car, window: bool) -> None:
        """With `window`, on the screen; else in memory."""
        if window:
            import matplotlib.pyplot as plt

            self._figure: Any = plt.figure(figsize=SIZE, dpi=DPI)
            self._show: Any = plt
        else:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure

            self._figure, self._show = Figure(figsize=SIZE, dpi=DPI), None
            FigureCanvasAgg(self._figure)
        axes = self._figure.add_axes((0.02, 0.02, 0.96, 0.96))
        for ax, ay, bx, by in course.walls:
            axes.plot([ax, bx], [ay, by], color="0.2", lw=1.5)
        axes.set_aspect("equal")
        axes.axis("off")
        body = car.body
        front, rear = body.center + body.length / 2, body.center - body.length / 2
        half = body.width / 2
        self._shape = np.array(
            [[front, half], [front, -half], [rear, -half], [rear, half], [front, half]], float
        )
        self._wheel = np.array([float(body.front_axle), 0.0])
        (self._body,) = axes.plot([], [], color="#0a7fc2", lw=1.5)
        (self._steer,) = axes.plot([], [], color="#c23b0a", lw=2)

    def draw(self, x: float, y: float, heading: float, steering: float) -> np.ndarray | None:
        """The picture (height, width, 3) of 8 bits; None in a window."""
        cosine, sine = math.cos(heading), math.sin(heading)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        self._body.set_data(*(self._shape @ turn + (x, y)).T)
        ahead = 0.06 * np.array([math.cos(steering), math.sin(steering)])
        wheel = np.stack([self._wheel - ahead, self._wheel + ahead]) @ turn + (x, y)
        self._steer.set_data(*wheel.T)
        if self._show is not None:
            self._figure.canvas.draw_idle()
            self._show.pause(0.001)
            return None
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.array(canvas.buffer_rgba())[..., :3]

    def close(self) -> None:
        """Close the window."""
        if self._show is not None:
            self._show.close(self._figure)
