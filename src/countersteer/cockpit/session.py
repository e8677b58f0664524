"""`Session`: a person at the ordinary simulator, one drive after the other.

It knows nothing of sockets and of the wall clock: `step` advances the car by `STEP`, with what the
hands do then. What there is to tell comes out of `state` and `told`, as messages.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from countersteer.cockpit import messages as m
from countersteer.cockpit import setting as set_up
from countersteer.cockpit.gyro import Assist, Hands
from countersteer.cockpit.recording import Recording
from countersteer.cockpit.setting import Prepared, Setting
from countersteer.cockpit.stretch import Said, Stepper
from countersteer.course.course import Course, place
from countersteer.drivers.driver import Heard, Observation
from countersteer.pilot import PYTHON_PERIOD, bounded, checked
from countersteer.random_streams import Stream
from countersteer.random_streams import key as random_key
from countersteer.signals import Command, Reading
from countersteer.simulator import Record
from countersteer.task import turns as turning
from countersteer.task.judge import DRIFT, PERIOD, Outcome, Score, samples, summary
from countersteer.task.turns import sideslip
from countersteer.viewing.view import ELLIPSE, mounts, outline

TICKS = 10  # of a step
STEP = TICKS * set_up.DT  # s
FLUSHED = 10  # steps between two looks of the judge, and writes of the record
JUDGED = round(FLUSHED * STEP / PERIOD)  # samples in a look
SHORTEST = 2.0  # s; a drive that is broken off sooner is not kept
LONGEST = 3600.0  # s of a drive
TOUCHING = 0.3  # s for which a touch is shown
PATHS, LOOK = 24, 0.2  # paths of a planner that are shown, and s between two looks
READY, DRIVES, PAUSED, ENDED = "ready", "drives", "paused", "ended"


class Session:
    """The drives of one cockpit. All times are of the car's clock."""

    def __init__(self, prepared: Prepared, runs: Path | None, recording: bool = True) -> None:
        """Ready at the start. With `recording`, drives are folders in `runs`."""
        self.runs, self.records = runs, recording
        self.finished: list[str] = []  # names of the folders that are complete and not told of yet
        self._told: list[Any] = []
        self._recording: Recording | None = None
        self.rollouts = False
        self.use(prepared)

    # ---- what is driven ----

    def use(self, prepared: Prepared) -> None:
        """Drive something else from the start."""
        stepper = Stepper(prepared.simulator, prepared.pilot, TICKS)
        stepper.warm_up()
        self.close()
        self.prepared, self.setting, self._stepper = prepared, prepared.setting, stepper
        self._begin()

    def reset(self) -> None:
        """Back to the start, with the car and the floor as they are now. The person drives."""
        self.close()
        simulator = set_up.simulator_of(self.setting)
        if self.setting is not self.prepared.setting:
            self.prepared = self.prepared._replace(setting=self.setting, simulator=simulator)
            self._stepper = Stepper(simulator, self.prepared.pilot, TICKS)
        else:
            self._stepper.reset()
        self._begin()

    def _begin(self) -> None:
        self._failing_since: dict[str, float] = {}  # s, by sensor
        self.phase, self.who = READY, m.PERSON
        self.time = 0.0
        self._pending: list[Record] = []
        self._score: Score = self.prepared.task.init()
        self._turns = 0
        self._touches: list[float] = []  # s
        self._contacts = 0
        self._last: Record | None = None
        self._forces = np.zeros((4, 5))
        self._said = Hands()
        self._own, self._given, self._next_look = None, Command(0.0, 0.0), 0.0
        self._next_decision = 0.0
        self._who_at = [(0.0, self.who)]
        driver = self.prepared.own
        if driver is not None:
            root = self._stepper.simulator.root
            self._own = driver.reset(random_key(root, Stream.DRIVER))
        self._first = self._stepper.peek()

    def start(self) -> None:
        """Start the clock of a drive that is ready or paused.

        Raises `InputError` or `OSError` if it cannot be recorded.
        """
        if self.phase == READY and self.records and self.runs is not None:
            name = f"{Path(self.setting.course.name).stem}-person"
            about = set_up.about_of(self.prepared, self._stepper.simulator)
            self.records = False  # if it cannot be made, the next start is without
            self._recording = Recording(self.runs, name, about, self._stepper.simulator)
            self.records = True
            self._recording.driven_by(0.0, self._name(self.who))
            for sensor, state in self.setting.sensors.items():
                self._recording.sensor(0.0, sensor, state)
        if self.phase in (READY, PAUSED):
            self.phase = DRIVES

    def pause(self) -> None:
        """Stop the clock."""
        if self.phase == DRIVES:
            self.phase = PAUSED

    def hand_over(self, to: str) -> None:
        """Who drives from now on."""
        if to != self.who:
            self.who = to
            self._who_at.append((self.time, to))
            if self._recording is not None:
                self._recording.driven_by(self.time, self._name(to))

    def _name(self, who: str) -> str:
        return self.setting.driver if who == m.DRIVER else m.PERSON

    def change(self, changed: Setting) -> bool:
        """Go on with a changed car, sensors, floor or gyroscope.

        Returns False if that needs `use`. Raises `InputError` for a wrong value.
        """
        if not set_up.is_live(changed, self._stepper.simulator):
            return False
        since = self._failing_since
        self._failing_since = {
            name: since.get(name, self.time)
            if self.setting.sensors.get(name) == state
            else self.time
            for name, state in changed.sensors.items()
        }
        self._stepper.replace(set_up.simulator_of(changed, self._failing_since))
        before, self.setting = self.setting, changed
        if self._recording is not None:
            note_changes(self._recording, self.time, before, changed)
        return True

    # ---- the drive ----

    def step(self, hands: Hands, cut: bool = False, seq: int = -1, source: int = 0) -> None:
        """One step, with what the hands do in it. `cut` puts the person's throttle to zero.

        `seq` and `source` are for the record.
        """
        setting, driver = self.setting, self.who == m.DRIVER
        if driver and self.prepared.own is not None:
            self._ask()
        assist = Assist(float(setting.gyro), setting.strength, self._lock)
        said = Said(hands, assist, float(not driver), self._given, float(cut))
        if self._recording is not None:
            state = (float(driver), float(setting.gyro), setting.strength, float(cut))
            self._recording.input((self.time, float(seq), *hands, float(source), *state))
        record, self._forces = self._stepper.step(said)
        self._said, self._last = hands, record
        self.time = round(self._stepper.tick * set_up.DT, 6)
        contacts = int(record.wall_contacts[-1])
        if contacts > self._contacts:
            self._contacts = contacts
            self._touches.append(self.time)
        self._pending.append(record)
        if len(self._pending) == FLUSHED:
            self._flush()

    @property
    def _lock(self) -> float:
        servo = self._stepper.simulator.car.servo
        return float(min(servo.limit_left, servo.limit_right))

    def _ask(self) -> None:
        """Ask a driver that JAX cannot trace, if its next decision is due."""
        if self.time < self._next_decision - 1e-9 or self._last is None:
            return
        driver = self.prepared.own
        self._next_decision = self.time + float(getattr(driver, "period", PYTHON_PERIOD))
        seen = observation(self._last, set_up.DT)
        if self.rollouts and self.time >= self._next_look and hasattr(driver, "rollouts"):
            self._next_look = self.time + LOOK
            self._told.append(rollouts_of(self.time, driver.rollouts(self._own, seen, PATHS)))
        command, self._own = checked(driver, driver.act(self._own, seen))
        self._given = Command(*(float(part) for part in bounded(command)))

    def _flush(self) -> None:
        """Show the pending steps to the judge and write them."""
        if not self._pending:
            return
        record: Record = jax.tree.map(lambda *parts: np.concatenate(parts), *self._pending)
        self._pending = []
        rows = np.nonzero(record.tick % round(PERIOD / set_up.DT) == 0)[0]
        # The judge's program is of one length: the last sample is shown again.
        rows = np.append(rows, np.full(JUDGED - len(rows), rows[-1]))
        self._score, outcomes = self.prepared.task.follow(
            self._score, samples(record, rows, set_up.DT)
        )
        over = np.nonzero(outcomes != Outcome.DRIVING.code)[0]
        end = int(rows[over[0]]) + 1 if len(over) else len(record.tick)
        if self._recording is not None:
            self._recording.write(jax.tree.map(lambda leaf: leaf[:end], record))
        self._tell_turns()
        outcome = Outcome.of(self._score.outcome)
        if outcome != Outcome.DRIVING:
            self._end(outcome)
        elif self.time >= LONGEST:
            self._end(Outcome.DONE if self.prepared.task.line is None else Outcome.LATE)

    def _tell_turns(self) -> None:
        """Tell the figures of turns that have ended since the last look."""
        score = self._score
        found = turning.results(score.turns, score.handover, float(score.time))
        done = [t for t in found if t.end_s < float(score.time)]
        for number in range(self._turns, len(done)):
            turn = done[number]
            fields = {k: v for k, v in dataclasses.asdict(turn).items() if k != "handover_s"}
            touched = any(turn.begin_s - 0.3 <= t <= turn.end_s for t in self._touches)
            who = [who for at, who in self._who_at if at <= turn.begin_s][-1]
            self._told.append(
                m.Turn(
                    number=number + 1,
                    of=len(score.handover),
                    drift=turn.peak_sideslip_deg > math.degrees(DRIFT),
                    touched=touched,
                    who=who,
                    **fields,
                )
            )
        self._turns = max(self._turns, len(done))

    def _end(self, outcome: Outcome) -> None:
        """The drive is over: complete its record and say what came of it."""
        result = summary(self._score, outcome)
        name = ""
        kept = outcome != Outcome.INTERRUPTED or self.time >= SHORTEST
        if self._recording is not None:
            if kept:
                self._recording.finish(result)
                name = self._recording.folder.name
                self.finished.append(name)
            else:
                self._recording.drop()
            self._recording = None
        if self.phase in (DRIVES, PAUSED) and kept:
            self._told.append(
                m.Ended(
                    outcome=result["outcome"],
                    verdict=result["verdict"],
                    success=result["success"],
                    wall_contacts=result["wall_contacts"],
                    lap_time_s=result["lap_time_s"],
                    drifts=result["drifts"],
                    turns=len(result["turns"]),
                    run=name,
                )
            )
        self.phase = ENDED

    def close(self) -> None:
        """Break off a drive that is under way. Its record is complete."""
        if getattr(self, "phase", ENDED) in (DRIVES, PAUSED):
            self._flush()
        if getattr(self, "phase", ENDED) in (DRIVES, PAUSED):  # it may just have ended
            self._end(Outcome.INTERRUPTED)

    # ---- what there is to tell ----

    def told(self) -> list[Any]:
        """The messages since the last call: turns, the end, rollouts."""
        told, self._told = self._told, []
        return told

    @property
    def recording(self) -> bool:
        """Whether this drive is recorded."""
        return self._recording is not None

    def state(self, **clock: Any) -> m.State:
        """The car now; `clock` are the fields of `State` that only the clock knows."""
        record = self._last or self._first
        now: Record = jax.tree.map(lambda leaf: leaf[-1], record)
        motion, command = now.motion, now.command
        person = self.who == m.PERSON
        target = self._stepper.target() if person and self.setting.gyro else None
        since = int(now.tick) - 2 * TICKS
        return m.State(
            tick=self._stepper.tick,
            time_s=self.time,
            x_m=float(motion.x),
            y_m=float(motion.y),
            heading_rad=float(motion.heading),
            vx_mps=float(motion.vx),
            vy_mps=float(motion.vy),
            speed_mps=math.hypot(motion.vx, motion.vy),
            sideslip_deg=math.degrees(sideslip(motion.vx, motion.vy)),
            yaw_rate_degps=math.degrees(motion.yaw_rate),
            yaw_target_degps=None if target is None else math.degrees(target),
            steering_deg=math.degrees(motion.steering),
            steering_command_deg=math.degrees(command.steering),
            throttle=float(command.throttle),
            battery_v=float(now.voltage),
            wheels=[m.Wheel(**dict(zip(WHEEL, row, strict=True))) for row in self._forces.tolist()],
            sonar_m=[float(r.value) if r.tick >= 0 else math.nan for r in now.readings.sonar],
            sonar_new=[bool(r.tick > since and r.tick > 0) for r in now.readings.sonar],
            estimate=None if self.setting.estimate == "truth" else believed(now.estimate),
            who=self.who,
            phase=self.phase,
            wall_contacts=self._contacts,
            touching=bool(self._touches) and self.time - self._touches[-1] < TOUCHING,
            turn=int(np.isfinite(self._score.turns.begin).sum()),
            recording=self.recording,
            **clock,
        )

    def world(self, **menus: Any) -> m.World:
        """What is driven; `menus` are the fields of `World` that are of the whole cockpit."""
        setting, course = self.setting, self.setting.course
        car = self._stepper.simulator.car
        states = set_up.sensor_states(car, setting.link)
        x, y, heading = course.start
        return m.World(
            course=setting.course_name,
            car=setting.car,
            driver=setting.driver,
            estimate=setting.estimate,
            link=setting.link,
            seed=setting.seed,
            laps=setting.laps,
            battery=setting.battery,
            walls_m=course.walls.tolist(),
            line_m=course.line.tolist(),
            closed=course.closed,
            start={"x_m": x, "y_m": y, "heading_rad": heading},
            goal_m=goal_of(course, setting.laps),
            outline=outline(car),
            sonar=mounts(car),
            limit_n=set_up.wheel_limit(car),
            fastest_mps=set_up.fastest(car),
            sliders=[m.Slider(**fields) for fields in set_up.sliders_of(setting)],
            sensors=[
                m.SensorState(name=name, state=setting.sensors.get(name, "on"), states=list(known))
                for name, known in states.items()
            ],
            patches=list(setting.patches),
            gyro={"on": setting.gyro, "strength": setting.strength},
            recording=self.records,
            **menus,
        )


