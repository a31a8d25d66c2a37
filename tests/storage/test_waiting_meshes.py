"""Meshes that wait in files are those that were made, to the bit, and leave nothing behind."""

import dataclasses

import numpy as np
import pytest
from factories import cube, living_scene

from more2_jax.config import preset
from more2_jax.storage.scene_folder import save_scene
from more2_jax.storage.waiting_meshes import WaitingMeshes
from more2_jax.types import Mesh


def test_a_mesh_is_read_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(0)
    mesh = Mesh(vertices=rng.normal(size=(40, 3)), faces=rng.integers(0, 40, (70, 3)).astype(np.int32))
    other = cube(np.zeros(3))
    with WaitingMeshes(tmp_path / "waiting") as keep:
        first, second = keep(mesh), keep(other)
        for there, made in ((first, mesh), (second, other)):
            assert isinstance(there, Mesh)
            for name in ("vertices", "faces"):
                value, true = getattr(there, name), getattr(made, name)
                assert value.dtype == true.dtype
                np.testing.assert_array_equal(value, true)


def test_a_scene_is_stored_as_if_its_meshes_were_in_memory(tmp_path):
    scene = living_scene()
    with WaitingMeshes(tmp_path / "waiting") as keep:
        objects = tuple(dataclasses.replace(o, mesh=o.mesh and keep(o.mesh)) for o in scene.objects)
        save_scene(dataclasses.replace(scene, objects=objects), tmp_path / "waited", preset("robust"))
    save_scene(scene, tmp_path / "held", preset("robust"))
    held = sorted((tmp_path / "held" / "objects").iterdir())
    assert len(held) == 2 * len(scene.objects) - 1  # clouds, and meshes of all but one
    for path in held:
        assert (tmp_path / "waited" / "objects" / path.name).read_bytes() == path.read_bytes()


def test_the_folder_goes_whatever_happens(tmp_path):
    folder = tmp_path / "waiting"

    def fail_among_meshes():
        with WaitingMeshes(folder) as keep:
            keep(cube(np.zeros(3)))
            assert len(list(folder.iterdir())) == 1
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_among_meshes()
    assert not folder.exists()


def test_what_a_killed_process_left_is_gone_before_others_wait_there(tmp_path):
    waiting = WaitingMeshes.beside(tmp_path / "room")
    assert waiting.folder.parent == tmp_path.resolve()
    assert waiting.folder.name == ".room.meshes"
    waiting.folder.mkdir()
    (waiting.folder / "7.mesh").write_bytes(b"half a me")
    with waiting:
        assert list(waiting.folder.iterdir()) == []
