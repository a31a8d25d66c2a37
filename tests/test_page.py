"""The page in a real browser, without a display: what it does, what it draws, and whether everybody can use it."""

import base64
import dataclasses
import itertools
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
pytestmark = [
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


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(room(), path, SceneConfig())
    return path


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def said():
    """What pages put on the console, ask for or fail with."""
    return []


@pytest.fixture(scope="module")
def opener(browser, report, said):
    contexts = []

    def opening(path=report, viewport=WIDE, init=None, **options):
        context = browser.new_context(viewport=viewport, **({"reduced_motion": "reduce"} | options))
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda r: None if r.url == path.as_uri() else said.append(f"asks for {r.url}"))
        if init:
            page.add_init_script(init)
        page.goto(path.as_uri())
        until(page, "Boolean(window.more2?.ready)")
        return page

    yield opening
    for context in contexts:
        context.close()


@pytest.fixture(scope="module")
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
        page.evaluate(AFRESH)
        return page

    yield opening
    assert said == []


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
    """The 3D view as it stands after the next frame, (h, w, 3), 0 to 255."""
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
    )
    page.evaluate("scrollTo(0, 0)")
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


# --- it opens ------------------------------------------------------------------------------------------------


def test_it_opens_from_disk_and_draws_every_object(opened):
    """No word on the console, no request (the fixture's), and the last scan's objects in their colours."""
    page = opened()
    assert state(page, "error") is None
    assert (state(page, "time"), state(page, "scans")) == (2, 3)
    page.locator("#toggle_labels").uncheck()
    page.locator("#toggle_trails").uncheck()
    view = pixels(page)
    assert [like(view, k) > 50 for k in (0, 1, 3)] == [True] * 3
    assert like(view, 2) == 0  # removed
    assert page.locator("#wait").is_hidden()


def test_the_words_are_all_there(opened):
    page = opened()
    text = page.locator("body").inner_text()
    for words in (
        "Between monday and friday: 2 objects moved, 1 was added, 1 was removed, 1 stayed.",
        "1 of these is unsure.",
        "% seen",
        "9 points; needed 64",
        "Finding how it moved",
        "7.2 s",
    ):
        assert words in text
    item = page.locator("[data-id=object_001]").inner_text()
    assert "m and turned by 90°" in item
    assert "<b>chair & co</b>" in item  # a name from a file, as text
    assert page.locator("[data-id=object_004] .doubt").is_visible()
    assert page.locator("[data-id=object_001] .doubt").is_hidden()


def test_without_3d_the_words_remain(opened):
    page = opened(init="HTMLCanvasElement.prototype.getContext = () => null; console.error = () => {}")
    assert state(page, "error")
    assert "WebGL" in page.locator("#wait").inner_text()
    page.locator("#time").press("ArrowLeft")
    assert page.locator("#headline").inner_text().startswith("Between monday and tuesday")


def test_hardly_anything_in_it(opened, tmp_path):
    """One scan of one point: nothing to slide or compare, and still a page."""
    scene = room()
    o = scene_object(0, {0: np.eye(4)}, mesh=False)
    o = dataclasses.replace(o, points=o.points[:1], point_scan=np.zeros(1, int))
    scene = dataclasses.replace(scene, objects=(o,), scans=living_scene().scans[:1], changes=())
    write_report(scene, tmp_path / "one.html", SceneConfig())
    page = opened(tmp_path / "one.html")
    assert state(page, "error") is None
    assert page.locator("section.time").is_hidden()
    assert page.locator("#toggle_split").is_disabled()
    assert page.locator("#headline").inner_text() == "monday: 1 object found."


# --- it does what it says -------------------------------------------------------------------------------------


