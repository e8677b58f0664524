"""`bench`: speed, side by side with what it is compared to."""

import argparse
import json

from countersteer.cli.options import DONE, Progress, Verbs


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    bench = verbs.verb("bench", "speed, side by side with what it is compared to", run)
    bench.add_argument("--quick", action="store_true", help="under a minute, less exact")


def run(options: argparse.Namespace) -> int:
    """`bench`."""
    from countersteer.bench import bench

    with Progress(options.json) as progress:
        found = bench.bench(bench.QUICK if options.quick else bench.FULL, progress.show)
    print(json.dumps(found) if options.json else "\n".join(bench.lines(found)))
    return DONE
