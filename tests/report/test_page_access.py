"""The page for everybody: on a phone, at night, by keyboard, read aloud."""

import itertools

import numpy as np
import pytest
from page_browser import PHONE, TOGGLES, click_on, in_a_browser, like, pixels, state, until

pytestmark = in_a_browser

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
    page = opened()
    page.emulate_media(color_scheme=scheme)
    until(page, f"more2.theme === '{scheme}'")
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

# WCAG 2.2, 1.4.3: contrast of every text with what lies under it, colors that let light through laid over each other.
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
    page = opened()
    page.emulate_media(color_scheme=scheme)
    until(page, f"more2.theme === '{scheme}'")
    page.locator("[data-id=object_004]").click()
    page.locator("summary").click()
    told = page.evaluate(FAINT)
    assert told["checked"] > 60
    assert told["found"] == []


def test_tab_goes_through_the_page_in_reading_order_and_shows_where_it_is(opened):
    page = opened()
    page.locator(".skip").focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    order, unseen = [], []
    while len(order) < 60:
        name, outlined = page.evaluate(FOCUSED)
        if name in ("BODY", *order):
            break
        order.append(name)
        unseen += [] if outlined else [name]
        page.keyboard.press("Tab")
    wanted = ["A", "theme", "canvas", "play", "time", "base", *(f"toggle_{t}" for t in TOGGLES), "home"]
    wanted += ["objects"] if "objects" in order else []
    assert order == [*wanted, *(f"object_{k:03d}" for k in range(5)), "SUMMARY"]
    assert unseen == []
