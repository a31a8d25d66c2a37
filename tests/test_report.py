"""The page stands alone, says what the scene says, and shows names from files as text."""

import dataclasses
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from factories import living_scene, scene_object

from more2_jax.report import motion_text, report_html, rgb, write_report

SCENE = living_scene()


class Tables(HTMLParser):
    """All tables of a page as rows of text; every tag opened must be closed."""

    VOID = ("meta", "path", "br")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data


def rows_by_name(page: str) -> dict[str, list[str]]:
    return {row[0]: row for row in Tables(page).rows}


def test_objects_changes_and_timings_are_told(tmp_path):
    write_report(SCENE, tmp_path / "report.html")
    rows = rows_by_name((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert rows["object"][2:4] == ["monday → tuesday", "tuesday → friday"]
    assert rows["object_000"][1:] == [
        "table",
        "static 0.00 m, 0.0°",
        "static 0.00 m, 0.0°",
        "0.900",
        "10.0",
        "150",
    ]
    assert rows["object_001"][2].startswith("moved ")
    assert rows["object_001"][2].endswith(" m, 90.0°")
    assert rows["object_002"][2:] == ["removed", "absent", "–", "–", "50"]
    assert rows["object_003"][2] == "added"
    assert rows["object_004"][2:4] == ["removed", "added"]
    assert rows["monday → tuesday"][1:] == [
        "object_001",
        "object_000",
        "object_003",
        "object_002, object_004",
    ]
    assert rows["tuesday"] == ["tuesday", "instance 5", "9 points; needed 64"]
    assert rows["register"] == ["register", "3.00"]


def test_motion_is_that_of_the_definition():
    """T_scan1_ref alone says where the object's middle went: the reference observation is scan 0."""
    o = SCENE.objects[1]
    T = np.linalg.inv(o.observations[1].T_ref_scan)
    middle = o.points.mean(axis=0)
    moved = np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle)
    assert motion_text(o, SCENE.changes[0]) == f"moved {moved:.2f} m, 90.0°"


def test_nothing_is_loaded_from_anywhere():
    page = report_html(SCENE)
    assert not re.search(r"https?://|//cdn|<script|<link|<img|@import|url\((?!#)", page)


@pytest.mark.parametrize(
    "evil", ["<script>alert(1)</script>", '"><img src=x onerror=y>', "$objects ${x} & co"]
)
def test_names_from_files_are_shown_as_text(evil):
    o = dataclasses.replace(SCENE.objects[0], label=evil)
    scans = tuple(dataclasses.replace(s, name=evil) for s in SCENE.scans)
    skipped = dataclasses.replace(SCENE.scans[1].skipped[0], what=evil, reason=evil)
    scans = (scans[0], dataclasses.replace(scans[1], skipped=(skipped,)), scans[2])
    page = report_html(dataclasses.replace(SCENE, objects=(o, *SCENE.objects[1:]), scans=scans, prior=evil))
    assert "<script" not in page
    assert "<img" not in page
    rows = rows_by_name(page)
    assert rows["object_000"][1] == evil
    assert rows[evil] == [evil, evil, evil]


def plans(page: str) -> list[ElementTree.Element]:
    return [ElementTree.fromstring(s) for s in re.findall(r"<figure>(<svg.*?</svg>)", page)]


def test_plans_show_each_object_once_in_its_colour_and_the_motion_to_scale():
    drawn = plans(report_html(SCENE))
    colors = ["#{:02x}{:02x}{:02x}".format(*rgb(k)) for k in range(5)]
    for s, plan in enumerate(drawn):
        strokes = [p.get("stroke") for p in plan.iter("path") if p.get("class") == "cloud"]
        assert strokes == [
            colors[k] for k, o in enumerate(SCENE.objects) if s in [v.scan for v in o.observations]
        ]
    arrows = [[p.get("d") for p in plan.iter("path") if p.get("class") == "arrow"] for plan in drawn]
    assert [len(a) for a in arrows] == [0, 1, 0]
    x0, y0, x1, y1 = map(float, re.findall(r"-?[\d.]+", arrows[1][0]))
    # T_ref_scan turns by 90° and shifts by 2 m along y; so the scan sees it turned back and shifted along −x.
    assert (x1 - x0, y1 - y0) == pytest.approx((-2.0, 0.0), abs=0.2)


def test_colors_differ():
    colors = np.array([rgb(k) for k in range(20)], float)
    distance = np.linalg.norm(colors[:, None] - colors[None], axis=-1)
    assert distance[~np.eye(20, dtype=bool)].min() > 15


@pytest.mark.parametrize("points", [1, 2])
def test_one_scan_with_hardly_a_point(points):
    o = scene_object(0, {0: np.eye(4)})
    o = dataclasses.replace(o, points=o.points[:1].repeat(points, 0), point_scan=np.zeros(points, int))
    page = report_html(dataclasses.replace(SCENE, objects=(o,), scans=SCENE.scans[:1], changes=()))
    assert "One scan only" in page
    assert not re.search(r"\b(nan|inf)\b", page)
    assert len(plans(page)) == 1


def test_large_clouds_are_thinned():
    o = SCENE.objects[0]
    many = dataclasses.replace(o, points=np.tile(o.points, (1000, 1)), point_scan=np.tile(o.point_scan, 1000))
    page = report_html(dataclasses.replace(SCENE, objects=(many,), changes=()))
    assert len(page) < 100_000
