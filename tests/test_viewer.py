"""The report in a real browser: opened, zoomed, panned and played by real events."""

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from conftest import DESKTOP, PHONE, windows
from countersteer import cli
from countersteer.errors import InputError
from countersteer.recorded_drive import Watched
from countersteer.runs.files import Table
from countersteer.runs.run import Run, read_run
from countersteer.viewing import viewer
from countersteer.viewing.page import FOLDER as TEMPLATES
from countersteer.viewing.picture import draw_picture
from countersteer.viewing.report import pack, report_html
from countersteer.viewing.side_by_side import differences, with_places
from countersteer.viewing.style import PALETTE
from countersteer.viewing.view import COLUMNS, POSE, events, is_simulated, view_of

DATA = Path(__file__).parents[2] / "shared" / "data"
DART = "dart/drift_tape_and_tiles/car_1_Datarecording_09_09_2024_18_13_59drifting_clockwise.csv"
HOSTILE = "</script><script>alert(1)</script><b>{{view}}"


def made_view(name: str = "made", speed: float = 1.0) -> dict[str, Any]:
    """Two seconds on a circle of 1 m, with all that a view can hold."""
    time = np.arange(0, 2, 0.01)
    angle, wave = speed * time, np.sin(time)
    wheel = {
        "force_x_n": 2 * wave,
        "force_y_n": 3 * np.cos(time),
        "limit_n": np.full(len(time), 4.0),
        "slip_mps": np.abs(wave),
        "angle_rad": np.full(len(time), 0.1),
    }
    hubs = [(0.12, 0.05), (0.12, -0.05), (-0.12, 0.05), (-0.12, -0.05)]
    turn = {
        "begin_s": 0.5, "end_s": 1.2, "entry_speed_mps": 2.0, "peak_sideslip_deg": 40.0,
        "peak_yaw_rate_degps": 250.0, "heading_error_deg": -2.0, "duration_s": 0.7,
    }  # fmt: skip
    pose = {"x_m": np.cos(angle), "y_m": np.sin(angle), "heading_rad": angle + math.pi / 2}
    known = {
        "speed_mps": np.full(len(time), speed),
        "sideslip_deg": 30 * wave,
        "yaw_rate_degps": np.full(len(time), 57.0 * speed),
    }
    ellipse = {"longer_m": 0.2, "shorter_m": 0.1, "ellipse_rad": 0.5}
    path = {"cost": 1.0, "x_m": np.array([1.0, 0.9]), "y_m": np.array([0.0, 0.5])}
    return {
        "title": f"{name} {HOSTILE}",
        "name": name,
        "facts": [("Command", f"countersteer drive {HOSTILE}"), ("Car", "rx7")],
        "summary": {
            "completed": True, "outcome": "goal reached", "wall_contacts": 0, "lap_time_s": 2.0,
            "turns": [turn],
        },
        "walls_m": [[-2, -2, 2, -2], [2, -2, 2, 2], [2, 2, -2, 2], [-2, 2, -2, -2]],
        "car": {
            "length_m": 0.4, "width_m": 0.17, "center_x_m": 0.0,
            "wheels": [{"x_m": x, "y_m": y, "radius_m": 0.03, "width_m": 0.026} for x, y in hubs],
        },
        "sonar": [
            {
                "name": "front", "x_m": 0.2, "y_m": 0.0, "angle_deg": 0.0, "half_angle_deg": 20.0,
                "time_s": np.array([0.1, 0.2]), "distance_m": np.array([1.0, np.inf]),
            }
        ],
        "time_s": time,
        **pose,
        **known,
        "steering_deg": 5 * wave,
        "steering_command_deg": 6 * wave,
        "throttle": np.full(len(time), 0.4),
        "battery_v": 9.6 - 0.1 * time,
        "wheels": [wheel] * 4,
        "estimate": {"time_s": time, **pose, **known}
        | {key: np.full(len(time), value) for key, value in ellipse.items()},
        "events": [
            {"kind": "fault", "label": HOSTILE, "from_s": 0.9, "to_s": 1.1},
            {"kind": "lost", "label": "command lost", "from_s": 1.5, "to_s": 1.6},
        ],
        "rollouts": [{"time_s": 0.95, "paths": [path, path | {"cost": 2.0}]}],
    }  # fmt: skip