def note_changes(recording: Recording, time: float, before: Setting, after: Setting) -> None:
    """Note what was changed in mid-drive."""
    for path in sorted({*before.parameters, *after.parameters}):
        if before.parameters.get(path) != after.parameters.get(path):
            recording.change(time, path, after.parameters.get(path, "as before"))
    for name in sorted({*before.sensors, *after.sensors}):
        if before.sensors.get(name) != after.sensors.get(name):
            recording.sensor(time, name, after.sensors.get(name, "on"))
    if before.patches != after.patches:
        recording.change(time, "floor", [m.plain(patch) for patch in after.patches])


WHEEL = ("force_x_n", "force_y_n", "limit_n", "slip_mps", "angle_rad")


def believed(estimate: Any) -> m.Believed:
    """An estimate for the page, with the ellipse of its place."""
    xx, xy, yy = (float(part) for part in estimate.pose_covariance[:3])
    middle, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return m.Believed(
        x_m=float(estimate.x),
        y_m=float(estimate.y),
        heading_rad=float(estimate.heading),
        speed_mps=math.hypot(estimate.vx, estimate.vy),
        sideslip_deg=math.degrees(sideslip(estimate.vx, estimate.vy)),
        yaw_rate_degps=math.degrees(estimate.yaw_rate),
        longer_m=ELLIPSE * math.sqrt(max(middle + half, 0.0)),
        shorter_m=ELLIPSE * math.sqrt(max(middle - half, 0.0)),
        ellipse_rad=math.atan2(2 * xy, xx - yy) / 2,
    )


