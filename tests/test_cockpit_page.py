"""The cockpit in a real browser, driven with real keys by a player who sees only the page."""

import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import windows
from countersteer.cockpit import messages
from countersteer.cockpit.server import Cockpit, running
from countersteer.cockpit.start import Start, cockpit
from countersteer.course.files import load_course
from countersteer.runs.files import Table, read_table
from countersteer.runs.run import read_run
from countersteer.viewing import viewer
from countersteer.viewing.style import PALETTE

PAGE = Path(messages.__file__).parent / "page"
FIRST_START = 400.0  # s: programs that are compiled for the first time
# Ways to take a corner, found by trying: m before it at which the player steers, s by which he
# looks ahead, ° that are left when he lets go, and m/s above which he gives no gas.
WAYS = [(0.9, 0.1, 40, 2.0), (1.0, 0.1, 40, 2.0), (1.3, 0.15, 40, 2.0)]
ATTEMPTS, CLOCKS = 9, (1, 0.25, 0.1)


# -------------------------------------------------------------------------------------------------
# Without a browser
# -------------------------------------------------------------------------------------------------


def scripts() -> dict[str, str]:
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(PAGE.glob("*.js"))}


def test_all_that_the_page_loads_is_there_and_comes_from_its_own_server():
    own = {path.name for path in PAGE.iterdir()} | {"shared.css"}
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    asked = re.findall(r'(?:src|href)="([^"#]+)"', page)
    assert {one for one in asked if one.startswith("/page/")} == set(asked) - {"data:,"}
    assert {one.removeprefix("/page/") for one in asked if one != "data:,"} <= own
    for name, text in scripts().items():
        for module in re.findall(r'from "([^"]+)"', text):
            if module.startswith("./"):
                assert module[2:] in own, f"{name} imports {module}"
            else:
                viewer.module(module.removeprefix("../viewer/"))
        assert "http:" not in text
        assert "https:" not in text.replace('=== "https:"', "")


def test_each_part_that_the_code_asks_for_is_in_the_page():
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    known = set(re.findall(r'id="([\w-]+)"', page))
    made = set(re.findall(r'id: "([\w-]+)"', "\n".join(scripts().values())))
    for name, text in scripts().items():
        for asked in re.findall(r'\bpart\("([\w-]+)"\)', text):
            assert asked in known | made, f"{name} asks for #{asked}"


def test_the_cockpit_draws_with_the_viewer_and_has_no_drawing_code_of_its_own():
    for name, text in scripts().items():
        assert ".beginPath(" not in text, name
        assert not re.search(r"#[0-9a-f]{6}\b", text), name
        for colour in re.findall(r'colour\("([\w-]+)"\)', text):
            assert colour in PALETTE, f"{name}: {colour}"
    drawn = "\n".join(viewer.module(name) for name in viewer.modules("stage.js"))
    for function in re.findall(r"^export function (draw\w+)\(", drawn, re.MULTILINE):
        assert not any(f"function {function}(" in text for text in scripts().values())


# -------------------------------------------------------------------------------------------------
# In Chromium
# -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cockpit")


@pytest.fixture(scope="module")
def served(browser: Any, folder: Path) -> Cockpit:
    assert browser.is_connected()  # without a browser, no server is started
    return cockpit(Start(runs=folder / "runs", courses=folder / "courses"))


@pytest.fixture(scope="module")
def address(served: Cockpit) -> Iterator[str]:
    with running(served) as found:
        yield found


Opened = Callable[..., Any]
SEEN = "({ ...document.getElementById('stage').dataset })"
TURN = "({ ...document.getElementById('last-turn').dataset })"


def until(page: Any, holds: str, seconds: float = 60) -> None:
    """Wait until a JavaScript expression holds. The page forbids Playwright's own way.

    What cannot be evaluated does not hold yet: a page that loads has not all its parts.
    """
    asked = (
        f"(() => {{ try {{ return Boolean({holds}) }} catch (error) {{ return `${{error}}` }} }})()"
    )
    end = time.monotonic() + seconds
    while (answer := page.evaluate(asked)) is not True:
        assert time.monotonic() < end, f"{holds}: {answer}, {page.evaluate(SEEN)}"
        page.wait_for_timeout(20)


def phase_is(*phases: str) -> str:
    return f"{list(phases)}.includes(document.getElementById('stage').dataset.phase)"


def role_is(role: str) -> str:
    return f"document.getElementById('role').classList.contains('{role}')"


@pytest.fixture(scope="module")
def opened(browser: Any, address: str) -> Iterator[Opened]:
    """Opens the page, which asks its own server only."""
    with windows(browser, address, "blob:", "data:") as window:

        def open_page(phone: bool = False, lesson: bool = False) -> Any:
            page = window(phone)
            if not lesson:
                page.add_init_script("localStorage.setItem('countersteer-lesson', 'yes')")
            page.goto(address)
            until(page, phase_is("ready", "drives", "paused", "ended"), FIRST_START)
            return page

        yield open_page


