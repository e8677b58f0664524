"""One drive from start to goal, recorded as it goes."""

import contextlib
import dataclasses
import importlib.metadata
import math
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from countersteer.car.car import wheel_positions
from countersteer.car.files import car_tables
from countersteer.course.files import course_tables
from countersteer.evaluation.turns import Judge, going_straight, sideslip, summary
from countersteer.runs.files import COMMANDS, TRUTH
from countersteer.runs.writer import WHEELS, Rows, RunWriter
from countersteer.sensing.faults import fault_tables
from countersteer.simulator import Record, Simulator
from countersteer.world.floor import floor_tables

COUNTS = ("turn", "wall_contacts")
TRUTH_PERIOD = 0.005  # s between two rows of truth.csv
VIEW_PERIOD = 0.01  # s between two samples of the report


@dataclasses.dataclass(frozen=True)
class Log:
    """A piece of a drive, thinned to what is written and shown."""

    rows: Rows
    truth: dict[str, np.ndarray]  # columns of truth.csv, and turn, wall_contacts
    view: dict[str, np.ndarray]  # commands and contacts at the truth's times
    echoes: tuple[tuple[np.ndarray, np.ndarray], ...]  # times and distances by sonar mount

    @staticmethod
    def read(
        record: Record, simulator: Simulator, judge: Judge, longest: float
    ) -> tuple["Log", str | None]:
        """The piece, cut off where the drive ends in it, and how it ended there if it did."""
        dt, plan = simulator.dt, simulator.plan()
        ticks = np.asarray(record.tick)
        shown = np.nonzero(ticks % max(1, round(TRUTH_PERIOD / dt)) == 0)[0]
        time, motion = ticks * dt, record.motion
        end, status = len(ticks), None
        calm = going_straight(motion.vx[shown], motion.vy[shown], motion.yaw_rate[shown])
        finish = judge.follow(time[shown], motion.x[shown], motion.y[shown], calm)
        for ends, reached in (
            (finish is not None, "goal reached"),
            (np.any(record.rolled_over), "rolled over"),
            (not np.all(np.isfinite(motion.x)), "lost its state"),
            (judge.stalled(float(time[-1])), "stalled"),
        ):
            if ends:
                status = reached
                break
        if finish is not None:
            end = int(shown[finish]) + 1
        elif status == "rolled over":
            end = int(np.argmax(record.rolled_over)) + 1
        end = min(end, int(np.searchsorted(time, longest + 1e-9, side="right")))
        shown = shown[shown < end]
        truth = (
            time,
            motion.x,
            motion.y,
            motion.heading,
            motion.vx,
            motion.vy,
            motion.yaw_rate,
            *motion.wheels,
            motion.steering,
            record.voltage,
        )
        columns = {n: np.asarray(c)[shown] for n, c in zip(TRUTH, truth, strict=True)}
        told = np.nonzero(ticks[:end] % plan.telemetry == 0)[0]
        telemetry = [time[told]]
        sensors = (r for r in record.readings[1:] if r is not None)
        for reading in (*record.readings.sonar, *sensors):
            new = reading.tick[told] > np.maximum(ticks[told] - plan.telemetry, 0)
            values = reading.value[told].reshape(len(told), -1)  # a column each
            telemetry.extend(np.where(new[:, None], values, np.nan).T)
        echoes = []
        for reading in record.readings.sonar:
            new = np.nonzero((reading.tick == ticks) & (ticks > 0))[0]
            new = new[new < end]
            echoes.append((time[new], np.asarray(reading.value)[new]))
        fresh = np.nonzero(np.asarray(record.fresh)[:end])[0]
        commands = (time[fresh], record.command.throttle[fresh], record.command.steering[fresh])
        view = {
            "throttle": record.command.throttle[shown],
            "steering_command": record.command.steering[shown],
        }
        for wheel, forces in zip(WHEELS, record.forces, strict=True):
            for name, values in forces._asdict().items():
                view[f"{wheel}_{name}"] = np.asarray(values)[shown]
        return Log(
            Rows(commands, tuple(telemetry), tuple(columns.values())),
            columns | {name: np.asarray(getattr(record, name))[shown] for name in COUNTS},
            view,
            tuple(echoes),
        ), status


