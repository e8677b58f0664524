"""The cockpit's server: messages, the gyroscope, drives, the clock, and who may do what."""

import contextlib
import dataclasses
import json
import random
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from countersteer.cockpit import gyro
from countersteer.cockpit import messages as m
from countersteer.cockpit.gyro import Assist, Hands, Ramps
from countersteer.cockpit.messages import encode, messages_js, parse
from countersteer.cockpit.realtime import SILENCE
from countersteer.cockpit.recordings import RunShelf
from countersteer.cockpit.server import AT_ONCE, running
from countersteer.cockpit.session import ENDED, PAUSED, READY, STEP, Session
from countersteer.cockpit.setting import Prepared, Setting, prepare
from countersteer.cockpit.start import Start, cockpit
from countersteer.course.files import load_course
from countersteer.errors import InputError
from countersteer.learning.stop_angle import without_bad
from countersteer.runs.files import read_table
from countersteer.runs.marks import read_mark, write_mark
from countersteer.runs.run import read_run
from countersteer.signals import Command
from countersteer.simulator import Simulator
from studies.cockpit_hostile import malformed

FORWARD = Hands(0.0, 1.0, 0.0)
CLOCK: dict[str, Any] = {
    "seq": 0, "page_time_ms": 0.0, "rate": 1.0, "lag_s": 0.0, "keeps": 1.0, "silent": False,
}  # fmt: skip


# ---- messages ----


def test_the_pages_module_is_that_of_the_declarations():
    page = Path(m.__file__).with_name("page") / "messages.js"
    assert page.read_text() == messages_js(), "python -m countersteer.cockpit.messages > …"


@pytest.mark.parametrize(
    "message",
    [
        m.Hello(session="abc"),
        m.Input(seq=3, steer=-1.0, throttle=1.0, source="pad"),
        m.SetUp(course="box", seed=7),
        m.Parameter(path="battery.wear", value=None),
        m.Paint(patches=[m.Patch(x_m=1.0, y_m=2.0, radius_m=0.5, friction=0.5)]),
        m.DrawCourse(action="sketch", walls=[m.Line(points_m=[[0.0, 0.0], [1.0, 0.0]])]),
    ],
)
def test_a_message_of_the_page_comes_back_as_it_was(message):
    read = parse(encode(message))
    assert json.loads(encode(read)) == json.loads(encode(message))
    assert type(read) is type(message)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not valid JSON"),
        ("[]", "one JSON object"),
        ('{"kind":"nothing"}', "no kind 'nothing'"),
        ('{"kind":{"a":1}}', "no kind"),
        ('{"kind":"input"}', "input.seq is missing"),
        ('{"kind":"input","seq":1,"steer":1.5}', r"input.steer must be a number in \[-1, 1\]"),
        ('{"kind":"input","seq":1,"steer":NaN}', "input.steer must be a number"),
        ('{"kind":"input","seq":1,"steer":true}', "input.steer must be a number"),
        ('{"kind":"input","seq":1.5}', "input.seq must be a whole number"),
        ('{"kind":"input","seq":1,"other":2}', "input: no field other"),
        ('{"kind":"control","action":"fly"}', "control.action must be one of"),
        ('{"kind":"mark","run":"a\\nb","mark":"good"}', "mark.run must be a text"),
        ('{"kind":"hello","token":"' + "x" * 101 + '"}', "hello.token must be a text"),
        ("[" * 50_000, "nested too deeply"),
        ('{"kind":"paint","patches":' + json.dumps([{}] * 17) + "}", "a list of 0 to 16 items"),
        ('{"kind":"input","seq":1' + " " * 70_000 + "}", "over 65536 characters"),
        ('{"kind":"input","seq":' + "9" * 5000 + "}", "a number is too large"),
    ],
)
def test_a_wrong_message_is_one_line(text, says):
    with pytest.raises(InputError, match=says) as error:
        parse(text)
    assert len(str(error.value)) < 300
    assert str(error.value).isprintable()


def test_hostile_messages_are_refused_or_read():
    draw, read = random.Random(5), 0
    for _ in range(3000):
        with contextlib.suppress(InputError):
            parse(malformed(draw))
            read += 1
    assert 0 < read < 3000


# ---- the gyroscope ----


