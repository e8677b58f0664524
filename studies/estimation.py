"""The accuracy of the estimates, and of drives on them: `make estimation` writes the page.

All drives are in closed loop, with the drift-turn driver on the velocity filter. Their cars are
drawn from a set and differ from the nominal one. There are five studies. Each is a function that
gives the lines of its section: errors of the filters, the pose from anywhere, sensors that fail on
a straight, straightening by sonar and by filter, and the benefit of better sensors.
"""

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from countersteer.batch.evaluate import Trials, interval, results
from countersteer.batch.population import Drawn, draw, load_population
from countersteer.car.car import Car
from countersteer.car.files import load_car
from countersteer.compiling import configure_jax
from countersteer.course.course import Course
from countersteer.course.files import load_course
from countersteer.course.position import legs_of
from countersteer.drivers.drift_turn import drift_turn
from countersteer.drivers.driver import Driver
from countersteer.drivers.straighten import straighten
from countersteer.estimation.pose import PoseFilter
from countersteer.link.link import ONBOARD
from countersteer.sensing.faults import KINDS, SensorFault
from countersteer.task.judge import PERIOD, Outcome, Score
from countersteer.world import battery
from countersteer.world.walls import padded
from countersteer.writing import whole, write_whole
from studies.watches import FIT, PARTICLES, SAMPLE, Errors, Places, anywhere

SET, SPEEDS, COURSES = "around", (1.5, 3.0), ("box", "ess")
CARS = 256  # of each course
FIRST = 5000  # first seed; the filters' noises were set on seeds 0 to 255
POSES = 128  # drives of each course with a pose filter, which is slow
FAULT = 0.5  # s, duration of a sensor's fault
FAILING = 8  # cars for each sensor, kind and straight
SENSORS = (
    "sonar_front",
    "sonar_left",
    "sonar_right",
    "encoder",
    "gyroscope",
    "accelerometer",
    "voltmeter",
)
NAMES = {"box": (4, "its four places"), "ess": (1, "the one place")}
Make = Callable[[Course, Car, float | None], Driver]


def trials(course: Course, car: Car, seeds: Sequence[int]) -> Trials:
    """The trials of all studies."""
    cars = load_population(SET)
    return Trials(course, car, car, cars, seeds, SPEEDS, 1, ONBOARD, "filter", 0.001)


def drawn(of: Trials) -> Drawn:
    """The random cars of the trials."""
    return draw(of.population, of.car, of.course, of.seeds, np.float32, of.speeds)


def rms(values: Any) -> float:
    """Root mean square of the values that are not NaN."""
    return math.sqrt(float(np.nanmean(np.square(np.asarray(values, float)))))


def errors(course: Course, car: Car, seeds: Sequence[int], make: Make = drift_turn) -> Any:
    """Scores, and the result of `watches.Errors`, of one drive for each seed."""
    legs = jax.tree.map(np.float32, legs_of(course, 1))
    sonar = jax.tree.map(np.float32, car.sensors.sonar)
    watch = Errors(legs=legs, sonar=sonar, inside=np.float32(chi2.ppf(0.95, 3)))
    return trials(course, car, seeds).run_watched(partial(make, course, car), watch)


