"""`Setting`: what is driven, and its simulator, pilot and task."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from countersteer.car.car import GRAVITY, Car
from countersteer.car.files import check, load_car, parameters
from countersteer.cockpit.messages import SENSOR_STATES, Patch
from countersteer.cockpit.sharing import Shared
from countersteer.course.course import Course
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.link.link import LINKS, ONBOARD
from countersteer.pilot import Pilot, traceable
from countersteer.recorded_drive import about_run
from countersteer.runs.files import read_commands
from countersteer.sensing import all_sensors
from countersteer.sensing.faults import SensorFault
from countersteer.signals import flat
from countersteer.simulator import Simulator
from countersteer.task.judge import Task
from countersteer.world import floor
from countersteer.world.planar import Planar, delay_slots, planar

DT = 0.001  # s, of the physics
SLOTS = 32  # of the delay lines, so that delays can be changed up to 29 ms
PATCHES = 16  # discs on the floor
NEVER = 1e9  # s, start of a fault that is off
NOISIER = 5.0  # times the noise
LOSSES = {"on": None, "noisier": 0.3, "failing": 0.7, "off": 1.0}  # of the radio; None: its own
RADIO = "radio"


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is driven. Names are those of menus; numbers are in the units of files."""

    course: Course
    course_name: str
    car: str = "rx7"
    driver: str = "drift-turn"
    estimate: str = "filter"
    link: str = ONBOARD.name
    seed: int = 0
    laps: int = 1
    battery: float = 1.0  # charge
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)  # that differ
    sensors: Mapping[str, str] = dataclasses.field(default_factory=dict)  # that are not on
    patches: tuple[Patch, ...] = ()
    gyro: bool = True
    strength: float = 1.0


class Prepared(NamedTuple):
    """All that a drive of a setting needs."""

    setting: Setting
    simulator: Simulator
    pilot: Pilot  # its driver is a `Shared`
    task: Task
    own: Any  # the driver, where JAX cannot trace it; else None
    nominal: Car
    tables: Mapping[str, Any]  # of the driver


def prepare(setting: Setting) -> Prepared:
    """The parts of a drive. Raises `InputError` if they do not go together."""
    course, link = setting.course, LINKS[setting.link]
    course.check_laps(setting.laps)
    nominal = load_car(setting.car)
    driver, tables = make_driver(setting.driver, course, nominal, None, setting.laps, read_commands)
    traced = traceable(driver)
    pilot = Pilot.of(
        Shared(driver=driver if traced else None), course, nominal, setting.estimate, link, DT
    )
    # A person may rest, or drive backwards.
    task = dataclasses.replace(Task.of(course, setting.laps), of_log=True)
    simulator = simulator_of(setting)
    return Prepared(setting, simulator, pilot, task, None if traced else driver, nominal, tables)


def simulator_of(setting: Setting, at: Mapping[str, float] | None = None) -> Simulator:
    """The simulator of a setting. `at` are the times (s) at which sensors began to fail."""
    link = LINKS[setting.link]
    car = car_of(setting)
    faults = tuple(
        SensorFault(
            sensor=name,
            kind=kind,
            start=(at or {}).get(name, 0.0) if setting.sensors.get(name) == state else NEVER,
            duration=math.inf,
        )
        for name in sensor_names(car)
        for state, kind in (("off", "dead"), ("failing", "spike"))
    )
    simulator = Simulator.of(
        setting.course,
        car,
        link=link,
        dt=DT,
        seed=setting.seed,
        charge=setting.battery,
        floor=floor_of(setting.patches),
        faults=faults,
        world=_with_slots,
    )
    loss = LOSSES[setting.sensors.get(RADIO, "on")]
    return simulator if loss is None else dataclasses.replace(simulator, loss=np.float64(loss))


def _with_slots(car: Car, walls: Any, painted: Any, dt: float) -> Planar:
    made = planar(car, walls, painted, dt)
    return dataclasses.replace(made, slots=max(SLOTS, made.slots))