def test_the_law_is_the_same_on_both_sides():
    ramps, hands = Ramps(1.0, 0.3, 0.2), Hands(0.7, 0.8, 0.0)
    for on in (0.0, 1.0):
        left = gyro.steer(Assist(gyro=on), ramps, hands, 2.0, 1.5, 0.01)
        right = gyro.steer(
            Assist(gyro=on), Ramps(-1.0, -0.3, 0.2), Hands(-0.7, 0.8, 0.0), -2.0, 1.5, 0.01
        )
        assert left[0].steering == pytest.approx(-right[0].steering)
        assert left[1].target == pytest.approx(-right[1].target)
        assert left[0].throttle == right[0].throttle


def test_a_target_is_given_up_faster_than_it_is_taken():
    hands, ramps, taken = Hands(1.0, 1.0, 0.0), Ramps(), 0
    while ramps.target < gyro.RATE:
        _, ramps = gyro.steer(Assist(), ramps, hands, 0.0, 1.0, 0.005)
        taken += 1
    given = 0
    while ramps.target > 0:
        _, ramps = gyro.steer(Assist(), ramps, Hands(), 0.0, 1.0, 0.005)
        given += 1
    assert given < taken
    assert ramps.target == 0


def test_the_limit_is_lifted_while_counter_steering():
    lock, fast = Assist().lock, 5.0
    for on in (0.0, 1.0):
        ramps, assist = Ramps(gyro.RATE, 1.0, 0.0), Assist(gyro=on, strength=2.0)
        into, _ = gyro.steer(assist, ramps, Hands(1.0), 0.1, fast, 0.005)
        against, _ = gyro.steer(assist, Ramps(-gyro.RATE, -1.0, 0.0), Hands(-1.0), 9.0, fast, 0.005)
        assert into.steering < 0.7 * lock
        assert against.steering == pytest.approx(-lock)


def test_the_gyroscope_counter_steers_without_a_key():
    command, _ = gyro.steer(Assist(), Ramps(), Hands(), 3.0, 2.0, 0.005)
    assert command.steering < -0.3
    without, _ = gyro.steer(Assist(gyro=0.0), Ramps(), Hands(), 3.0, 2.0, 0.005)
    assert without.steering == 0


def test_the_law_is_one_for_floats_and_for_jax():
    arguments = (Assist(), Ramps(1.0, 0.5, -0.2), Hands(-0.5, 0.0, 1.0), -2.0, 2.5, 0.01)
    plain, traced = gyro.steer(*arguments), jax.jit(gyro.steer)(*arguments)
    np.testing.assert_allclose(jax.tree.leaves(plain), jax.tree.leaves(traced), atol=1e-12)


# ---- drives ----


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(Setting(load_course("box"), "box"))


@pytest.fixture
def seat(prepared: Prepared, tmp_path: Path) -> Iterator[Session]:
    made = Session(prepared, tmp_path)
    yield made
    made.close()


def go(seat: Session, seconds: float, hands: Hands = FORWARD, **more: Any) -> None:
    seat.start()
    for _ in range(round(seconds / STEP)):
        seat.step(hands, **more)


def test_a_person_drives_and_the_folder_is_a_run_like_any_other(seat, tmp_path):
    go(seat, 0.8)
    go(seat, 0.5, Hands(-1.0, 1.0, 0.0), seq=7, source=1)
    seat.hand_over(m.DRIVER)
    go(seat, 1.2)
    state = seat.state(**CLOCK)
    assert state.speed_mps > 0.5
    assert state.phase == "drives"
    assert state.who == m.DRIVER
    seat.close()
    (name,) = seat.finished
    run = read_run(tmp_path / name)
    assert run.outcome == "interrupted"
    assert run.about["driver"] == "person and drift-turn"
    assert run.about["driven_by"] == [
        {"from_s": 0.0, "who": "person"}, {"from_s": 1.3, "who": "drift-turn"},
    ]  # fmt: skip
    assert run.truth["time_s"][-1] == pytest.approx(2.495)
    assert run.truth["x_m"][-1] == pytest.approx(state.x_m, abs=0.05)
    inputs = read_table(tmp_path / name / "inputs.csv", ("time_s",))
    assert inputs["steer"].tolist() == [0, -1, 0]
    assert inputs["driver"].tolist() == [0, 0, 1]
    assert (inputs["seq"][1], inputs["source"][1]) == (7, 1)


