"""`import`: other people's logs to run folders."""

import argparse
import json
from pathlib import Path

from countersteer.cli.options import DONE, Verbs
from countersteer.runs.importers import FORMATS, importer


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    take = verbs.verb("import", "other people's logs to run folders", run)
    kinds = "; ".join(": ".join(pair) for pair in FORMATS.items())
    take.add_argument("format", choices=tuple(FORMATS), metavar="FORMAT", help=kinds)
    take.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a log")
    take.option("--out", "DIR", Path, None, "folder of the run folders", required=True)


def run(options: argparse.Namespace) -> int:
    """`import`."""
    to_run, results = importer(options.format), []
    for file in options.files:
        results.append(to_run(file, options.out))
        if not options.json:
            print(f"{file.name} -> {options.out / file.stem}")
    if options.json:
        print(json.dumps({"runs": results}))
    return DONE
