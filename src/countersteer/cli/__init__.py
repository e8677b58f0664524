"""The command line: one file a verb, its options beside its handler. Parse, call, print."""

import argparse
import gc
import os
import signal
import sys
from collections.abc import Sequence

from countersteer import __version__
from countersteer.cache import cache_folder
from countersteer.cli import (
    bench,
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
    one_line,
)
from countersteer.errors import InputError
from countersteer.progress import waiting

__all__ = ["DONE", "FAILED", "INTERRUPTED", "WRONG_INPUT", "Progress", "entry", "main"]

VERBS = (
    drive, evaluate, replay, importing, trials, experiment, learn, tune, export, bench, listing,
    new, completing,
)  # fmt: skip


# They import JAX and compile, which takes seconds.
LONG = {"drive", "evaluate", "replay", "trials", "experiment", "learn", "tune", "export", "bench"}


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
        if options.verb not in LONG or options.json:
            return int(options.run(options))
        with waiting(_title(options), cache_folder() / "waits.json"):
            return int(options.run(options))
    except InputError as error:
        print(f"countersteer: {one_line(error)}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("countersteer: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        print(f"countersteer: {name}{error.strerror or error}", file=sys.stderr)
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
        os.write(2, b"countersteer: interrupted\n")
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, leave)
    gc.set_threshold(100_000, 50, 50)  # a tenth of a short drive goes into looking for garbage
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's own log is for its developers
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # what JAX takes apart at an exit takes a tenth of a second