def test_the_commands_of_a_person_drive_the_ordinary_simulator_the_same(seat, tmp_path):
    go(seat, 0.8)
    go(seat, 1.3, Hands(-0.5, 1.0, 0.0))
    seat.close()
    run = read_run(tmp_path / seat.finished[0])
    simulator, every = Simulator.of(load_course("box"), run.car), 5
    loop = simulator.init()
    for tick in range(0, 2000, every):
        row = np.searchsorted(run.commands["time_s"], tick * simulator.dt + 1e-6) - 1
        command = Command(run.commands["throttle"][row], run.commands["steering"][row])
        loop, _ = simulator.apply(loop, command, every)
    at = np.searchsorted(run.truth["time_s"], 2.0 - 1e-6)
    assert loop.state.motion.x == pytest.approx(run.truth["x_m"][at], abs=1e-4)
    assert loop.state.motion.yaw_rate == pytest.approx(run.truth["yaw_rate_radps"][at], abs=1e-3)
    assert abs(run.truth["yaw_rate_radps"][at]) > 0.2


def test_the_driver_goes_round_and_the_judge_is_told_live(seat):
    seat.hand_over(m.DRIVER)
    seat.start()
    told: list[Any] = []
    while seat.phase != ENDED and seat.time < 12:
        seat.step(Hands())
        told += seat.told()
    turns = [one for one in told if isinstance(one, m.Turn)]
    assert [turn.number for turn in turns] == [1, 2, 3, 4]
    assert all(turn.drift and not turn.touched and turn.who == m.DRIVER for turn in turns)
    assert told[-1].success
    assert told[-1].run == seat.finished[0]


def test_a_cut_throttle_is_zero_in_the_same_step(seat):
    go(seat, 0.5)
    assert seat.state(**CLOCK).throttle > 0.3
    seat.step(FORWARD, cut=True)
    assert seat.state(**CLOCK).throttle == 0


def test_the_clock_waits_for_the_person_and_can_be_stopped(seat):
    assert seat.phase == READY
    go(seat, 0.2)
    seat.pause()
    assert seat.phase == PAUSED
    seat.reset()
    assert (seat.time, seat.phase) == (0.0, READY)
    assert seat.finished == [], "a drive of 0.2 s is not kept"


def test_the_car_and_the_floor_change_in_mid_drive(seat, tmp_path):
    go(seat, 0.6)
    setting = seat.setting
    patch = m.Patch(x_m=2.0, y_m=0.0, radius_m=5.0, friction=0.1)
    assert seat.change(
        dataclasses.replace(setting, patches=(patch,), parameters={"battery.wear": 0.9})
    )
    slippery = seat.state(**CLOCK).wheels[0].limit_n
    go(seat, 0.5)
    assert seat.state(**CLOCK).wheels[0].limit_n < 0.3 * slippery
    assert seat.change(dataclasses.replace(seat.setting, sensors={"gyroscope": "off"}))
    go(seat, 1.0)
    assert not seat.change(
        dataclasses.replace(seat.setting, parameters={"sensors.gyroscope.rate_hz": 50.0})
    )
    with pytest.raises(InputError, match="outside its range"):
        seat.change(dataclasses.replace(seat.setting, parameters={"body.mass_kg": -1.0}))
    seat.close()
    about = read_run(tmp_path / seat.finished[0]).about
    assert [change["what"] for change in about["changes"]] == [
        "battery.wear", "floor", "sensor gyroscope",
    ]  # fmt: skip
    assert about["faults"][0]["kind"] == "dead"


def test_a_driver_in_python_can_be_handed_over_to(prepared):
    class Straight:
        period = 0.02

        def reset(self, key: Any) -> int:
            return 0

        def act(self, memory: int, seen: Any) -> Any:
            assert seen.time == pytest.approx(0.02 * (memory + 1), abs=0.011)
            return (0.5, 0.0), memory + 1

    seat = Session(prepared._replace(own=Straight()), None, recording=False)
    seat.hand_over(m.DRIVER)
    go(seat, 0.5)
    assert seat._given == (0.5, 0.0)


# ---- the server ----


class Client:
    """A page: its socket, and what it has been told."""

    def __init__(self, address: str, **hello: str) -> None:
        self.address, self.seq = address, 0
        self._open = contextlib.ExitStack()
        self.socket: ClientConnection = self._open.enter_context(
            connect(address.replace("http", "ws") + "/ws", origin=address, max_size=None)
        )
        self.say(kind="hello", **hello)

    def say(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def input(self, **axes: float) -> None:
        self.seq += 1
        self.say(kind="input", seq=self.seq, **axes)

    def until(self, kind: str, holds: Callable[[Any], bool] = lambda _: True) -> Any:
        """The first message of a kind that holds, among the next thousand."""
        for _ in range(1000):
            found = json.loads(self.socket.recv(timeout=120))
            if found["kind"] == kind and holds(found):
                return found
        raise AssertionError(f"no {kind} came")

    def throttle(self, seconds: float) -> Any:
        """Hold the throttle for a time of the car. Gives the last state."""
        self.input(throttle=1.0)
        first = self.until("state", lambda s: s["phase"] == "drives")
        while True:
            self.input(throttle=1.0)
            state = self.until("state")
            if state["time_s"] > first["time_s"] + seconds:
                return state

    def close(self) -> None:
        self._open.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory: Any) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("cockpit")
    with running(cockpit(Start(runs=folder / "runs", courses=folder / "courses"))) as found:
        yield found


