"""The picture of the README: a room before and after, taken from the page of a living scene in a real browser.

`python -m eval.page_picture --scene demo_scene --out docs/pictures/before_after.png`; needs Chromium on the PATH.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path

from PIL import Image

from eval.page_speed import SOFTWARE_GL, opened
from train.run.program import run

SHOWN = 0.84  # of the view's height, from above: below lies bare floor
COLORS = 96  # of the palette; more are hardly seen and double the file


def main(scene: Path, out: Path, width: int = 1500, height: int = 900, nearer: int = 1) -> None:
    """Opens the page, shows the first scan beside the last, and keeps the 3D view alone.

    Args:
        scene: folder of a living scene, as `more2 demo --out` leaves it.
        out: PNG to write.
        width: of the window, pixels.
        height: of the window, pixels.
        nearer: presses of the key + before the picture is taken.
    """
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ValueError("no Chromium on the PATH; needed to open the page (`apt-get install chromium`)")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=SOFTWARE_GL)
        page = opened(browser, scene / "report.html", width, height)
        page.evaluate("window.more2.toggle('split', true)")
        for _ in range(nearer):
            page.evaluate("window.more2.moveCamera('+')")
        page.wait_for_function("window.more2.settled", timeout=120_000)
        shot = page.locator(".stage").screenshot()
        browser.close()
    view = Image.open(io.BytesIO(shot)).convert("RGB")
    picture = view.crop((0, 0, view.width, round(SHOWN * view.height)))
    out.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(COLORS, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    run(main)
