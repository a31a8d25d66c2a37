"""What still stands where it stood speaks against its having moved, and nothing else does."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import apply_pose
from more2_jax.matching.candidates import AlignedPairs
from more2_jax.tracking.rooms import Rooms
from more2_jax.tracking.still_standing import STANDS, SURELY_STANDS, lost_by_standing, standing
from more2_jax.types import Frame
from tests.support import boxes, pieces

FLOOR = np.random.default_rng(0).uniform([-1, -1, 0], [6, 6, 0], (20_000, 3))
PAIR = np.array([[0, 0]])


def box(seed, corner, size=(0.8, 0.6, 0.7), count=3000):
    """The surface of a box, by its lowest corner."""
    return boxes.box(seed, size, np.add(corner, np.divide(size, 2)), count)


HERE, THERE = [1.0, 1.0, 0.0], [4.0, 3.5, 0.0]
FREE = [4.0, 0.0, 0.0]


class PairsAlone(AlignedPairs):
    """Clouds and poses of pairs, with nothing prepared."""

    sides = ([], [])


def lost(
    old, new, scene=FLOOR, scan=FLOOR, frame=None, pairs=PAIR, listed=None, said_to_stay=False, color=0.0
):
    """What pairs lose; clouds of the first scan, and of the second, all in the scene's frame.

    `listed`: pairs that were compared, by default the same; `color`: log likelihood ratios of theirs.
    """
    listed = pairs if listed is None else listed
    frame = frame or Frame(T_scene_scan=np.eye(4))
    back = np.linalg.inv(frame.T_scene_scan)
    sides = tuple(
        [SimpleNamespace(points=p) for p in clouds] for clouds in ([apply_pose(back, c) for c in new], old)
    )
    T = np.broadcast_to(np.eye(4), (len(listed), 1, 4, 4)).copy()
    T[:, 0] = frame.T_scene_scan
    if not said_to_stay:
        T[:, 0, :3, 3] += 10.0
    aligned = object.__new__(PairsAlone)
    compared = SimpleNamespace(color=np.broadcast_to(color, len(listed)))
    for name, value in (
        ("rows", np.asarray(listed)),
        ("sides", sides),
        ("T_old_new", T),
        ("compared", compared),
    ):
        object.__setattr__(aligned, name, value)
    rooms = Rooms(scene=scene, scan=apply_pose(back, scan))
    return lost_by_standing(aligned, np.asarray(pairs), frame, rooms).tolist()


def test_what_left_an_empty_place_for_another_empty_one_loses_nothing():
    assert lost([box(0, HERE)], [box(1, THERE)]) == [0.0]


# Without a mask, what is close to the floor may be of the floor.
@pytest.mark.parametrize(("masked", "told"), [(True, SURELY_STANDS), (False, STANDS)])
def test_an_object_whose_surface_still_stands_there_did_not_move(masked, told):
    still = box(2, HERE)
    elsewhere = [box(1, THERE), *([still] if masked else [])]
    scan = FLOOR if masked else np.concatenate([FLOOR, still])
    assert lost([box(0, HERE)], elsewhere, scan=scan) == [told]


@pytest.mark.parametrize(("masked", "told"), [(True, SURELY_STANDS), (False, STANDS)])
def test_an_instance_that_stood_there_before_did_not_come(masked, told):
    before = box(2, THERE)
    known = [box(0, HERE), *([before] if masked else [])]
    scene = FLOOR if masked else np.concatenate([FLOOR, before])
    assert lost(known, [box(1, THERE)], scene=scene) == [told]


def test_both_speak_twice():
    both = [box(3, HERE), box(4, THERE)]
    assert lost([box(0, HERE), both[1]], [box(1, THERE), both[0]]) == [2 * SURELY_STANDS]


def test_its_own_points_are_no_evidence_against_it():
    """Slid by less than its length, it lies on its old place in part; what stayed is another pair's matter."""
    slid = box(1, np.add(HERE, [0.3, 0.0, 0.0]))
    assert lost([box(0, HERE)], [slid]) == [0.0]
    assert lost([box(0, HERE)], [box(1, HERE), box(2, HERE)]) == [0.0]
    assert lost([box(0, HERE)], [box(1, THERE), box(2, HERE)], said_to_stay=True) == [0.0]


