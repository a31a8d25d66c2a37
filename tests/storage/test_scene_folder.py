"""A living scene comes back from its folder as it went in, and a killed run never leaves half of one."""

import contextlib
import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from factories import living_scene, scene_object
from places import ROOT

import more2_jax
from more2_jax.config import preset
from more2_jax.storage.scene_folder import check_output, load_scene, save_scene, stored_at
from more2_jax.types import Anchors, Frame, Repair

CONFIG = preset("robust", upright=True)


def assert_same(a, b, where="scene"):
    """Equality of records to the last bit, arrays, dtypes and all."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray | np.generic):
        np.testing.assert_array_equal(b, a, err_msg=where)
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{i}]")
    else:
        assert a == b, where


def test_round_trip_is_exact(tmp_path):
    scene = living_scene()
    save_scene(scene, tmp_path / "a" / "scene", CONFIG)
    again, config = load_scene(tmp_path / "a" / "scene")
    assert_same(scene, again)
    assert config == CONFIG
    assert again.objects[0].points.dtype == np.float64
    assert again.objects[0].embedding.inv.dtype == np.float32


def with_anchors(scene, normal):
    """The scene with one level of anchors in every embedding; those of the first object have normals."""
    objects = []
    for k, o in enumerate(scene.objects):
        rng = np.random.default_rng(k)
        anchors = Anchors(
            offset=rng.normal(size=(5, 3)).astype(np.float32),
            features=rng.normal(size=(5, 3, 2)).astype(np.float32),
            mask=np.arange(5) < 4,
            normal=np.full((5, 3), normal * (k == 0), np.float32),
        )
        objects.append(dataclasses.replace(o, embedding=dataclasses.replace(o.embedding, anchors=(anchors,))))
    return dataclasses.replace(scene, objects=tuple(objects))


@pytest.mark.parametrize("normal", [0.0, 0.6])
def test_normals_of_anchors_come_back_and_unknown_ones_take_no_place(tmp_path, normal):
    scene = with_anchors(living_scene(), normal)
    save_scene(scene, tmp_path / "scene", CONFIG)
    with np.load(tmp_path / "scene" / "embeddings.npz") as file:
        assert ("anchors_0_normal" in file.files) == (normal != 0)
    assert_same(scene, load_scene(tmp_path / "scene")[0])


@pytest.mark.parametrize(("unknown", "noise_m"), [(False, 0.0), (False, 0.02), (True, 0.0)])
def test_the_frame_of_a_scan_is_that_of_its_observations(tmp_path, unknown, noise_m):
    scene = living_scene()
    T = np.eye(4)
    T[1:3, 1:3] = [[0.0, -1.0], [1.0, 0.0]]  # a quarter turn about x
    frame = Frame(T_scene_scan=T, sigma_m=0.01, sigma_deg=0.2, noise_m=noise_m, unknown=unknown)
    assert frame.tilt_deg == 90.0
    scans = (*scene.scans[:2], dataclasses.replace(scene.scans[2], frame=frame))
    objects = tuple(
        dataclasses.replace(
            o, observations=tuple(dataclasses.replace(s, frame=scans[s.scan].frame) for s in o.observations)
        )
        for o in scene.objects
    )
    scene = dataclasses.replace(scene, scans=scans, objects=objects)
    save_scene(scene, tmp_path / "scene", CONFIG)
    again, _ = load_scene(tmp_path / "scene")
    assert_same(scene, again)
    content = json.loads((tmp_path / "scene/scene.json").read_text())
    tilts = [s["frame"].pop("tilt_deg", 0.0) for s in content["scans"]]
    assert tilts == [s.frame.tilt_deg for s in again.scans]
    assert [s["frame"].get("unknown") for s in content["scans"]] == [None, None, unknown or None]
    assert [s["frame"].get("noise_m") for s in content["scans"]] == [None, None, noise_m or None]
    (tmp_path / "scene/scene.json").write_text(json.dumps(content))  # as written before tilts were
    assert_same(scene, load_scene(tmp_path / "scene")[0])
    for s in content["scans"]:
        del s["frame"]  # as written before frames were
    (tmp_path / "scene/scene.json").write_text(json.dumps(content))
    old, _ = load_scene(tmp_path / "scene")
    assert_same(old.scans[2].frame, Frame())


def test_folder_satisfies_the_schema(tmp_path):
    save_scene(living_scene(), tmp_path / "scene", CONFIG, page="<p>page</p>")
    schema = json.loads((Path(more2_jax.__file__).parent / "assets/scene.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    content = json.loads((tmp_path / "scene/scene.json").read_text())
    jsonschema.validate(content, schema)
    assert [list(np.shape(s["T_ref_scan"])) for s in content["objects"][1]["observations"]] == [[4, 4]] * 3
    assert (
        content["objects"][1]["observations"][1]["T_ref_scan"][0][3] != 0
    )  # row-major: shift in the last column
    names = {
        p.relative_to(tmp_path / "scene").as_posix() for p in (tmp_path / "scene").rglob("*") if p.is_file()
    }
    listed = {o[k] for o in content["objects"] for k in ("mesh", "points")} - {None}
    assert names == listed | {"scene.json", "embeddings.npz", "report.html", "run.log", "config.yaml"}


@pytest.mark.parametrize(
    "repair",
    [
        Repair(object="object_001", instances=(3, 5), share=0.9),
        Repair(object="object_001", absorbed=("object_007",), share=0.9),
        Repair(object="object_001", instances=(3,), divided="object_002"),
        Repair(object="object_001", instances=(3,), dropped=4, points=90, share=0.75),
        Repair(object="object_001", dropped=4, neighbor="object_002", points=90, share=0.75),
        Repair(object="object_001", instances=(3,), regained=12, points=90, share=0.75),
        Repair(object="object_001", instances=(9,), unmasked=700),
        Repair(object="object_001", instances=(3, 5), smooth=0.75),
    ],
)
def test_what_was_mended_comes_back_and_only_what_is_said_of_it_is_written(tmp_path, repair):
    scene = living_scene()
    scans = (*scene.scans[:2], dataclasses.replace(scene.scans[2], repairs=(repair,)))
    save_scene(dataclasses.replace(scene, scans=scans), tmp_path / "scene", CONFIG)
    assert load_scene(tmp_path / "scene")[0].scans[2].repairs == (repair,)
    content = json.loads((tmp_path / "scene" / "scene.json").read_text())
    schema = json.loads((Path(more2_jax.__file__).parent / "assets/scene.schema.json").read_text())
    jsonschema.validate(content, schema)
    (written,) = content["scans"][2]["repairs"]
    said = {
        k
        for k in ("divided", "dropped", "neighbor", "regained", "unmasked", "smooth", "points")
        if getattr(repair, k)
    }
    assert set(written) == {"object", "instances", "absorbed", "share", *said}


def test_a_page_is_stored_as_given_and_never_outlives_its_scene(tmp_path):
    page = tmp_path / "scene" / "report.html"
    save_scene(living_scene(), tmp_path / "scene", CONFIG, page="<p>Räum</p>")
    assert page.read_text(encoding="utf-8") == "<p>Räum</p>"
    save_scene(living_scene(), tmp_path / "scene", CONFIG)
    assert not page.exists()


def test_saving_and_loading_know_no_page():
    code = (
        "import sys, more2_jax.storage.scene_folder\n"
        "assert not [m for m in sys.modules if m.startswith('more2_jax.report')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("key", ["version", "unit", "scans", "objects", "changes", "timing_s"])
def test_the_schema_misses_every_key(tmp_path, key):
    save_scene(living_scene(), tmp_path / "scene", CONFIG)
    schema = json.loads((Path(more2_jax.__file__).parent / "assets/scene.schema.json").read_text())
    content = json.loads((tmp_path / "scene/scene.json").read_text())
    del content[key]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, schema)


def test_saving_again_replaces_objects_but_keeps_other_files_and_the_log(tmp_path):
    folder = tmp_path / "scene"
    save_scene(living_scene(), folder, CONFIG, log="first\n")
    (folder / "notes.txt").write_text("mine")
    fewer = dataclasses.replace(living_scene(), objects=living_scene().objects[:2])
    save_scene(fewer, folder, CONFIG, log="second\n")
    assert len(list((folder / "objects").iterdir())) == 4
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "run.log").read_text() == "first\nsecond\n"
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_a_failing_save_leaves_the_old_folder_and_nothing_beside_it(tmp_path):
    folder = tmp_path / "scene"
    save_scene(living_scene(), folder, CONFIG)
    bad = dataclasses.replace(living_scene(), timing_s={"encode": float("nan")})
    with pytest.raises(ValueError, match="JSON"):
        save_scene(bad, folder, CONFIG)
    assert_same(living_scene(), load_scene(folder)[0])
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_a_swap_cut_short_is_read_and_then_repaired(tmp_path):
    folder = tmp_path / "scene"
    save_scene(living_scene(), folder, CONFIG)
    folder.rename(tmp_path / ".scene.old")
    (tmp_path / ".scene.new").mkdir()
    assert_same(living_scene(), load_scene(folder)[0])
    assert stored_at(folder).name == ".scene.old"
    save_scene(living_scene(), folder, CONFIG, log="again\n")
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    assert (folder / "run.log").read_text() == "again\n"


SAVER = """
import sys, dataclasses
sys.path.insert(0, sys.argv[2])
from factories import living_scene
from more2_jax.config import preset
from more2_jax.storage.scene_folder import save_scene
for n in range(10**6):
    save_scene(dataclasses.replace(living_scene(), prior=f"prior {n}"), sys.argv[1], preset("robust"))
    print(n, flush=True)
