"""`completion`: a script that completes verbs, options, names, files and parameters in a shell.

shtab makes it from the parser. All words stand in it, so that no Python starts at a key.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, Verbs, plans
from countersteer.drivers import DRIVERS

# Bash puts a space behind a completed word, unless this says otherwise.
NO_SPACE_AFTER_A_PARAMETER = """
_countersteer_complete() {
  _shtab_countersteer
  [[ ${#COMPREPLY[@]} = 1 && ${COMPREPLY[0]} = *= ]] && compopt -o nospace
  return 0
}
complete -o bashdefault -F _countersteer_complete countersteer
"""


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    complete = verbs.verb("completion", "a script that completes commands in a shell", run)
    complete.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell it is for")


def run(options: argparse.Namespace) -> int:
    """`completion`."""
    from countersteer.cli import parser

    text = script(parser(), options.shell, [*DRIVERS, *plans()])
    print(json.dumps({"script": text}) if options.json else text)
    return DONE


def script(parser: argparse.ArgumentParser, shell: str, drivers: Sequence[str]) -> str:
    """The script for `bash`, `zsh` or `fish`."""
    import shtab

    from countersteer.car.files import library as cars
    from countersteer.car.files import parameters
    from countersteer.course.files import library as courses

    known: dict[str, Any] = {
        "car": _or_file("car", cars()),
        "course": _or_file("course", courses()),
        "driver": _or_file("driver", drivers),
        "set": _set([entry["path"] for entry in parameters() if "NAME" not in entry["path"]]),
    }
    for action in every_action(parser):
        if action.dest in known:
            action.complete = known[action.dest]  # type: ignore[attr-defined]  # shtab's way
        elif action.type is Path:
            folder = action.metavar == "DIR"
            action.complete = shtab.DIRECTORY if folder else shtab.FILE  # type: ignore[attr-defined]  # shtab's way
    text = shtab.complete(parser, shell)
    return text + NO_SPACE_AFTER_A_PARAMETER if shell == "bash" else text


def every_action(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """The options and arguments of every verb."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                yield from every_action(verb)


def _or_file(kind: str, names: Sequence[str]) -> dict[str, Any]:
    """One of these names, or a file."""
    words, function = " ".join(names), f"_countersteer_{kind}_or_file"
    return {
        "bash": function,
        "zsh": function,
        "fish": f"(printf '%s\\n' {words}; __fish_complete_path (commandline -ct))",
        "preamble": {
            "bash": f'{function}() {{ compgen -W "{words}" -- "$1"; compgen -f -- "$1"; }}\n',
            "zsh": f"{function}() {{ compadd -- {words}; _files }}\n",
        },
    }


def _set(paths: Sequence[str]) -> dict[str, Any]:
    """PATH=, to which a value is typed."""
    words, function = " ".join(f"{path}=" for path in paths), "_countersteer_set"
    return {
        "bash": function,
        "zsh": function,
        "fish": f"(printf '%s\\n' {words})",
        "preamble": {
            "bash": f'{function}() {{ compgen -W "{words}" -- "$1"; }}\n',
            "zsh": f"{function}() {{ compadd -S '' -- {words} }}\n",
        },
    }
