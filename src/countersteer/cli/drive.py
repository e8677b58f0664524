"""`drive`: one closed-loop drive over a course."""

import argparse
from typing import TYPE_CHECKING, Any

from countersteer.cli.options import (
    SPEEDS,
    Verbs,
    complain,
    laps_and_link,
    number,
    physics,
)
from countersteer.cli.recorded import record, set_up
from countersteer.drivers import DRIVERS
from countersteer.errors import InputError

if TYPE_CHECKING:
    from countersteer.car.car import Car
    from countersteer.course.course import Course


def add(verbs: Verbs) -> None:
    """The verb with its options."""
    drive = verbs.verb("drive", "one closed-loop drive over a course", run)
    meaning = (
        "library name, or a file: .toml, a centre line with widths .csv (F1TENTH), a map .yaml "
        "with its image (ROS)"
    )
    drive.add_argument("course", metavar="COURSE", help=meaning)
    names = ", ".join(DRIVERS)
    meaning = f"{names}, a plan, a policy or plan .toml, a commands.csv, or FILE.py:CLASS"
    drive.option("--driver", None, str, "drift-turn", meaning)
    physics(drive, "rx7")
    meaning = (
        "speed that the driver is asked to bring to a turn (default the driver's); with --cars "
        "also LO:HI"
    )
    drive.option("--speed-mps", "V", SPEEDS, None, meaning)
    meaning = "drive the car, charge and start that --seed draws from this set, as evaluate does"
    drive.option("--cars", "SET", str, None, meaning)
    drive.option("--battery", "F", number(0, 1), None, "charge, 0 to 1 (default 1)")
    meaning = (
        "a sensor that is dead, stuck or spiking for a while: 'SENSOR KIND START DURATION' in "
        "seconds, such as 'gyroscope stuck 2.0 0.5' (repeatable)"
    )
    drive.option("--fault", "TEXT", str, [], meaning, action="append")
    meaning = "record the paths that a planner looks at too, for the report (slower)"
    drive.add_argument("--rollouts", action="store_true", help=meaning)
    laps_and_link(drive)


def run(options: argparse.Namespace) -> int:
    """`drive`."""
    set_up(options)
    from countersteer.car.files import load_car
    from countersteer.course.files import load_course
    from countersteer.drivers.policy import for_another_car
    from countersteer.link.link import LINKS
    from countersteer.recorded_drive import prepare, watched
    from countersteer.sensing.faults import read_fault

    course, car = load_course(options.course), load_car(options.car, options.set)
    charge, start, speed, floor = 1.0, None, None, None
    if options.battery is not None:
        charge = options.battery
    if options.cars is not None:
        if options.battery is not None:
            raise InputError("--battery: --cars draws the charge")
        car, charge, start, speed, floor = drawn_alone(options, course, car)
    elif options.speed_mps is not None:
        speed, most = options.speed_mps
        if most != speed:
            raise InputError("--speed-mps LO:HI: a range is drawn from with --cars only")
    drive = prepare(
        course,
        car,
        options.driver,
        car_name=options.car,
        speed=speed,
        laps=options.laps,
        estimate=options.estimate,
        link=LINKS[options.link],
        dt=options.dt,
        seed=options.seed,
        charge=charge,
        start=start,
        floor=floor,
        faults=tuple(read_fault(text) for text in options.fault),
    )
    note = for_another_car(drive.about["pilot"], options.car)
    if note:
        complain(note)
    if options.rollouts:
        drive = watched(drive)
    return record(options, drive, course.name)


def drawn_alone(options: argparse.Namespace, course: "Course", car: "Car") -> tuple[Any, ...]:
    """The trial of `--seed`: car, charge, start, speed asked for and floor."""
    import jax
    import numpy as np

    from countersteer.batch.population import draw, load_population

    drawn = draw(
        load_population(options.cars), car, course, [options.seed], np.float64, options.speed_mps
    )
    speed = None if drawn.speed is None else float(drawn.speed[0])
    x, y, heading = (float(value) for value in drawn.pose[0])
    alone, floor = jax.tree.map(lambda leaf: leaf[0], (drawn.cars, drawn.floor))
    return alone, float(drawn.charge[0]), (x, y, heading), speed, floor
