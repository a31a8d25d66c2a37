"""The page stands alone, says what the scene says, shows names from files as text, and keeps to its size."""

import dataclasses
import json
import re

import numpy as np
import pytest
from factories import WORLD_M, cube, living_scene, scene_object, turn_z
from packed_arrays import array_of, points_back, unpacked
from report_html_parser import Page
from scipy.spatial.transform import Rotation
from skimage.color import rgb2lab

from more2_jax.config import SceneConfig
from more2_jax.geometry.poses import apply_pose
from more2_jax.report import (
    color,
    frame_text,
    leveled_text,
    motion_text,
    noise_text,
    report_html,
    rgb,
    write_report,
)
from more2_jax.report.blob import Blob
from more2_jax.report.coverage import coverage
from more2_jax.report.palette import BASE, ink
from more2_jax.report.payload import payload
from more2_jax.report.wording import Verdict, headline, phrase, verdict
from more2_jax.tracking.objects import points_of
from more2_jax.types import Changes, Frame, Repair

SCENE, CONFIG = living_scene(), SceneConfig()


def page_of(scene=SCENE) -> Page:
    return Page(report_html(scene, CONFIG))


def test_the_room_and_every_object_are_told(tmp_path):
    write_report(SCENE, tmp_path / "report.html", CONFIG)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Between monday and friday: 1 object moved, 1 was added, 1 was removed, 2 stayed." in text
    assert "Between tuesday and friday: 1 object was added, 3 stayed." in text
    page = Page(text)
    assert page.buttons["object_000"].startswith(
        "0|table|stayed where it was|unsure|match 0.90 · 150 points · "
    )
    assert re.search(r"moved by \d\.\d\d m and turned by 90°", page.buttons["object_001"])
    assert page.buttons["object_002"].startswith("2|object 2|removed|unsure|in one scan only · 50 points · ")
    assert page.buttons["object_003"].startswith("3|object 3|added|")
    assert "no surface" in page.buttons["object_004"]
    assert ["tuesday", "instance 5", "9 points; needed 64"] in page.rows
    assert ["Finding how it moved", "", "3.0 s"] in page.rows
    assert page.rows[-1] == ["All", "", "7.8 s"]


def test_motion_is_that_of_the_definition():
    """T_scan1_ref alone says where the object's middle went: the reference observation is scan 0."""
    o = SCENE.objects[1]
    T = np.linalg.inv(o.observations[1].T_ref_scan)
    middle = o.points.mean(axis=0)
    moved = np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle)
    assert motion_text(o, SCENE.changes[0]) == f"moved {moved:.2f} m, 90.0°"


def test_nothing_is_loaded_from_anywhere():
    page = page_of()
    loading = {"src", "href", "action", "srcset", "data"}
    assert [e for e in page.elements if loading & set(e[1]) and e[1].get("href") != "#list"] == []
    assert not {e[0] for e in page.elements} & {"link", "img", "iframe", "object", "embed"}
    policy = next(e[1]["content"] for e in page.elements if e[1].get("http-equiv"))
    assert policy == "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"


@pytest.mark.parametrize(
    "evil", ["<script>alert(1)</script>", '"><img src=x onerror=y>', "$title ${x} & </script>"]
)
def test_names_from_files_are_shown_as_text(evil):
    o = dataclasses.replace(SCENE.objects[0], label=evil)
    scans = tuple(dataclasses.replace(s, name=evil) for s in SCENE.scans)
    skipped = dataclasses.replace(SCENE.scans[1].skipped[0], what=evil, reason=evil)
    scans = (scans[0], dataclasses.replace(scans[1], skipped=(skipped,)), scans[2])
    page = page_of(dataclasses.replace(SCENE, objects=(o, *SCENE.objects[1:]), scans=scans, prior=evil))
    assert [e[0] for e in page.elements] == [e[0] for e in page_of().elements]
    assert [evil, evil, evil] in page.rows
    assert json.loads(page.scripts[0])["objects"][0]["name"] == evil