"""


@pytest.mark.parametrize("delay", np.linspace(0.003, 0.12, 8))
def test_killed_at_any_moment_the_folder_loads(tmp_path, delay):
    """Delays spread over one save of about a tenth of a second; each kill falls elsewhere."""
    command = [sys.executable, "-c", SAVER, str(tmp_path / "scene"), str(ROOT / "tests/support")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as saver:
        assert saver.stdout is not None
        first = int(saver.stdout.readline())
        time.sleep(delay)
        saver.send_signal(signal.SIGKILL)
    scene, _ = load_scene(tmp_path / "scene")
    assert int(scene.prior.split()[1]) >= first
    assert_same(dataclasses.replace(living_scene(), prior=scene.prior), scene)
    save_scene(living_scene(), tmp_path / "scene", CONFIG)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_killed_at_every_step_of_the_swap(tmp_path, monkeypatch):
    """Every rename and removal in turn is the last thing the process does."""
    for steps in range(6):
        folder = tmp_path / str(steps) / "scene"
        save_scene(living_scene(), folder, CONFIG)
        with monkeypatch.context() as patch:
            done = _stop_after(patch, steps)
            changed = dataclasses.replace(living_scene(), prior="newer")
            with contextlib.suppress(Killed):
                save_scene(changed, folder, CONFIG)
        assert load_scene(folder)[0].prior == ("newer" if done.count("rename") == 2 else "small"), done
        save_scene(living_scene(), folder, CONFIG)
        assert [p.name for p in folder.parent.iterdir()] == ["scene"]


class Killed(BaseException):
    pass


def _stop_after(patch, steps: int) -> list[str]:
    done: list[str] = []

    def limited(name, original):
        def step(*args, **kwargs):
            if len(done) >= steps:
                raise Killed
            done.append(name)
            return original(*args, **kwargs)

        return step

    patch.setattr("pathlib.Path.rename", limited("rename", Path.rename))
    patch.setattr("more2_jax.storage.scene_folder.shutil.rmtree", limited("rmtree", shutil.rmtree))
    return done


# --- what is refused ----------------------------------------------------------------------------------------


def test_check_output_refuses_what_is_not_ours(tmp_path):
    check_output(tmp_path / "new" / "deep")
    (tmp_path / "empty").mkdir()
    check_output(tmp_path / "empty")
    (tmp_path / "empty/thesis.tex").write_text("years")
    with pytest.raises(ValueError, match="output folder not empty and not a living scene"):
        check_output(tmp_path / "empty")
    with pytest.raises(ValueError, match="needed a folder"):
        check_output(tmp_path / "empty/thesis.tex")
    with pytest.raises(ValueError, match="output folder not empty"):
        save_scene(living_scene(), tmp_path / "empty", CONFIG)
    assert (tmp_path / "empty/thesis.tex").read_text() == "years"


def test_another_tools_scene_json_is_not_a_living_scene(tmp_path):
    (tmp_path / "scene.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="not a living scene"):
        check_output(tmp_path)


def test_a_scene_without_objects_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no objects"):
        save_scene(dataclasses.replace(living_scene(), objects=()), tmp_path / "scene", CONFIG)


def test_points_far_apart_stay_exact(tmp_path):
    o = scene_object(0, {0: np.eye(4)})
    far = dataclasses.replace(o, points=o.points + [1e6 + 1e-7, 0, 0])
    save_scene(dataclasses.replace(living_scene(), objects=(far,), changes=()), tmp_path / "scene", CONFIG)
    np.testing.assert_array_equal(load_scene(tmp_path / "scene")[0].objects[0].points, far.points)


def damage_json(folder: Path) -> None:
    (folder / "scene.json").write_text("{")


def damage_version(folder: Path) -> None:
    content = json.loads((folder / "scene.json").read_text()) | {"version": 2}
    (folder / "scene.json").write_text(json.dumps(content))


def damage_key(folder: Path) -> None:
    content = json.loads((folder / "scene.json").read_text())
    del content["objects"][0]["observations"]
    (folder / "scene.json").write_text(json.dumps(content))


def damage_points(folder: Path) -> None:
    path = folder / "objects/object_001_points.ply"
    path.write_bytes(path.read_bytes()[:-10])


def damage_embeddings(folder: Path) -> None:
    path = folder / "embeddings.npz"
    path.write_bytes(path.read_bytes()[:100])


def damage_config(folder: Path) -> None:
    (folder / "config.yaml").write_text("preset: [")


def damage_mesh(folder: Path) -> None:
    path = folder / "objects/object_000.ply"
    path.write_bytes(path.read_bytes()[:-10])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_json, "damaged"),
        (damage_version, "version 2; needed 1"),
        (damage_key, "observations"),
        (damage_points, "truncated"),
        (damage_embeddings, "damaged"),
        (damage_config, "ParserError"),
        (damage_mesh, "truncated"),
    ],
)
def test_damage_is_said_in_one_line(tmp_path, damage, message):
    save_scene(living_scene(), tmp_path / "scene", CONFIG)
    damage(tmp_path / "scene")
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(tmp_path / "scene")
    assert "\n" not in str(caught.value)


def test_no_living_scene(tmp_path):
    with pytest.raises(ValueError, match="no living scene"):
        load_scene(tmp_path)
