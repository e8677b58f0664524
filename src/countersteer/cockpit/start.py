"""The cockpit put together: session, clock, courses, runs and server. It imports no JAX."""

import functools
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from countersteer.cockpit import messages as m
from countersteer.cockpit.courses import CourseShelf
from countersteer.cockpit.realtime import RealTime
from countersteer.cockpit.recordings import RunShelf
from countersteer.cockpit.server import Cockpit, Hub

if TYPE_CHECKING:
    from countersteer.cockpit.session import Session
    from countersteer.course.course import Course

REMEMBERED = "cockpit"  # name of its programs in the cache


class Start(NamedTuple):
    """What is driven first, and where runs go."""

    course: str = "box"  # a name, or a file
    car: str = "rx7"
    driver: str = "drift-turn"
    seed: int = 0
    runs: Path = Path("runs")
    courses: Path = Path("courses")  # that are drawn


def cockpit(start: Start, host: str = "127.0.0.1", token: str = "") -> Cockpit:
    """The application for a server at an address."""
    runs, courses = RunShelf(start.runs), CourseShelf(start.courses)
    return Cockpit(lambda hub: clock(start, hub), runs, courses, host, token)


def clock(start: Start, hub: Hub) -> RealTime:
    """The clock, whose session is made when it starts."""

    def load(name: str) -> "Course":
        from countersteer.course.files import load_course

        return load_course(name) if name == start.course else hub.courses.load(name)

    def make() -> "Session":
        from countersteer import kept_programs
        from countersteer.compiling import configure_jax

        configure_jax(batches=False, cores=2)
        kept_programs.preload(REMEMBERED)
        from countersteer.cockpit.session import Session
        from countersteer.cockpit.setting import Setting, prepare

        setting = Setting(
            load(start.course), start.course, start.car, start.driver, seed=start.seed
        )
        session = Session(prepare(setting), start.runs)
        kept_programs.remember(REMEMBERED)
        return session

    def menus() -> dict[str, Any]:
        from countersteer.car.files import library as cars

        courses = list(dict.fromkeys([start.course, *hub.courses.names()]))
        return {
            "courses": items(courses),
            "cars": items(list(dict.fromkeys([start.car, *cars()]))),
            "drivers": items(list(dict.fromkeys([start.driver, *drivers()]))),
        }

    return RealTime(make, hub.say, menus, load)


@functools.cache
def drivers() -> tuple[str, ...]:
    """Names of the drivers that can be chosen. To look for what is installed takes a while."""
    from countersteer.drivers import DRIVERS, own
    from countersteer.drivers.plan import library as plans

    return (*DRIVERS, *plans(), *own.installed())


def items(names: list[str]) -> list[m.Item]:
    """A menu of names. A file is shown by its name alone."""
    return [m.Item(name=name, label=Path(name).stem if "/" in name else name) for name in names]


def open_browser(address: str) -> None:
    """Open the page, where there is a browser."""
    webbrowser.open(address)