# --- words --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance", "angle", "says"),
    [
        (1.2, 35.0, "moved by 1.20 m and turned by 35°"),
        (0.3, 0.2, "moved by 30 cm"),
        (0.004, 90.0, "turned by 90°"),
    ],
)
def test_motion_in_words(distance, angle, says):
    assert phrase(Verdict(status="moved", distance_m=distance, angle_deg=angle)) == says


def doubtful(**seen) -> Verdict:
    o = SCENE.objects[1]
    worse = dataclasses.replace(o.observations[1], **{"interchangeable": False} | seen)
    return verdict(dataclasses.replace(o, observations=(o.observations[0], worse)), SCENE.changes[0])


def test_a_change_of_little_probability_is_told_as_unsure():
    o, changes = SCENE.objects[0], SCENE.changes[0]
    for chance, doubts in ((0.9, 0), (0.55, 1)):
        found = verdict(o, dataclasses.replace(changes, probability={o.id: chance}))
        assert len(found.doubts) == doubts and all("probability of 55%" in d for d in found.doubts)


def test_doubts_are_told():
    assert doubtful().doubts == ()
    assert doubtful(converged=False).doubts == ("its new position did not settle",)
    assert "match score 0.20" in doubtful(score=0.2).doubts[0]
    assert len(doubtful(score=-1.0, converged=False).doubts) == 2
    assert doubtful(interchangeable=True).doubts == (
        "it may have changed places with a piece that looks the same",
    )
    assert "left out of its shape" in doubtful(accumulated=False).doubts[0]
    assert headline(SCENE, [doubtful(score=0.2)], 0, 1).endswith("1 object moved. 1 of these is unsure.")


def in_frames(*frames: Frame):
    """The scene whose last scans lie so."""
    kept, last = SCENE.scans[: -len(frames)], SCENE.scans[-len(frames) :]
    scans = (dataclasses.replace(s, frame=f) for s, f in zip(last, frames, strict=True))
    return dataclasses.replace(SCENE, scans=(*kept, *scans))


def test_how_a_scan_lies_in_a_frame_of_its_own_is_told_and_where_nothing_tells():
    turned, little = np.eye(4), np.eye(4)
    turned[:3, :3] = Rotation.from_euler("zx", [-67.0, 3.0], degrees=True).as_matrix()
    turned[:3, 3] = [5.0, -3.0, 0.4]
    little[:3, :3] = Rotation.from_euler("z", 1.0, degrees=True).as_matrix()
    scene = in_frames(Frame(T_scene_scan=little), Frame(T_scene_scan=turned))
    told = [frame_text(scene, s) for s in scene.scans]
    assert told == [None, None, "friday: lies in a frame of its own, turned by 67° against monday"]
    assert "turned by 67° against monday." in report_html(scene, CONFIG)
    tipped = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # about x
    free = dataclasses.replace(in_frames(Frame(T_scene_scan=tipped)), upright=False)
    assert "turned by 90°" in (frame_text(free, free.scans[-1]) or "")
    text = frame_text(lost := in_frames(Frame(unknown=True)), lost.scans[-1])
    assert text is not None and "nothing tells how" in text and text in report_html(lost, CONFIG)
    both = in_frames(Frame(T_scene_scan=turned), Frame(T_scene_scan=turned))
    assert frame_text(dataclasses.replace(both, scans=both.scans[1:]), both.scans[-1]) is None  # one frame


@pytest.mark.parametrize(("noise_m", "told"), [(0.0, False), (0.012, False), (0.024, True)])
def test_much_noise_between_scans_is_told(noise_m, told):
    friday = dataclasses.replace(SCENE.scans[2], frame=Frame(noise_m=noise_m))
    scene = dataclasses.replace(SCENE, scans=(*SCENE.scans[:2], friday))
    text = (
        "friday: surfaces lie some 2.4 cm off those before, by noise and drift: small motions cannot be told"
    )
    assert [noise_text(scene, s) for s in scene.scans] == [None, None, text if told else None]
    assert ("by noise and drift" in report_html(scene, CONFIG)) == told


