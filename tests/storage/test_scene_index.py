"""An index over scenes: what is like an object is found wherever it stands, in any blocks, and the file is checked."""

import dataclasses

import numpy as np
import pytest
from factories import living_scene

from more2_jax.cli.main import main
from more2_jax.config import preset
from more2_jax.storage import scene_index
from more2_jax.storage.scene_folder import save_scene
from more2_jax.storage.scene_index import SceneIndex, find, index_of, load_index, save_index
from more2_jax.types import LivingScene

CONFIG = preset("robust", upright=True)


def drawn(count: int, seed: int = 0) -> SceneIndex:
    rng = np.random.default_rng(seed)
    inv = rng.normal(size=(count, 4)).astype(np.float32)
    names = np.array([f"room_{k % 7}" for k in range(count)])
    return SceneIndex(
        prior="small",
        inv=inv / np.linalg.norm(inv, axis=1, keepdims=True),
        scale=rng.uniform(0.2, 2.0, count).astype(np.float32),
        extent_m=rng.uniform(size=(count, 3)),
        place_m=rng.uniform(size=(count, 3)),
        scene=names,
        object=np.array([f"object_{k}" for k in range(count)]),
        label=np.array([""] * count),
        scan=np.array(["a"] * count),
        there=np.ones(count, bool),
    )


def asked_for(inv, scale):
    """An object with such a code."""
    o = living_scene().objects[0]
    code = dataclasses.replace(o.embedding, inv=np.asarray(inv, np.float32), scale=np.float32(scale))
    return dataclasses.replace(o, embedding=code)


@pytest.mark.parametrize("block", [1, 10, 1000])
def test_the_most_alike_come_first_whatever_the_block(monkeypatch, block):
    monkeypatch.setattr(scene_index, "ROWS_AT_ONCE", block)
    index, code = drawn(60), np.array([1.0, -2, 0.5, 3])
    score = index.inv @ (code / np.linalg.norm(code)) - 0.5 * np.abs(np.log(index.scale / 0.7))
    hits = find(index, asked_for(code, 0.7), 8)
    assert [hit.row for hit in hits] == np.argsort(-score)[:8].tolist()
    np.testing.assert_allclose([hit.score for hit in hits], np.sort(score)[::-1][:8], rtol=1e-5)
    elsewhere = find(index, asked_for(code, 0.7), 60, besides="room_3")
    assert len(elsewhere) == (index.scene != "room_3").sum()
    assert all(index.scene[hit.row] != "room_3" for hit in elsewhere)


def test_a_row_says_where_an_object_was_seen_last():
    scene = living_scene()
    index = index_of([("here", scene)])
    assert index.object.tolist() == [o.id for o in scene.objects]
    for k, o in enumerate(scene.objects):
        seen = o.observations[-1]
        T = seen.frame.T_scene_scan @ np.linalg.inv(seen.T_ref_scan)
        points = o.points @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(index.extent_m[k], np.ptp(points, axis=0), atol=1e-9)
        np.testing.assert_allclose(
            index.place_m[k], points.min(axis=0) / 2 + points.max(axis=0) / 2, atol=1e-9
        )
        assert index.there[k] == (seen.scan == len(scene.scans) - 1)
    assert 0 < index.there.sum() < len(index)


def test_a_file_holds_it_and_a_bad_one_is_refused_in_a_line(tmp_path):
    index, path = drawn(9), tmp_path / "all.npz"
    save_index(index, path)
    assert_equal(load_index(path), index)
    assert [p.name for p in tmp_path.iterdir()] == ["all.npz"]
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=r"all\.npz: not an index"):
        load_index(path)
    with pytest.raises(ValueError, match="no such index"):
        load_index(tmp_path / "none.npz")


def assert_equal(found: SceneIndex, expected: SceneIndex) -> None:
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value)


def test_a_file_stays_where_it_is_and_one_that_is_compressed_is_read(tmp_path):
    index, ours, packed = drawn(200), tmp_path / "ours.npz", tmp_path / "packed.npz"
    save_index(index, ours)
    np.savez_compressed(packed, version=np.array(scene_index.VERSION), **vars(index))
    mapped, read = load_index(ours), load_index(packed)
    assert_equal(read, index)
    for name in ("inv", "scale", "scene", "there"):
        assert isinstance(getattr(mapped, name), np.memmap) and not isinstance(getattr(read, name), np.memmap)
    save_index(drawn(200, seed=1), ours)  # another one in its place: what is open stays
    assert_equal(mapped, index)


def test_a_file_that_is_not_all_there_is_refused(tmp_path):
    """At whatever byte it ends; and with other bytes where a member should begin."""
    path, content = tmp_path / "all.npz", bytearray()
    save_index(drawn(20), path)
    content[:] = path.read_bytes()
    for length in range(0, len(content), 97):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"all\.npz: not an index"):
            load_index(path)
    content[:200] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"all\.npz: not an index"):
        load_index(path)


def test_one_prior_and_some_objects_are_needed():
    a = living_scene()
    with pytest.raises(ValueError, match=r"one has codes of prior .* two of 'other'; needed one"):
        index_of([("one", a), ("two", dataclasses.replace(a, prior="other"))])
    with pytest.raises(ValueError, match="no objects"):
        index_of([])
    with pytest.raises(ValueError, match="a code of 3 numbers; needed 4"):
        find(drawn(5), asked_for([1, 2, 3], 1.0), 2)


def carried(scene: LivingScene) -> LivingScene:
    """Another room, in which the first object alone stands."""
    return dataclasses.replace(scene, objects=scene.objects[:1])


def test_commands_find_in_one_room_what_was_carried_off_from_another(tmp_path, capsys):
    scene = living_scene()
    for name, room in (("a", scene), ("b", carried(scene))):
        save_scene(room, tmp_path / name, CONFIG)
    file = tmp_path / "all.npz"
    assert main(["index", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(file)]) == 0
    assert f"{len(scene.objects) + 1} objects of 2 scenes" in capsys.readouterr().out
    id_ = scene.objects[0].id
    assert main(["find", str(file), str(tmp_path / "a"), id_]) == 0
    said = "".join(capsys.readouterr().out.split())
    assert said.count(id_) == 1 and "1.000" in said
    assert main(["find", str(file), str(tmp_path / "a"), id_, "--everywhere", "--top", "2"]) == 0
    assert "".join(capsys.readouterr().out.split()).count(id_) == 2
    assert main(["find", str(file), str(tmp_path / "a"), "object_999"]) == 2
    assert "no object 'object_999'" in capsys.readouterr().err
