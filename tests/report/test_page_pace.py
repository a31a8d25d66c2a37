"""How much of the page's 3D view is drawn: all at rest, on the way what the machine keeps up with."""

import pytest
from page_browser import differing, in_a_browser, pixels, state, until

pytestmark = in_a_browser

# Frames asked for without a pause for half a second, of a machine that takes `cost[level]` ms for a frame.
MOVE = """async (cost) => {
  const pace = new Pace(async (quality) => {
    const end = performance.now() + cost[QUALITY.indexOf(quality)];
    while (performance.now() < end);
  });
  const end = performance.now() + 500;
  while (performance.now() < end) {
    pace.request();
    await new Promise(requestAnimationFrame);
  }
  const moving = pace.frames.map(([, , level]) => level);
  await new Promise((done) => setTimeout(done, 3 * REST_MS + 2 * cost[0]));
  return { moving, after: pace.frames.slice(moving.length).map(([, , level]) => level), settled: pace.settled };
}"""


@pytest.mark.parametrize(
    ("cost", "level"),
    [
        pytest.param([400, 200, 30, 0], 2, id="the finest level that is smooth"),
        pytest.param([400, 300, 200, 150], 3, id="the coarsest where none is"),
        pytest.param([0, 0, 0, 0], 0, id="all of it on a fast machine"),
    ],
)
def test_moving_is_as_fine_as_the_machine_allows_and_rest_is_full(opened, cost, level):
    told = opened().evaluate(MOVE, cost)
    assert told["moving"][0] == 3  # nothing is known yet
    assert min(told["moving"]) == level
    assert told["after"] == ([0] if told["moving"][-1] else [])
    assert told["settled"]


@pytest.mark.parametrize("everything", [False, True])
def test_a_coarser_view_shows_the_same_room_with_less(opened, everything):
    page = opened()
    page.evaluate(f"more2.toggle('accumulated', {str(everything).lower()})")
    full = pixels(page)
    counted = []
    for level in range(4):
        page.evaluate(f"stage.pace.drawLevel({level})")
        counted.append(page.evaluate("({ ...stage.renderer.info.render, width: stage.canvas.width })"))
    for name in ("points", "width"):
        amounts = [c[name] for c in counted]
        assert amounts == sorted(amounts, reverse=True) and amounts[-1] < amounts[0], name
    assert counted[0]["triangles"] >= counted[1]["triangles"] > counted[3]["triangles"]  # no pale shapes
    page.evaluate("stage.redraw()")
    assert differing(pixels(page), full) == 0


def test_nothing_is_drawn_at_rest(opened):
    page = opened()
    pixels(page)
    frames = state(page, "frames")
    page.wait_for_timeout(500)
    assert state(page, "frames") == frames


def test_every_change_ends_in_a_full_picture(opened):
    """Turning, sliding, selecting, switching: whatever was drawn on the way, the last frame is of full quality."""
    page = opened()
    for change in ("moveCamera('d')", "setTime(0)", "select('object_001')", "toggle('labels', false)"):
        assert page.evaluate(f"() => {{ more2.{change}; return more2.settled; }}") is False
        until(page, "more2.settled")
        assert page.evaluate("stage.canvas.width === stage.canvas.clientWidth")
