"""One drive from start to goal, recorded as it goes."""

import contextlib
import dataclasses
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from countersteer import __version__
from countersteer.car.car import Car
from countersteer.car.files import car_tables, load_car
from countersteer.course.course import Course
from countersteer.course.files import course_tables
from countersteer.drivers.driver import ROUNDING, Observation, Status, status_of
from countersteer.drivers.registry import make_driver
from countersteer.errors import InputError
from countersteer.link.link import ONBOARD, Link
from countersteer.pilot import Pilot, command_type
from countersteer.runs.files import COVARIANCE, ESTIMATE, ROLLOUTS, read_commands
from countersteer.runs.recorder import Frames, Pace, Recorder
from countersteer.sensing.all_sensors import channels
from countersteer.sensing.faults import SensorFault, fault_tables
from countersteer.signals import Motion, Wheels, truth_columns
from countersteer.simulator import PIECE, Record, Simulator
from countersteer.task.judge import PERIOD, Outcome, Sample, Task, samples, summary
from countersteer.world.floor import Floor, floor_tables

LOOK, LOOKED_AT, THINNED = 0.1, 24, 2  # s between notes; paths of each; one knot in so many
VELOCITY = ("vx_mps", "vy_mps", "yaw_rate_radps")


class Drive(NamedTuple):
    """All that a recorded drive needs."""

    simulator: Simulator
    pilot: Pilot
    course: Course | None
    about: dict[str, Any]  # content of `run.toml`
    longest: float  # s, time limit


def prepare(
    course: Course,
    car: Car,
    driver: str,
    *,
    car_name: str = "rx7",
    speed: float | None = None,
    laps: int = 1,
    estimate: str = "filter",
    link: Link = ONBOARD,
    dt: float = 0.001,
    seed: int = 0,
    charge: float = 1.0,
    start: tuple[float, float, float] | None = None,
    floor: Floor | None = None,
    faults: tuple[SensorFault, ...] = (),
) -> Drive:
    """A drive of a car on a course, by a driver's name or file.

    The driver knows the car `car_name`. `speed` (m/s) is what it should bring to a turn, `charge`
    is the battery's, 0 to 1. Raises `InputError` for a wrong argument.
    """
    course.check_laps(laps)
    nominal = load_car(car_name)
    made, tables = make_driver(driver, course, nominal, speed, laps, read_commands)
    pilot = Pilot.of(made, course, nominal, estimate, link, dt)
    simulator = Simulator.of(
        course,
        car,
        link=link,
        dt=dt,
        seed=seed,
        charge=charge,
        start=start,
        floor=floor,
        faults=faults,
    )
    name = Path(driver).stem if driver.endswith((".csv", ".toml")) else driver.rpartition(":")[2]
    about = about_run(simulator, pilot, course, name, car_name, laps, nominal, tables)
    # The time limit is enough for a crawl of 0.3 m/s.
    return Drive(simulator, pilot, course, about, 20.0 + (course.lap_end(laps) or 0.0) / 0.3)


