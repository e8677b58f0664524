"""What verbs share: the parser, exit statuses, options that several have, the progress bar."""

import argparse
import contextlib
import math
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

from countersteer.errors import InputError
from countersteer.progress import Progress
from countersteer.text import nearest
from countersteer.writing import alone

__all__ = ["Progress"]  # and all else that is defined here

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130
Handler = Callable[[argparse.Namespace], int]


def one_line(error: BaseException) -> str:
    """An error's message in one line of printable characters."""
    line = " ".join(str(error).split())
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    known: ClassVar[list[str]] = []  # options of the verb that is parsed

    def error(self, message: str) -> Any:
        """Raises `InputError` with what argparse found, and the nearest word that there is."""
        if wrong := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message):
            known = re.findall(r"[\w-]+", wrong[2])
            message = message[: wrong.start()] + f"there is no {wrong[1]}{nearest(wrong[1], known)}"
        elif message.startswith("unrecognized arguments: "):
            word = message.split(": ", 1)[1].split()[0].partition("=")[0]
            message = f"there is no {word}{nearest(word, self.known)}"
        raise InputError(f"{message} (see {self.prog} --help)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse; the options of the verb that is parsed last are known for its errors."""
        Parser.known = [*self._option_string_actions]
        return super().parse_known_args(args, namespace)

    def option(
        self, name: str, metavar: str | None, kind: Any, default: Any, meaning: str, **more: Any
    ) -> None:
        """An option that takes a value. Its help says the default, where there is one."""
        shown = " ".join(map(str, default)) if isinstance(default, list) else default
        text = meaning if shown in (None, "") else f"{meaning} (default {shown})"
        self.add_argument(
            name, metavar=metavar, type=kind, default=default, help=text.lstrip(), **more
        )

    def runs(self, name: str, meaning: str, **more: Any) -> None:
        """An option that takes the folders of runs."""
        self.option(name, "RUN", Path, [], meaning, nargs="+", **more)

    def out_file(self, metavar: str, what: str) -> None:
        """`--out`, which must be given."""
        self.option("--out", metavar, Path, None, f"where the {what} is written", required=True)

    def out_folder(self) -> None:
        """`--out`, a folder."""
        self.option("--out", "DIR", Path, None, "default a new one in runs/")

    def seed(self) -> None:
        """`--seed`."""
        self.option("--seed", None, number(0, 2**31 - 1, int), 0, "of all that is random")


@contextlib.contextmanager
def out_file(path: Path, suffix: str = ".toml") -> Iterator[None]:
    """Keep other processes from a file and what is written beside it; make its folder.

    Raises `InputError` if it has another name, or if nothing can be written there.
    """
    if path.suffix != suffix:
        raise InputError(f"--out {path}: name a {suffix} file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror}") from None
    with alone(path):
        yield


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


def in_one_line(error: Exception) -> str:
    """The message of an error without line breaks."""
    return " ".join(str(error).split())


def complain(message: str) -> None:
    """Writes a line to standard error, if that can be written to."""
    with contextlib.suppress(OSError):
        print(f"countersteer: {message}", file=sys.stderr, flush=True)


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
    """`--car` and `--set`. Without a default car, several may be given."""
    meaning = "library name or .toml file"
    if car is None:
        meaning += " (default the run's own, else rx7); repeatable with --compare"
        made.option("--car", None, str, None, meaning, action="append")
    else:
        made.option("--car", None, str, car, meaning)
    meaning = (
        "override a parameter of the car, such as battery.wear=0.5 (repeatable; 'countersteer list "
        "parameters' has them all)"
    )
    made.option("--set", "PATH=VALUE", str, [], meaning, action="append")


def physics(made: Parser, car: str | None) -> None:
    """The same with `--seed`, `--dt` and `--out`."""
    nominal_car(made, car)
    made.seed()
    made.option("--dt", "S", number(1e-5, 0.02), 0.001, "physics step in seconds")
    made.out_folder()


def laps_and_link(made: Parser, estimates: bool = False) -> None:
    """`--laps`, `--link` and `--estimate`, of which there may be several."""
    made.option("--laps", "N", number(1, 1000, int), 1, "of a closed course")
    meaning = "where the driver runs: in the car, or behind a radio that delays and loses packets"
    made.option("--link", None, str, "onboard", meaning, choices=("onboard", "radio"))
    meaning = (
        "what the driver knows of its motion: by the velocity filter, by dead reckoning, or by a "
        "particle filter of the pose (slower), all from the sensors; or the truth"
    )
    more: dict[str, Any] = {"choices": ("filter", "pose", "reckoning", "truth")}
    default: Any = "filter"
    if estimates:
        default, more = [default], more | {"nargs": "+"}
        meaning = f"{meaning}; several give a row each"
    made.option("--estimate", None, str, default, meaning, **more)


def plans() -> dict[str, str]:
    """The plans of the library, and what they say of themselves."""
    from countersteer.drivers.plan import library

    return library()
