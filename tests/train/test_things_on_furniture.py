"""Rooms that are lived in: small things rest on furniture or the floor, apart, and go where what bears them goes."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh

from train import synthesize
from train.furniture.collections import SourceMesh
from train.rooms.furnishing import MOVED_M
from train.rooms.ray_scanner import footprint_radius
from train.rooms.regimes import LIVED_IN, SMALL_SHARE, lived_in
from train.rooms.things_on_furniture import Arranged, furnish_and_lay, is_small

ROOM_M = (6.0, 5.0)
NOTHING = Arranged(poses={}, borne_by={})


def standing_box(extents: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box(extents)
    return np.asarray(box.vertices) + [0, 0, extents[2] / 2], np.asarray(box.faces)


PRESENT = {
    "table": standing_box((1.4, 0.8, 0.75)),
    "cabinet": standing_box((0.9, 0.5, 1.1)),
    "wardrobe": standing_box((1.0, 0.6, 2.0)),
    **{f"thing_{k}": standing_box((0.2 + 0.03 * k, 0.2, 0.3)) for k in range(5)},
}
THINGS = [n for n in PRESENT if n.startswith("thing")]


def arranged(seed: int, before: Arranged = NOTHING, static: tuple[str, ...] = ()) -> Arranged:
    return furnish_and_lay(PRESENT, before, static, ROOM_M, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_small_things_rest_on_what_bears_them(seed):
    room = arranged(seed)
    assert list(room.poses) == list(PRESENT)
    for n in THINGS:
        bearer = room.borne_by.get(n)
        height = 0.0 if bearer is None else PRESENT[bearer][0][:, 2].max()
        assert room.poses[n][2, 3] == pytest.approx(height, abs=1e-6)
        if bearer is not None:
            local = np.linalg.inv(room.poses[bearer]) @ room.poses[n]
            assert (np.abs(local[:2, 3]) <= np.abs(PRESENT[bearer][0][:, :2]).max(axis=0)).all()
    for a, b in itertools.combinations(THINGS, 2):
        if room.borne_by.get(a) == room.borne_by.get(b):
            apart = np.linalg.norm((room.poses[a] - room.poses[b])[:2, 3])
            assert apart > footprint_radius(PRESENT[a][0]) + footprint_radius(PRESENT[b][0])


def test_most_things_stand_on_furniture_and_none_out_of_reach():
    bearers = [b for seed in range(6) for b in arranged(seed).borne_by.values()]
    assert set(bearers) == {"table", "cabinet"}  # the wardrobe is too high
    assert 15 <= len(bearers) < 30


def test_what_stays_goes_with_what_bears_it_and_what_moves_moves():
    first = arranged(0)
    then = arranged(1, first, static=("thing_0", "thing_1", "wardrobe"))
    np.testing.assert_array_equal(then.poses["wardrobe"], first.poses["wardrobe"])
    for n in ("thing_0", "thing_1"):
        assert then.borne_by.get(n) == first.borne_by.get(n)
        if n in first.borne_by:
            bearer = first.borne_by[n]
            before, after = (np.linalg.inv(r.poses[bearer]) @ r.poses[n] for r in (first, then))
            np.testing.assert_allclose(after, before, atol=1e-7)
    for n in set(PRESENT) - {"thing_0", "thing_1", "wardrobe"}:
        assert np.linalg.norm((then.poses[n] - first.poses[n])[:3, 3]) >= MOVED_M
    assert any(n in first.borne_by for n in ("thing_0", "thing_1"))


def test_a_seed_decides_alone():
    for n, pose in arranged(3).poses.items():
        np.testing.assert_array_equal(pose, arranged(3).poses[n])


def test_furniture_of_a_room_that_is_lived_in():
    models = [
        SourceMesh(name=f"{c}_{k}", category=c, vertices=v * (1 + 0.02 * k), faces=f, source="boxes")
        for c, (v, f) in {k: PRESENT[k] for k in ("table", "cabinet", "wardrobe", "thing_0")}.items()
        for k in range(9)
    ]
    for seed in range(5):
        chosen = lived_in(models, np.random.default_rng(seed))
        assert LIVED_IN[0] <= len(chosen) <= LIVED_IN[1]
        small = [m for m in chosen if is_small(m.vertices)]
        assert len(small) == min(round(SMALL_SHARE * len(chosen)), 9)
        copies = sorted([m.name for m in chosen].count(n) for n in {m.name for m in chosen})
        assert copies[-2] >= 2
        assert copies[-3] == 1


def test_only_upright_rooms_of_regime_real_are_lived_in(tmp_path: Path):
    for regime, free in (("sparse", False), ("real", True)):
        settings = synthesize.Settings(
            source=tmp_path / "none.npz", regime=regime, out=tmp_path / "out", free=free, lived_in=True
        )
        with pytest.raises(ValueError, match="needed regime real, upright"):
            synthesize.main(settings)
    assert not (tmp_path / "out").exists()
