"""`import`: other people's logs to run folders."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, WRONG_INPUT, Verbs, one_line
from countersteer.errors import InputError
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
    from countersteer.cli.report import report_of_import

    to_run = importer(options.format)
    results: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    for file in options.files:
        try:
            result = to_run(file, options.out)
            results.append(result | report_of_import(Path(result["run"])))
        except InputError as error:  # a bad log does not keep the others from being imported
            failed.append({"file": str(file), "error": one_line(error)})
            continue
        if not options.json:
            print(f"{file.name} -> {options.out / file.stem}")
    if options.json:
        print(json.dumps({"runs": results} | ({"failed": failed} if failed else {})))
    for one in failed:
        print(f"countersteer: {one['error']}", file=sys.stderr)
    return WRONG_INPUT if failed else DONE