def car_of(setting: Setting) -> Car:
    """The simulated car. Raises `InputError` if a parameter is out of range."""
    car = load_car(setting.car, [f"{k}={v!r}" for k, v in setting.parameters.items()])
    check(car, "parameter")
    sensors: Any = car.sensors
    for name, state in setting.sensors.items():
        part: Any = getattr(sensors, name, None)
        if state == "noisier" and hasattr(part, "noise"):
            louder = dataclasses.replace(part, noise=part.noise * NOISIER)
            sensors = dataclasses.replace(sensors, **{name: louder})
    return dataclasses.replace(car, sensors=sensors)


def sensor_names(car: Car) -> list[str]:
    """The car's sensors. Those of one kind have one name."""
    names = [channel.sensor for channel in flat(all_sensors.channels(car))]
    return list(dict.fromkeys("sonar" if n.startswith("sonar_") else n for n in names))


def sensor_states(car: Car, link: str) -> dict[str, tuple[str, ...]]:
    """The states that each sensor of a car can have, and the radio, where there is one."""
    states = {
        name: SENSOR_STATES
        if hasattr(getattr(car.sensors, name), "noise")
        else tuple(state for state in SENSOR_STATES if state != "noisier")
        for name in sensor_names(car)
    }
    return states if LINKS[link].onboard else states | {RADIO: SENSOR_STATES}


def floor_of(patches: tuple[Patch, ...]) -> floor.Floor:
    """A floor of `PATCHES` discs. Those that are not painted have the factor 1."""
    painted = [floor.Patch(p.x_m, p.y_m, p.radius_m, p.friction) for p in patches]
    blank = [floor.Patch(0.0, 0.0, 1.0, 1.0)] * (PATCHES - len(painted))
    return floor.Floor((), 0.0, (*painted, *blank))


def is_live(setting: Setting, simulator: Simulator) -> bool:
    """Whether the drive of `simulator` can go on with the car of `setting`."""
    car, world = car_of(setting), simulator.world
    return (
        delay_slots(car, DT) <= world.slots  # type: ignore[attr-defined]  # it is planar
        and all_sensors.periods(car, DT) == simulator.every
        and all_sensors.position_slots(car, DT) == simulator.slots
    )


def sliders_of(setting: Setting) -> list[dict[str, Any]]:
    """The parameters that have a range: what `messages.Slider` holds."""
    return [
        {
            "path": p["path"],
            "unit": p["unit"],
            "meaning": p["meaning"],
            "low": p["low"],
            "high": p["high"],
            "value": setting.parameters.get(p["path"], p["value"]),
            "first": p["value"],
            "live": not p["path"].endswith(("rate_hz", "update_s", "beams", "regions")),
        }
        for p in declared(setting.car).values()
    ]


@functools.lru_cache(maxsize=8)
def declared(car: str) -> dict[str, dict[str, Any]]:
    """The parameters of a car that have a range, by path. They are asked for often."""
    return {p["path"]: p for p in parameters(load_car(car)) if not p["choices"]}


def about_of(prepared: Prepared, simulator: Simulator) -> dict[str, Any]:
    """The content of `run.toml` at the start of a drive with a simulator of that setting."""
    setting = prepared.setting
    about = about_run(
        dataclasses.replace(simulator, faults=()),
        prepared.pilot,
        setting.course,
        "person",
        setting.car,
        setting.laps,
        prepared.nominal,
        {"kind": "shared", "driver": setting.driver},
    )
    if not setting.patches:
        about.pop("floor", None)
    return about


def fastest(car: Car) -> float:
    """The speed (m/s) at which a fresh battery's voltage is all back-EMF."""
    wheel = car.battery.full / (car.motor.torque_constant * car.drivetrain.gear_ratio)
    return float(wheel * car.tires.rear.radius)


def wheel_limit(car: Car) -> float:
    """The largest friction force of a wheel at rest (N)."""
    grip = max(float(car.tires.front.peak_friction), float(car.tires.rear.peak_friction))
    return float(car.body.mass) * GRAVITY / 4 * grip


def refuse_unknown(name: str, known: Mapping[str, Any], what: str) -> None:
    """Raise `InputError` if a name is none of those known."""
    if name not in known:
        raise InputError(f"{what}: there is no {name[:60]}; there are {', '.join(known)[:200]}")