def write_log(folder: Path, velocities: bool) -> Path:
    """The run of a real car: four seconds on a circle at 1 m/s with 20° of sideslip."""
    folder.mkdir()
    (folder / "run.toml").write_text("car_name = 'rx7'\nlog_format = 'dart'\nsource = 'a.csv'\n")
    (folder / "commands.csv").write_text(
        "time_s,throttle,direction,steering_deg\n0,0.4,forward,10\n2,0.2,forward,-10\n"
    )
    (folder / "telemetry.csv").write_text("time_s,gyro_radps,armed\n0,1,0\n1,1,1\n4,1,1\n")
    slip = math.radians(20)
    time = np.arange(0, 4, 0.01)
    columns = {
        "time_s": time, "x_m": np.cos(time), "y_m": np.sin(time),
        "heading_rad": time + math.pi / 2 - slip,
    }  # fmt: skip
    if velocities:
        still = np.ones(len(time))
        columns |= {"vx_mps": math.cos(slip) * still, "vy_mps": math.sin(slip) * still}
        columns |= {"yaw_rate_radps": still}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    (folder / "truth.csv").write_text("\n".join(lines) + "\n")
    return folder


# -------------------------------------------------------------------------------------------------
# Without a browser
# -------------------------------------------------------------------------------------------------


def scripts() -> dict[str, str]:
    return {name: viewer.module(name) for name in viewer.modules("report.js")}


def test_each_module_is_in_the_page_once_and_no_page_has_code_of_its_own():
    files = {file.name for file in viewer.FOLDER.iterdir() if file.name.endswith(".js")}
    assert files | {"look.js"} == set(scripts())
    page = report_html(made_view())
    for name, text in scripts().items():
        exported = re.findall(r"^export (\w+ \w+)", text, re.MULTILINE)
        assert exported or name == "report.js"
        for one in exported:
            assert len(re.findall(rf"^{one}\b", page, re.MULTILINE)) == 1, one
    bundle = viewer.bundle("report.js")
    assert not re.search(r"^(import|export)\b", bundle, re.MULTILINE)
    assert "</script" not in bundle
    for template in TEMPLATES.iterdir():
        if template.name.endswith(".html"):
            for inside in re.findall(r"<script[^>]*>(.*?)</script>", template.read_text(), re.S):
                assert inside.strip() in ("{{view}}", "{{viewer}}"), template.name


def test_names_are_unique_among_modules_so_that_their_texts_can_follow_each_other():
    declared = re.compile(
        r"^(?:export )?(?:async )?(?:function|class|const|let) (\w+)|^const [^;]*?, (\w+) =",
        re.MULTILINE,
    )
    homes: dict[str, list[str]] = {}
    for module, text in scripts().items():
        for match in declared.finditer(text):
            for name in filter(None, match.groups()):
                homes.setdefault(name, []).append(module)
    assert len(homes) > 80
    assert not {name: where for name, where in homes.items() if len(where) > 1}


def test_no_drawing_code_stands_twice():
    """No four lines in a row, or function's body, are in two places, up to names and numbers."""
    seen: dict[str, str] = {}
    for module, text in scripts().items():
        if module == "look.js":
            continue
        lines = [
            re.sub(r"\b\d[\d.]*\b|[\"'`][^\"'`]*[\"'`]", "#", line.strip())
            for line in text.splitlines()
            if line.strip() and not line.strip().startswith(("//", "*", "/*", "import", "}"))
        ]
        for i in range(len(lines) - 3):
            four = "\n".join(lines[i : i + 4])
            assert four not in seen, f"{module} and {seen[four]}:\n{four}"
            seen[four] = module
    # What is drawn through a camera is drawn by the pen: no other module has a path of its own,
    # but for those in pixels.
    own = {name for name, text in scripts().items() if ".beginPath(" in text}
    assert own == {"pen.js", "floor.js", "stage.js", "traces.js"}
    drawn = ("Car", "Walls", "Sonar", "Skids", "WholePath", "Forces", "Estimate", "Rollouts")
    for what in drawn:
        homes = [name for name, text in scripts().items() if f"function draw{what}(" in text]
        assert len(homes) == 1, what


def test_the_outline_of_a_car_and_the_colours_are_given_in_one_place():
    for path in [*TEMPLATES.iterdir(), *viewer.FOLDER.iterdir()]:
        if path.name in ("style.py", "page.css", "foxglove_layout.json") or path.is_dir():
            continue
        colours = set(re.findall(r"#[0-9a-f]{6}\b", path.read_text()))
        assert colours <= {"#0a7fc2"}, path.name  # the paint that is only an animation's
    for name in re.findall(r'colour\("([\w-]+)"\)', "\n".join(scripts().values())):
        assert name in PALETTE


