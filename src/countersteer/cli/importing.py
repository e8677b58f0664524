"""`import`: other people's logs to run folders."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from countersteer.cli.options import DONE, WRONG_INPUT, Progress, Verbs, one_line, out_file
from countersteer.errors import InputError
from countersteer.runs.importers import FORMATS, importer


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    take = verbs.verb("import", "other people's logs to run folders", run)
    kinds = "; ".join(f"{name}: {known.meaning}" for name, known in FORMATS.items())
    take.add_argument("format", choices=tuple(FORMATS), metavar="FORMAT", help=kinds)
    take.add_argument("files", nargs="+", type=Path, metavar="FILE", help="a log")
    take.option("--map", "MAP.toml", Path, None, "which column is which signal (csv needs it)")
    meaning = "write a first mapping of a csv log to --out, and what is doubtful about it"
    take.add_argument("--guess", action="store_true", help=meaning)
    meaning = "folder of the run folders; with --guess, the mapping's file"
    take.option("--out", "DIR", Path, None, meaning, required=True)


def run(options: argparse.Namespace) -> int:
    """`import`."""
    if options.guess:
        return guess(options)
    results: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    lines: list[str] = []
    with Progress(options.json) as progress:
        progress.show(0, len(options.files))  # what reads logs takes a second to load
        from countersteer.cli.report import report_of_import

        to_run = importer(options.format, options.map)
        for done, file in enumerate(options.files, start=1):
            try:
                result = to_run(file, options.out)
                results.append(result | report_of_import(Path(result["run"])))
                lines.append(f"{file.name} -> {result['run']}")
                lines += [f"  doubt: {doubt}" for doubt in result.get("doubts", ())]
            except InputError as error:  # a bad log does not keep the others from being imported
                failed.append({"file": str(file), "error": one_line(error)})
            progress.show(done, len(options.files))
    if options.json:
        print(json.dumps({"runs": results} | ({"failed": failed} if failed else {})))
    elif lines:
        print("\n".join(lines))
    for one in failed:
        print(f"countersteer: {one['error']}", file=sys.stderr)
    return WRONG_INPUT if failed else DONE


def guess(options: argparse.Namespace) -> int:
    """`import csv --guess`."""
    from countersteer.runs.importers.guess import guess_mapping
    from countersteer.writing import write_whole

    if options.format != "csv" or len(options.files) != 1 or options.map is not None:
        raise InputError("--guess: takes one log of the format csv, and no --map")
    text, doubts = guess_mapping(options.files[0])
    with out_file(options.out):
        if options.out.exists():
            raise InputError(f"--out {options.out}: is there already: give another name")
        write_whole(options.out, text)
    if options.json:
        print(json.dumps({"mapping": str(options.out), "doubts": doubts}))
        return DONE
    print(f"{options.files[0].name} -> {options.out}")
    for doubt in doubts:
        print(f"  doubt: {doubt}")
    return DONE