def drives(welcome: Any) -> bool:
    return bool(welcome["role"] == "drives")


@pytest.fixture(scope="module")
def last() -> dict[str, str]:
    """The session of the last page that drove: who has it drives on at once."""
    return {"key": ""}


@pytest.fixture
def page(address: str, last: dict[str, str]) -> Iterator[Client]:
    made = Client(address, session=last["key"])
    last["key"] = made.until("welcome", drives)["session"]
    made.say(kind="control", action="reset")
    made.until("state", lambda s: s["phase"] == "ready")
    yield made
    made.close()


def test_a_page_drives_the_car_and_its_input_comes_back(page):
    state = page.throttle(0.4)
    assert state["speed_mps"] > 0.1
    assert state["seq"] > 0
    assert len(encode(m.Error(text="x"))) < len(json.dumps(state)) < 2000


def test_a_silent_page_loses_its_throttle_within_200_ms(page):
    page.throttle(0.3)
    page.input(throttle=1.0)
    felt = page.until("state", lambda s: s["seq"] == page.seq)
    assert felt["throttle"] > 0
    quiet = page.until("state", lambda s: s["silent"])
    assert quiet["throttle"] == 0
    # The car's clock goes ahead of the wall's only where it catches up; a state comes each 20 ms.
    assert quiet["time_s"] - felt["time_s"] < SILENCE + 0.04 + felt["lag_s"]
    assert SILENCE < 0.2
    page.input(throttle=1.0)
    page.until("event", lambda e: e["what"] == "heard")


def test_a_second_page_watches_until_the_first_has_gone(address, page):
    page.throttle(0.1)
    other = Client(address)
    assert other.until("welcome")["role"] == "watches"
    other.input(throttle=1.0)
    assert "watches" in other.until("error")["text"]
    assert other.until("state")["phase"] == "drives"
    other.close()


def test_a_page_that_is_loaded_again_drives_on(address, page, last):
    page.throttle(0.2)
    page.close()
    stranger = Client(address)
    again = Client(address, session=last["key"])
    assert again.until("welcome")["role"] == "drives"
    assert again.until("state")["time_s"] > 0.2
    assert stranger.until("welcome")["role"] == "watches"
    stranger.close()
    again.close()


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_another_origin_is_refused_before_the_socket_opens(address, origin):
    with pytest.raises(InvalidStatus, match="403"):
        connect(address.replace("http", "ws") + "/ws", origin=origin)


