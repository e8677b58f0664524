"""`list`: what there is by name, each with what tells it from the others."""

import argparse
import importlib
import json
from collections.abc import Iterable
from typing import Any

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
    if options.car and options.what != "parameters":
        raise InputError("--car: goes with list parameters")
    found = {
        "cars": cars,
        "courses": courses,
        "drivers": lambda: [
            *drivers(DRIVERS),
            *({"name": name, "description": text} for name, text in plans().items()),
            *({"name": name, "description": text} for name, text in installed().items()),
        ],
        "parameters": lambda: parameters(options.car),
    }[options.what]()
    if options.json:
        print(json.dumps({options.what: found}))
    else:
        print("\n".join(lines(options.what, found)))
    return DONE


def cars() -> list[dict[str, Any]]:
    """The cars of the library."""
    from countersteer.car.files import LIBRARY, library, load_car
    from countersteer.text import read_toml

    found = []
    for name in library():
        tables, _ = read_toml(name, LIBRARY, "car")
        car = load_car(name)
        found.append(
            {
                "name": name,
                "mass_kg": float(car.body.mass),
                "wheelbase_m": float(car.body.wheelbase),
                "drive": {0.0: "RWD", 1.0: "FWD"}.get(float(car.drivetrain.front_share), "4WD"),
                "description": tables.get("description", ""),
            }
        )
    return found


def courses() -> list[dict[str, Any]]:
    """The courses of the library. Free walls have neither length nor width."""
    from countersteer.course.files import library, load_course

    return [
        {
            "name": name,
            "turns": len(course.turns),
            "length_m": round(course.length, 6),
            "width_m": course.width,
            "closed": course.closed,
        }
        for name in library()
        for course in [load_course(name)]
    ]


def drivers(names: Iterable[str]) -> list[dict[str, Any]]:
    """What the file of each of these drivers says of it."""
    return [
        {"name": name, "description": str(module.__doc__).splitlines()[0]}
        for name in names
        for module in [importlib.import_module(f"countersteer.drivers.{name.replace('-', '_')}")]
    ]


def installed() -> dict[str, str]:
    """The drivers that installed packages offer, and this one by the same way."""
    from countersteer.drivers import own

    return {name: own.described(name) for name in own.installed()}


def parameters(car: str | None) -> list[dict[str, Any]]:
    """Every parameter of a car, or with its default; numbers in the unit that is named."""
    from countersteer.car.files import load_car, parameters

    return parameters(load_car(car)) if car else parameters()


def lines(what: str, found: list[dict[str, Any]]) -> list[str]:
    """The same for a person: aligned columns."""
    rows = []
    for item in found:
        if what == "cars":
            row = ["{mass_kg:.2f} kg", "wheelbase {wheelbase_m:g} m", "{drive}", "{description}"]
        elif what == "courses":
            row = ["{turns} turns", "{length_m:.1f} m long", "{width_m} m wide"]
            row.append("closed" if item["closed"] else "open")
        elif what == "drivers":
            row = ["{description}"]
        else:
            row = ["{value}", "{span}", "{meaning} (default {default}: {source})"]
            words = ", ".join(item["choices"])
            item = {
                **item,
                **{key: item[key] if words else f"{item[key]:g}" for key in ("value", "default")},
                "name": item["path"],
                "span": "" if words else "[{low:g} … {high:g}]".format(**item),
                "meaning": item["meaning"] + (f"; one of {words}" if words else ""),
            }
        rows.append([cell.format(**item) for cell in ["{name}", *row]])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
