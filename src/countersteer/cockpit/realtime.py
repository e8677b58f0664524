"""The car's clock beside the wall clock, in a thread of its own.

The thread steps a `Session` when a step is due, carries out orders between two steps, and says what
there is to tell. A page that falls silent loses its throttle. Nothing here imports JAX, so that a
page can be served while JAX is being loaded.
"""

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from countersteer.cockpit import messages as m
from countersteer.errors import InputError
from countersteer.reading.values import short

if TYPE_CHECKING:
    from countersteer.cockpit.session import Session
    from countersteer.cockpit.setting import Setting
    from countersteer.course.course import Course

SILENCE = 0.18  # s without input, after which the throttle is cut: it is zero within 0.2 s
IDLE = 0.2  # s between two states while the clock stands
STATES = 2  # steps between two states
BEHIND = 0.1  # s; a clock that lags by more goes on from there
LAGS = 1.0  # s of lagging after which it is said
AGAIN = 10.0  # s before it is said again
PATIENCE = 10.0  # s, for the thread to end
SETTLE = 0.1  # s between two changes of the car
DRIVES, READY, PAUSED = "drives", "ready", "paused"  # as in `session`

Answer = Callable[[Any], None]  # takes a message for one page


class Held(NamedTuple):
    """The last input of the page that drives."""

    axes: tuple[float, float, float] = (0.0, 0.0, 0.0)  # steer, throttle, brake
    seq: int = -1
    source: int = 0
    page_time_ms: float = 0.0
    at: float = float("-inf")  # of the wall clock, s


class Finished(NamedTuple):
    """The folder of a drive is complete."""

    run: str