@pytest.fixture(scope="module")
def driving(opened: Opened) -> Any:
    """The page that drives; it is the first one."""
    return opened()


@pytest.fixture
def page(driving: Any) -> Any:
    """The page that drives, with its car at the start and the panel of the drive."""
    for key in ("ArrowUp", "ArrowLeft", "ArrowRight"):
        driving.keyboard.up(key)
    until(driving, role_is("drives"))
    driving.click("#tab-now")
    driving.keyboard.press("r")
    until(driving, phase_is("ready"))
    return driving


@pytest.fixture
def earlier(page: Any, folder: Path) -> set[str]:
    """The runs that were recorded before the test."""
    assert page.evaluate(phase_is("ready"))  # what drove before is complete
    return {path.parent.name for path in folder.glob("runs/*/run.toml")}


def finished_run(page: Any, earlier: set[str]) -> str:
    """End the drive, and give the run's name as soon as the page lists it."""
    page.keyboard.press("r")
    page.click("#tab-runs")
    newest = "document.querySelector('#run-list [data-run]')?.dataset.run"
    until(page, f"!{['', *earlier]}.includes({newest} ?? '')")
    return str(page.evaluate(newest))


class Keys:
    """The keys that a player holds; each change is a real event."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.held: set[str] = set()

    def hold(self, *wanted: str) -> None:
        for key in self.held - set(wanted):
            self.page.keyboard.up(key)
        for key in set(wanted) - self.held:
            self.page.keyboard.down(key)
        self.held = set(wanted)


def drift(page: Any, before: float, lead: float, left: float, fastest: float) -> dict[str, str]:
    """Drive into the first corner of `box` until its figures come; {} if that went wrong.

    The player knows only what the page shows: where the corner is, and the car's numbers.
    """
    keys, outgoing, turning = Keys(page), 0.0, False
    seen = {"time": "0"}
    page.keyboard.press("r")
    until(page, phase_is("ready"))
    while float(seen["time"]) < 8:
        seen, turn = page.evaluate(f"[{SEEN}, {TURN}]")
        if seen["phase"] == "ended" or seen["contacts"] != "0":
            break
        if outgoing == 0 and float(seen["corner"] or 9) < before:
            outgoing, turning = -90.0, True
        error = (float(seen["heading"]) - outgoing + 180) % 360 - 180
        error += lead * float(seen["yawRate"])
        turning = turning and error > left
        side = "ArrowRight" if turning or error > 10 else "ArrowLeft" if error < -10 else ""
        gas = float(seen["speed"]) < fastest and (turning or abs(float(seen["sideslip"])) < 12)
        keys.hold(*["ArrowUp"] * gas, *[side] * bool(side))
        if outgoing and turn.get("turn") == "1":
            keys.hold()
            return turn if turn["touched"] == "false" else {}
    keys.hold()
    return {}


def test_a_player_drifts_round_a_corner_and_keeps_a_run_that_is_marked_and_replayed(
    page, folder, earlier
):
    page.select_option("#course", "box")
    until(page, "document.getElementById('stage').dataset.course === 'box'")
    until(page, phase_is("ready"))
    assert page.locator("#record").get_attribute("aria-pressed") == "true"
    for attempt in range(ATTEMPTS):
        # Where the machine is busy and pictures come late, a slower clock helps a person too.
        page.click(f"#clock [value='{CLOCKS[attempt // len(WAYS)]}']")
        turn = drift(page, *WAYS[attempt % len(WAYS)])
        if turn and turn["drift"] == "true" and 25 < float(turn["sideslip"]) < 80:
            break
    else:
        pytest.fail(f"no drift in {ATTEMPTS} attempts")
    assert "drift" in page.locator("#banner").inner_text()
    until(page, "Number(document.getElementById('stage').dataset.time) > 2.2")
    name = finished_run(page, earlier)  # the drive is broken off, and its record is complete
    page.keyboard.press("m")
    until(page, f"document.querySelector('[data-run=\"{name}\"]').dataset.mark === 'good'")
    run = read_run(folder / "runs" / name)
    assert run.about["course"]["name"] == "box"
    assert abs(run.truth["vy_mps"]).max() > 0.5
    inputs = read_table(run.path / "inputs.csv", ("steer", "throttle"))
    assert {-1, 0} <= set(inputs["steer"])  # the key to the right, and none
    with page.context.expect_page() as replay:
        page.locator(f"[data-run='{name}']").get_by_text("Replay").click()
    replay.value.wait_for_load_state()
    assert name in replay.value.url
    until(replay.value, "document.querySelector('h1').textContent.startsWith('box, person')")
    until(replay.value, "document.getElementById('stage').width > 300")  # it is drawn
    replay.value.close()
    page.click("#clock [value='1']")


def test_two_keys_are_held_at_once_and_all_are_let_go_when_the_page_loses_the_focus(page):
    page.keyboard.down("w")
    page.keyboard.down("ArrowLeft")
    until(page, "document.querySelectorAll('.key-cap.held').length === 2")
    until(page, "Number(document.getElementById('stage').dataset.throttle) > 0.1")
    page.evaluate("dispatchEvent(new Event('blur'))")
    until(page, "Number(document.getElementById('stage').dataset.throttle) === 0")
    page.keyboard.up("w")
    page.keyboard.up("ArrowLeft")


def test_keys_in_a_field_are_not_the_cars(page):
    page.focus("#seed")
    page.keyboard.down("ArrowUp")
    page.wait_for_timeout(200)
    page.keyboard.up("ArrowUp")
    assert page.evaluate(SEEN)["phase"] == "ready"
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    assert page.locator("#help").is_visible()
    page.keyboard.press("Escape")
    assert page.locator("#help").is_hidden()
    page.focus("#tab-now")
    for name in ("tune", "sense", "paint", "runs", "draw"):
        page.keyboard.press("ArrowRight")
        assert page.locator(f"#{name}").is_visible()


def test_the_clock_stands_steps_and_slows(page):
    page.keyboard.press("[")
    until(page, "document.querySelector('#clock [aria-pressed=true]').value === '0.5'")
    page.keyboard.press("]")
    page.keyboard.down("ArrowUp")
    until(page, phase_is("drives"))
    page.keyboard.up("ArrowUp")
    page.keyboard.press(" ")
    until(page, phase_is("paused"))
    before = float(page.evaluate(SEEN)["time"])
    page.keyboard.press(".")
    until(page, f"Number(document.getElementById('stage').dataset.time) > {before}")
    assert float(page.evaluate(SEEN)["time"]) - before < 0.05


def test_a_second_page_watches(page, opened):
    other = opened()
    until(other, role_is("watches"))
    assert "watch" in other.locator("#role").inner_text()
    assert other.locator("#reset").is_disabled()
    other.keyboard.down("ArrowUp")
    other.wait_for_timeout(300)
    other.keyboard.up("ArrowUp")
    assert page.evaluate(SEEN)["phase"] == other.evaluate(SEEN)["phase"] == "ready"
    page.keyboard.down("ArrowUp")
    until(other, phase_is("drives"))
    page.keyboard.up("ArrowUp")
    other.close()


def test_a_reload_in_mid_drive_drives_on(page):
    page.keyboard.down("ArrowUp")
    until(page, "Number(document.getElementById('stage').dataset.time) > 0.2")
    page.keyboard.up("ArrowUp")
    before = float(page.evaluate(SEEN)["time"])
    page.reload()
    until(page, role_is("drives"))
    until(page, f"Number(document.getElementById('stage').dataset.time) > {before}")


@pytest.mark.usefixtures("page")
def test_a_phone_has_pads_and_fits_its_window(opened):
    phone = opened(phone=True)
    for scheme in ("light", "dark"):
        phone.emulate_media(color_scheme=scheme)
        assert phone.evaluate("document.documentElement.scrollWidth - window.innerWidth") <= 0
    assert phone.locator("#pad-steer").is_visible()
    phone.close()


@pytest.mark.usefixtures("page")
def test_the_first_visit_is_led_one_sentence_at_a_time(opened):
    visitor = opened(lesson=True)
    assert "hold it" in visitor.locator("#lesson-text").inner_text()
    visitor.click("#lesson-skip")
    visitor.reload()
    until(visitor, phase_is("ready", "drives", "paused", "ended"))
    assert visitor.locator("#lesson").is_hidden()
    visitor.close()


def test_the_car_its_sensors_and_the_floor_change_while_it_stands(page):
    page.click("#tab-tune")
    page.fill("#find-parameter", "body mass")
    mass = page.locator("#parameters .parameter:visible").first
    mass.locator("input").fill("2")
    until(page, "document.querySelector('.parameter.changed')")
    page.click("#reset-parameters")
    until(page, "!document.querySelector('.parameter.changed')")
    page.fill("#find-parameter", "")
    page.click("#tab-sense")
    page.locator("#sensors select").first.select_option("failing")
    page.locator("#sensors select").first.select_option("on")
    page.click("#tab-paint")
    box = page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 420, box["y"] + 200, steps=4)
    page.mouse.up()
    until(page, "/^[2-9] of/.test(document.getElementById('paint-count').textContent)")
    page.click("#paint-clear")
    until(page, "/^0 of/.test(document.getElementById('paint-count').textContent)")


def test_a_course_is_drawn_with_snapped_corners_undone_redone_and_saved(page, folder):
    page.click("#tab-draw")
    box = page.locator("#stage").bounding_box()

    def click(x: float, y: float) -> None:
        """Click at a place in metres."""
        at = box["x"] + box["width"] / 2 + 90 * (x - 2), box["y"] + box["height"] / 2 - 90 * y
        page.mouse.move(*at)
        page.mouse.click(*at)

    click(3.02, 0.3)  # the first straight goes to the right
    click(3.05, -1.48)
    click(4.5, -1.48)
    page.keyboard.press("Control+z")
    until(page, "document.querySelector('#draw p[role=status]').textContent.startsWith('3 points')")
    page.keyboard.press("Control+Shift+z")
    until(page, "document.querySelector('#draw p[role=status]').textContent.startsWith('4 points')")
    page.get_by_label("Name").fill("drawn here")
    page.get_by_text("Save as TOML").click()
    until(page, "document.getElementById('say').textContent.startsWith('Saved')")
    (saved,) = (folder / "courses").glob("*.toml")
    course = load_course(str(saved))
    assert course.length == pytest.approx(3.0 + 1.5 + 1.4, abs=0.15)
    assert [round(math.degrees(turn.angle)) for turn in course.turns] == [-90, 90]


def test_a_file_that_is_no_log_is_refused_in_one_line_and_a_run_that_is_dropped_is_listed(
    page, folder, tmp_path
):
    page.click("#tab-runs")
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("nothing\n")
    page.set_input_files("#upload", wrong)
    until(page, "document.getElementById('say').classList.contains('bad')")
    assert "\n" not in page.locator("#say").inner_text()
    (run, *_) = sorted(path.parent for path in (folder / "runs").glob("*/run.toml"))
    files = {
        f"other/{name.name}": name.read_text()
        for name in run.iterdir()
        if name.suffix in (".csv", ".toml", ".json")
    }
    count = page.locator("#run-list [data-run]").count()
    status = page.evaluate(
        """async (files) => {
          const { zipped } = await import("/page/archive.js");
          const body = zipped(Object.entries(files).map(([name, text]) =>
            ({ name, bytes: new TextEncoder().encode(text) })));
          const answer = await fetch("/upload?name=other.zip", { method: "POST", body });
          return [answer.status, await answer.text()];
        }""",
        files,
    )
    assert status[0] == 200, status
    until(page, f"document.querySelectorAll('#run-list [data-run]').length === {count + 1}")


THROTTLE = "Number(document.getElementById('stage').dataset.throttle)"
TIME = "Number(document.getElementById('stage').dataset.time)"
STALLED = f"""(() => {{
  const time = {TIME}, end = performance.now() + 600;
  while (performance.now() < end);
  return time;
}})()"""


@pytest.fixture
def steps(served: Cockpit, monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Of each step that the server drives: s since the page's last word, and the car's time (s)."""
    clock, words, found = served.hub.clock, [-math.inf], []
    hear, step = clock.hear, clock.session.step

    def noted_word(said: messages.Input) -> None:
        words.append(time.monotonic())
        hear(said)

    def noted_step(*arguments: Any) -> None:
        found.append((time.monotonic() - words[-1], clock.session.time))
        step(*arguments)

    monkeypatch.setattr(clock, "hear", noted_word)
    monkeypatch.setattr(clock.session, "step", noted_step)
    return found


