"""The pictures of README and guide: taken from the page of a living scene in a real browser.

`python -m eval.page_pictures --scene demo_scene --out docs/pictures`; needs Chromium on the PATH.
"""

from __future__ import annotations

import io
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from eval.page_speed import SOFTWARE_GL, opened
from train.run.program import run

COLORS = 256  # of the palette: a third of the file


@dataclass(frozen=True)
class Shot:
    """One picture, and what is set on the page before it is taken."""

    name: str
    window: tuple[int, int]  # pixels
    theme: str = "light"
    split: bool = False  # the first scan beside the last
    selected: int | None = None  # row of the object
    nearer: int = 0  # presses of the key +
    stage_alone: bool = False  # the 3D view without what is around it
    shown: float = 1.0  # of the height, from above


SHOTS = (
    # Of the lower part of the view nothing but floor.
    Shot("before_after", (1500, 900), split=True, nearer=1, stage_alone=True, shown=0.84),
    Shot("page_light", (1200, 820)),
    Shot("page_dark", (1200, 820), theme="dark", split=True, selected=1),
    Shot("page_phone", (390, 844)),
)


def main(scene: Path, out: Path) -> None:
    """Opens the page once for every picture, and keeps what it shows.

    Args:
        scene: folder of a living scene, as `more2 demo --out` leaves it.
        out: folder for the PNGs.
    """
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ValueError("no Chromium on the PATH; needed to open the page (`apt-get install chromium`)")
    out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=SOFTWARE_GL)
        for shot in SHOTS:
            page = opened(browser, scene / "report.html", *shot.window)
            picture = taken(page, shot)
            few = picture.quantize(COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            few.save(out / f"{shot.name}.png", optimize=True)
            page.close()
        browser.close()


def taken(page: Any, shot: Shot) -> Image.Image:
    """The picture of an open page."""
    page.evaluate(f"window.more2.setTheme('{shot.theme}')")
    if shot.split:
        page.evaluate("window.more2.toggle('split', true)")
    if shot.selected is not None:
        page.locator("button[data-id]").nth(shot.selected).click()
    for _ in range(shot.nearer):
        page.evaluate("window.more2.moveCamera('+')")
    page.wait_for_function("window.more2.settled", timeout=120_000)
    bytes_ = page.locator(".stage").screenshot() if shot.stage_alone else page.screenshot()
    image = Image.open(io.BytesIO(bytes_)).convert("RGB")
    return image.crop((0, 0, image.width, round(shot.shown * image.height)))


if __name__ == "__main__":
    run(main)