def test_a_page_fetches_nothing_and_its_data_cannot_become_markup():
    page = report_html(*with_places([made_view(), made_view("other")]))
    assert not re.search(r'(src|href)\s*=\s*"', page)
    assert "alert(1)</script>" not in page
    assert page.count("<script") == page.count("</script>") == 2


def test_packed_series_have_a_byte_for_each_small_change():
    smooth = np.cumsum(np.random.default_rng(0).integers(-50, 50, 1000)) * 0.01
    assert len(pack(smooth, 0.01)["packed"]) < 1.4 * len(smooth)


def test_a_real_run_has_speed_and_sideslip_whether_it_tells_velocities_or_poses(tmp_path):
    for velocities in (True, False):
        view = view_of(read_run(write_log(tmp_path / f"log{velocities}", velocities)))
        inner = slice(20, -20)
        np.testing.assert_allclose(view["speed_mps"][inner], 1, atol=0.002)
        np.testing.assert_allclose(view["sideslip_deg"][inner], 20, atol=0.1)
        np.testing.assert_allclose(view["yaw_rate_degps"][inner], math.degrees(1), atol=0.2)
        (event,) = view["events"]
        assert (event["kind"], event["from_s"], event["to_s"]) == ("released", 0.0, 1.0)
        draw_picture(view, tmp_path / "report.png")


def test_a_switch_that_is_rarely_told_is_one_event_and_an_empty_truth_is_none():
    time, nothing = np.arange(8.0), math.nan
    armed = np.array([1, nothing, 0, nothing, nothing, 0, 1, nothing])
    commands = Table(time_s=time, throttle=0 * time, steering=0 * time)
    empty = Table({name: np.zeros(0) for name in ("time_s", *POSE, *COLUMNS)})
    run = Run(Path("log"), {}, commands, Table(time_s=time, armed=armed), empty)
    (event,) = events(run)
    assert (event["kind"], event["from_s"], event["to_s"]) == ("released", 2.0, 6.0)
    assert not is_simulated(run)


def test_lost_commands_of_a_radio_are_the_gaps_between_those_that_came(tmp_path):
    run = write_log(tmp_path / "run", True)
    times = [0.02, 0.12, 0.32, 0.42]
    rows = "\n".join(f"{t},0.1,forward,0" for t in times)
    (run / "commands.csv").write_text(f"time_s,throttle,direction,steering_deg\n{rows}\n")
    with (run / "run.toml").open("a") as file:
        file.write("link.name = 'radio'\nrates.control_s = 0.1\n")
    lost = [event for event in view_of(read_run(run))["events"] if event["kind"] == "lost"]
    assert [(round(e["from_s"], 6), e["to_s"]) for e in lost] == [(0.22, 0.32)]


def test_the_ellipse_of_the_estimate_is_two_deviations_along_the_axes_of_its_covariance(tmp_path):
    run = write_log(tmp_path / "run", True)
    columns = "time_s,x_m,y_m,heading_rad,vx_mps,vy_mps,yaw_rate_radps,xx_m2,xy_m2,yy_m2"
    turned = "0.025,0.015,0.025"  # 0.04 and 0.01 m², the longer axis at 45°
    (run / "estimate.csv").write_text(
        f"{columns}\n0,0,0,0,1,0,0,0.04,0,0.01\n1,0,0,0,1,0,0,{turned}\n2,0,0,0,1,0,0,0,0,0\n"
    )
    found = view_of(read_run(run))["estimate"]
    np.testing.assert_allclose(found["longer_m"], [0.4, 0.4, 0], atol=1e-9)
    np.testing.assert_allclose(found["shorter_m"], [0.2, 0.2, 0], atol=1e-9)
    np.testing.assert_allclose(found["ellipse_rad"][:2], [0, math.pi / 4], atol=1e-9)