def test_the_slider_goes_through_time(opened):
    page = opened()
    page.locator("#toggle_trails").uncheck()
    page.locator("#toggle_labels").uncheck()
    seen = {2: pixels(page)}
    slider = page.locator("#time")
    for time, name in ((1, "tuesday"), (0, "monday")):
        slider.press("ArrowLeft")
        assert state(page, "time") == state(page, "shownTime") == time
        assert slider.get_attribute("aria-valuetext") == name == page.locator("#view_now").inner_text()
        seen[time] = pixels(page)
    assert page.locator("#headline").inner_text() == "monday: 4 objects found."
    assert like(seen[0], 2) > 50 and like(seen[1], 2) == 0  # removed after monday
    assert like(seen[0], 3) == 0 and like(seen[1], 3) > 50  # added on tuesday
    assert differing(seen[0], seen[1]) > 500
    slider.press("End")
    assert differing(pixels(page), seen[2]) == 0


def test_comparing_with_the_scan_before(opened):
    page = opened()
    page.locator("#base").select_option("previous")
    assert (
        page.locator("#headline")
        .inner_text()
        .startswith("Between tuesday and friday: 1 object was added, 3 stayed")
    )
    assert page.locator("[data-id=object_001] .status").inner_text().endswith("stayed where it was")


def test_objects_glide_and_play_ends_at_the_last(opened):
    page = opened(reduced_motion="no-preference")
    page.evaluate(
        """() => { window.times = []; const note = () => { times.push(more2.shownTime); requestAnimationFrame(note); };
        note(); }"""
    )
    page.locator("#play").click()
    assert page.locator("#play").get_attribute("aria-label") == "Stop"
    until(page, "times.includes(1) && more2.shownTime === 2 && !more2.playing")
    assert any(0 < t < 1 for t in page.evaluate("times"))


def test_selecting_in_the_list_shows_in_the_view(opened):
    page = opened()
    page.locator("#toggle_labels").uncheck()
    before = pixels(page)
    page.locator("[data-id=object_001]").click()
    assert state(page, "selected") == "object_001"
    assert page.locator("[aria-pressed=true]").get_attribute("data-id") == "object_001"
    assert page.locator("#details").inner_text().startswith("1")
    assert "turned by 90°" in page.locator("#details").inner_text()
    after = pixels(page)
    assert like(after, 1) > 50
    assert like(after, 0) < 0.2 * like(before, 0)  # what is not selected fades
    page.keyboard.press("Escape")
    assert state(page, "selected") is None
    assert page.locator("#details").is_hidden()
    assert differing(pixels(page), before) == 0


def test_selecting_in_the_view_shows_in_the_list(opened):
    page = opened()
    for name in ("object_000", "object_003"):
        click_on(page, name)
        assert state(page, "selected") == name
        assert page.locator(f"[data-id={name}]").get_attribute("aria-pressed") == "true"
    box = page.locator("#canvas").bounding_box()
    page.mouse.click(box["x"] + 3, box["y"] + 3)
    assert state(page, "selected") is None


@pytest.mark.parametrize("name", TOGGLES)
def test_a_toggle_changes_the_view_and_back(opened, name):
    page = opened()
    if name == "accumulated":  # what it adds lies within the surfaces
        page.locator("#toggle_meshes").uncheck()
        page.locator("#toggle_clouds").uncheck()
    first = pixels(page)
    box = page.locator(f"#toggle_{name}")
    page.locator("label", has=box).click()
    assert state(page, f"toggles.{name}") == box.is_checked()
    assert differing(pixels(page), first) > 20
    page.locator("label", has=box).click()
    assert differing(pixels(page), first) == 0


def test_before_and_after_stand_side_by_side(opened):
    page = opened()
    page.locator("#toggle_labels").uncheck()
    page.locator("#toggle_trails").uncheck()
    page.locator("#toggle_split").check()
    assert page.locator("#view_before").inner_text() == "Before: monday"
    assert page.locator("#view_now").inner_text() == "After: friday"
    view = pixels(page)
    left, right = np.array_split(view, 2, axis=1)
    assert like(left, 2) > 20 and like(right, 2) == 0
    assert like(left, 3) == 0 and like(right, 3) > 20