def test_the_tilt_of_a_leveled_scan_is_told():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", [70.0, 3.21], degrees=True).as_matrix()
    friday = dataclasses.replace(SCENE.scans[2], frame=Frame(T_scene_scan=T))
    scene = dataclasses.replace(SCENE, scans=(*SCENE.scans[:2], friday))
    assert [leveled_text(scene, s) for s in scene.scans] == [None, None, "friday: leveled by 3.2°"]
    assert "friday: leveled by 3.2°." in report_html(scene, CONFIG)
    assert "leveled" not in report_html(SCENE, CONFIG)
    free = dataclasses.replace(scene, upright=False)  # the scans' frames then differ any way
    assert leveled_text(free, friday) is None


def test_the_reference_observation_is_beyond_doubt():
    o = SCENE.objects[2]
    odd = dataclasses.replace(o, observations=(dataclasses.replace(o.observations[0], score=0.0),))
    assert verdict(odd, SCENE.changes[0]).doubts == ()


def test_nobody_in_either_scan():
    absent = verdict(SCENE.objects[2], SCENE.changes[1])
    assert phrase(absent) == "not here"
    assert "no object is in either" in headline(SCENE, [absent], 1, 2)


def test_first_and_last_are_compared_by_the_settings():
    """From scan 0 to 2 the scene has no changes stored: object 1 moved 90° there, unless that counts as still."""
    lenient = dataclasses.replace(CONFIG, static_deg=180.0, static_m=100.0)
    assert payload(SCENE, CONFIG)[0]["pairs"]["0-2"]["verdicts"][1]["status"] == "moved"
    assert payload(SCENE, lenient)[0]["pairs"]["0-2"]["verdicts"][1]["status"] == "static"


# --- what goes into the page --------------------------------------------------------------------------------


def test_points_come_back_to_half_a_step():
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(n, 3)) * [1, 20, 0.1] for n in (1, 3, 1000)]
    blob = Blob()
    references = [blob.add_points(c) for c in clouds]
    data = unpacked(blob.text())
    for cloud, reference in zip(clouds, references, strict=True):
        assert reference["at"] % 4 == 0
        assert np.abs(points_back(data, reference) - cloud).max() <= 0.5001 * reference["step"]
        assert reference["step"] <= np.ptp(cloud, axis=0).max() / 65535 + 1e-9
    with pytest.raises(ValueError, match="array of float64"):
        blob.add(np.zeros(3))


def test_the_page_puts_every_observation_where_the_scan_saw_it():
    """Poses and quantized clouds of the payload, composed as three.js does, give the scans' points back."""
    data, text = payload(SCENE, CONFIG)
    blob = unpacked(text)
    clouds = [points_of(o, s) for o in SCENE.objects for s in o.observations]
    low, high = (f(np.concatenate(clouds), axis=0) for f in (np.min, np.max))
    for o, shown in zip(SCENE.objects, data["objects"], strict=True):
        start = np.cumsum([0, *shown["counts"]])
        local = points_back(blob, shown["cloud"])
        for k, seen in enumerate(shown["observations"]):
            R = Rotation.from_quat(seen["quaternion"])
            placed = R.apply(local[start[k] : start[k + 1]]) + seen["position"] + (low + high) / 2
            expected = points_of(o, o.observations[k])
            order = [np.lexsort(np.round(p, 2).T) for p in (placed, expected)]
            nearest = np.linalg.norm(placed[:, None] - expected[None], axis=-1).min(axis=1)
            assert nearest.max() < 1e-4
            assert len(order[0]) == len(order[1]) == 50
        if o.mesh is not None:
            faces = array_of(blob, shown["mesh"]["faces"]).reshape(-1, 3)
            np.testing.assert_array_equal(faces, o.mesh.faces)
            vertices = points_back(blob, shown["mesh"]["vertices"]) + o.points.mean(axis=0)
            np.testing.assert_allclose(vertices, o.mesh.vertices, atol=1e-4)