def test_a_name_that_was_pointed_here_is_refused(address):
    asked = urllib.request.Request(address, headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(asked)


def test_a_wrong_token_is_refused(tmp_path):
    with running(cockpit(Start(runs=tmp_path), token="right")) as address:
        wrong = Client(address, token="wrong")
        assert "token" in wrong.until("error")["text"]
        with pytest.raises(ConnectionClosed):
            wrong.socket.recv(timeout=10)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{address}/report/some")
        right = Client(address, token="right")
        assert right.until("welcome")["role"] == "drives"
        right.close()


@pytest.mark.parametrize(
    "name", ["/page/server.py", "/page/..%2fserver.py", "/viewer/nothing.js", "/run/..%2f..json"]
)
def test_no_file_is_reached_but_those_that_are_listed(address, name):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(address + name)


@pytest.mark.parametrize(
    "wanted", [{"driver": "own.py:Car"}, {"car": "/etc/passwd"}, {"course": "../box.toml"}]
)
def test_the_page_names_only_what_is_on_a_menu(page, wanted):
    page.say(kind="set_up", **wanted)
    assert "there is no" in page.until("error")["text"]


def test_a_slider_changes_the_car_and_the_page_is_told(page):
    def mass(world: Any) -> Any:
        return next(s for s in world["sliders"] if s["path"] == "body.mass_kg")

    page.say(kind="parameter", path="body.mass_kg", value=2.0)
    changed = mass(page.until("world", lambda w: mass(w)["value"] == 2.0))
    assert changed["live"]
    assert changed["first"] < 2.0
    page.say(kind="parameter", path="body.mass_kg", value=None)
    page.until("world", lambda w: mass(w)["value"] == changed["first"])
    page.say(kind="parameter", path="body.mass_kg", value=-1.0)
    assert "body.mass_kg must be in" in page.until("error")["text"]


def test_hostile_messages_and_a_flood_leave_the_next_drive_as_it_was(address, page, last):
    draw = random.Random(6)
    for _ in range(300):
        page.socket.send(malformed(draw).replace("control", "contrary"))
    for _ in range(2 * AT_ONCE):
        page.socket.send("{" * 20)
    page.until("error", lambda e: "too many messages" in e["text"])
    page.close()
    after = Client(address, session=last["key"])
    after.until("welcome", drives)
    after.say(kind="set_up", course="box", car="rx7", driver="drift-turn", seed=0, laps=1)
    after.say(kind="control", action="reset")
    after.until("state", lambda s: s["phase"] == "ready")
    assert after.throttle(0.3)["speed_mps"] > 0.05
    after.close()


def test_runs_are_marked_trimmed_shown_and_taken_in(address, page):
    page.say(kind="hand_over", to="driver")
    page.until("turn")
    page.until("turn")
    page.say(kind="control", action="reset")
    run = page.until("runs", lambda r: r["new"])["new"]
    page.say(kind="hand_over", to="person")
    page.say(kind="mark", run=run, mark="good")
    assert page.until("runs")["runs"][0]["mark"] == "good"
    page.say(kind="trim", run=run, turn=1)
    short = page.until("runs", lambda r: r["new"])["new"]
    assert short == f"{run}-turn-1"
    view = json.loads(urllib.request.urlopen(f"{address}/run/{short}.json").read())
    assert view["runs"][0]["summary"]["turns"][0]["begin_s"] == pytest.approx(1.0)
    packed = urllib.request.urlopen(f"{address}/download/{run}").read()
    asked = urllib.request.Request(
        f"{address}/upload?name=dropped.zip", data=packed, headers={"Origin": address}
    )
    assert b"in the list" in urllib.request.urlopen(asked).read()
    page.say(kind="ask_ghost", of="run", run="dropped")
    assert len(page.until("ghost")["time_s"]) > 10
    for path, says in (("bad.zip", "no ZIP"), ("x.exe", "drop a run"), ("..%2fx.zip", "no ZIP")):
        asked = urllib.request.Request(
            f"{address}/upload?name={path}", data=b"PK", headers={"Origin": address}
        )
        with pytest.raises(urllib.error.HTTPError) as error:
            urllib.request.urlopen(asked)
        assert says in error.value.read().decode()


def test_a_drawn_course_is_looked_at_saved_and_driven(page):
    drawn = {
        "kind": "draw_course", "name": "my bend", "width_m": 1.4,
        "segments": [{"straight_m": 3}, {"turn_deg": 90}, {"straight_m": 3}],
    }  # fmt: skip
    page.say(**drawn, action="sketch")
    assert page.until("sketch")["length_m"] == pytest.approx(6)
    page.say(**drawn, action="drive")
    assert page.until("world", lambda w: w["course"] == "my bend")["walls_m"]
    page.say(**drawn | {"name": "../up"}, action="save")
    assert "name" in page.until("error")["text"]
    page.say(kind="set_up", course="box")
    page.until("world", lambda w: w["course"] == "box")


def test_learn_leaves_out_runs_that_are_marked_bad(tmp_path):
    good, bad, table = (tmp_path / name for name in ("good", "bad", "turns.csv"))
    for folder, mark in ((good, "good"), (bad, "bad")):
        folder.mkdir()
        write_mark(folder, mark)
    assert without_bad([good, bad, table]) == [good, table]
    with pytest.raises(InputError, match="marked bad"):
        without_bad([bad])
    write_mark(bad, "none")
    assert without_bad([bad]) == [bad]


def test_marks_and_lists_survive_damage(tmp_path):
    shelf = RunShelf(tmp_path / "none")
    assert shelf.items() == []
    with pytest.raises(InputError, match="there is no"):
        shelf.path("../tmp")
    folder = tmp_path / "runs" / "a"
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text("course = 3")
    (folder / "mark.toml").write_text("mark = 'splendid'")
    assert RunShelf(tmp_path / "runs").items() == []
    with pytest.raises(InputError, match="good or bad"):
        read_mark(folder)