class RealTime:
    """A session on the wall clock. `say` gets each message for all pages, in the thread."""

    def __init__(
        self,
        make: Callable[[], "Session"],
        say: Callable[[Any], None],
        menus: Callable[[], dict[str, Any]],
        load_course: Callable[[str], "Course"],
    ) -> None:
        """Nothing runs before `start`.

        `make` makes the session, `menus` are those of `World`, and `load_course` is by their names.
        """
        self._make, self._say, self._menus, self._load = make, say, menus, load_course
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cockpit", daemon=True)
        self._closing = False
        self.made = threading.Event()  # the session is there, or there will be none
        self.held = self._felt = Held()
        self.failed: str | None = None  # why there is no session
        self.rate = 1.0
        self._silent = False
        self._world_due = False

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Complete the record and end the thread. What is being compiled is not waited for long."""
        self._closing = True
        self._wake.set()
        if self.made.is_set():
            self._thread.join(PATIENCE)

    def hear(self, said: m.Input) -> None:
        """Take an input of the page that drives. It is felt in the next step."""
        axes = (said.steer, said.throttle, said.brake)
        source = m.SOURCES.index(said.source)
        self.held = Held(axes, said.seq, source, said.page_time_ms, time.monotonic())
        if any(axes) and self._waits:
            self._wake.set()

    def release(self) -> None:
        """The page that drives is gone: hands off."""
        self.held = Held()

    def post(self, job: Callable[[], None]) -> None:
        """Have a job done in the thread, between two steps."""
        self._jobs.append(job)
        self._wake.set()

    def order(self, message: Any, answer: Answer) -> None:
        """Have an order of the page carried out. `answer` gets an `Error`, where it is wrong."""

        def job() -> None:
            try:
                self._carry_out(message, answer)
            except InputError as error:
                answer(m.Error(text=short_line(error)))

        self.post(job)

    # ---- in the thread ----

    _waits = True

    def _run(self) -> None:
        self._say(m.Busy(text="Loading the simulator"))
        try:
            self.session = self._make()
        except InputError as error:
            self.failed = short_line(error)
            self._say(m.Busy(text=self.failed))
            return
        finally:
            self.made.set()
        self._wanted: Setting = self.session.setting
        self._asker: Answer = lambda _: None
        self._settled = 0.0
        self._say(m.Busy(text=""))
        self._tell_world()
        self._from()
        try:
            while not self._closing:
                self._guarded_round()
        except Exception as error:
            self.failed = f"The simulator has stopped: {short_line(error)}. Start it again."
            self._say(m.Busy(text=self.failed))
            raise
        finally:
            self.session.close()
            self._tell()

    def _guarded_round(self) -> None:
        """A round. A driver that fails, or a full disk, pauses the drive and is told."""
        try:
            self._round()
        except (InputError, OSError) as error:
            self.session.pause()
            self.session.hand_over(m.PERSON)
            self._tell_event("note", short_line(error))

    def _from(self) -> None:
        """Count the clock from here."""
        self._wall, self._car = time.monotonic(), self.session.time
        self._lag, self._lags_since, self._said_at = 0.0, 0.0, -AGAIN
        self._busy = 0.0  # s of computing in a step, smoothed
        self._silent = False

    def _round(self) -> None:
        """Orders, then one step if it is due, or else a wait."""
        while self._jobs:
            self._jobs.popleft()()
        now = time.monotonic()
        if self._wanted is not self.session.setting and now - self._settled > SETTLE:
            self._settle()
        if self.session.phase == READY and any(self.held.axes) and not self._is_silent(now):
            self.session.start()
            self._from()
        self._waits = self.session.phase != DRIVES
        if self._waits:
            self._publish(now)
            self._wake.wait(IDLE)
            self._wake.clear()
            self._from()
            return
        due = self._wall + (self.session.time - self._car) / self.rate
        if now < due:
            self._wake.wait(due - now)
            self._wake.clear()
            return
        self._keep_up(now, now - due)
        self._advance(now)

    def _keep_up(self, now: float, lag: float) -> None:
        """Note how far the clock is behind. Say so when it stays behind."""
        self._lag = max(lag, 0.9 * self._lag)
        if lag < BEHIND / 2:
            self._lags_since = now
        elif now - max(self._lags_since, self._said_at + AGAIN) > LAGS:
            self._said_at = now
            self._tell_event(
                "lag",
                f"This machine keeps {self._keeps():.1f} of real time: choose a slower clock.",
            )
        if lag > BEHIND:
            self._wall += lag - BEHIND

    def _keeps(self) -> float:
        """The fastest rate of the clock that this machine keeps."""
        return min(self._step / self._busy, 99.0) if self._busy else 99.0

    @property
    def _step(self) -> float:
        from countersteer.cockpit.session import STEP

        return STEP

    def _is_silent(self, now: float) -> bool:
        return now - self.held.at > SILENCE

    def _advance(self, now: float) -> None:
        """One step with what the hands do."""
        from countersteer.cockpit.gyro import Hands

        session, held = self.session, self.held
        silent = session.who == m.PERSON and self._is_silent(now)
        if silent != self._silent:
            self._silent = silent
            if silent:
                self._tell_event("silence", "No input for 200 ms: the throttle is zero.")
            elif session.who == m.PERSON:
                self._tell_event("heard", "Input is back.")
        self._felt = held
        axes = (0.0, 0.0, 0.0) if silent else held.axes
        session.step(Hands(*axes), silent, held.seq, held.source)
        self._tell()
        if round(session.time / self._step) % STATES == 0 or session.phase != DRIVES:
            self._publish(now)
        took = time.monotonic() - now
        self._busy = took if not self._busy else 0.98 * self._busy + 0.02 * took

    def _publish(self, now: float) -> None:
        state = self.session.state(
            seq=self._felt.seq,
            page_time_ms=self._felt.page_time_ms,
            rate=self.rate,
            lag_s=self._lag,
            keeps=self._keeps(),
            silent=self._silent and self.session.phase == DRIVES,
        )
        self._say(state)
        if self._world_due and now - self._settled > SETTLE:
            self._tell_world()

    def _tell(self) -> None:
        for message in self.session.told():
            self._say(message)
        finished, self.session.finished = self.session.finished, []
        for name in finished:
            self._say(Finished(name))

    def _tell_event(self, what: str, text: str) -> None:
        self._say(m.Event(what=what, text=text))

    def _tell_world(self) -> None:
        self._world_due = False
        self._say(self.session.world(**self._menus()))

    # ---- orders ----

    def _carry_out(self, message: Any, answer: Answer) -> None:
        session = self.session
        if isinstance(message, m.Control | m.HandOver) and self._wanted is not session.setting:
            self._settle()  # orders are carried out in their order
        if isinstance(message, m.Control):
            self._control(message)
        elif isinstance(message, m.HandOver):
            session.hand_over(message.to)
            if message.to == m.DRIVER:
                session.start()
                self._from()
            name = session.setting.driver if message.to == m.DRIVER else "you"
            self._tell_event("hand_over", f"Driving: {name}.")
        elif isinstance(message, m.Record):
            session.records = message.on
            self._tell_event("recording", "From the next start on.")
            self._tell_world()
        elif isinstance(message, m.AskRollouts):
            session.rollouts = message.on
        elif isinstance(message, m.AskGhost):
            self._ghost()
        else:
            self._asker = answer
            self._change(message)

    def _control(self, message: m.Control) -> None:
        session = self.session
        if message.action == "reset":
            session.reset()
            self._tell()
            self._publish(time.monotonic())
        elif message.action == "pause":
            session.pause()
        elif message.action == "go":
            session.start()
        elif message.action == "slow":
            self.rate = message.value
        elif message.action == "step" and session.phase in (READY, PAUSED):
            session.start()
            for _ in range(STATES):
                if session.phase == DRIVES:
                    self._advance(time.monotonic())
            session.pause()
        self._from()

    def _ghost(self) -> None:
        """Have the driver drive the setting by itself, beside the drive, as a ghost."""
        from countersteer.cockpit.ghost import drive_alone

        prepared, setting = self.session.prepared, self.session.setting

        def drive() -> None:
            try:
                self._say(drive_alone(prepared, setting))
            except InputError as error:
                self._tell_event("note", short_line(error))

        threading.Thread(target=drive, daemon=True).start()

    def _change(self, message: Any) -> None:
        """Note what is wanted of the setting. It is made so by `_settle`."""
        from countersteer.cockpit import orders

        if isinstance(message, m.SetUp):
            self._check_names(message)
            course = self._load(message.course) if message.course else None
            self._wanted = orders.set_up(self._wanted, message, course)
        else:
            self._wanted = orders.wanted(self._wanted, message)

    def _check_names(self, message: m.SetUp) -> None:
        """Raise `InputError` for a name that is on no menu: others might be files of any kind."""
        menus = self._menus()
        for what in ("course", "car", "driver"):
            name = getattr(message, what)
            if name and name not in {item.name for item in menus[f"{what}s"]}:
                raise InputError(f"{what}: there is no {name}")

    def _settle(self) -> None:
        """Make the setting as it is wanted, in mid-drive where that can be."""
        from countersteer.cockpit.setting import prepare

        self._settled = time.monotonic()
        before, after = self.session.setting, self._wanted
        try:
            if not (same_drive(before, after) and self.session.change(after)):
                self._say(m.Busy(text="Preparing the drive"))
                try:
                    self.session.use(prepare(after))
                finally:
                    self._tell()
                    self._say(m.Busy(text=""))
                self._tell_world()
            self._world_due = True
        except InputError as error:
            self._asker(m.Error(text=short_line(error)))
            self._world_due = True  # the page shows what holds
        self._wanted = self.session.setting
        self._from()


LIVE = ("parameters", "sensors", "patches", "gyro", "strength")  # of a setting


def same_drive(before: "Setting", after: "Setting") -> bool:
    """Whether two settings differ in what can be changed in mid-drive only."""
    return all(
        getattr(before, field.name) == getattr(after, field.name)
        for field in dataclasses.fields(before)
        if field.name not in (*LIVE, "course")
    ) and (before.course is after.course)


def short_line(error: Exception) -> str:
    """An error in one line for the page."""
    return (
        short(" ".join(str(error).split()))
        if len(str(error)) > 300
        else " ".join(str(error).split())
    )
