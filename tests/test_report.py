"""The report, opened in a browser."""

import math
import re
import shutil
import subprocess

import numpy as np
import pytest

from countersteer.viewing.picture import draw_picture
from countersteer.viewing.report import report_html

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--virtual-time-budget=4000",
    "--window-size=1280,800",
    "--enable-logging=stderr",
    "--v=0",
]


@pytest.fixture(scope="module")
def view() -> dict:
    """Two seconds on a circle, with sideslip, one sonar, four wheels."""
    time = np.arange(0, 2, 0.01)
    n = len(time)
    wave = np.sin(time)
    wheel = {
        "force_x_n": (2 * wave).tolist(),
        "force_y_n": (3 * np.cos(time)).tolist(),
        "limit_n": [4.0] * n,
        "slip_mps": np.abs(wave).tolist(),
        "angle_rad": [0.1] * n,
    }
    places = [(0.12, 0.05), (0.12, -0.05), (-0.12, 0.05), (-0.12, -0.05)]
    turn = {
        "begin_s": 0.5, "end_s": 1.2, "entry_speed_mps": 2.0, "peak_sideslip_deg": 40.0,
        "peak_yaw_rate_degps": 250.0, "heading_error_deg": -2.0, "duration_s": 0.7,
    }  # fmt: skip
    return {
        "title": "a test </script><b>",
        "summary": {
            "completed": True, "outcome": "goal reached", "wall_contacts": 0, "lap_time_s": 2.0,
            "turns": [turn],
        },
        "walls_m": [[-2, -2, 2, -2], [2, -2, 2, 2]],
        "car": {
            "length_m": 0.4, "width_m": 0.17, "center_x_m": 0.0,
            "wheels": [
                {"x_m": x, "y_m": y, "radius_m": 0.03, "width_m": 0.026} for x, y in places
            ],
        },
        "sonar": [
            {
                "name": "front", "x_m": 0.2, "y_m": 0.0, "angle_deg": 0.0, "half_angle_deg": 20.0,
                "time_s": [0.1, 0.2], "distance_m": [1.0, None],
            }
        ],
        "time_s": time.tolist(),
        "x_m": np.cos(time).tolist(),
        "y_m": np.sin(time).tolist(),
        "heading_rad": (time + math.pi / 2).tolist(),
        "speed_mps": [1.0] * n,
        "sideslip_deg": (30 * wave).tolist(),
        "yaw_rate_degps": [57.0] * n,
        "steering_deg": (5 * wave).tolist(),
        "steering_command_deg": (6 * wave).tolist(),
        "throttle": [0.4] * n,
        "wheels": [wheel] * 4,
    }  # fmt: skip


def test_the_page_fetches_nothing_and_holds_its_data_safely(view):
    page = report_html(view)
    assert not re.search(r'(src|href)\s*=\s*"(https?:)?//', page)
    assert "</script><b>" not in page
    assert page.count("<script") == page.count("</script>")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here to open the page in")
def test_the_page_opens_and_draws_without_an_error(view, tmp_path):
    page = tmp_path / "report.html"
    page.write_text(report_html(view))
    done = subprocess.run(
        [
            CHROMIUM,
            *FLAGS,
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--screenshot={tmp_path / 'page.png'}",
            "--dump-dom",
            f"{page.as_uri()}#t=1.0",
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "Uncaught" not in done.stderr, done.stderr
    assert "Goal reached" in done.stdout
    assert "1.00" in done.stdout


def test_the_picture_has_the_size_of_the_readme(view, tmp_path):
    from PIL import Image

    draw_picture(view, tmp_path / "report.png")
    with Image.open(tmp_path / "report.png") as image:
        assert image.size == (1400, 900)
        colours = image.convert("RGB").getcolors(1 << 24)
        assert len(colours) > 100
