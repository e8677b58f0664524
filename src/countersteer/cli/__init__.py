"""The command line: one file a verb, its options beside its handler. Parse, call, print."""

import argparse
import contextlib
import gc
import logging
import os
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from countersteer import __version__
from countersteer.cache import cache_folder
from countersteer.cli import (
    bench,
    cockpit,
    completing,
    drive,
    evaluate,
    experiment,
    export,
    importing,
    learn,
    listing,
    new,
    replay,
    report,
    trials,
    tune,
)
from countersteer.cli.options import (
    DONE,
    FAILED,
    INTERRUPTED,
    WRONG_INPUT,
    Parser,
    Progress,
    Verbs,
    complain,
    one_line,
)
from countersteer.errors import InputError
from countersteer.progress import waiting
from countersteer.writing import clean_up, naming

__all__ = ["DONE", "FAILED", "INTERRUPTED", "WRONG_INPUT", "Progress", "entry", "main"]

VERBS = (
    drive, cockpit, evaluate, replay, importing, report, trials, experiment, learn, tune, export,
    bench, listing, new, completing,
)  # fmt: skip


# They import JAX and compile, which takes seconds.
LONG = {
    "drive", "evaluate", "replay", "report", "trials", "experiment", "learn", "tune", "export",
    "bench",
}  # fmt: skip


def parser() -> Parser:
    """All verbs with their options."""
    top = Parser(prog="countersteer", description="Makes a radio-controlled car drift by itself.")
    top.add_argument("--version", action="version", version=f"countersteer {__version__}")
    verbs = Verbs(top)
    for verb in VERBS:
        verb.add(verbs)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a verb; returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    top = parser()
    if not given:
        top.print_help()
        return DONE
    try:
        options = top.parse_args(given)
        options.command = shlex.join([top.prog, *given])
        told = options.verb in LONG and not options.json
        wait = waiting(_title(options), cache_folder() / "waits.json")
        with wait if told else contextlib.nullcontext():
            status = int(options.run(options))
        with naming(Path("standard output")):
            sys.stdout.flush()
        return status
    except InputError as error:
        complain(one_line(error))
        return WRONG_INPUT
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        complain(f"{name}{error.strerror or error}")
        return FAILED


def _title(options: argparse.Namespace) -> str:
    """What is under way, in words."""
    about = [getattr(options, name, None) for name in ("what", "name", "course", "source")]
    return " ".join([options.verb, *(str(word) for word in about if word)])


def entry() -> None:
    """The command: `main`, but that a Ctrl-C ends the process at once.

    Until a drive is under way there is nothing to save, and an exception might come where a
    compiler's callback swallows it.
    """

    def leave(*_: object) -> None:
        clean_up()
        os.write(2, b"countersteer: interrupted\n")
        os._exit(INTERRUPTED)

    _open_streams()
    # That it cannot keep its fonts between processes is no news for who drives.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    signal.signal(signal.SIGINT, leave)
    gc.set_threshold(100_000, 50, 50)  # a tenth of a short drive goes into looking for garbage
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's own log is for its developers
    status = main()
    with contextlib.suppress(OSError):  # of what could not be written, `main` has told
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)  # what JAX takes apart at an exit takes a tenth of a second


def _open_streams() -> None:
    """Give a closed stream to the null device, lest the next file that is opened has its number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # the lowest free number is this stream's
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115  # as long as the process