def test_parts_of_one_thing_beside_one_another_have_not_changed_places():
    """Either half of a divided mask may be said to be either half of the object: neither went anywhere."""
    halves = [HERE, np.add(HERE, [0.5, 0.0, 0.3])]
    old, new = ([box(3 * way + k, corner) for k, corner in enumerate(halves)] for way in (0, 1))
    assert lost(old, new, pairs=np.array([[0, 1], [1, 0]])) == [0.0, 0.0]


@pytest.mark.parametrize(("share", "told"), [(0.5, 0.0), (0.9, STANDS), (1.0, SURELY_STANDS)])
def test_half_of_it_may_lie_on_what_was_put_there_since(share, told):
    object_ = box(0, HERE)
    there = object_[object_[:, 0] <= HERE[0] + 0.8 * share]
    assert lost([object_], [box(1, THERE), there]) == [told]


@pytest.mark.parametrize(("color", "told"), [(-2.0, 0.0), (2.0, 2 * SURELY_STANDS)])
def test_copies_of_two_colors_may_have_changed_places(color, told):
    """Each stands where the other stood; only what has the color of what left is that."""
    both = [box(3, HERE), box(4, THERE)]
    listed = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    colors = [2.0, color, color, 2.0]
    assert lost([box(0, HERE), both[1]], [box(1, THERE), both[0]], listed=listed, color=colors) == [told]


def test_another_thing_put_there_is_not_the_object():
    smaller = box(2, HERE, size=(0.4, 0.3, 0.4))
    assert lost([box(0, HERE)], [box(1, THERE), smaller]) == [0.0]


def test_floor_and_a_wall_close_by_are_no_surface_of_it():
    wall = np.random.default_rng(5).uniform([-1, 1.62, 0], [6, 1.62, 2.5], (15_000, 3))
    around = np.concatenate([FLOOR, wall])
    assert lost([box(0, HERE)], [box(1, THERE)], around, around) == [0.0]