def figures(of: Trials, kept: Any) -> dict[str, float]:
    """The filters' errors over all trials, in the units of the page."""
    draws, nominal = drawn(of), of.car
    cars, told = draws.cars, kept.estimate
    each = np.nanmean(kept.squares, axis=1)  # of a trial
    full = np.asarray(nominal.battery.full)
    voltage = np.asarray(jax.vmap(battery.open_circuit)(cars.battery, kept.charge))
    resistance = np.asarray(jax.vmap(battery.resistance)(cars.battery))
    friction = cars.tires.rear.friction / nominal.tires.rear.friction
    servo = cars.servo.gain_left / nominal.servo.gain_left
    bias = cars.sensors.gyroscope.bias

    def per(total: np.ndarray, count: np.ndarray) -> float:
        return math.sqrt(float(np.sum(total)) / max(float(np.sum(count)), 1.0))

    # A car's errors are correlated over a drive. So a drive counts as one draw of three numbers.
    low, high = (float(chi2.ppf(p, 3 * len(each))) / len(each) for p in (0.025, 0.975))
    timed = np.sum(np.isfinite(kept.squares), axis=0) == len(each)  # until the first drive ends
    means = np.mean(kept.squares[:, timed], axis=0)
    return {
        "drives": len(each),
        "drifting_s": PERIOD * float(np.sum(kept.drifting)),
        "sideslip_deg": math.degrees(per(kept.slip, kept.drifting)),
        "reckoned_deg": math.degrees(per(kept.reckoned, kept.drifting)),
        "normalised": float(np.nanmean(each)),
        "normalised_low": low,
        "normalised_high": high,
        "timely": float(np.mean((means > low) & (means < high))),
        "inside": float(np.sum(kept.inside) / np.sum(kept.looks)),
        **{
            f"{name}_normal": float(np.sum(total) / np.sum(kept.looks))
            for name, total in zip(("vx", "vy", "yaw_rate"), kept.alone, strict=True)
        },
        "gyro_bias_degps": math.degrees(rms(told.gyro_bias - bias)),
        "gyro_bias_spread_degps": math.degrees(rms(bias - nominal.sensors.gyroscope.bias)),
        "friction": rms(told.friction - friction),
        "friction_spread": rms(friction - 1),
        "servo": rms((told.servo - servo)[servo < 1]),
        "servo_spread": rms((servo - 1)[servo < 1]),
        "battery_v": rms(told.battery * full - voltage),
        "battery_spread_v": float(np.std(voltage)),
        "resistance_ohm": rms(told.battery_resistance - resistance),
        "resistance_spread_ohm": float(np.std(resistance)),
        "offset_mm": 1e3 * per(kept.offset_error, kept.straight),
        "angle_deg": math.degrees(per(kept.angle_error, kept.straight)),
        "offset_normal": per(kept.offset_normal, kept.straight) ** 2,
        "angle_normal": per(kept.angle_normal, kept.straight) ** 2,
        "pings": float(np.sum(kept.pings)),
        "alarms": float(np.sum(kept.alarms)),
        "doubts": float(np.sum(kept.doubts)),
        "strays": float(np.sum(kept.strays)),
        "passed": float(np.sum(kept.passed)),
    }


def filters(car: Car, seeds: Sequence[int], picture: Path | None) -> list[str]:
    """The section on the filters' errors."""
    found, squares = {}, {}
    for name in COURSES:
        course = load_course(name)
        _, kept = errors(course, car, seeds)
        found[name] = figures(trials(course, car, seeds), kept)
        squares[name] = kept.squares
        print(name, found[name], flush=True)
    rows: list[tuple[str, Callable[[dict[str, float]], str]]] = [
        (
            "sideslip in drifts (over 10°), RMS error",
            lambda f: f"**{f['sideslip_deg']:.1f}°** over {f['drifting_s']:.0f} s",
        ),
        ("the same by dead reckoning", lambda f: f"{f['reckoned_deg']:.1f}°"),
        (
            "(vx, vy, yaw rate): normalised error squared, mean; 95 % bounds",
            lambda f: (
                f"{f['normalised']:.2f}; {f['normalised_low']:.2f} to {f['normalised_high']:.2f}"
            ),
        ),
        (
            "each alone: vx, vy, yaw rate (1 agrees)",
            lambda f: f"{f['vx_normal']:.2f}, {f['vy_normal']:.2f}, {f['yaw_rate_normal']:.2f}",
        ),
        (
            "instants at which its mean over the cars is within the bounds",
            lambda f: f"{100 * f['timely']:.0f} %",
        ),
        ("instants within the covariance's 95 %", lambda f: f"{100 * f['inside']:.1f} %"),
        *(
            (
                f"{name} at the end, RMS error (and spread of the cars)",
                lambda f, key=key, unit=unit, form=form: (
                    f"{f[f'{key}{unit}']:{form}} ({f[f'{key}_spread{unit}']:{form}})"
                ),
            )
            for name, key, unit, form in (
                ("gyroscope's bias, °/s", "gyro_bias", "_degps", ".2f"),
                ("friction of the rear axle over the nominal", "friction", "", ".3f"),
                ("gain of a servo that gives too little", "servo", "", ".3f"),
                ("open-circuit voltage, V", "battery", "_v", ".3f"),
                ("battery's resistance, ohm", "resistance", "_ohm", ".4f"),
            )
        ),
        ("offset from the corridor's middle, RMS error", lambda f: f"{f['offset_mm']:.0f} mm"),
        ("angle to the corridor, RMS error", lambda f: f"{f['angle_deg']:.2f}°"),
        (
            "these two squared over their variance, mean (1 agrees)",
            lambda f: f"{f['offset_normal']:.2f}, {f['angle_normal']:.2f}",
        ),
        (
            "front pings of the right wall held for spikes (by the driver's own gate)",
            lambda f: (
                f"{100 * f['alarms'] / f['pings']:.2f} % "
                f"({100 * f['doubts'] / f['pings']:.2f} %) of {f['pings']:.0f}"
            ),
        ),
        (
            "pings that are too short, believed",
            lambda f: f"{f['passed']:.0f} of {f['strays']:.0f}",
        ),
    ]
    lines = ["| | " + " | ".join(f"`{name}`" for name in COURSES) + " |"]
    lines += ["| --- |" + " ---: |" * len(COURSES)]
    lines += [f"| {name} | " + " | ".join(map(say, found.values())) + " |" for name, say in rows]
    if picture is not None:
        draw_picture(squares, picture)
    return lines