def about_run(
    simulator: Simulator,
    pilot: Pilot,
    course: Course | None,
    driver: str,
    car: str,
    laps: int,
    nominal: Car,
    pilot_tables: Mapping[str, Any],
) -> dict[str, Any]:
    """Content of `run.toml`: enough to drive it again, and to run the pilot without a simulator.

    `nominal` is the car that the pilot knows. `pilot_tables` describe the driver, as returned by
    `drivers.registry.make_driver`.
    """
    link, dt = simulator.link, simulator.dt
    pace, sensors = pace_of(simulator), simulator.every._asdict()
    estimator: Any = pilot.estimator
    about: dict[str, Any] = {
        "driver": driver,
        "car_name": car,
        "seed": int(simulator.seed),
        "laps": laps,
        "estimate": getattr(estimator, "name", type(estimator).__name__),
        "battery_charge": float(simulator.charge),
        "rates": {
            "dt_s": dt,
            "control_s": pilot.control * dt,
            "telemetry_s": pace.telemetry * dt,
            "truth_s": pace.truth * dt,
        }
        | {f"{name}_s": float(n) * dt for name, n in sensors.items() if n is not None},
        "link": {
            "name": link.name,
            "delay_s": link.delay,
            "loss": link.loss,
            "timeout_s": link.timeout,
        },
        "precision_bits": 8 * np.asarray(simulator.car.body.mass).dtype.itemsize,
        "versions": {
            # Not by `importlib.metadata`: to parse what pip wrote takes a tenth of a second.
            "countersteer": __version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
        }
        | {"python": sys.version.split()[0]},
        "pilot": dict(pilot_tables),
        "car": car_tables(simulator.car),
        "nominal": car_tables(nominal),
    }
    detector = simulator.car.sensors.line_detector
    if detector.lines != "none":
        about["line_spacing_m"] = float(detector.spacing)
    if course is not None:
        about["course"] = course_tables(course)
    if simulator.pose != (course.start if course else (0.0, 0.0, 0.0)):
        pose = map(float, simulator.pose)
        about["start"] = dict(zip(("x_m", "y_m", "heading_rad"), pose, strict=True))
    floor = getattr(simulator.world, "floor", None)
    if floor is not None:
        about["floor"] = floor_tables(floor)
    if simulator.faults:
        about["faults"] = fault_tables(simulator.faults)
    if any(simulator.velocity):
        about["initial"] = dict(zip(VELOCITY, map(float, simulator.velocity), strict=True))
    return about


def pace_of(simulator: Simulator) -> Pace:
    """The recording periods of a drive."""
    ticks = simulator.link.in_ticks(simulator.dt)
    truth = max(1, round(PERIOD / simulator.dt))
    return Pace(simulator.dt, ticks.telemetry, truth, ticks.onboard)


class Watched:
    """A planner as a driver that also notes what it looks at, once in `LOOK` seconds."""

    def __init__(self, driver: Any) -> None:
        """Raises `InputError` if the driver plans nothing."""
        if not hasattr(driver, "rollouts"):
            raise InputError("--rollouts: this driver looks at no paths; mppi does")
        self.driver, self.period = driver, driver.period
        self._next = 0.0
        self._seen: list[tuple[float, Any]] = []

    def reset(self, key: jax.Array) -> Any:
        """As the planner."""
        return self.driver.reset(key)

    def act(self, memory: Any, observation: Observation) -> Any:
        """As the planner."""
        time = float(observation.time)
        if time >= self._next - ROUNDING:
            self._next = time + LOOK
            self._seen.append((time, self.driver.rollouts(memory, observation, LOOKED_AT)))
        return self.driver.act(memory, observation)

    def status(self, memory: Any) -> Status:
        """As the planner."""
        return status_of(self.driver, memory)

    def columns(self, until: float) -> list[np.ndarray]:
        """Columns of `ROLLOUTS` for what was noted up to a time (s) and not yet returned."""
        rows: list[np.ndarray] = []
        while self._seen and self._seen[0][0] <= until:
            time, seen = self._seen.pop(0)
            paths = [(np.nanmin(seen.cost), seen.plan.x, seen.plan.y)]
            paths += list(zip(seen.cost, seen.motion.x, seen.motion.y, strict=True))
            for k, (cost, x, y) in enumerate(paths):
                at = np.arange(0, len(x), THINNED)
                known = np.full(len(at), time), np.full(len(at), k), np.full(len(at), cost)
                rows.append(np.stack([*known, np.round(x[at], 4), np.round(y[at], 4)]))
        return list(np.hstack(rows)) if rows else [np.zeros(0)] * len(ROLLOUTS)


def watched(what: Drive) -> Drive:
    """The same drive, with what its planner looks at. Raises `InputError` if it does not plan."""
    pilot = dataclasses.replace(what.pilot, driver=Watched(what.pilot.driver))
    return what._replace(pilot=pilot)


