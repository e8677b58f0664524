"""The cockpit's pictures, or how fast its page is: `python -m studies.cockpit_shots [DIR]`.

A server of this process is driven by real keys in Chromium. With DIR, each view becomes a small PNG
there: light, dark and on a phone. Without, the page is measured while it drives: pictures a second,
what drawing one costs, the time from a key to the first picture of a state that has felt it, and
how far the car's clock falls behind. Playwright and Pillow are needed (`make browser`).
"""

import io
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from countersteer.cockpit.server import running
from countersteer.cockpit.start import Start, cockpit

DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
LARGEST = 150_000  # bytes of a picture; a larger one gets fewer colours
PATIENCE = 600.0  # s for a first start, in which programs are compiled
MEASURED = 20.0  # s
TAPS = 40  # of a key
STAGE = "document.getElementById('stage')"
READY = f"['ready', 'drives', 'paused', 'ended'].includes({STAGE}.dataset.phase)"


def until(page: Page, holds: str, seconds: float = 30.0) -> None:
    """Wait until a JavaScript expression holds; after that time, go on as it is."""
    end = time.monotonic() + seconds
    while not page.evaluate(f"Boolean({holds})") and time.monotonic() < end:
        page.wait_for_timeout(30)


def opened(browser: Browser, address: str, lesson: bool = False, **context: Any) -> Page:
    """The page in a window of its own."""
    made = browser.new_context(**context)
    if not lesson:
        made.add_init_script("localStorage.setItem('countersteer-lesson', 'yes')")
    page = made.new_page()
    page.goto(address)
    until(page, READY, PATIENCE)
    until(page, "document.getElementById('role').classList.contains('drives')")
    return page


def kept(page: Page, file: Path) -> None:
    """Keep what the page shows as a small picture."""
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    file.parent.mkdir(parents=True, exist_ok=True)
    picture.save(file, optimize=True)
    if file.stat().st_size > LARGEST:
        picture.quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)


def driven(page: Page, seconds: float) -> None:
    """Have the driver drive for so long, from the start."""
    page.keyboard.press("r")
    until(page, f"{STAGE}.dataset.phase === 'ready'")
    if page.evaluate(f"{STAGE}.dataset.who") == "person":
        page.keyboard.press("h")
    until(page, f"{STAGE}.dataset.phase === 'drives'")
    until(page, f"Number({STAGE}.dataset.time) > {seconds}", 120)
    page.keyboard.press(" ")
    until(page, f"{STAGE}.dataset.phase === 'paused'")
    page.evaluate("document.getElementById('over').style.visibility = 'hidden'")
    page.wait_for_timeout(300)


def draw_course(page: Page) -> None:
    """Click the corners of a course."""
    page.click("#tab-draw")
    box = page.locator("#stage").bounding_box()
    assert box is not None
    for x, y in ((2.5, 0), (2.5, -1.5), (4.0, -1.5), (4.0, 0.6)):
        at = box["x"] + box["width"] / 2 + 90 * (x - 2), box["y"] + box["height"] / 2 - 90 * y
        page.mouse.move(*at)
        page.mouse.click(*at)
    page.mouse.move(box["x"] + box["width"] - 60, box["y"] + 60)
    page.wait_for_timeout(800)


def paint_floor(page: Page) -> None:
    """Paint a slippery stroke."""
    page.click("#tab-paint")
    box = page.locator("#stage").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 430, box["y"] + 150)
    page.mouse.down()
    page.mouse.move(box["x"] + 560, box["y"] + 170, steps=6)
    page.mouse.up()
    page.wait_for_timeout(500)


def pictures(browser: Browser, address: str, folder: Path) -> None:
    """All views, one after the other."""
    page = opened(browser, address, lesson=True, viewport=DESKTOP)
    kept(page, folder / "cockpit-first.png")
    page.click("#lesson-skip")
    driven(page, 3.3)
    kept(page, folder / "cockpit.png")
    page.emulate_media(color_scheme="dark")
    page.click("#camera [value=chase]")
    page.wait_for_timeout(400)
    kept(page, folder / "cockpit-dark.png")
    page.click("#camera [value=follow]")
    page.emulate_media(color_scheme="light")
    page.click("#tab-tune")
    kept(page, folder / "cockpit-car.png")
    paint_floor(page)
    kept(page, folder / "cockpit-floor.png")
    page.click("#paint-clear")
    page.keyboard.press("r")
    page.click("#tab-runs")
    page.wait_for_timeout(1500)
    kept(page, folder / "cockpit-runs.png")
    draw_course(page)
    kept(page, folder / "cockpit-course.png")
    page.context.close()
    phone: dict[str, Any] = {"viewport": PHONE, "has_touch": True, "is_mobile": True}
    page = opened(browser, address, **phone)
    driven(page, 2.6)
    kept(page, folder / "cockpit-phone.png")
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(300)
    kept(page, folder / "cockpit-phone-dark.png")
    page.context.close()


def measured(browser: Browser, address: str) -> dict[str, float]:
    """The page's figures while it drives, with a key that is tapped."""
    page = opened(browser, address, viewport=DESKTOP)
    page.keyboard.press("r")
    until(page, f"{STAGE}.dataset.phase === 'ready'")
    page.keyboard.press("ArrowUp")
    until(page, f"{STAGE}.dataset.phase === 'drives'")
    begin, car = time.monotonic(), float(page.evaluate(f"{STAGE}.dataset.time"))
    for _ in range(TAPS):
        page.keyboard.down("ArrowLeft")
        page.wait_for_timeout(1000 * MEASURED / TAPS / 2)
        page.keyboard.up("ArrowLeft")
        page.wait_for_timeout(1000 * MEASURED / TAPS / 2)
    now = float(page.evaluate(f"{STAGE}.dataset.time"))
    taken = time.monotonic() - begin
    found: dict[str, float] = page.evaluate("({ ...document.getElementById('meter').dataset })")
    page.context.close()
    return {name: float(value) for name, value in found.items()} | {
        "car_s_per_s": round((now - car) / taken, 3)
    }


def main(folder: Path | None) -> None:
    """Make the pictures, or print the figures as JSON."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        sync_playwright() as driver,
        running(
            cockpit(Start(runs=Path(scratch) / "runs", courses=Path(scratch) / "courses"))
        ) as address,
    ):
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        if folder is not None:
            pictures(browser, address, folder)
        else:
            load = os.getloadavg()[0]  # others may be at work too
            print(json.dumps(measured(browser, address) | {"load_average": round(load, 1)}))
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