def test_what_a_planner_looks_at_is_noted_ten_times_a_second():
    class Planner:
        period = 0.02

        def reset(self, key: Any) -> int:
            return 0

        def act(self, memory: int, observation: Any) -> tuple[str, int]:
            return "command", memory + 1

        def rollouts(self, memory: int, observation: Any, count: int) -> Any:
            paths = SimpleNamespace(x=np.full((2, 4), float(memory)), y=np.zeros((2, 4)))
            plan = SimpleNamespace(x=np.ones(4), y=np.ones(4))
            return SimpleNamespace(motion=paths, cost=np.array([3.0, np.nan]), plan=plan)

    watched, memory = Watched(Planner()), 0
    for step in range(16):
        command, memory = watched.act(memory, SimpleNamespace(time=0.02 * step))
        assert command == "command"
    time, rollout, cost, x, _ = watched.columns(0.25)
    assert sorted(set(time)) == pytest.approx([0, 0.1, 0.2])
    assert list(rollout[:6]) == [0, 0, 1, 1, 2, 2]
    assert cost[0] == 3
    assert list(x[2:4]) == [0, 0]
    assert sorted(set(watched.columns(0.35)[0])) == pytest.approx([0.3])
    with pytest.raises(InputError, match="mppi"):
        Watched(object())


def test_at_the_same_place_a_slower_drive_is_later_and_at_the_same_time_it_is_behind():
    quick, slow = made_view("quick", 1.0), made_view("slow", 0.8)
    both = with_places([quick, slow])
    own, other = (view["place_m"] for view in both)
    np.testing.assert_allclose(own, quick["time_s"], atol=0.03)  # 1 m/s on a circle of 1 m
    np.testing.assert_allclose(other, 0.8 * slow["time_s"], atol=0.03)
    (time,), (place,) = (list(differences(both, by)) for by in ("time", "place"))
    assert time["speed_mps"]["rms"] == pytest.approx(0.2, abs=0.001)
    assert time["apart_m"]["largest"] == pytest.approx(2 * math.sin(0.2), abs=0.02)
    assert place["apart_m"]["largest"] < 0.03
    assert place["later_s"] == pytest.approx(1.6 / 0.8 - 1.6, abs=0.05)


def test_a_second_lap_is_another_place_than_the_first():
    view = made_view(speed=2 * math.pi)  # two laps
    own = with_places([view])[0]["place_m"]
    assert own[-1] == pytest.approx(4 * math.pi, rel=0.02)
    assert np.all(np.diff(own) >= 0)


