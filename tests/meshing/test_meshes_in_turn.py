"""Meshes are made in order, no more of them side by side than the budget of memory holds, and none drawn ahead."""

import dataclasses
import threading

import numpy as np
import pytest

from more2_jax.config import preset
from more2_jax.meshing import object_mesh as module
from more2_jax.meshing.object_mesh import MESH_MB, MESHES_AT_ONCE, object_meshes


@pytest.mark.parametrize(
    ("memory_mb", "cores", "most"),
    [(1, 4, 1), (2 * MESH_MB, 4, 2), (100 * MESH_MB, 4, 4), (100 * MESH_MB, 64, MESHES_AT_ONCE)],
)
def test_as_many_as_memory_and_cores_hold(tiny_prior, monkeypatch, memory_mb, cores, most):
    drawn, finished, running, lock = [], [], [], threading.Lock()
    together = threading.Barrier(most)

    def object_mesh(_, o, config):
        with lock:
            running.append(o)
            assert len(running) <= most
        together.wait(timeout=30)  # so many are indeed worked on side by side
        with lock:
            running.remove(o)
            finished.append(o)

    def objects():
        for k in range(3 * most):
            drawn.append(k)
            yield k

    monkeypatch.setattr(module, "object_mesh", object_mesh)
    monkeypatch.setattr(module.os, "cpu_count", lambda: cores)
    config = dataclasses.replace(preset("robust"), memory_mb=memory_mb)
    for count, _ in enumerate(object_meshes(tiny_prior, objects(), config), start=1):
        assert len(drawn) <= count + most
    assert count == len(drawn) == len(finished) == 3 * most
    np.testing.assert_array_equal(sorted(finished), drawn)