class Interrupt:
    """Notes a Ctrl-C during a drive, so that the drive ends between two pieces.

    An exception could come anywhere, even where a library swallows it. Before the first piece, and
    from the second Ctrl-C on, Ctrl-C acts as it did before.
    """

    def __init__(self) -> None:
        """Before any Ctrl-C."""
        self.asked = False
        self._before: Any = None

    def __enter__(self) -> "Interrupt":
        return self

    def begin(self) -> None:
        """Note Ctrl-C from now on, in the main thread; no other thread receives it."""
        if self._before is None and threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._note)

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, *_: object) -> None:
        if self.asked:
            signal.signal(signal.SIGINT, self._before)
            signal.raise_signal(signal.SIGINT)
        self.asked = True


def drive(
    what: Drive, folder: Path, report: Callable[[float, float], None] = lambda *_: None
) -> dict[str, Any]:
    """Drive to the goal or to the time limit, and write the run's folder without its pictures.

    Returns the summary. `report` receives the progress and its end (m or s). On an interrupt the
    files are completed, and the drive counts as interrupted.
    """
    simulator, pilot, course, about, longest = what
    laps = int(about["laps"])
    task, pace = Task.of(course, laps), pace_of(simulator)
    score, outcome = task.init(), Outcome.DRIVING
    # Who plays commands looks at no estimate, and the ground truth is recorded already.
    known = about["pilot"].get("kind") == "replay" or about["estimate"] == "truth"
    more: dict[str, tuple[str, ...]] = {} if known else {"estimate": ESTIMATE}
    planner = pilot.driver if isinstance(pilot.driver, Watched) else None
    if planner is not None:
        more["rollouts"] = ROLLOUTS
    sensors, command = channels(simulator.car), command_type(pilot.driver)
    with Recorder(
        folder, about, channels=sensors, pace=pace, command=command, more=more
    ) as recorder:
        with (
            Interrupt() as interrupt,
            contextlib.closing(simulator.run(pilot, longest)) as pieces,
        ):
            for record in pieces:
                interrupt.begin()
                shown = np.nonzero(record.tick % pace.truth == 0)[0]
                shown = shown[record.tick[shown] * simulator.dt <= longest + 1e-9]
                score, outcomes = task.follow(score, samples(record, shown, simulator.dt))
                over = np.nonzero(outcomes != Outcome.DRIVING.code)[0]
                end = int(shown[over[0]]) + 1 if len(over) else len(record.tick)
                last = np.searchsorted(record.tick * simulator.dt, longest + 1e-9, side="right")
                shot = frames(record, min(end, int(last)))
                until = float(shot.tick[-1]) * simulator.dt if len(shot.tick) else -1.0
                seen = {} if planner is None else {"rollouts": planner.columns(until)}
                recorder.record(shot, seen)
                if task.line is not None:
                    report(float(score.distance), float(task.goal))
                else:
                    report(float(score.time), longest)
                outcome = Outcome.of(score.outcome)
                if outcome != Outcome.DRIVING or interrupt.asked:
                    break
        if outcome == Outcome.DRIVING:
            ended = Outcome.LATE if task.line is not None else Outcome.DONE
            outcome = Outcome.INTERRUPTED if interrupt.asked else ended
        result = summary(score, outcome)
        recorder.finish(result)
    return result


def warm_up(what: Drive) -> None:
    """Compile the judge of the drive. Call it while the loop compiles, which takes longer."""
    pace, task = pace_of(what.simulator), Task.of(what.course, int(what.about["laps"]))
    control = what.pilot.control
    ticks = max(1, round(PIECE / what.simulator.dt / control)) * control
    zero = np.zeros(len(range(0, ticks, pace.truth)))
    parts: list[Any] = [*[zero] * 6, Wheels(*[zero] * 4), *[zero] * 5]
    still = Motion(*parts)
    task.follow(task.init(), Sample(zero, still, zero, zero, zero))


def frames(record: Record, end: int) -> Frames:
    """The frames of the first `end` rows of a record, for the recorder."""
    truth = truth_columns(record.motion, record.voltage)
    known = record.estimate
    estimate = known and (*known[:6], *(getattr(known.pose_covariance, k[:2]) for k in COVARIANCE))
    whole = Frames(record.tick, record.readings, record.command, record.fresh, truth, estimate)
    cut: Frames = jax.tree.map(lambda leaf: leaf[:end], whole)
    return cut
