"""`bench`: speed, side by side with what it is compared to."""

import argparse
import json
from pathlib import Path

from countersteer.cli.options import DONE, Progress, Verbs
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    bench = verbs.verb("bench", "speed, side by side with what it is compared to", run)
    bench.add_argument("--quick", action="store_true", help="under a minute, less exact")
    bench.add_argument("--out", type=Path, metavar="FILE.md", help="a page of it, with its picture")


def run(options: argparse.Namespace) -> int:
    """`bench`."""
    from countersteer.bench import bench

    if options.out and (options.out.suffix != ".md" or not options.out.parent.is_dir()):
        raise InputError(f"{options.out}: name a file .md in a folder that is there")
    with Progress(options.json) as progress:
        found = bench.measure(bench.QUICK if options.quick else bench.FULL, progress.show)
    if options.out:
        bench.write_page(found, options.out)
    print(json.dumps(found) if options.json else "\n".join(bench.lines(found)))
    return DONE