def poses(car: Car, seeds: Sequence[int]) -> list[str]:
    """The section on the pose from a uniform start."""
    lines = [
        "| course | drives of two turns | settled, up to symmetry (95 %) | at the one place | "
        "median share of the weight |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name in COURSES:
        course = load_course(name)
        placed, two = settled(course, car, seeds)
        near = (placed.distance < 0.3) & (placed.angle < math.radians(15))
        near = near[two]
        count, alike = len(near), int(np.sum(np.any(near, axis=1)))
        low, high = interval(alike, count)
        lines.append(
            f"| `{name}` | {count} | {100 * alike / count:.1f} % ({100 * low:.1f}–{100 * high:.1f})"
            f" | {100 * np.mean(near[:, 0]):.1f} % | {np.median(placed.share[two]):.2f} |"
        )
        print(lines[-1], flush=True)
    return lines


def settled(course: Course, car: Car, seeds: Sequence[int]) -> tuple[Any, np.ndarray]:
    """The result of `watches.Places`, and a mask of the drives that made two turns."""
    walls = jnp.asarray(padded(course.walls, np.dtype(np.float32)))
    place = PoseFilter(walls=walls, sonar=jax.tree.map(np.float32, car.sensors.sonar))
    alike = NAMES.get(course.name, (1, ""))[0]
    low, high = (getattr(np, f"nan{end}")(course.walls.reshape(-1, 2), 0) for end in ("min", "max"))
    watch = Places(
        place=place,
        uniform=anywhere(course, place, 20 * PARTICLES),
        middle=((low + high) / 2).astype(np.float32),
        turns=(np.arange(alike) * 2 * math.pi / alike).astype(np.float32),
    )
    make = partial(drift_turn, course, car)
    score, placed = trials(course, car, seeds).run_watched(make, watch, lanes=len(seeds) // 2)
    return placed, np.isfinite(score.turns.end[:, 1])


def failing(
    course: Course, car: Car, cars: int, sensors: Sequence[str] = SENSORS
) -> dict[tuple[str, str], np.ndarray]:
    """The outcomes for each sensor and kind: (cars, straights). ("none", "") has no fault.

    A fault begins 0.4 s after the start, or at the end of a turn, and lasts half a second. One
    program holds all faults. Outside its own trials, a fault has no duration.
    """
    pairs = [(sensor, kind) for sensor in sensors for kind in KINDS]
    count = len(course.turns_ahead(1))

    def run(which: np.ndarray, starts: np.ndarray, seeds: np.ndarray) -> Score:
        faults = tuple(
            SensorFault(sensor=s, kind=k, start=starts, duration=np.where(which == i, FAULT, 0.0))
            for i, (s, k) in enumerate(pairs)
        )
        own = trials(course, car, seeds.tolist())
        return own.run_watched(partial(drift_turn, course, car), None, faults=faults)[0]

    seeds = np.arange(cars)
    none = np.full(cars, -1)
    sound = run(none, 0.0 * none, seeds)
    begins = np.concatenate([np.full((cars, 1), 0.4), sound.turns.end[:, : count - 1]], axis=1)
    # A straight that the car without a fault never reached gets no fault.
    begins = np.where(np.isfinite(begins), begins, 1e6)
    shape = (len(pairs), cars, count)
    which, car_number, straight = (axis.ravel() for axis in np.indices(shape))
    score = run(which, begins[car_number, straight], seeds[car_number])
    status = score.outcome.reshape(shape)
    found = {pair: status[i] for i, pair in enumerate(pairs)}
    return found | {("none", ""): np.repeat(sound.outcome[:, None], count, axis=1)}


def sensor_faults(car: Car, cars: int) -> list[str]:
    """The section on sensors that fail on a straight of `box`."""
    found = failing(load_course("box"), car, cars)
    lines = ["| sensor | " + " | ".join(KINDS) + " |", "| --- |" + " ---: |" * len(KINDS)]

    def say(status: np.ndarray) -> str:
        goal, stops = (
            np.sum(status == Outcome.REACHED.code),
            np.sum((status == Outcome.STALLED.code) | (status == Outcome.LATE.code)),
        )
        touched, lost = np.sum(status == Outcome.TOUCHED.code), np.sum(status == Outcome.LOST.code)
        rest = f", {stops} stop" if stops else ""
        rest += f", **{touched} touch**" if touched else ""
        rest += f", **{lost} lost**" if lost else ""
        return f"{goal} of {status.size}{rest}"

    for sensor in SENSORS:
        told = " | ".join(say(found[sensor, kind]) for kind in KINDS)
        lines.append(f"| {sensor.replace('_', ', ')} | {told} |")
        print(lines[-1], flush=True)
        for kind in KINDS:
            touched = np.argwhere(found[sensor, kind] == Outcome.TOUCHED.code)
            if len(touched):
                print(" ", kind, "seed and straight:", touched.tolist(), flush=True)
    lines.append(f"| none | {say(found['none', ''][:, :1])} | | |")
    return lines


def straightening(car: Car, seeds: Sequence[int]) -> list[str]:
    """The section on straightening: PID on sonar, and on the wall filter."""
    lines = [
        "| | offset, RMS | angle, RMS | as known: offset | angle | success | heading error, RMS |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    kinds: tuple[tuple[str, Any, str], ...] = (
        ("straight", straighten, "by"),
        ("box", drift_turn, "straight_by"),
        ("ess", drift_turn, "straight_by"),
    )
    for where, make, what in kinds:
        course = load_course(where)
        for by in ("sonar", "filter"):
            score, kept = errors(course, car, seeds, partial(make, **{what: by}))
            count = np.sum(kept.straight)
            offset, angle, offset_error, angle_error = (
                math.sqrt(np.sum(total) / count)
                for total in (kept.offset, kept.angle, kept.offset_error, kept.angle_error)
            )
            told = results(score, seeds)
            error = told["heading_error_rms_deg"]
            lines.append(
                f"| `{where}`, by {by} | {1e3 * offset:.0f} mm | {math.degrees(angle):.2f}° | "
                f"{1e3 * offset_error:.0f} mm | {math.degrees(angle_error):.2f}° | "
                f"{100 * told['success_rate']:.1f} % | {'' if error is None else f'{error:.2f}°'} |"
            )
            print(lines[-1], flush=True)
    return lines


SENSING = (  # a car's sensors in words, their settings, and the driver's source for its corridor
    ("the sensors as they are", (), "filter"),
    ("a lidar of 72 beams over 270°, 40 Hz, 10 mm", ("sensors.lidar.beams=72",), "filter"),
    (
        "place and heading from outside: 100 Hz, 1 mm, 0.3°, 10 ms late",
        ("sensors.position.reports=pose",),
        "pose",
    ),
    (
        "place by GPS-like reports: 10 Hz, 20 mm, 50 ms late",
        (
            "sensors.position.reports=place",
            "sensors.position.rate_hz=10",
            "sensors.position.noise_m=0.02",
            "sensors.position.delay_s=0.05",
        ),
        "pose",
    ),
)


def sensing(name: str, seeds: Sequence[int]) -> list[str]:
    """The section on better sensors: their headline figures."""
    lines = [
        "| | course | success (95 %) | drifts | heading error, RMS |",
        "| --- | --- | ---: | ---: | ---: |",
    ]
    for what, settings, by in SENSING:
        car = load_car(name, settings)
        for where in COURSES:
            course = load_course(where)
            score, _ = errors(course, car, seeds, partial(drift_turn, straight_by=by))
            told = results(score, seeds)
            low, high = told["success_interval"]
            share, error = told["drift_share"], told["heading_error_rms_deg"]
            lines.append(
                f"| {what} | `{where}` | {100 * told['success_rate']:.1f} % "
                f"({100 * low:.1f}–{100 * high:.1f}) | "
                + ("| |" if share is None else f"{100 * share:.1f} % | {error:.2f}° |")
            )
            print(lines[-1], told["failures"], flush=True)
    return lines


def draw_picture(squares: dict[str, np.ndarray], path: Path) -> None:
    """Draw the normalised error squared over time, a dot for each instant, with its bounds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(squares), figsize=(10, 3.4), layout="constrained")
    for one, (name, table) in zip(np.atleast_1d(axes), squares.items(), strict=True):
        number = np.sum(np.isfinite(table), axis=0)
        many = number >= len(table) / 2
        time, count = PERIOD * SAMPLE * np.arange(table.shape[1])[many], number[many]
        bounds = chi2.ppf(np.array([[0.025], [0.975]]), 3 * count) / count
        one.fill_between(time, *bounds, alpha=0.25, label="95 % bounds of the mean")
        one.plot(time, np.nanmean(table[:, many], axis=0), ".-", markersize=3, label="mean")
        one.plot(time, np.nanmedian(table[:, many], axis=0), lw=0.8, color="grey", label="median")
        one.set_title(name, fontsize=10)
        one.set_xlabel("time, s")
        one.set_ylim(0, None)
    axes[0].set_ylabel("normalised error squared")
    axes[0].legend(frameon=False, fontsize=8)
    with whole(path) as part:
        figure.savefig(part, format="png", dpi=110)
    plt.close(figure)


PAGE = """# What the estimates are worth

Made by `make estimation`. Cars drawn from the set `{set}` around `{car}` (each with its own
tyres, mass, motor, servo, battery, charge, noises, biases and floor), asked for {low:g} to
{high:g} m/s, drive with the drift-turn driver on the sensors alone. The filters know the nominal
car only; their noises were set on other seeds.

## The filters

{cars} drives on each course, looked at every 5 ms from half a second on. *Dead reckoning* takes the
same readings from the true start. For the normalised error squared a drive counts as one draw of
three numbers, as errors hang together over a drive.

{filters}

![The normalised error squared over time](estimation.png)

The bounds hold for a whole drive. By the instant, the filter is too careful in the first two
seconds, when the car has just stood.

The gyroscope's bias is not learned within a lap: while the car drives, little but the gyroscope
itself tells how fast it turns, so the estimate is as far off as the cars are spread.

A ping is *of the right wall* within {fit:g} cm of where the walls, which the judge knows, let it
be. The spike filter (`estimation/spikes.py`) costs no delay for a wall that comes nearer as the car
drives. A wall that comes into view at once is held back for one ping, 25 ms at 40 Hz: that is what
its alarms cost. Pings that are too short are echoes of edges; two in a row are a wall to it. The
driver looks at the same pings against its odometry, and wants two that follow the one before.

## The pose from anywhere

A particle filter of {particles} that begins spread evenly over the whole course and all headings,
at the end of the second turn: settled where the place it believes most is within 30 cm and 15°. The
four places of `box` look alike to every sensor of the car. No filter can tell them apart, so what
can be asked for is the place up to a quarter turn; the one place is found by luck, in one of four.

{poses}

## Sensors that fail on a straight

A sensor is dead, stuck (repeats its last reading) or spikes (reads any number of its range) for
half a second, on each straight of `box`: from 0.4 s after the start, or from the instant a turn has
ended; {failing} cars each. How many reach the goal; the rest stop or touch a wall.

{faults}

What holds the car off the walls: a sensor that is late or repeats itself is not believed, nor is
one whose readings differ by more than any car can change within its period, until four in a row
do not. The nominal car's single track goes on meanwhile, and the side sonars hold the heading.

## Straightening by sonar and by filter

The paper's PID on sonar and gyroscope beside the same PID on the wall filter, over the same cars:
how far the car is from the middle and the angle of its corridor on straights, how far what it
believes is from the truth, and what becomes of the turns.

{straightening}

## What better sensing would bring

The same driver. With a lidar, the beams on the side walls correct the wall filter, and those ahead
tell the corner instead of the front sonar. Behind a corner the wall filter begins at the place that
the corridor before tells. Otherwise beams are taken for those of other walls. With a place from
outside, that is among the velocity filter's states, and the driver takes offset, angle and corner
from the pose.

{sensing}
"""


def write(page: Path, name: str = "rx7", cars: int = CARS) -> None:
    """Write the page, and the picture beside it."""
    car, seeds = load_car(name), range(FIRST, FIRST + cars)
    studies = {
        "filters": filters(car, seeds, page.with_suffix(".png")),
        "poses": poses(car, seeds[:POSES]),
        "faults": sensor_faults(car, FAILING),
        "straightening": straightening(car, seeds),
        "sensing": sensing(name, seeds),
    }
    text = PAGE.format(
        set=SET,
        car=name,
        low=SPEEDS[0],
        high=SPEEDS[1],
        cars=cars,
        fit=100 * FIT,
        particles=PARTICLES,
        failing=FAILING,
        **{study: "\n".join(lines) for study, lines in studies.items()},
    )
    write_whole(page, text)


if __name__ == "__main__":
    configure_jax(blocks=True, cores=2)
    write(Path(sys.argv[1]), cars=int(sys.argv[2]) if len(sys.argv) > 2 else CARS)