def test_backgrounds_go_in_with_their_scan():
    ground = np.random.default_rng(1).uniform(-2, 2, (500, 3)) + WORLD_M
    scans = (dataclasses.replace(SCENE.scans[0], background=ground), *SCENE.scans[1:])
    data, text = payload(dataclasses.replace(SCENE, scans=scans), CONFIG)
    assert [s["background"] is None for s in data["scans"]] == [False, True, True]
    shown = points_back(unpacked(text), data["scans"][0]["background"])
    np.testing.assert_allclose(np.ptp(shown, axis=0), np.ptp(ground, axis=0), atol=1e-3)


@pytest.mark.parametrize("points", [1, 2])
def test_one_scan_with_hardly_a_point(points):
    o = scene_object(0, {0: np.eye(4)}, mesh=False)
    o = dataclasses.replace(o, points=o.points[:1].repeat(points, 0), point_scan=np.zeros(points, int))
    scene = dataclasses.replace(SCENE, objects=(o,), scans=SCENE.scans[:1], changes=())
    page = report_html(scene, CONFIG)
    assert "monday: 1 object found." in page
    assert "One scan only: nothing to compare." in page
    assert not re.search(r"\b(nan|inf|NaN|Infinity)\b", Page(page).scripts[0])


def test_no_objects_no_page():
    with pytest.raises(ValueError, match="no objects"):
        report_html(dataclasses.replace(SCENE, objects=()), CONFIG)


def test_a_large_scene_is_thinned_and_keeps_to_its_size():
    """Ten million points and half a million faces still make a page below 15 MB; everything remains a little."""
    o = scene_object(0, {0: np.eye(4), 1: turn_z(1.0, WORLD_M, np.ones(3))})
    rng = np.random.default_rng(0)
    many = dataclasses.replace(
        o, points=WORLD_M + rng.uniform(size=(10**6, 3)), point_scan=np.repeat([0, 1], 5 * 10**5)
    )
    objects = [dataclasses.replace(many, id=f"object_{k:03d}", mesh=None) for k in range(3)]
    scene = dataclasses.replace(
        SCENE, objects=(*objects, o), changes=(Changes(from_scan=0, to_scan=1),), scans=SCENE.scans[:2]
    )
    data, text = payload(scene, CONFIG)
    assert sum(sum(shown["counts"]) for shown in data["objects"]) <= 500_002
    assert min(min(shown["counts"]) for shown in data["objects"]) >= 1
    assert len(text) < 5e6


def test_coverage_of_a_cube_is_the_share_of_sides_seen():
    rng = np.random.default_rng(0)
    mesh = cube(np.zeros(3))
    top = np.c_[rng.uniform(-0.5, 0.5, (4000, 2)), np.full(4000, 0.5)]
    # One side of six, and of the four beside it a rim of 3 % of the diagonal: 1/6 + 4/6 · 0.052
    assert coverage(mesh, top) == pytest.approx(1 / 6 + 4 / 6 * 0.03 * 3**0.5, abs=0.02)
    sides = [np.roll(top * [1, 1, s], k, axis=1) for k in range(3) for s in (1, -1)]
    assert coverage(mesh, np.concatenate(sides)) == 1.0
    assert coverage(mesh, np.zeros((0, 3))) == 0.0
    assert coverage(mesh, top[:1] + 5) == 0.0


# --- colors ------------------------------------------------------------------------------------------------

# Machado, Oliveira & Fernandes 2009, severity 1, on linear RGB.
SEEN_BY = {
    "protan": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.01182, 0.04294, 0.968881],
    ],
    "tritan": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.3039],
    ],
    "all": np.eye(3).tolist(),
}


def linear(c: np.ndarray) -> np.ndarray:
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def companded(c: np.ndarray) -> np.ndarray:
    c = np.clip(c, 0, 1)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("eyes", sorted(SEEN_BY))
def test_the_first_colors_differ_for_all_eyes(eyes):
    base = np.array([rgb(k) for k in range(len(BASE))]) / 255
    lab = rgb2lab(companded(linear(base) @ np.array(SEEN_BY[eyes]).T))
    distance = np.linalg.norm(lab[:, None] - lab[None], axis=-1)
    assert distance[~np.eye(len(base), dtype=bool)].min() > 20  # CIE76; 2.3 is just noticeable