def test_it_is_the_scans_place_in_the_scene_that_counts_and_none_if_unknown():
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.array([[c, -s, 0, 2.0], [s, c, 0, -1.0], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    clouds = [box(0, HERE)], [box(1, THERE), box(2, HERE)]
    assert lost(*clouds, frame=Frame(T_scene_scan=T)) == [SURELY_STANDS]
    assert lost(*clouds, frame=Frame(T_scene_scan=T, unknown=True)) == [0.0]


def test_scans_of_objects_alone_are_asked_as_well():
    nothing = np.zeros((0, 3))
    assert lost([box(0, HERE)], [box(1, THERE), box(2, HERE)], nothing, nothing) == [SURELY_STANDS]
    assert lost([box(0, HERE)], [box(1, THERE)], nothing, nothing) == [0.0]


def test_every_pair_is_told_as_if_it_were_alone():
    old = [box(0, HERE), box(1, FREE)]
    new = [box(2, THERE), box(3, HERE)]
    pairs = np.array([[0, 0], [1, 1]])
    assert lost(old, new, pairs=pairs) == [
        SURELY_STANDS,
        SURELY_STANDS,
    ]  # the second stood where the first was
    assert [lost(old, new, pairs=pairs[k : k + 1]) for k in (0, 1)] == [[SURELY_STANDS], [SURELY_STANDS]]


def held(old, new, scene=FLOOR, scan=FLOOR, frame=None, pairs=((0, 0),), told=None):
    """Which pairs are `standing`; clouds as `lost` takes them.

    `told`: poses by registration, of instances to where they are said to have stood; by default as if far off.
    """
    frame = frame or Frame(T_scene_scan=np.eye(4))
    back = np.linalg.inv(frame.T_scene_scan)
    rooms = Rooms(scene=scene, scan=apply_pose(back, scan))
    there = FAR_OFF if told is None else told
    poses = np.array([there @ frame.T_scene_scan for _ in pairs]).reshape(-1, 4, 4)
    return standing(old, [apply_pose(back, c) for c in new], list(pairs), poses, frame, rooms).tolist()


FAR_OFF = pieces.pose(Rotation.identity(), [9.0, 0.0, 0.0])
TALL, LOW = (0.8, 0.6, 1.5), np.array([0.0, 0.0, 0.3])  # off the floor, of which what is close may be


def tall(seed, shift=(0.0, 0.0, 0.0), noise_m=0.0, count=9000):
    """A box that stands 30 cm off the floor."""
    points = box(seed, HERE, TALL, count) + LOW + shift
    return points + np.random.default_rng(seed).normal(0, noise_m, points.shape)


def test_what_both_scans_show_in_one_place_stands_whatever_mask_it_has_there():
    object_, instance, rest = map(tall, range(3))
    assert held([object_], [instance]) == [True]
    # Of a mask in two each half stands where the whole does.
    left, right = (instance[keep] for keep in (instance[:, 0] < 1.3, instance[:, 0] >= 1.3))
    assert held([object_], [left, right], pairs=((0, 0), (0, 1))) == [True, True]
    assert held([object_], [left], scan=np.concatenate([FLOOR, rest])) == [True]


@pytest.mark.parametrize("other", ["object", "instance"])
def test_of_a_mask_that_holds_more_than_the_object_one_cloud_stands(other):
    """Half of the larger cloud is of what only one scan shows; it lies nowhere else any better."""
    small, large = tall(0), np.concatenate([tall(1), box(2, [1.0, 1.65, 0.3], TALL, 9000)])
    assert held(*([small], [large]) if other == "instance" else ([large], [small])) == [True]


def test_of_one_cloud_that_lies_there_another_pose_has_to_be_nearer_only():
    """Another thing was put where the object stood: its old place is full, and yet it lies elsewhere."""
    shift = np.array([3.0, 0.0, 0.0])
    clouds = [tall(0)], [tall(1, shift), tall(2)]
    assert held(*clouds, told=pieces.pose(Rotation.identity(), -shift)) == [False]
    assert held(*clouds) == [True]  # nowhere else is nearer


@pytest.mark.parametrize("shift_m", [0.08, 0.3])
def test_what_moved_does_not_stand(shift_m):
    shift = np.array([shift_m, 0.0, 0.0])
    true = pieces.pose(Rotation.identity(), -shift)
    assert held([tall(0)], [tall(1, shift)], told=true) == [False]


def test_where_neither_cloud_lies_on_the_other_scan_nothing_stands():
    assert held([box(0, HERE)], [box(1, THERE)]) == [False]


@pytest.mark.parametrize(("noise_m", "stands"), [(0.01, True), (0.0, False)])
def test_another_pose_has_to_be_nearer_by_more_than_noise(noise_m, stands):
    """Slid by 1.5 cm, it lies within 3 cm of where it stood all over."""
    shift = np.array([0.015, 0.0, 0.0])
    true = pieces.pose(Rotation.identity(), -shift)
    clouds = [tall(0, noise_m=noise_m, count=50_000)], [tall(1, shift, noise_m, 50_000)]
    assert held(*clouds, told=true) == [stands]


@pytest.mark.parametrize(("noise_m", "stands"), [(0.0, False), (0.012, False), (0.03, True)])
def test_among_noise_what_lies_farther_off_stands_as_well(noise_m, stands):
    frame = Frame(noise_m=noise_m)
    assert held([box(0, HERE)], [box(1, np.add(HERE, 0.05))], frame=frame) == [stands]
    gone = [box(0, HERE)], [box(1, THERE), box(2, np.add(HERE, 0.05))]
    assert lost(*gone, frame=frame) == ([SURELY_STANDS] if stands else [0.0])


def test_nothing_stands_in_a_scan_of_unknown_frame_and_of_no_pairs_there_is_none():
    c, s = np.cos(0.7), np.sin(0.7)
    T = np.array([[c, -s, 0, 2.0], [s, c, 0, -1.0], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    clouds = [tall(0)], [tall(1)]
    assert held(*clouds, frame=Frame(T_scene_scan=T)) == [True]
    assert held(*clouds, frame=Frame(T_scene_scan=T, unknown=True)) == [False]
    assert held(*clouds, pairs=()) == []