def test_silence_of_the_page_cuts_the_throttle_within_200_ms_and_so_does_its_end(
    opened, page, steps, folder, earlier
):
    watcher = opened()
    page.keyboard.down("ArrowUp")
    until(page, f"{TIME} > 0.3")
    stalled = page.evaluate(STALLED)  # the page hangs with the key held
    until(page, f"{TIME} > {stalled} + 0.7 && {THROTTLE} > 0")
    page.close()  # in mid-drive
    closed = watcher.evaluate(TIME)
    cut = "document.getElementById('events').textContent.includes('throttle cut')"
    until(watcher, f"{TIME} > {closed} + 0.5 && {THROTTLE} === 0 && {cut}")
    until(watcher, role_is("drives"))
    name = finished_run(watcher, earlier)
    watcher.close()
    since, times = np.array(steps).T

    def at_steps(table: Table, column: str) -> np.ndarray:
        """The record has a row where something changes."""
        return table[column][np.searchsorted(table["time_s"], times + 1e-6, "right") - 1]

    run = read_run(folder / "runs" / name)
    inputs = read_table(run.path / "inputs.csv", ("time_s", "silent"))
    throttle, silent = at_steps(run.commands, "throttle"), at_steps(inputs, "silent")
    late = since > 0.2 + 0.02  # s: and a step
    for part in (times < closed, times > closed):
        assert np.any(late & part)
    assert not np.any(throttle[late])
    assert np.all(silent[late])
    assert np.any(throttle[(since < 0.1) & (times > stalled + 0.7)] > 0)  # it came back