def test_dragging_turns_and_does_not_select(opened):
    page = opened()
    first = pixels(page)
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 380, box["y"] + 300, steps=4)
    page.mouse.up()
    assert differing(pixels(page), first) > 500
    assert state(page, "selected") is None
    page.locator("#home").click()
    page.wait_for_timeout(400)  # fine again, where moving made it coarse
    assert differing(pixels(page), first) < 0.01 * first[..., 0].size


def test_all_of_it_by_keyboard(opened):
    page = opened()
    canvas = page.locator("#canvas")
    canvas.focus()
    for key in ("a", "w", "+"):
        before = pixels(page)
        page.keyboard.press(key)
        assert differing(pixels(page), before) > 100, key
    page.keyboard.press("ArrowLeft")
    assert state(page, "time") == 1
    page.keyboard.press(" ")
    assert state(page, "playing")
    page.keyboard.press(" ")
    assert not state(page, "playing")
    page.locator("[data-id=object_000]").focus()
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    assert state(page, "selected") == "object_002"


def test_nothing_is_drawn_at_rest(opened):
    page = opened()
    pixels(page)
    page.wait_for_timeout(300)
    frames = state(page, "frames")
    page.wait_for_timeout(500)
    assert state(page, "frames") == frames


# --- on a phone, at night -------------------------------------------------------------------------------------


