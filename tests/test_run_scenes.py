"""Many scenes in one call: each as if it were alone, whatever the others hold, and by the same compiled programs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from small_scenes import CONFIG, scan

from more2_jax.network import prior as network_prior
from more2_jax.registration import search, surface
from more2_jax.scene import add_scan, reconstruct, run_scenes, start_scene

pytestmark = pytest.mark.optimized

SCENES = (
    # Two stay or move, one comes; one object alone; none of the second scan is known.
    (scan("a", {0: (0.0, 0.0), 1: (0.3, 3.0)}), scan("b", {0: (0.5, 0.3), 1: (0.3, 3.0), 2: (0.0, 6.0)})),
    (scan("c", {1: (0.0, 0.0)}), scan("d", {1: (0.4, 0.5)})),
    (scan("e", {0: (0.0, 0.0)}), scan("f", {2: (0.0, 4.0), 1: (1.0, 8.0)})),
)
PROGRAMS = {
    "encode": network_prior._encode_many,
    "prepare": search._alignable,
    "search": search._search_poses,
    "refine": surface._refine_poses,
}


def alone(prior, scans):
    """A scene by the three verbs."""
    scene = start_scene(prior, scans[0], CONFIG)
    for more in scans[1:]:
        scene = add_scan(prior, scene, more, CONFIG)
    return reconstruct(prior, scene, CONFIG)


@pytest.fixture(scope="module")
def together(tiny_prior):
    return run_scenes(tiny_prior, SCENES, CONFIG)


@pytest.mark.parametrize("n", range(len(SCENES)))
def test_each_scene_is_what_it_is_alone(tiny_prior, together, n):
    """Objects, codes, poses, points and meshes, to rounding; all that is counted or named exactly."""
    expected, found = alone(tiny_prior, SCENES[n]), together[n]
    assert [o.id for o in found.objects] == [o.id for o in expected.objects]
    for a, b in zip(expected.objects, found.objects, strict=True):
        assert [(s.scan, s.instance) for s in a.observations] == [
            (s.scan, s.instance) for s in b.observations
        ]
        for s, t in zip(a.observations, b.observations, strict=True):
            np.testing.assert_allclose(t.T_ref_scan, s.T_ref_scan, atol=1e-5)
        np.testing.assert_allclose(b.embedding.inv, a.embedding.inv, atol=1e-5)
        np.testing.assert_allclose(b.points, a.points, atol=1e-5)
        assert (a.mesh is None) == (b.mesh is None)
        if a.mesh is not None:
            assert len(a.mesh.faces) == len(b.mesh.faces)
            np.testing.assert_allclose(b.mesh.vertices, a.mesh.vertices, atol=1e-4)
    for a, b in zip(expected.changes, found.changes, strict=True):
        assert dataclasses.replace(a, probability={}) == dataclasses.replace(b, probability={})


def test_the_scenes_hold_what_the_others_do_not(together):
    """Else the test above would say nothing of a lone object, and of a scan in which nothing is known."""
    first, lone, strange = ([len(o.observations) for o in s.objects] for s in together)
    assert first == [2, 2, 1] and lone == [2] and strange == [1, 1, 1]


def test_more_scenes_of_other_sizes_compile_nothing_new(tiny_prior, together):
    before = {name: p._cache_size() for name, p in PROGRAMS.items()}
    assert all(before.values())
    run_scenes(tiny_prior, [*SCENES[::-1], SCENES[0], SCENES[0][::-1]], CONFIG, meshes=False)
    assert {name: p._cache_size() for name, p in PROGRAMS.items()} == before


def test_a_scene_that_fails_is_told_when_the_others_are_done(tiny_prior, monkeypatch):
    done = []
    monkeypatch.setattr("more2_jax.scene.reconstruct", lambda prior, scene, config: done.append(scene))
    empty = dataclasses.replace(SCENES[0][0], instances=())
    with pytest.raises(ValueError, match="0 instances"):
        run_scenes(tiny_prior, [(empty,), *SCENES], CONFIG)
    assert len(done) == len(SCENES)


def test_a_scene_without_scans_is_refused(tiny_prior):
    with pytest.raises(ValueError, match=r"scenes \[1\] have no scans"):
        run_scenes(tiny_prior, [SCENES[0], ()], CONFIG)
