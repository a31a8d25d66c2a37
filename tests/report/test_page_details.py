"""The page of a large scene in a real browser: fine shapes come when wanted, go in time, and may be missing."""

import shutil
import threading

import pytest
from detailed_room import FACES, POINTS, detailed_room, small_pages
from page_browser import differing, in_a_browser, pixels, state, until

from more2_jax.cli.server import address_of, scene_server
from more2_jax.config import SceneConfig
from more2_jax.report import write_report

pytestmark = in_a_browser

COARSE = "stage.builds.map((b) => (b.fine ? b.fine.index.count / 3 : 0))"
HELD = "[...more2.details.held.keys()].map((b) => b.object.id)"
# Puts the camera half a meter off an object, so that no other is near.
GO_TO = """(id) => { const { group } = stage.builds.find((b) => b.object.id === id);
  stage.controls.target.copy(group.position);
  stage.camera.position.copy(group.position).add(new THREE.Vector3(0, -3, 0.5));
  stage.controls.update(); stage.redraw(); }"""
AFRESH = "() => { more2.select(null); more2.details.most = { points: 1e6, faces: 1e6 }; more2.home(); }"


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "report.html"
    with small_pages():
        write_report(detailed_room(), path, SceneConfig())
    return path


@pytest.fixture(scope="module")
def shared(large, opener):
    page = opener(large)
    until(page, "Boolean(more2.details)")
    return page


@pytest.fixture
def asked(said):
    """The files of details asked for since; any other word or request fails the test."""
    said.clear()
    yield said
    assert [s for s in said if "report_details/" not in s] == []
    said.clear()


@pytest.fixture
def large_page(shared, asked):
    shared.evaluate(AFRESH)
    pixels(shared)
    asked.clear()
    return shared


def idle(page) -> None:
    """Waits until all that is wanted is there and drawn."""
    until(page, "more2.settled && more2.details.reading === null")


def numbers(asked) -> list[str]:
    """Of the files asked for."""
    return [s.rpartition("/")[2].removesuffix(".js") for s in asked if s.startswith("asks for")]


def test_it_opens_coarse_and_a_selected_object_becomes_fine(large_page, asked):
    first, coarse = pixels(large_page), large_page.evaluate(COARSE)
    assert asked == [] and max(coarse) < FACES / 3
    large_page.locator("[data-id=object_001]").click()
    until(large_page, "more2.details.held.size === 1")
    idle(large_page)
    assert numbers(asked) == ["1"]
    assert large_page.evaluate("document.querySelector('script[src]')") is None
    assert large_page.evaluate(COARSE) == [FACES if k == 1 else n for k, n in enumerate(coarse)]
    assert large_page.evaluate("stage.builds[1].cloud.geometry.attributes.position.count") == POINTS
    large_page.evaluate("more2.select(null)")
    pixels(large_page)
    assert large_page.evaluate(HELD) == ["object_001"] and numbers(asked) == ["1"]  # kept while there is room
    assert state(large_page, "error") is None and first.shape == pixels(large_page).shape


# Corners of a surface in its object's frame, meters: fine and coarse.
REACH = """() => { const { mesh, fine, coarse } = stage.builds[2];
  return [fine, coarse].map((geometry) => { geometry.computeBoundingBox();
    const { min, max } = geometry.boundingBox;
    return [min, max].map((v) => v.clone().multiplyScalar(mesh.scale.x).add(mesh.position).toArray()); }); }"""


def test_a_near_object_becomes_fine_where_it_is(large_page, asked):
    large_page.evaluate("more2.details.most = { points: 0, faces: 0 }")
    large_page.evaluate(GO_TO, "object_002")
    before = pixels(large_page)
    assert asked == []
    large_page.evaluate("more2.details.most = { points: 1e6, faces: 1e6 }; stage.redraw()")
    until(large_page, "more2.details.held.size > 0")
    idle(large_page)
    assert numbers(asked) == ["2"]
    fine, coarse = large_page.evaluate(REACH)
    for a, b, half in zip(fine, coarse, (-0.5, 0.5), strict=True):
        assert a == pytest.approx(b, abs=0.1)  # a mean of vertices lies within the ball
        assert a == pytest.approx([half] * 3, abs=0.05)  # around the anchor
    assert 0.001 < differing(pixels(large_page), before) / before[..., 0].size < 0.2  # finer, not elsewhere


def test_no_more_is_held_than_may_be_and_what_was_wanted_last_stays(large_page):
    most = {"points": 2 * POINTS, "faces": 10 * FACES}
    large_page.evaluate("(most) => { more2.details.most = most; }", most)
    coarse = large_page.evaluate("stage.builds.map((b) => b.object.mesh?.faces.count / 3)")
    held = []
    for k in (0, 1, 0, 3, 4):
        large_page.evaluate(f"more2.select('object_00{k}')")
        until(large_page, f"{HELD}.includes('object_00{k}')")
        idle(large_page)
        held.append([int(name[-1]) for name in large_page.evaluate(HELD)])
    assert held[-4:] == [[0, 1], [1, 0], [0, 3], [3, 4]]
    assert large_page.evaluate(COARSE)[:4] == [*coarse[:3], FACES]
    large_page.evaluate("more2.details.most = { points: 10, faces: 10 }; more2.select('object_001')")
    pixels(large_page)
    assert "object_001" not in large_page.evaluate(HELD)  # too large ever to be held


def test_a_file_that_is_missing_cut_or_of_another_scene_leaves_the_coarse_object(
    large, opener, asked, tmp_path
):
    shutil.copytree(large.parent, tmp_path / "room")
    folder = tmp_path / "room" / "report_details"
    (folder / "0.js").unlink()
    text = (folder / "1.js").read_text()
    (folder / "1.js").write_text(text[: len(text) // 2])
    shutil.copy(folder / "3.js", folder / "2.js")
    (folder / "3.js").write_text(
        text.replace(text[14:30], (folder / "3.js").read_text()[14:30])[:-40] + '");'
    )
    page = opener(tmp_path / "room" / "report.html")
    until(page, "Boolean(more2.details)")
    coarse = page.evaluate(COARSE)
    for k in range(4):
        page.evaluate(f"more2.select('object_00{k}')")
        until(page, f"more2.details.missing.size === {k + 1}")
    idle(page)
    assert page.locator("[role=status]").inner_text() == "4 objects stay coarse: no detail in report_details"
    assert page.evaluate(COARSE) == coarse
    page.evaluate("more2.select('object_004')")
    until(page, f"{HELD}.includes('object_004')")
    assert state(page, "error") is None and numbers(asked) == list("01234")
    # The browser's own words, which a page cannot hold back.
    words = [s for s in asked if not s.startswith("asks for")]
    assert len(words) == 2 and "NOT_FOUND" in words[0] and "token" in words[1], words
    for word in words:
        asked.remove(word)


def test_over_http_too_and_for_no_other_site(large, opener, browser, asked):
    server = scene_server(large.parent)
    threading.Thread(target=lambda: server.serve_forever(poll_interval=0.02), daemon=True).start()
    try:
        page = opener(address_of(server))
        page.evaluate("more2.select('object_001')")
        until(page, f"more2.details && {HELD}.includes('object_001')")
        assert numbers(asked) == ["1"]
        other = browser.new_page()
        found = """(path) => new Promise((end) => { window.more2Detail = () => end("read");
          const script = document.createElement("script"); script.onerror = () => end("refused");
          script.src = path; document.head.append(script); })"""
        assert other.evaluate(found, f"{address_of(server)}report_details/1.js") == "refused"
        other.close()
    finally:
        server.shutdown()
        server.server_close()
