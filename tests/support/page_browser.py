"""A page in a real browser without a display, for tests: opened once, set back to its beginning for each of them."""

import dataclasses
import math
import shutil
from io import BytesIO

import numpy as np
import pytest
from factories import WORLD_M, living_scene, scene_object, turn_z
from skimage.io import imread

from more2_jax.config import SceneConfig
from more2_jax.report import rgb, write_report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
in_a_browser = [
    pytest.mark.browser,
    pytest.mark.skipif(
        CHROMIUM is None, reason="no Chromium on the PATH; `apt-get install chromium` has one"
    ),
]
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDE, PHONE = {"width": 920, "height": 560}, {"width": 390, "height": 844}
TOGGLES = ["meshes", "clouds", "accumulated", "background", "trails", "labels", "split"]


def room():
    """The scene by hand with a ground, and an object that two matches leave in doubt."""
    scene = living_scene()
    ground = WORLD_M + np.random.default_rng(0).uniform([-1, -2, -0.6], [13, 3, -0.5], (4000, 3))
    scans = tuple(dataclasses.replace(s, background=ground) for s in scene.scans)
    moved = turn_z(1.0, WORLD_M + [12.0, 0, 0], np.array([0.0, 1.0, 0.0]))
    doubted = scene_object(4, {0: np.eye(4), 2: moved}, mesh=False)
    seen = dataclasses.replace(doubted.observations[1], score=0.1)
    doubted = dataclasses.replace(doubted, observations=(doubted.observations[0], seen))
    return dataclasses.replace(scene, scans=scans, objects=(*scene.objects[:4], doubted))


@pytest.fixture(scope="session")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(room(), path, SceneConfig())
    return path


@pytest.fixture(scope="session")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def said():
    """What pages put on the console, ask for or fail with."""
    return []


@pytest.fixture(scope="session")
def opener(browser, report, said):
    contexts = []

    def opening(path=report, viewport=WIDE, init=None, **options):
        address = path if isinstance(path, str) else path.as_uri()
        context = browser.new_context(viewport=viewport, **({"reduced_motion": "reduce"} | options))
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda r: None if r.url == address else said.append(f"asks for {r.url}"))
        if init:
            page.add_init_script(init)
        page.goto(address)
        until(page, "Boolean(window.more2?.ready)")
        return page

    yield opening
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def common(opener):
    """One page for all tests that need nothing of their own."""
    return opener()


AFRESH = """() => {
  more2.play(false);
  more2.select(null);
  more2.setBase("first");
  more2.setTime(more2.scans - 1);
  for (const box of document.querySelectorAll("[data-toggle]")) more2.toggle(box.dataset.toggle, box.defaultChecked);
  more2.home();
  localStorage.removeItem("more2-theme");
  delete document.documentElement.dataset.theme;
  more2.setTheme("light", false);
  document.activeElement.blur();
  for (const details of document.querySelectorAll("details")) details.open = false;
  scrollTo(0, 0);
}"""


@pytest.fixture
def opened(opener, request, said):
    """Opens the page from disk, as a person would; whatever it says or asks for fails the test."""

    def opening(*path, **options):
        if path or options:
            return opener(*path, **options)
        page = request.getfixturevalue("common")
        page.emulate_media(color_scheme="light", reduced_motion="reduce")
        page.evaluate(AFRESH)
        return page

    yield opening
    assert said == [], said


def until(page, condition: str) -> None:
    """Waits for a condition on the page; its own policy forbids the driver's way of waiting."""
    for _ in range(300):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never came: {condition}")


def state(page, name: str):
    return page.evaluate(f"more2.{name}")


def pixels(page) -> np.ndarray:
    """The 3D view once it is drawn in full, (h, w, 3), 0 to 255."""
    page.evaluate(
        """() => new Promise((done) => { scrollTo(0, 0); let frames = 0;
        const wait = () => (more2.settled && ++frames > 1 ? done() : requestAnimationFrame(wait));
        requestAnimationFrame(wait); })"""
    )
    box = page.locator("#canvas").bounding_box()  # the canvas may begin within a pixel: whole ones only
    clip = {k: math.ceil(box[k]) for k in "xy"} | {k: int(box[k]) - 2 for k in ("width", "height")}
    shot = imread(BytesIO(page.screenshot(clip=clip)))
    return np.asarray(shot)[..., :3].astype(int)


def like(view: np.ndarray, number: int) -> int:
    """How many pixels have an object's hue, whatever the light on them."""
    shade = view / np.maximum(np.linalg.norm(view, axis=-1, keepdims=True), 1)
    hue = np.array(rgb(number)) / np.linalg.norm(rgb(number))
    return int(((shade @ hue > 0.985) & (np.ptp(view, axis=-1) > 60)).sum())


def differing(a: np.ndarray, b: np.ndarray) -> int:
    return int((np.abs(a - b).max(axis=-1) > 24).sum())


def click_on(page, object_id: str, tap: bool = False) -> None:
    at = page.evaluate(f"more2.where('{object_id}')")
    page.locator("#canvas").scroll_into_view_if_needed()
    box = page.locator("#canvas").bounding_box()
    (page.touchscreen.tap if tap else page.mouse.click)(box["x"] + at["x"], box["y"] + at["y"])