def make_view(
    simulator: Simulator, about: dict[str, Any], result: dict[str, Any], logs: list[Log]
) -> dict[str, Any]:
    """What report and picture are made from: plain lists, units in the names."""
    truth = {name: np.concatenate([log.truth[name] for log in logs]) for name in logs[0].truth}
    extra = {name: np.concatenate([log.view[name] for log in logs]) for name in logs[0].view}
    every = slice(None, None, max(1, round(VIEW_PERIOD / TRUTH_PERIOD)))
    body, sonar = simulator.car.body, simulator.car.sensors.sonar
    tires = (simulator.car.tires.front,) * 2 + (simulator.car.tires.rear,) * 2
    place = about.get("course", {}).get("name", "open floor")
    shown = {
        "speed_mps": np.hypot(truth["vx_mps"], truth["vy_mps"]),
        "sideslip_deg": np.degrees(sideslip(truth["vx_mps"], truth["vy_mps"])),
        "yaw_rate_degps": np.degrees(truth["yaw_rate_radps"]),
        "steering_deg": np.degrees(truth["steering_rad"]),
        "steering_command_deg": np.degrees(extra["steering_command"]),
        "throttle": extra["throttle"],
    } | {name: truth[name] for name in ("time_s", "x_m", "y_m", "heading_rad")}
    wheels = [
        {
            "force_x_n": extra[f"{wheel}_force_x"][every].tolist(),
            "force_y_n": extra[f"{wheel}_force_y"][every].tolist(),
            "limit_n": extra[f"{wheel}_limit"][every].tolist(),
            "slip_mps": extra[f"{wheel}_slip"][every].tolist(),
            "angle_rad": extra[f"{wheel}_angle"][every].tolist(),
        }
        for wheel in WHEELS
    ]
    mounts = []
    for i, (name, mount) in enumerate(zip(sonar.mount_names, sonar.mounts, strict=True)):
        times = np.concatenate([log.echoes[i][0] for log in logs])
        heard = np.concatenate([log.echoes[i][1] for log in logs])
        mounts.append(
            {
                "name": name,
                "x_m": float(mount.x),
                "y_m": float(mount.y),
                "angle_deg": math.degrees(mount.angle),
                "half_angle_deg": math.degrees(sonar.half_angle),
                "time_s": times.tolist(),
                "distance_m": [d if math.isfinite(d) else None for d in heard.tolist()],
            }
        )
    return {
        "title": f"{place}, {about['driver']}, {about['car_name']}, seed {simulator.seed}",
        "summary": result,
        "walls_m": about.get("course", {}).get("walls_m", []),
        "car": {
            "length_m": float(body.length),
            "width_m": float(body.width),
            "center_x_m": float(body.center),
            "wheels": [
                {
                    "x_m": float(x),
                    "y_m": float(y),
                    "radius_m": float(tire.radius),
                    "width_m": float(tire.width),
                }
                for x, y, tire in zip(*wheel_positions(body), tires, strict=True)
            ],
        },
        "sonar": mounts if place != "open floor" else [],
        "wheels": wheels,
    } | {name: values[every].tolist() for name, values in shown.items()}


