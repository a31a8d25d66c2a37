"""The whole protocol of 3RScan on rooms of regime `real`, written in its layout: the truth survives, programs run."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from pieces import furniture
from scipy.spatial.transform import Rotation

from eval import end_to_end, matching, reconstruction, registration
from eval.data.threerscan import MOVED_DEG, MOVED_M, threerscan
from eval.data.threerscan_index import read_index
from more2_jax.geometry.poses import apply_pose
from more2_jax.network.prior import save_prior
from train.rooms.depth_sensor import DepthSensor
from train.rooms.fused_scan import ScanSettings
from train.rooms.hand_held import Walk
from train.rooms.real_files import write_real_scene
from train.rooms.real_visits import RealConfig, real_scene
from train.rooms.scene_files import read_scene
from train.tools import as_threerscan

QUICK = ScanSettings(
    sensor=DepthSensor(width=80, height=60),
    walk=Walk(views_of_an_object=2, views_of_walls=5, frames_a_view=3),
    voxel_m=(0.04, 0.04),
    kept_faces=(0.8, 0.8),
    masks="perfect",
)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """A room of regime `real` and two visits, as it is synthesized and in 3RScan's layout."""
    folder = tmp_path_factory.mktemp("rooms")
    scene = real_scene(
        list(furniture()[:7]), RealConfig(scans=2, scanned=QUICK), np.random.default_rng(1), "scene_0000"
    )
    write_real_scene(folder / "real" / "scene_0000", scene, {"seed": 1})
    as_threerscan.main(folder / "real", folder / "3rscan")
    return folder


def test_the_truth_survives_the_layout(rooms):
    """Motions between two scans, as both readings tell them, differ by the scans' frames alone."""
    data = threerscan(rooms / "3rscan", split="validation", predicted=False)
    (name,) = data.names
    known, made = data.read(name), read_scene(rooms / "real" / "scene_0000")
    assert len(known.scans) == len(made.scans) == 2 and data.upright
    original = {f"instance_{as_threerscan.FIRST_OBJECT + k}": o for k, o in enumerate(made.objects)}
    both = [o for o in known.objects if 1 in o.instance]
    assert len(both) >= 3 and {o.moved[1] for o in both} == {True, False}
    (place,) = read_index(rooms / "3rscan" / "3RScan.json").places
    T_rescan_ref = np.linalg.inv(place.rescans[0].T_ref_rescan)
    for o in both:
        true = original[o.name]
        start, end = (np.linalg.inv(made.T_scan_room[k]) @ true.T_scan_model[k] for k in (0, 1))
        in_room = start @ np.linalg.inv(end)  # what brings it back
        written = o.true_pose(o, 1, 0) @ T_rescan_ref  # the same, in the reference's frame
        turns = [np.rad2deg(Rotation.from_matrix(T[:3, :3]).magnitude()) for T in (in_room, written)]
        assert turns[0] == pytest.approx(turns[1], abs=1e-3)
        assert o.moved[1] == (turns[0] > MOVED_DEG or np.linalg.norm(start[:3, 3] - end[:3, 3]) > MOVED_M)


def test_true_poses_lay_scans_onto_the_surfaces(rooms):
    """In every scan the points lie on the reference's surface through the true pose, as far as sensors are noisy."""
    data = threerscan(rooms / "3rscan", split="validation", predicted=False)
    scene = data.read(data.names[0])
    tried = 0
    for o in scene.objects:
        if o.mesh is None:
            continue
        mesh = trimesh.Trimesh(o.mesh.vertices, o.mesh.faces, process=False)
        for k, instance in o.instance.items():
            points = apply_pose(np.linalg.inv(o.T_scan_model[k]), scene.instance(k, instance).points)
            _, distance, _ = trimesh.proximity.closest_point(mesh, points[:: max(1, len(points) // 200)])
            assert np.median(distance) < 0.03
            tried += 1
    assert tried >= 4


# The whole task as users run it, matching by evidence included; poses by fields, which compile sooner. The program of
# matching has a test of its own below.
PROGRAMS = {registration: "field", reconstruction: "robust", end_to_end: "robust"}


@pytest.mark.parametrize(
    "program",
    [pytest.param(p, marks=[pytest.mark.optimized] * (name == "robust")) for p, name in PROGRAMS.items()],
    ids=lambda p: p.__name__,
)
def test_every_program_scores_it(rooms, tmp_path, tiny_prior, program):
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    known = {f.name for f in dataclasses.fields(program.Settings)}
    options = program.Settings(
        data=rooms / "3rscan",
        out=tmp_path / "out",
        dataset="3rscan",
        preset=PROGRAMS[program],
        prior=str(tmp_path / "tiny.npz"),
        peers=False,
        **({"samples": 500} if "samples" in known else {}),
    )
    program.main(options)
    found = json.loads((tmp_path / "out" / "results.json").read_text())
    assert found["settings"]["data"]["dataset"] == "3RScan"
    counted = {r["method"] for r in found["rows"] if r["group"] == "all" and r["count"]}
    assert f"ours, {options.preset}" in counted
    one_way = {r["column"] for r in found["rows"] if r["name"] == "Chamfer-L1, one way" and r["count"]}
    assert one_way == ({"paper", "published"} if program is reconstruction else set())


def test_several_presets_are_scored_side_by_side(rooms, tmp_path, tiny_prior):
    """Each once, whatever they share; codes decide in both here, so that their figures are the same."""
    save_prior(tiny_prior, tmp_path / "tiny.npz")
    options = matching.Settings(
        data=rooms / "3rscan",
        out=tmp_path / "out",
        dataset="3rscan",
        preset="field",
        beside=("paper", "field"),
        prior=str(tmp_path / "tiny.npz"),
        peers=False,
    )
    assert options.presets == ("field", "paper")
    matching.main(options)
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    recall = {
        r["method"]: r["value"] for r in rows if r["name"] == "instance recall" and r["column"] == "strict"
    }
    assert {"ours, field", "ours, paper"} <= set(recall) and recall["ours, field"] == recall["ours, paper"]
    settings = registration.by_preset(("paper", "field", "robust"), upright=True)
    names = [name for methods in settings.values() for name in methods]
    assert len(names) == len(set(names)) and {f"ours, {p}" for p in settings} <= set(names)
    assert settings["field"]["ours, field, without optimization"].steps == 0
