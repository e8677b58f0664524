"""`import`: other people's logs to run folders."""

import argparse
import json
from pathlib import Path

from countersteer.cli.options import DONE, Verbs


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    take = verbs.verb("import", "other people's logs to run folders", run)
    take.add_argument("format", choices=("dart", "eth"), metavar="FORMAT", help="dart or eth")
    take.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a log")
    take.option("--out", "DIR", Path, None, "folder of the run folders", required=True)


def run(options: argparse.Namespace) -> int:
    """`import`."""
    from countersteer.runs.importers.dart import import_dart
    from countersteer.runs.importers.eth import import_eth

    importer = {"dart": import_dart, "eth": import_eth}[options.format]
    results = []
    for file in options.files:
        results.append(importer(file, options.out))
        if not options.json:
            print(f"{file.name} -> {options.out / file.stem}")
    if options.json:
        print(json.dumps({"runs": results}))
    return DONE
