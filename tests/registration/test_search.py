"""Which starts of a search go on after its first steps."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.config import SurfaceSearch
from more2_jax.registration.search import ROUNDS, SAME_DEG, FoundPoses, in_rounds

SEARCH = SurfaceSearch(steps=6)


def in_rounds_of(turns_deg, cost, rounds=ROUNDS):
    """Rows of the starts that went on, and the sum of the reaches that each of them had."""
    count = len(turns_deg)
    wxyz = Rotation.from_euler("z", np.asarray(turns_deg)[:, None], degrees=True).as_quat(scalar_first=True)
    starts = jnp.asarray(np.c_[wxyz, np.zeros((count, 2)), np.arange(count)], jnp.float32)

    def aligned(poses, reaches):
        row = poses.wxyz_xyz[:, 6].astype(int)
        moved = jaxlie.SE3(poses.wxyz_xyz.at[:, 4].add(reaches.sum()))
        return FoundPoses(poses=moved, cost=jnp.asarray(cost)[row])

    found = jax.jit(lambda s: in_rounds(jaxlie.SE3(s), aligned, SEARCH, rounds))(starts)
    rows = np.asarray(found.poses.wxyz_xyz[:, 6]).astype(int)
    np.testing.assert_array_equal(found.cost, np.asarray(cost, np.float32)[rows])
    return rows.tolist(), np.asarray(found.poses.wxyz_xyz[:, 4])


@pytest.mark.parametrize(("count", "rounds"), [(9, ROUNDS), (11, ROUNDS), (13, 2)])
def test_the_best_part_has_all_steps(count, rounds):
    cost = np.random.default_rng(count).permutation(count) / count
    rows, reaches = in_rounds_of(25.0 * np.arange(count), cost, rounds)
    assert rows == np.argsort(cost)[: -(-count // rounds)].tolist()
    expected = np.geomspace(SEARCH.first_reach, SEARCH.last_reach, SEARCH.steps).sum()
    np.testing.assert_allclose(reaches, expected, rtol=1e-5)


def test_of_starts_that_came_together_the_best_alone_goes_on():
    turns = np.r_[0.0, 0.4 * SAME_DEG, 0.8 * SAME_DEG, 40 * np.arange(1, 7)]
    rows, _ = in_rounds_of(turns, [0.1, 0.0, 0.2, 0.5, 0.4, 0.3, 0.6, 0.7, 0.8])
    assert rows == [1, 5, 4]


def test_in_one_round_all_starts_have_all_steps():
    rows, reaches = in_rounds_of([0.0, 1.0, 2.0, 90.0], [0.3, 0.1, 0.2, 0.4], rounds=1)
    assert rows == [0, 1, 2, 3]
    expected = np.geomspace(SEARCH.first_reach, SEARCH.last_reach, SEARCH.steps).sum()
    np.testing.assert_allclose(reaches, expected, rtol=1e-5)
