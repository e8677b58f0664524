"""The page of a tuning, and the advice on which log to record next."""

import base64
import io
import json
import math
import re
import shutil
import subprocess
from fnmatch import fnmatch
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from countersteer.car.car import Car
from countersteer.car.parameter import declarations
from countersteer.tuning import advice, fit
from countersteer.viewing.tuning_page import write_tuning_page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
QUANTITIES = ("vx_mps", "vy_mps", "yaw_rate_radps", "wheel_speed_mps")
VOID = {"meta", "img", "br", "wbr", "line", "circle", "rect", "polyline"}


def scored(scale, windows, names=QUANTITIES):
    errors = {n: {"median_abs_error": scale, "rmse": 1.4 * scale} for n in names}
    still = {n: {"median_abs_error": 0.31, "rmse": 0.47} for n in names}
    return {"windows": windows, "errors": errors, "persistence": still}


def with_transient(scale, windows, names=QUANTITIES):
    whole = scored(scale, windows, names)
    return whole | {"transient": scored(2 * scale, windows // 3, names)}


def parameter(path, value, deviation, unit="", surface=None, **other):
    given = {
        "path": path, "surface": surface, "unit": unit, "prior": 1.3 * value, "value": value,
        "deviation": deviation, "by_curvature": 0.4 * deviation, "by_halves": deviation,
        "determined": True, "at_bound": False,
    }  # fmt: skip
    return given | other


def log(name, surface, kind, duration, names=QUANTITIES):
    """A run whose windows drift off from what was measured, every third one held out."""
    time = np.arange(0, duration, 0.01)
    noise = np.random.default_rng(1)
    quantities = []
    for k, quantity in enumerate(names):
        truth = np.sin((0.7 + 0.2 * k) * time) + 0.3 * k
        measured = truth + noise.normal(0, 0.01, len(time))
        measured[(time > 3.0) & (time < 3.4)] = np.nan
        windows = []
        for i, start in enumerate(np.arange(0, duration - 1.0, 0.25)):
            at = (time >= start) & (time <= start + 1.0)
            off = 0.08 * (time[at] - start) * noise.normal()
            windows.append({
                "time": time[at], "simulated": truth[at] + off,
                "held_out": kind == "validation" or i // 8 % 3 == 2,
            })  # fmt: skip
        quantities.append(
            {"name": quantity, "time": time, "measured": measured, "windows": windows}
        )
    steps = np.arange(0, duration, 0.5)
    commands = {
        "time": steps, "throttle": 0.4 + 0.3 * np.sign(np.sin(steps)),
        "steering_deg": 18 * np.sin(0.7 * steps),
    }  # fmt: skip
    return {
        "run": name, "surface": surface, "kind": kind, "quantities": quantities,
        "commands": commands,
    }  # fmt: skip


@pytest.fixture
def result():
    """Two surfaces; one parameter left open, one at a bound, one tiny."""
    parameters = [
        parameter("motor.resistance", 0.31, 0.02, "ohm"),
        parameter("motor.torque_constant", 0.0124, 0.0006, "N m/A"),
        parameter("motor.rotor_inertia", 2.3e-6, 1.9e-6, "kg m2", determined=False),
        parameter("motor.neutral_brake", 0.38, 0.2),
        parameter("motor.delay", 0.011, 0.012, "s", determined=False),
        parameter("servo.trim", -0.8, 0.15, "deg", prior=0.0),
        parameter("servo.limit_right", 25.2, 0.6, "deg"),
        parameter("body.yaw_inertia", 0.0061, 0.0008, "kg m2"),
        parameter("tires.front.friction", 0.37, 0.008, surface="tape-and-tiles"),
        parameter("tires.front.friction", 0.71, 0.03, surface="rubber"),
        parameter(
            "tires.rear.longitudinal_stiffness", 200.0, 60.0, surface="rubber", at_bound=True
        ),
    ]
    noise = np.random.default_rng(0)
    totals = {
        "fitted": {
            "tape-and-tiles": with_transient(0.041, 402), "rubber": with_transient(0.06, 90),
        },
        "held out": {
            "tape-and-tiles": with_transient(0.048, 180), "rubber": with_transient(0.083, 40),
        },
        "validation": {"tape-and-tiles": with_transient(0.052, 97)},
    }  # fmt: skip
    runs = [
        {"run": "drift-1", "surface": "tape-and-tiles", "kind": "fitted"} | scored(0.041, 402),
        {"run": "drift-1", "surface": "tape-and-tiles", "kind": "held out"} | scored(0.048, 180),
        {"run": "<b>", "surface": "rubber", "kind": "fitted"} | scored(0.06, 90),
        {"run": "drift-2", "surface": "tape-and-tiles", "kind": "validation"} | scored(0.052, 97),
    ]
    return {
        "car": "jetracer", "fit": "all", "seconds": 83.2,
        "surfaces": ["tape-and-tiles", "rubber"],
        "commands": "countersteer tune runs/drift-1 'runs/<b>' --car jetracer --fit all",
        "parameters": parameters, "runs": runs, "totals": totals,
        "masked": ["drift-1: 0.0–1.6 s: the dead-man switch is released"],
        "not_determined": ["motor.rotor_inertia", "motor.delay"],
        "at_bounds": ["tires.rear.longitudinal_stiffness (rubber)"],
        "residuals": {
            name: {"scale": 0.05, "values": noise.standard_t(4, 2000).tolist()}
            for name in QUANTITIES
        },
        "next_log": advice.next_log(parameters),
        "correlations": [[0, 1, -0.93], [3, 4, 0.2]],
    }  # fmt: skip


@pytest.fixture
def series():
    """A short log, one with a name that looks like HTML, a validation log of two minutes."""
    return [
        log("drift-1", "tape-and-tiles", "fitted", 20.0),
        log("<b>", "rubber", "fitted", 6.0, QUANTITIES[3:]),
        log("drift-2", "tape-and-tiles", "validation", 120.0),
    ]


class Page(HTMLParser):
    """What is in a page; every element has to be closed in its turn."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.addresses, self.text = [], [], [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text += data


def written(tmp_path, result, series):
    path = tmp_path / "tuning.html"
    write_tuning_page(path, result, series)
    text = path.read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    return page, text


def images(page):
    for address in page.addresses:
        head, _, data = address.partition(",")
        assert head == "data:image/png;base64"
        yield Image.open(io.BytesIO(base64.b64decode(data)))


def test_a_page_is_well_formed_and_stands_alone(tmp_path, result, series):
    page, text = written(tmp_path, result, series)
    assert "script" not in page.tags
    assert "{{" not in text
    assert not re.search(r"url\(|@import|https?:", text)
    assert all(address.startswith("data:") for address in page.addresses)


def test_each_run_is_drawn_in_its_colours(tmp_path, result, series):
    page, _ = written(tmp_path, result, series)
    pictures = list(images(page))
    assert len(pictures) == len(series)
    strips = [len(run["quantities"]) for run in series]
    assert np.argsort([p.height for p in pictures]).tolist()[0] == int(np.argmin(strips))
    for picture, run in zip(pictures, series, strict=True):
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
        assert (0x87, 0x96, 0xA3) in colours
        held = [w["held_out"] for q in run["quantities"] for w in q["windows"]]
        assert ((0x7A, 0x5B, 0xA8) in colours) == any(held)
        assert ((0xC4, 0x40, 0x0F) in colours) == (not all(held))
    assert "40 s of 120 s" in page.text


def test_names_are_shown_as_text(tmp_path, result, series):
    result["masked"] = ["<i>{{title}}</i> & more"]
    result["not_determined"].append("<script>")
    result["surfaces"][1] = "<u>"
    for by_surface in result["totals"].values():
        if "rubber" in by_surface:
            by_surface["<u>"] = by_surface.pop("rubber")
    page, text = written(tmp_path, result, series)
    assert "{{title}}" in text
    assert not {"u", "script"} & set(page.tags)
    for name in ("<b>", "<i>{{title}}</i> & more", "<script>", "<u>"):
        assert name in page.text


def test_the_headline_judges_by_what_was_not_fitted(tmp_path, result, series):
    page, _ = written(tmp_path, result, series)
    lead = page.text[: page.text.index("Errors by surface")]
    assert "on tape-and-tiles (97 windows)" in lead
    assert "0.052\N{NO-BREAK SPACE}m/s in forward velocity (0.31)" in lead
    assert "on rubber (40 windows)" in lead
    assert "0.041" not in lead
    assert "motor.rotor_inertia, motor.delay" in lead
    assert "tires.rear.longitudinal_stiffness (rubber)" in lead
    assert "No better" not in lead


def test_the_headline_says_when_the_car_predicts_nothing(tmp_path, result, series):
    for scored in (result["totals"]["validation"]["tape-and-tiles"],):
        scored["transient"]["errors"]["vy_mps"]["median_abs_error"] = 0.5
    page, _ = written(tmp_path, result, series)
    assert "No better than predicting that nothing changes: lateral velocity." in page.text


def test_without_held_out_windows_the_page_says_so(tmp_path, result, series):
    result["totals"] = {"fitted": result["totals"]["fitted"]}
    page, _ = written(tmp_path, result, series)
    assert "Nothing was held out" in page.text


def test_quantities_that_were_not_measured_leave_no_number(tmp_path, result, series):
    for by_surface in result["totals"].values():
        for scored in by_surface.values():
            del scored["errors"]["vx_mps"], scored["persistence"]["vx_mps"]
            scored["errors"]["vy_mps"]["median_abs_error"] = math.nan
            scored["persistence"]["yaw_rate_radps"]["rmse"] = None
            scored["transient"] = {"windows": 0, "errors": {}, "persistence": {}}
    result["parameters"][2] |= {"deviation": math.inf, "by_halves": None}
    result["parameters"][3] |= {"value": 0.0, "deviation": 0.0, "prior": 0.0}
    result["residuals"] = {"vx_mps": {"scale": 0.05, "values": []}, "other": {
        "scale": 1.0, "values": [0.0, math.nan, 9.0]}}  # fmt: skip
    result["next_log"] = ""
    series[0]["quantities"][0]["measured"][:] = np.nan
    series[0]["quantities"][0]["windows"] = []
    for window in series[0]["quantities"][1]["windows"]:
        window["simulated"][-20:] = 1e9
    series[1]["quantities"] = []
    series[2]["commands"] = {"time": [], "throttle": [], "steering_deg": []}
    page, text = written(tmp_path, result, series)
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"base64,[^\"]*", "", text))
    by_surface = page.text[page.text.index("Errors by surface") : page.text.index("Parameters")]
    assert "forward velocity" not in by_surface
    assert len(list(images(page))) == len(series)


def test_a_result_read_back_from_json_gives_the_same_page(tmp_path, result, series):
    _, text = written(tmp_path, result, series)
    _, again = written(tmp_path, json.loads(json.dumps(result)), series)
    assert again == text


def test_long_lists_of_what_was_masked_are_folded(tmp_path, result, series):
    _, text = written(tmp_path, result, series)
    folds = text.count("<details>")
    result["masked"] *= 30
    _, text = written(tmp_path, result, series)
    assert text.count("<details>") == folds + 1
    assert "30 entries" in text


def test_values_show_as_many_digits_as_are_known(tmp_path, result, series):
    page, _ = written(tmp_path, result, series)
    assert "0.310 ± 0.020 ohm" in page.text
    assert "2.3 ± 1.9 ×10−6 kg m2" in page.text
    assert "25.20 ± 0.60 deg" in page.text
    assert "motor.resistance and motor.torque_constant: −0.93" in page.text
    assert "motor.neutral_brake and" not in page.text


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here to open the page in")
@pytest.mark.parametrize("width", [1280, 500])  # the narrowest that Chromium opens a window
def test_the_page_is_no_wider_than_its_window(tmp_path, result, series, width):
    page = tmp_path / "tuning.html"
    write_tuning_page(page, result, series)
    probe = "<script>document.title=`${document.documentElement.scrollWidth} wide`</script>"
    page.write_text(page.read_text().replace("</body>", probe + "</body>"))
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900",
            "--dump-dom", page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    shown = re.search(r"<title>(\d+) wide</title>", done.stdout)
    assert shown, done.stderr
    assert int(shown[1]) <= width


# -------------------------------------------------------------------------------------------------
# Advice
# -------------------------------------------------------------------------------------------------


def test_what_is_least_determined_is_asked_for_first():
    lines = advice.next_log(
        [
            parameter("motor.resistance", 0.3, 0.001, "ohm"),
            parameter("servo.limit_left", 25.0, 12.0, "deg"),
            parameter("motor.neutral_brake", 0.4, 0.2, determined=False),
            parameter("motor.lag", 0.02, 0.03, "s", determined=False),
            parameter("motor.delay", 0.01, 0.012, "s"),
        ]
    ).splitlines()
    assert [re.findall(r"\(for (.*)\)", line)[0] for line in lines] == [
        "motor.lag, motor.delay",
        "motor.neutral_brake",
        "servo.limit_left",
    ]


def test_advice_names_the_surface():
    stiffness = "tires.rear.longitudinal_stiffness"
    text = advice.next_log([parameter(stiffness, 20.0, 15.0, surface="tape", determined=False)])
    assert text.startswith("On tape: hard launches and hard braking")
    assert text.endswith(f"(for {stiffness}).")


def test_a_trim_near_zero_is_no_reason_for_another_log():
    trim = parameter("servo.trim", 0.01, 0.3, "deg")
    assert "None is missing" in advice.next_log([trim])
    assert "straight" in advice.next_log([trim | {"deviation": 1.5}])


def declared(part=None, path=""):
    part = Car() if part is None else part
    names = [path + name for name, _ in declarations(type(part)).values()]
    parts = ("body", "tires", "drivetrain", "motor", "speed_controller", "servo", "front", "rear")
    for name in parts:
        if hasattr(part, name) and hasattr(type(part), "__dataclass_fields__"):
            names += declared(getattr(part, name), f"{path}{name}.")
    return names


def test_advice_is_about_parameters_that_a_car_has():
    patterns = [pattern for those in advice.LOGS.values() for pattern in those]
    for pattern in patterns:
        assert any(fnmatch(path, pattern) for path in (*declared(), fit.CHARGE)), pattern
    assert advice.log_for("sensors.gyroscope.lag") == advice.OTHER


def test_there_is_advice_on_whatever_is_fitted():
    assert [path for path in fit.PARAMETERS if advice.log_for(path) == advice.OTHER] == []
