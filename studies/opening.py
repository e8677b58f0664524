"""How large pages are, and how soon they show a picture: `python -m studies.opening PAGE…`.

Chromium opens each page in turn, without a cache. The time goes from the start of the navigation to
the first frame in which the middle of the stage is painted. Playwright is needed (`make browser`).
"""

import shutil
import statistics
import sys
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

TIMES = 12
LOOK = """
window.painted = null;
const look = () => {
  const canvas = document.getElementById("stage");
  if (canvas && canvas.width > 300) {
    const [x, y] = [canvas.width / 2 - 150, canvas.height / 2 - 80];
    const { data } = canvas.getContext("2d").getImageData(x, y, 300, 160);
    if (data.some((value, i) => i % 4 === 3 && value > 0)) {
      window.painted = performance.now();
      return;
    }
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""


def first_picture(browser: Browser, page: Path) -> float:
    """Time (ms) until a page shows its stage."""
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    context.add_init_script(LOOK)
    tab = context.new_page()
    tab.goto(page.resolve().as_uri())
    tab.wait_for_function("window.painted !== null")
    painted = float(tab.evaluate("window.painted"))
    context.close()
    return painted


def main(pages: list[Path]) -> None:
    """Print a line for each page."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        times = [[first_picture(browser, page) for page in pages] for _ in range(TIMES)]
        browser.close()
    for page, taken in zip(pages, zip(*times, strict=True), strict=True):
        kilobytes = page.stat().st_size / 1000
        print(
            f"{page}: {kilobytes:.0f} kB, first picture after {statistics.median(taken):.0f} ms "
            f"(median of {TIMES}; {min(taken):.0f} to {max(taken):.0f})"
        )


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