def test_on_a_phone(opened):
    page = opened(viewport=PHONE, has_touch=True, is_mobile=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.locator("[data-id=object_000]").tap()
    assert state(page, "selected") == "object_000"
    click_on(page, "object_003", tap=True)
    assert state(page, "selected") == "object_003"
    page.locator("label", has=page.locator("#toggle_split")).tap()
    page.locator("#toggle_labels").uncheck()
    page.locator("#toggle_trails").uncheck()
    page.evaluate("more2.select(null)")
    upper, lower = np.array_split(pixels(page), 2, axis=0)
    assert like(upper, 2) > 10 and like(lower, 2) == 0  # one over the other where the screen is narrow
    small = page.evaluate(
        """[...document.querySelectorAll("button, select, .toggle, #time")].filter((e) => e.offsetParent)
        .filter((e) => Math.min(e.offsetWidth, e.offsetHeight) < 24).map((e) => e.outerHTML)"""
    )
    assert small == []  # WCAG 2.2, target size


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_light_and_dark(opened, scheme):
    page = opened(color_scheme=scheme)
    assert state(page, "theme") == scheme
    assert (pixels(page)[5:40, -40:-5].mean() > 128) == (scheme == "light")
    page.locator("#theme").click()
    assert (pixels(page)[5:40, -40:-5].mean() > 128) == (scheme == "dark")


# --- for everybody --------------------------------------------------------------------------------------------

NAMELESS = """() => [...document.querySelectorAll("button, input, select, a, summary, canvas, section, aside")]
  .filter((e) => {
    const by = e.getAttribute("aria-labelledby");
    const label = e.getAttribute("aria-label") || (by && document.getElementById(by).textContent);
    const own = e.matches("button, a, summary") && e.textContent.trim();
    const heading = e.matches("section") && e.querySelector("h2");
    return !(label || own || heading || (e.labels && [...e.labels].some((l) => l.textContent.trim())));
  }).map((e) => e.outerHTML.slice(0, 120))"""

# WCAG 2.2, 1.4.3: contrast of every text with what lies under it, colours that let light through laid over each other.
FAINT = """() => {
  const parse = (c) => { const v = c.match(/[\\d.]+/g).map(Number); return v.length === 3 ? [...v, 1] : v; };
  const over = (a, b) => [0, 1, 2].map((k) => a[k] * a[3] + b[k] * (1 - a[3])).concat(1);
  const ground = (e) => { if (!e) return [255, 255, 255, 1];
    const c = parse(getComputedStyle(e).backgroundColor); return c[3] === 1 ? c : over(c, ground(e.parentElement)); };
  const light = (c) => c.slice(0, 3).map((v) => v / 255)
    .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const found = [];
  let checked = 0;
  for (const e of document.querySelectorAll("body *")) {
    const text = [...e.childNodes].filter((n) => n.nodeType === 3).map((n) => n.data.trim()).join("");
    if (!text || !e.checkVisibility() || e.matches("script, noscript, :disabled")) continue;
    if (e.querySelector(":disabled")) continue;
    if (e.closest(".tag.off")) continue;
    checked += 1;
    const style = getComputedStyle(e);
    const under = ground(e);
    const [a, b] = [light(over(parse(style.color), under)), light(under)];
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize);
    if (contrast < (size >= 24 || (size >= 18.7 && style.fontWeight >= 700) ? 3 : 4.5)) found.push([text, contrast]);
  }
  return { checked, found };
}"""


FOCUSED = """() => {
  const e = document.activeElement;
  const line = (x) => x && getComputedStyle(x);
  const shown = (x) => x && line(x).outlineStyle !== "none" && parseFloat(line(x).outlineWidth) >= 2;
  return [e.id || e.dataset.id || e.tagName, shown(e) || shown(e.closest(".toggle"))];
}"""


def test_everything_has_a_name_and_a_place(opened):
    page = opened()
    page.locator("[data-id=object_001]").click()
    assert page.evaluate(NAMELESS) == []
    assert page.evaluate("document.documentElement.lang") == "en"
    assert page.title() == "Living scene: monday, tuesday, friday"
    assert page.evaluate("[...document.querySelectorAll('[id]')].map((e) => e.id).length") == page.evaluate(
        "new Set([...document.querySelectorAll('[id]')].map((e) => e.id)).size"
    )
    assert page.locator("h1").count() == page.locator("main").count() == page.locator("header").count() == 1
    levels = page.evaluate(
        "[...document.querySelectorAll('h1, h2, h3, h4')].map((e) => Number(e.tagName[1]))"
    )
    assert levels[0] == 1 and all(b - a <= 1 for a, b in itertools.pairwise(levels))
    assert page.locator("th:not([scope])").count() == 0
    assert page.locator("#headline").get_attribute("aria-live") == "polite"
    assert page.evaluate("[...document.querySelectorAll('[tabindex]')].every((e) => e.tabIndex <= 0)")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out(opened, scheme):
    page = opened(color_scheme=scheme)
    page.locator("[data-id=object_004]").click()
    page.locator("summary").click()
    told = page.evaluate(FAINT)
    assert told["checked"] > 60
    assert told["found"] == []


def test_tab_goes_through_the_page_in_reading_order_and_shows_where_it_is(opened):
    page = opened(viewport=WIDE)  # its own: focus begins at the top
    order, unseen = [], []
    for _ in range(60):
        page.keyboard.press("Tab")
        name, outlined = page.evaluate(FOCUSED)
        if name in ("BODY", *order):
            break
        order.append(name)
        unseen += [] if outlined else [name]
    wanted = ["A", "theme", "canvas", "play", "time", "base", *(f"toggle_{t}" for t in TOGGLES), "home"]
    wanted += ["objects"] if "objects" in order else []
    assert order == [*wanted, *(f"object_{k:03d}" for k in range(5)), "SUMMARY"]
    assert unseen == []


def test_the_data_are_not_in_the_way_of_reading(report):
    """What is read comes before data, library and program: the first paint waits for none of them."""
    text = report.read_text(encoding="utf-8")
    assert text.index("How to read this page") < text.index('id="scene"') < text.index('id="blob"')
    assert text.index('id="blob"') < text.index("var THREE")
    packed = text.split('id="blob">')[1].split("<")[0]
    assert base64.b64decode(packed)[:2] == b"\x1f\x8b"
