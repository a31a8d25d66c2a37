"""The page in a real browser: it opens from disk, and slider, selection and switches do what they say."""

import base64
import dataclasses

import numpy as np
import pytest
from factories import living_scene, scene_object
from page_browser import (
    PHONE,
    TOGGLES,
    WIDE,
    click_on,
    differing,
    in_a_browser,
    like,
    pixels,
    room,
    state,
    until,
)

from more2_jax.config import SceneConfig
from more2_jax.report import write_report

pytestmark = in_a_browser

# --- it opens ------------------------------------------------------------------------------------------------


def test_it_opens_from_disk_and_draws_every_object(opened):
    """No word on the console, no request (the fixture's), and the last scan's objects in their colors."""
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
        "7.8 s",
    ):
        assert words in text
    item = page.locator("[data-id=object_001]").inner_text()
    assert "m and turned by 90°" in item
    assert "<b>chair & co</b>" in item  # a name from a file, as text
    assert page.locator("[data-id=object_004] .doubt").is_visible()
    assert page.locator("[data-id=object_001] .doubt").is_visible()  # it may have changed places
    assert page.locator("[data-id=object_000] .doubt").is_hidden()


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


def test_the_data_are_not_in_the_way_of_reading(report):
    """What is read comes before data, library and program: the first paint waits for none of them."""
    text = report.read_text(encoding="utf-8")
    assert text.index("How to read this page") < text.index('id="scene"') < text.index('id="blob"')
    assert text.index('id="blob"') < text.index("var THREE")
    packed = text.split('id="blob">')[1].split("<")[0]
    assert base64.b64decode(packed)[:2] == b"\x1f\x8b"


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
    page = opened()
    page.emulate_media(reduced_motion="no-preference")
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


CORNERS = """() => [0, 1, 2, 3, 4, 5, 6, 7].map((k) => {
  const c = new THREE.Vector3(...[0, 1, 2].map((axis) => (k & (1 << axis) ? scene.box.high : scene.box.low)[axis]));
  const { x, y } = c.project(stage.camera);
  return [x, y];
})"""


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("viewport", [WIDE, PHONE], ids=["wide", "phone"])
def test_at_first_the_room_fills_the_view(opened, viewport, split):
    """All corners of the objects' box lie in the picture, -1 to 1, and touch the margin on two opposite sides."""
    page = opened()
    page.set_viewport_size(viewport)
    page.evaluate(f"more2.toggle('split', {str(split).lower()})")
    pixels(page)
    page.evaluate("more2.home()")
    pixels(page)
    corners = np.array(page.evaluate(CORNERS))
    page.set_viewport_size(WIDE)
    low, high = corners.min(axis=0), corners.max(axis=0)
    assert low.min() > -1 and high.max() < 1
    tight = (high - low).argmax()
    assert (low[tight], high[tight]) == pytest.approx((-1 / 1.08, 1 / 1.08), abs=0.01)


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
