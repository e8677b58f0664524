"""`list`: what there is by name."""

import argparse
import json

from countersteer.cli.options import DONE, Verbs, plans
from countersteer.drivers import DRIVERS
from countersteer.errors import InputError


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    lists = verbs.verb("list", "what there is by name", run)
    lists.add_argument(
        "what",
        choices=("cars", "courses", "drivers", "parameters"),
        help="parameters: all that --set takes",
    )
    lists.add_argument("--car", help="with parameters: the values of this car")


def run(options: argparse.Namespace) -> int:
    """`list`."""
    from countersteer import listing

    if options.car and options.what != "parameters":
        raise InputError("--car: goes with list parameters")
    found = {
        "cars": listing.cars,
        "courses": listing.courses,
        "drivers": lambda: [
            *listing.drivers(DRIVERS),
            *({"name": name, "description": text} for name, text in plans().items()),
        ],
        "parameters": lambda: listing.parameters(options.car),
    }[options.what]()
    if options.json:
        print(json.dumps({options.what: found}))
    else:
        print("\n".join(listing.lines(options.what, found)))
    return DONE
