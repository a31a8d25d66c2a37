"""What lies around an object is what its scan shows there: not itself, no floor, no wall, nothing far away."""

import numpy as np
import pytest
from factories import embedding
from furnished import cabinet, chair, corner
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.tracking.objects import new_object, seen_again
from more2_jax.tracking.surroundings import (
    LEAST_REACH_M,
    OTHER_POINTS,
    REACH,
    surroundings,
    surroundings_of_objects,
)
from more2_jax.types import Instance, Observation, ScanRecord

CHAIR, CABINET, ROOM = chair(), cabinet(), corner()
LOW = CHAIR[:, 2] < 0.4  # what a mask that is cut holds of the chair


def share(what, among):
    """Of points, the share that is among others."""
    return np.mean(KDTree(among).query(what)[0] < 1e-6) if len(among) else 0.0


def near(cloud, points):
    """The points that lie within reach of a cloud."""
    reach = max(REACH * np.linalg.norm(cloud - cloud.mean(axis=0), axis=1).max(), LEAST_REACH_M)
    return points[KDTree(cloud).query(points)[0] < reach]


def elsewhere():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
    T[:3, 3] = [120.0, -40.0, 7.0]
    return T


def test_what_was_cut_off_is_there_and_floor_and_walls_are_not():
    (around,) = surroundings([CHAIR[LOW]], np.concatenate([ROOM, CHAIR[~LOW]]))
    cut_off = near(CHAIR[LOW], CHAIR[~LOW])
    assert len(cut_off) > 100 and share(cut_off, around) > 0.98
    assert share(ROOM, around) == 0  # nor of the edge where they meet
    assert share(CHAIR[LOW], around) == 0


def test_other_masks_are_there_as_far_as_they_are_near():
    half = CHAIR[LOW], CHAIR[~LOW], CABINET + [40.0, 0, 0]
    low, high, far = surroundings(half, ROOM)
    for around, cloud, other in ((low, half[0], half[1]), (high, half[1], half[0])):
        some = other[:: max(1, -(-len(other) // OTHER_POINTS))]
        assert len(near(cloud, some)) > 20 and share(near(cloud, some), around) == 1
    assert not len(far)


def test_nothing_lies_farther_away_than_the_reach():
    (around,) = surroundings([CHAIR[LOW]], np.concatenate([ROOM, CABINET, CHAIR[~LOW]]))
    assert 0 < len(around) == len(near(CHAIR[LOW], around))


def test_it_moves_with_the_scan():
    T, rest = elsewhere(), np.concatenate([ROOM, CHAIR[~LOW]])
    (here,), (there,) = (
        surroundings([CHAIR[LOW]], rest),
        surroundings([apply_pose(T, CHAIR[LOW])], apply_pose(T, rest)),
    )
    np.testing.assert_allclose(there, apply_pose(T, here), atol=1e-9)


@pytest.mark.parametrize("background", [ROOM[:0], ROOM[:5]], ids=["none", "five points"])
def test_where_there_is_no_background_other_masks_alone_are_around(background):
    around = surroundings([CHAIR[LOW], CHAIR[~LOW]], background)
    assert all(len(a) for a in around)
    assert surroundings([], ROOM) == []
    assert len(surroundings([CHAIR], ROOM[:0])[0]) == 0


def test_an_object_has_what_lay_around_it_in_every_scan_that_makes_up_its_shape():
    """In its own frame; what a scan in doubt shows is left out."""
    T = elsewhere()
    cloud = CHAIR[LOW]
    o = new_object(0, 0, Instance(id=3, points=cloud), embedding(np.random.default_rng(0), np.zeros(3)))
    more = dict(instance=7, T_ref_scan=np.linalg.inv(T), score=0.9, rms_m=0.01, converged=True)
    later = Instance(id=7, points=apply_pose(T, cloud))
    scans = [
        ScanRecord(
            index=k,
            name=f"scan_{k}",
            source="",
            instances=(3,),
            background=apply_pose(X, np.concatenate([ROOM, rest])),
        )
        for k, (X, rest) in enumerate([(np.eye(4), CHAIR[~LOW][::2]), (T, CHAIR[~LOW][1::2])])
    ]
    both = seen_again(o, later, Observation(scan=1, **more))
    doubtful = seen_again(o, later, Observation(scan=1, accumulated=False, **more))
    (all_of_it,), (first,) = (surroundings_of_objects([x], scans) for x in (both, doubtful))
    first_half, second_half = (near(cloud, CHAIR[~LOW][k::2]) for k in (0, 1))
    assert share(first_half, all_of_it) > 0.98 < share(second_half, all_of_it)
    assert share(first_half, first) > 0.98 and share(second_half, first) == 0
