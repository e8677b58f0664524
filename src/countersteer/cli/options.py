"""What verbs share: the parser, exit statuses, options that several have, the progress bar."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from countersteer.errors import InputError
from countersteer.progress import Progress

if TYPE_CHECKING:
    from countersteer.course.course import Course

__all__ = ["Progress"]  # and all else that is defined here

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
Handler = Callable[[argparse.Namespace], int]


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> Any:
        """Raises `InputError` with what argparse found."""
        raise InputError(f"{message} (see {self.prog} --help)")


class Verbs:
    """The verbs of a parser; each file of this room adds its own."""

    def __init__(self, top: Parser) -> None:
        """Those of the command itself."""
        self._verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True)

    def verb(self, name: str, does: str, run: Handler) -> Parser:
        """A verb, to which options can be added."""
        made: Parser = self._verbs.add_parser(name, help=does, description=does)
        made.add_argument("--json", action="store_true", help="one JSON object, nothing else")
        made.set_defaults(run=run)
        return made

    def group(self, name: str, does: str, metavar: str) -> Callable[[str, str, Handler], Parser]:
        """A verb of several things, each with options of its own."""
        made = self._verbs.add_parser(name, help=does, description=does)
        kinds = made.add_subparsers(dest="what", metavar=metavar, required=True, help=does)

        def kind(name: str, does: str, run: Handler) -> Parser:
            part: Parser = kinds.add_parser(name, help=does, description=does)
            part.add_argument("--json", action="store_true", help="one JSON object, nothing else")
            part.set_defaults(run=run)
            return part

        return kind


def number(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    """A number within bounds."""

    def read(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be a number in [{low:g}, {high:g}], not {text}")
        return value

    return read


def span(low: float, high: float) -> Callable[[str], tuple[float, float]]:
    """A range LO:HI within bounds, or one number for both."""

    def read(text: str) -> tuple[float, float]:
        first, _, last = text.partition(":")
        one = number(low, high)
        ends = (one(first), one(last or first))
        if ends[0] > ends[1]:
            raise argparse.ArgumentTypeError(f"must rise, not {text}")
        return ends

    return read


SPEEDS, CHARGES = span(0.2, 20), span(0, 1)  # m/s; of a battery


def nominal_car(made: Parser, car: str | None = "rx7") -> None:
    """`--car` and `--set`."""
    default = f"default {car}" if car else "default the run's own, else rx7"
    made.add_argument("--car", default=car, help=f"library name or .toml file ({default})")
    made.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help="override a parameter of the car, such as battery.wear=0.5 (repeatable; "
        "'countersteer list parameters' has them all)",
    )


def physics(made: Parser, car: str | None) -> None:
    """The same with `--seed`, `--dt` and `--out`."""
    nominal_car(made, car)
    made.add_argument("--seed", type=number(0, 2**31 - 1, int), default=0, help="default 0")
    made.add_argument(
        "--dt",
        type=number(1e-5, 0.02),
        default=0.001,
        metavar="S",
        help="physics step in seconds (default 0.001)",
    )
    made.add_argument("--out", type=Path, metavar="DIR", help="default a new one in runs/")


def laps_and_link(made: Parser) -> None:
    """`--laps`, `--link` and `--estimate`."""
    made.add_argument(
        "--laps",
        type=number(1, 1000, int),
        default=1,
        metavar="N",
        help="of a closed course (default 1)",
    )
    made.add_argument(
        "--link",
        choices=("onboard", "radio"),
        default="onboard",
        help="where the driver runs: in the car, or behind a radio that delays and loses "
        "packets (default onboard)",
    )
    made.add_argument(
        "--estimate",
        choices=("filter", "pose", "reckoning", "truth"),
        default="filter",
        help="what the driver knows of its motion: by the velocity filter (default), dead "
        "reckoning, by a particle filter of the pose (slower), all from the sensors; or the "
        "truth",
    )


def check_laps(options: argparse.Namespace, course: "Course") -> None:
    """Only a closed course has laps."""
    if options.laps > 1 and not course.closed:
        raise InputError(f"--laps {options.laps}: {options.course} is open, and driven once")


def plans() -> dict[str, str]:
    """The plans of the library, and what they say of themselves."""
    from countersteer.drivers.plan import library

    return library()
