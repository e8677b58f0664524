"""`new`: a commented file to start from, which runs as it is."""

import argparse
import importlib.resources
import json
import re
from pathlib import Path

from countersteer.cli.options import DONE, Verbs
from countersteer.errors import InputError
from countersteer.writing import alone, write_whole

TEMPLATES = {"driver": "driver.py", "course": "course.toml", "car": "car.toml"}


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    new = verbs.verb("new", "a commented file to start from, which runs as it is", run)
    new.add_argument("what", choices=tuple(TEMPLATES), help="what to write")
    meaning = "its name: the file is NAME.py or NAME.toml in this folder"
    new.add_argument("name", metavar="NAME", help=meaning)


def run(options: argparse.Namespace) -> int:
    """`new`."""
    template = TEMPLATES[options.what]
    suffix = Path(template).suffix
    name = options.name.removesuffix(suffix)
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", name):
        raise InputError(f"new: NAME must be letters, digits, - and _, not {options.name}")
    file = Path(name + suffix)
    text = (importlib.resources.files("countersteer.cli.templates") / template).read_text()
    title = "".join(part.capitalize() for part in re.split("[-_]", name))
    text = text.replace("FILE", str(file)).replace("NAME", name)
    if options.what == "driver":
        text = text.replace("class Driver:", f"class {title}:").replace(":Driver", f":{title}")
        command = f"countersteer drive box --driver {file}:{title}"
    elif options.what == "course":
        command = f"countersteer drive {file}"
    else:
        command = f"countersteer drive box --car {file}"
    with alone(file):
        if file.exists():
            raise InputError(f"{file}: is there already: give another name")
        write_whole(file, text)
    if options.json:
        print(json.dumps({"file": str(file), "try": command}))
    else:
        print(f"{file}: written. Try: {command}")
    return DONE