def test_the_first_colors_stand_out_from_both_grounds():
    luminance = np.array(
        [linear(np.array(rgb(k)) / 255) @ [0.2126, 0.7152, 0.0722] for k in range(len(BASE))]
    )
    assert (1.05 / (luminance + 0.05)).min() >= 1.9
    assert ((luminance + 0.05) / 0.058).min() >= 1.9


def test_fifty_colors_differ():
    assert len({color(k) for k in range(50)}) == 50


def test_the_page_calls_an_object_by_the_number_of_its_id():
    """Joined parts leave gaps among the ids."""
    fewer = dataclasses.replace(SCENE, objects=SCENE.objects[2:], changes=())
    told = payload(fewer, CONFIG)[0]["objects"]
    assert [(o["id"], o["number"], o["color"]) for o in told] == [
        (f"object_{n:03d}", n, color(n)) for n in (2, 3, 4)
    ]
    assert told[0]["name"] == "object 2"


@pytest.mark.parametrize("number", range(50))
def test_numbers_are_readable_on_their_color(number):
    luminance = float(linear(np.array(rgb(number)) / 255) @ [0.2126, 0.7152, 0.0722])
    other = 0.0 if ink(number) == "#000" else 1.0
    assert (max(luminance, other) + 0.05) / (min(luminance, other) + 0.05) >= 4.5


def test_apply_pose_of_anchor_is_the_position():
    o, shown = SCENE.objects[1], payload(SCENE, CONFIG)[0]["objects"][1]
    anchor = o.points.mean(axis=0, keepdims=True)
    there = [apply_pose(np.linalg.inv(s.T_ref_scan), anchor)[0] for s in o.observations]
    shift = np.array([s["position"] for s in shown["observations"]]) - there
    assert np.ptp(shift, axis=0).max() < 1e-9


def test_mended_masks_are_listed():
    repairs = (
        Repair(object="object_001", instances=(3, 5, 6), share=0.92),
        Repair(object="object_000", absorbed=("object_007",), share=0.8),
        Repair(object="object_000", instances=(4,), divided="object_001", share=0.93),
        Repair(object="object_000", divided="object_008", share=0.7),
        Repair(object="object_000", instances=(4,), dropped=40, points=900, share=0.95),
        Repair(object="object_002", dropped=7, neighbor="object_003", points=90, share=0.5),
        Repair(object="object_001", instances=(3,), regained=1200, points=3000, share=0.75),
        Repair(object="object_004", instances=(9,), unmasked=800, share=0.66),
        Repair(object="object_005", unmasked=70),
        Repair(object="object_006", instances=(1, 2), smooth=0.8),
    )
    mended = dataclasses.replace(SCENE.scans[-1], repairs=repairs)
    text = report_html(dataclasses.replace(SCENE, scans=(*SCENE.scans[:-1], mended)), CONFIG)
    assert "friday: instances 3, 5 and 6 are object_001, in parts (92% on it)" in text
    assert "object_007 of the scan before and object_000 are one, in parts (80% on it)" in text
    assert "friday: instance 4 is object_000 and object_001 in one mask (93% sure)" in text
    assert "friday: one mask of the scan before held object_000 and object_008 (70% sure)" in text
    assert (
        "40 of 900 points of object_000 (instance 4) are floor or wall, and left out (95% within half the tolerance"
        in text
    )
    assert "7 of 90 points of object_002 (in an earlier scan) are object_003" in text
    assert "1200 points beside the 3000 of object_001 (instance 3) are part of it, and taken in (75%" in text
    assert "friday: 800 points without a mask are object_004, as instance 9 (66% sure)" in text
    assert "friday: 70 points without a mask are object_005, in the scan before" in text
    assert "instances 1 and 2 are object_006, in parts that go on in one another (80% of their" in text
    assert "Masks are as they were given." in report_html(SCENE, CONFIG)