def about_run(simulator: Simulator, driver: str, car: str, laps: int) -> dict[str, Any]:
    """What `run.toml` says: enough to drive it again."""
    plan, link = simulator.plan(), simulator.link
    sensors = plan.sensors._asdict()
    about: dict[str, Any] = {
        "driver": driver,
        "car_name": car,
        "seed": simulator.seed,
        "laps": laps,
        "estimate": simulator.estimate,
        "battery_charge": simulator.charge,
        "rates": {
            "dt_s": simulator.dt,
            "control_s": plan.control * simulator.dt,
            "telemetry_s": plan.telemetry * simulator.dt,
            "truth_s": max(1, round(TRUTH_PERIOD / simulator.dt)) * simulator.dt,
        }
        | {f"{name}_s": float(n) * simulator.dt for name, n in sensors.items() if n is not None},
        "link": {
            "name": link.name,
            "delay_s": link.delay,
            "loss": link.loss,
            "timeout_s": link.timeout,
        },
        "precision_bits": 8 * np.asarray(simulator.car.body.mass).dtype.itemsize,
        "versions": {
            name: importlib.metadata.version(name) for name in ("countersteer", "jax", "numpy")
        }
        | {"python": sys.version.split()[0]},
        "car": car_tables(simulator.car),
    }
    spacing = lines_spacing(simulator)
    if spacing is not None:
        about["line_spacing_m"] = spacing
    if simulator.course is not None:
        about["course"] = course_tables(simulator.course)
    if simulator.start is not None:
        about["start"] = dict(zip(("x_m", "y_m", "heading_rad"), simulator.start, strict=True))
    if simulator.floor is not None:
        about["floor"] = floor_tables(simulator.floor)
    if simulator.faults:
        about["faults"] = fault_tables(simulator.faults)
    if any(simulator.velocity):
        names = ("vx_mps", "vy_mps", "yaw_rate_radps")
        about["initial"] = dict(zip(names, simulator.velocity, strict=True))
    return about


def telemetry_header(simulator: Simulator) -> tuple[str, ...]:
    """Columns of `telemetry.csv` for the car's sensors."""
    sensors = simulator.car.sensors
    beams, place = sensors.lidar.beams, sensors.position.reports
    digits = max(2, len(str(beams - 1)))
    return (
        "time_s",
        *(f"sonar_{name}_m" for name in sensors.sonar.mount_names),
        "encoder_counts",
        "wheel_speed_mps",
        "gyro_radps",
        "accel_x_mps2",
        "accel_y_mps2",
        "battery_v",
        *(("line_crossings", "line_speed_mps") if lines_spacing(simulator) else ()),
        *(f"lidar_{beam:0{digits}}_m" for beam in range(beams)),
        *(("position_x_m", "position_y_m") if place != "none" else ()),
        *(("position_heading_rad",) if place == "pose" else ()),
    )


def lines_spacing(simulator: Simulator) -> float | None:
    """Distance between the lines that the car's detector looks for (m), if it has one."""
    part = simulator.car.sensors.line_detector
    return None if part.lines == "none" else float(part.spacing)


class Interrupt:
    """Notes a Ctrl-C once a drive is under way, so that it ends between two pieces.

    An exception could come anywhere, also where some library swallows it. Before the first piece,
    and from the second Ctrl-C on, it does what it did before.
    """

    def __init__(self) -> None:
        """Nothing was asked yet."""
        self.asked = False
        self._before: Any = None

    def __enter__(self) -> "Interrupt":
        return self

    def begin(self) -> None:
        """Notes Ctrl-C from now on (in the main thread; no other gets any)."""
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
    simulator: Simulator,
    folder: Path,
    about: dict[str, Any],
    laps: int,
    longest: float,
    report: Callable[[float, float], None],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Drives to the goal, or for `longest` seconds, and writes the run's folder but its pictures.

    Returns the summary and what the pictures show. `report` is told the progress (m or s). On an
    interrupt the files are ended, and the drive counts as interrupted.
    """
    judge = Judge(simulator.course, laps)
    logs: list[Log] = []
    status = "out of time"
    headers = {"commands": COMMANDS, "telemetry": telemetry_header(simulator), "truth": TRUTH}
    with RunWriter(folder, about, headers) as writer:
        with Interrupt() as interrupt, contextlib.closing(simulator.run(longest)) as pieces:
            for record in pieces:
                interrupt.begin()
                log, end = Log.read(record, simulator, judge, longest)
                logs.append(log)
                writer.write(log.rows.cells())
                if judge.goal is not None:
                    report(judge.distance, judge.goal)
                else:
                    report(float(log.truth["time_s"][-1]), longest)
                if interrupt.asked or end is not None:
                    status = end or "interrupted"
                    break
        contacts = int(logs[-1].truth["wall_contacts"][-1]) if logs else 0
        if judge.goal is None and status == "out of time":
            status = "done"
        truth = {n: np.concatenate([log.truth[n] for log in logs]) for n in (*TRUTH, *COUNTS)}
        result = summary(judge, laps, status, truth, contacts)
        writer.finish(result)
    return result, make_view(simulator, about, result, logs)
