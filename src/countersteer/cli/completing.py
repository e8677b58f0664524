"""`completion`: a script that completes commands in a shell."""

import argparse
import json

from countersteer.cli.options import DONE, Verbs, plans
from countersteer.drivers import DRIVERS


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    complete = verbs.verb("completion", "a script that completes commands in a shell", run)
    complete.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell it is for")


def run(options: argparse.Namespace) -> int:
    """`completion`."""
    from countersteer.cli import parser
    from countersteer.completion import script

    text = script(parser(), options.shell, [*DRIVERS, *plans()])
    print(json.dumps({"script": text}) if options.json else text)
    return DONE