def observation(record: Record, dt: float) -> Observation:
    """What a driver in Python is told at the end of a record."""
    now: Record = jax.tree.map(lambda leaf: leaf[-1], record)
    tick = int(now.tick) + 1

    def heard(reading: Reading) -> Heard:
        age = dt * (tick - int(reading.tick)) if reading.tick >= 0 else math.inf
        return Heard(reading.value, np.float64(age))

    parts: Any = jax.tree.map(
        heard, now.readings[:-1], is_leaf=lambda node: isinstance(node, Reading)
    )
    return Observation(*(np.float64(dt * tick), *parts, now.estimate))


def rollouts_of(time: float, seen: Any) -> m.Rollouts:
    """A planner's paths; the first is its plan."""
    lines = [(float(np.nanmin(seen.cost)), seen.plan.x, seen.plan.y)]
    lines += list(zip(seen.cost.tolist(), seen.motion.x, seen.motion.y, strict=True))
    paths = [
        {"cost": cost, "x_m": [*map(float, x[::2])], "y_m": [*map(float, y[::2])]}
        for cost, x, y in lines
        if math.isfinite(cost)
    ]
    return m.Rollouts(time_s=time, paths=paths)


def goal_of(course: Course, laps: int) -> list[float] | None:
    """The goal's line across the corridor: x, y, x, y (m); None if there is none to draw."""
    if course.goal_distance is None or course.width is None or not len(course.line):
        return None
    x, y, heading = place(course, course.lap_end(laps) or 0.0)
    aside_x, aside_y = -math.sin(heading) * course.width / 2, math.cos(heading) * course.width / 2
    return [x + aside_x, y + aside_y, x - aside_x, y - aside_y]