def test_report_puts_several_runs_on_one_page_and_import_makes_one_at_once(tmp_path, capsys):
    runs = [str(write_log(tmp_path / name, name == "a")) for name in ("a", "b")]
    assert cli.main(["report", *runs, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert Path(found["report"]) == tmp_path / "a" / "report-with-b.html"
    assert {one["by"] for one in found["differences"]} == {"time", "place"}
    assert cli.main(["report", *runs, "--each"]) == 0
    assert (tmp_path / "b" / "report.html").exists()
    assert cli.main(["report", *runs * 4]) == 2
    assert "at most 6" in capsys.readouterr().err
    log = tmp_path / "log.npz"
    turn = np.linspace(0, 1, 60)
    observed = np.zeros((60, 12))
    observed[:, 0] = turn
    np.savez(log, obs=observed, action=np.zeros((60, 2)))
    assert cli.main(["import", "eth", str(log), "--out", str(tmp_path / "runs"), "--json"]) == 0
    (made,) = json.loads(capsys.readouterr().out)["runs"]
    assert "log" in Path(made["report"]).read_text(encoding="utf-8")


# -------------------------------------------------------------------------------------------------
# In Chromium
# -------------------------------------------------------------------------------------------------

Opened = Callable[..., Any]


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Opened]:
    """Opens a page's text, which asks nobody for anything."""
    with windows(browser, "file:", "blob:") as window:

        def open_page(text: str, address: str = "", phone: bool = False) -> Any:
            file = tmp_path / "page.html"
            file.write_text(text, encoding="utf-8")
            page = window(phone)
            page.goto(file.as_uri() + address)
            return page

        yield open_page


DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
# The box around the pixels of a colour on the stage, in CSS pixels: left, top, right, bottom.
BOX = """([name, id]) => {
  const canvas = document.getElementById(id), c = canvas.getContext("2d");
  const hex = getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const want = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  const { data, width, height } = c.getImageData(0, 0, canvas.width, canvas.height);
  let box = [Infinity, Infinity, -Infinity, -Infinity], count = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] < 250 || want.some((v, k) => Math.abs(v - data[i + k]) > 3)) continue;
    const x = i / 4 % width, y = Math.floor(i / 4 / width);
    box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
    count++;
  }
  return { box: box.map((v) => v / devicePixelRatio), count };
}"""


def box_of(page: Any, colour: str, canvas: str = "stage") -> np.ndarray:
    """Where the colour is on a canvas."""
    page.evaluate(DRAWN)
    found = page.evaluate(BOX, [colour, canvas])
    assert found["count"] > 20, f"{colour} is not on the {canvas}"
    return np.array(found["box"])


def middle_of(page: Any, canvas: str = "stage") -> tuple[float, float]:
    box = page.locator(f"#{canvas}").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


SOURCES = ("made", "side by side", "dart", "eth", "dart and its simulation")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """The page of each source; skips where its logs are missing."""
    kept: dict[str, str] = {}

    def log(kind: str, name: str) -> dict[str, Any]:
        file = DATA / name
        if not file.exists():
            pytest.skip(f"no {file.name} in shared/data")
        out = tmp_path_factory.mktemp("log")
        assert cli.main(["import", kind, str(file), "--out", str(out), "--json"]) == 0
        return view_of(read_run(out / file.stem))

    def page(source: str) -> str:
        if source not in kept:
            if source == "made":
                views = [made_view()]
            elif source == "side by side":
                views = [made_view("quick"), made_view("slow", 0.8)]
            elif source == "eth":
                views = [log("eth", "eth_rccar/train_2.npz")]
            else:
                views = [log("dart", DART)] + [made_view("simulation")] * (source != "dart")
            kept[source] = report_html(*with_places(views))
        return kept[source]

    return page


@pytest.mark.parametrize("source", SOURCES)
def test_a_page_opens_on_desktop_and_phone_in_light_and_dark(opened, pages, source):
    page = opened(pages(source))
    for size, scheme in itertools.product((DESKTOP, PHONE), ("light", "dark")):
        page.set_viewport_size(size)
        page.emulate_media(color_scheme=scheme)
        box_of(page, "run-1" if "side" in source or "and" in source else "velocity")
        wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
        assert wide <= 0, "the page is wider than its window"


def test_text_of_a_run_is_shown_as_text(opened, pages):
    page = opened(pages("made"), "#t=1")
    assert page.locator("h1").inner_text() == f"made {HOSTILE}"
    assert HOSTILE in page.locator("#facts").inner_text()
    assert page.locator("#events").inner_text() == HOSTILE
    page.evaluate("location.hash = 't=1.55'")
    page.wait_for_function("document.getElementById('events').innerText === 'command lost'")


def test_the_wheel_zooms_about_the_pointer_and_a_drag_pans(opened, pages):
    page = opened(pages("made"), "#camera=course&t=1&hide=sonar,forces,skids,ghosts,estimate")
    before = box_of(page, "wall")
    x, y = middle_of(page)
    canvas = page.locator("#stage").bounding_box()
    at = np.array([x - canvas["x"], y - canvas["y"]] * 2)
    page.mouse.move(x, y)
    page.mouse.wheel(0, 200)  # away, so that all walls stay in view
    smaller = box_of(page, "wall")
    factor = (smaller[2] - smaller[0]) / (before[2] - before[0])
    assert 0.6 < factor < 0.85
    # What is under the pointer stays there; walls have a width that does not follow.
    np.testing.assert_allclose(smaller, at + factor * (before - at), atol=4)
    page.mouse.down()
    page.mouse.move(x + 30, y + 10)
    page.mouse.move(x + 60, y + 20)
    page.mouse.up()
    np.testing.assert_allclose(box_of(page, "wall"), np.add(smaller, [60, 20, 60, 20]), atol=2)
    page.mouse.dblclick(x, y)
    np.testing.assert_allclose(box_of(page, "wall"), before, atol=2)


def test_a_pinch_zooms_and_a_finger_pans(opened, pages):
    page = opened(pages("made"), "#camera=course&t=1&hide=sonar,forces,skids,ghosts,estimate", True)
    before = box_of(page, "wall")
    x, y = middle_of(page)
    touch = page.context.new_cdp_session(page)

    def fingers(kind: str, *points: tuple[float, float]) -> None:
        touches = [{"x": px, "y": py, "id": k} for k, (px, py) in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    fingers("touchStart", (x - 80, y), (x + 80, y))
    for apart in (70, 60, 50, 40):
        fingers("touchMove", (x - apart, y), (x + apart, y))
    fingers("touchEnd")
    smaller = box_of(page, "wall")
    assert (smaller[2] - smaller[0]) / (before[2] - before[0]) == pytest.approx(0.5, abs=0.04)
    fingers("touchStart", (x, y))
    for moved in (10, 25, 40):
        fingers("touchMove", (x + moved, y))
    fingers("touchEnd")
    np.testing.assert_allclose(box_of(page, "wall")[0] - smaller[0], 40, atol=3)


def test_the_traces_zoom_with_ctrl_and_scrub_by_a_drag(opened, pages):
    page = opened(pages("made"), "#t=1")
    x, y = middle_of(page, "traces")
    wide = page.locator("#traces").bounding_box()
    page.mouse.click(x, y)
    page.wait_for_function("document.getElementById('clock').innerText !== '1.00'")
    clicked = float(page.locator("#clock").inner_text())
    left, right = 182, wide["width"] - 22
    assert clicked == pytest.approx(1.99 * (wide["width"] / 2 - left) / (right - left), abs=0.02)
    turn = box_of(page, "turn", "traces")
    page.keyboard.down("Control")
    page.mouse.move(x, y)
    page.mouse.wheel(0, -60)
    page.keyboard.up("Control")
    zoomed = box_of(page, "turn", "traces")
    assert zoomed[2] - zoomed[0] > 1.2 * (turn[2] - turn[0])


def test_it_plays_steps_and_looks_from_behind(opened, pages):
    page = opened(pages("made"), "#t=0.5")
    page.keyboard.press("ArrowRight")
    page.wait_for_function("document.getElementById('clock').innerText === '0.52'")
    page.keyboard.press(" ")
    page.wait_for_function("Number(document.getElementById('clock').innerText) > 0.7")
    page.keyboard.press(" ")
    above = page.locator("#stage").screenshot()
    page.get_by_text("Behind car").click()
    box_of(page, "wall")  # the walls are drawn anew
    behind = page.locator("#stage").screenshot()
    assert behind != above
    x, y = middle_of(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y)
    page.mouse.up()
    box_of(page, "wall")
    assert page.locator("#stage").screenshot() != behind


def test_the_series_are_saved_as_csv_within_the_steps_of_the_page(opened):
    view = made_view()
    view["speed_mps"][7] = np.nan
    page = opened(report_html(view))
    with page.expect_download() as saved:
        page.get_by_text("Save the series as CSV").click()
    lines = Path(saved.value.path()).read_text().splitlines()
    names = lines[0].split(",")
    rows = np.array([[float(c or "nan") for c in line.split(",")] for line in lines[1:]])
    steps = {
        "time_s": 0.001, "x_m": 0.0005, "speed_mps": 0.005, "throttle": 0.005,
        "sideslip_deg": 0.1, "heading_rad": 0.001,
    }  # fmt: skip
    for name, step in steps.items():
        np.testing.assert_allclose(rows[:, names.index(name)], view[name], atol=0.51 * step + 1e-4)
    assert saved.value.suggested_filename == "made.csv"


def test_runs_side_by_side_meet_at_the_same_place(opened, pages):
    page = opened(pages("side by side"), "#t=1.5&camera=course&hide=forces,skids")
    apart = box_of(page, "run-2")
    assert "slow" in page.locator("#differences").inner_text()
    page.get_by_text("Same place").click()
    page.get_by_text("Differences", exact=True).click()
    assert "Later at the end" in page.locator("#differences").inner_text()
    # The slow car has come as far as the quick one, so its path is longer than before.
    beside = box_of(page, "run-2")
    assert abs(beside[0] - apart[0]) + abs(beside[1] - apart[1]) > 5
    page.locator("#runs").get_by_text("slow").click()
    assert page.locator("#runs button[aria-pressed=true]").inner_text() == "slow"


def test_a_run_of_ten_minutes_opens_and_plays(opened):
    """How long it takes is measured in the docs; here, that it works at this size."""
    view = made_view()
    time = np.arange(0, 600, 0.02)

    def again(columns: dict[str, Any]) -> dict[str, Any]:
        series = {name: v for name, v in columns.items() if isinstance(v, np.ndarray)}
        return {name: np.interp(time % 2, view["time_s"], v) for name, v in series.items()}

    long = again(view) | {"time_s": time, "wheels": [again(wheel) for wheel in view["wheels"]]}
    text = report_html(view | long)
    assert len(text) < 3e6
    page = opened(text, "#t=599&camera=course")
    assert page.locator("#clock").inner_text() == "599.00"
    box_of(page, "wall")
