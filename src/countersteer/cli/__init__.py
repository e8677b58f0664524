"""The command line: one file a verb, its options beside its handler. Parse, call, print."""

import os
import signal
import sys
from collections.abc import Sequence

from countersteer import __version__
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
)
from countersteer.errors import InputError

__all__ = ["DONE", "FAILED", "INTERRUPTED", "WRONG_INPUT", "Progress", "entry", "main"]

VERBS = (
    drive, evaluate, replay, importing, trials, experiment, learn, tune, export, bench, listing,
    new, completing,
)  # fmt: skip


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
    try:
        options = parser().parse_args(arguments)
        return int(options.run(options))
    except InputError as error:
        print(f"countersteer: {' '.join(str(error).split())}", file=sys.stderr)
        return WRONG_INPUT
    except KeyboardInterrupt:
        print("countersteer: interrupted", file=sys.stderr)
        return INTERRUPTED
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        print(f"countersteer: {name}{error.strerror or error}", file=sys.stderr)
        return FAILED


def entry() -> None:
    """The command: `main`, but that a Ctrl-C ends the process at once.

    Until a drive is under way there is nothing to save, and an exception might come where a
    compiler's callback swallows it.
    """

    def leave(*_: object) -> None:
        os.write(2, b"countersteer: interrupted\n")
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, leave)
    sys.exit(main())
