"""Beside the page of a large scene lie its objects' own points and surfaces; beside that of a small one, nothing."""

import dataclasses
import json
import re

import numpy as np
import pytest
from detailed_room import detailed_room, small_pages
from factories import living_scene
from packed_arrays import array_of, points_back, unpacked
from report_html_parser import Page
from scipy.spatial import KDTree

from more2_jax.config import SceneConfig
from more2_jax.report import details, report_details, report_html, write_report
from more2_jax.report.details import is_large
from more2_jax.storage.scene_folder import load_scene, save_scene

ROOM, CONFIG = detailed_room(), SceneConfig()
CALL = re.compile(r'more2Detail\("([0-9a-f]{16})",(\{.*\}),"([A-Za-z0-9+/=]*)"\);\n')


@pytest.fixture
def little():
    with small_pages():
        yield


def read_detail(text: str) -> tuple[str, dict, bytes]:
    """Stamp, shape and arrays of a detail's file."""
    call = CALL.fullmatch(text)
    assert call is not None
    return call[1], json.loads(call[2]), unpacked(call[3])


def told(text: str) -> dict:
    return json.loads(Page(text).scripts[0])


# --- which scenes have them -----------------------------------------------------------------------------------


def sized(objects: int, points: int):
    """A scene of so many objects with so many points each, without surfaces."""
    o = living_scene().objects[4]
    cloud = np.broadcast_to(np.zeros(3), (points, 3))
    o = dataclasses.replace(o, points=cloud, point_scan=np.broadcast_to(0, points))
    return dataclasses.replace(ROOM, objects=(o,) * objects)


@pytest.mark.parametrize(
    ("objects", "points", "large"),
    [(65, 8000, True), (64, 8000, False), (1000, 500, False), (1000, 501, True)],
)
def test_a_scene_is_large_with_many_objects_and_more_than_a_page_holds(objects, points, large):
    assert is_large(sized(objects, points)) is large


def test_the_page_of_a_small_scene_stands_alone(tmp_path):
    write_report(ROOM, tmp_path / "report.html", CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert list(report_details(ROOM)) == []
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "details" not in told(text) and "more2Detail" not in text
    assert "script-src 'unsafe-inline'; style-src" in text


# --- what they hold -------------------------------------------------------------------------------------------


def test_a_detail_holds_the_points_and_the_surface_of_its_object(little):
    page = told(report_html(ROOM, CONFIG))
    files = dict(report_details(ROOM))
    assert page["details"] == "report_details"
    assert list(files) == [f"{k}.js" for k in range(5)]
    for k, (o, shown) in enumerate(zip(ROOM.objects, page["objects"], strict=True)):
        stamp, shape, data = read_detail(files[f"{k}.js"])
        assert shown["detail"] == {"stamp": stamp, "points": 900, "faces": 0 if o.mesh is None else 1280}
        anchor = o.points.mean(axis=0)
        cloud = points_back(data, shape["cloud"]) + anchor
        assert shape["counts"] == [600, 300] and sum(shown["counts"]) == 20  # the page's own share
        for scan, part in enumerate(np.split(cloud, [600])):
            far, nearest = KDTree(o.points[o.point_scan == scan]).query(part)
            assert far.max() < 1e-4 and len(np.unique(nearest)) == len(part)
        assert (shape["mesh"] is None) == (o.mesh is None)
        if o.mesh is not None:
            vertices = points_back(data, shape["mesh"]["vertices"]) + anchor
            np.testing.assert_allclose(vertices, o.mesh.vertices, atol=1e-4)
            np.testing.assert_array_equal(array_of(data, shape["mesh"]["faces"]).reshape(-1, 3), o.mesh.faces)
            assert shape["mesh"]["closed"] is True
            assert shown["mesh"]["faces"]["count"] < 3 * 1280 / 5


def test_a_detail_keeps_to_its_size(little, monkeypatch):
    monkeypatch.setattr(details, "MAX_DETAIL_POINTS", 90)
    monkeypatch.setattr(details, "MAX_DETAIL_FACES", 400)
    page = told(report_html(ROOM, CONFIG))
    for (_, text), shown in zip(report_details(ROOM), page["objects"], strict=True):
        _, shape, _ = read_detail(text)
        assert shape["counts"] == [60, 30]
        assert shown["detail"]["points"] == 90
        if shape["mesh"] is not None:
            assert 100 < shape["mesh"]["faces"]["count"] / 3 <= shown["detail"]["faces"] == 400


def test_another_surface_or_other_points_have_another_stamp(little):
    first = ROOM.objects[0]
    moved = dataclasses.replace(first, points=first.points + 0.001)
    mesh = dataclasses.replace(first.mesh, vertices=first.mesh.vertices * 1.001)
    stamps = [details.detail_of(o)["stamp"] for o in (first, moved, dataclasses.replace(first, mesh=mesh))]
    assert len(set(stamps)) == 3
    assert stamps[0] == details.detail_of(dataclasses.replace(first, label="chair"))["stamp"]


def test_the_page_may_load_scripts_of_its_own_origin_alone(little):
    page = Page(report_html(ROOM, CONFIG))
    policy = next(e[1]["content"] for e in page.elements if e[1].get("http-equiv"))
    assert policy == "default-src 'none'; script-src 'unsafe-inline' 'self' file:; style-src 'unsafe-inline'"
    assert [e for e in page.elements if "src" in e[1]] == []


# --- they come and go with the page ---------------------------------------------------------------------------


def test_details_are_written_beside_the_page_and_go_with_it(tmp_path):
    page, folder = tmp_path / "report.html", tmp_path / "report_details"
    with small_pages():
        write_report(ROOM, page, CONFIG)
        assert {p.name: p.read_text(encoding="utf-8") for p in folder.iterdir()} == dict(report_details(ROOM))
        fewer = dataclasses.replace(ROOM, objects=ROOM.objects[:4])
        write_report(fewer, page, CONFIG)
        assert len(list(folder.iterdir())) == 4
    write_report(ROOM, page, CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def saved(folder, scene=ROOM) -> set[str]:
    """Saves the scene with its page; the names in the folder of details."""
    save_scene(scene, folder, CONFIG, page=report_html(scene, CONFIG), details=report_details(scene))
    return {p.name for p in (folder / "report_details").glob("*")}


def test_a_saved_scene_has_the_details_of_its_page_alone(tmp_path):
    folder = tmp_path / "room"
    with small_pages():
        assert saved(folder) == {f"{k}.js" for k in range(5)}
        before = {p.name: p.read_bytes() for p in (folder / "report_details").iterdir()}
        assert saved(folder, load_scene(folder)[0]) == set(before)
        assert {p.name: p.read_bytes() for p in (folder / "report_details").iterdir()} == before
        (folder / "report_details" / "9.js").touch()  # of a scene with more objects
        assert saved(folder) == set(before)
    assert saved(folder) == set()
    assert not (folder / "report_details").exists()


def test_what_ends_in_the_middle_of_the_details_leaves_the_folder_as_it_was(tmp_path):
    def broken():
        yield "0.js", "half"
        raise OSError("disk full")

    folder = tmp_path / "room"
    with small_pages():
        saved(folder)
    with pytest.raises(OSError, match="disk full"):
        save_scene(ROOM, folder, CONFIG, page="<p>new</p>", details=broken())
    assert len(list((folder / "report_details").iterdir())) == 5
    assert "<p>new</p>" not in (folder / "report.html").read_text(encoding="utf-8")
    assert [p.name for p in tmp_path.iterdir()] == ["room"]
