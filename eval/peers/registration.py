"""What one would register two clouds of an object with instead: global features, or many starts of GICP.

Each takes source and target (meters, each in its scan's frame) and whether objects only turn about the vertical, and
returns `T_target_source`, or None where it fails. All work on clouds centered on their means, in units of the
target's diagonal: features and thresholds then fit a stool and a wardrobe.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from eval.harness.extra import has, library
from eval.peers.features import VOXEL, Featured, diagonal, featured
from more2_jax.geometry.poses import Points, Pose

Registrar = Callable[[Points, Points, bool], Pose | None]

YAW_STARTS = 24
GICP_VOXEL, GICP_REACH, GICP_STEPS = 0.02, 0.1, 30  # shares of the diagonal
TRUNCATED = 0.1  # a point farther than this from the other cloud counts as this far
RANSAC_DRAWS = 100_000
INLIER = 1.5 * VOXEL
FEWEST = 64  # points: on next to nothing KISS-Matcher ends the whole process


def fpfh_ransac(source: Points, target: Points, upright: bool) -> Pose | None:
    """FPFH, RANSAC over mutual correspondences, then GICP (Open3D, small_gicp)."""
    o3d = library("open3d")
    reg = o3d.pipelines.registration
    o3d.utility.random.seed(0)

    def find(a: Featured, b: Featured) -> Any:
        checks = [
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(INLIER),
        ]
        return reg.registration_ransac_based_on_feature_matching(
            *(a.cloud, b.cloud, a.feature, b.feature, True, INLIER),
            reg.TransformationEstimationPointToPoint(False),
            *(3, checks, reg.RANSACConvergenceCriteria(RANSAC_DRAWS, 0.999)),
        )

    return _by_features(source, target, find)


def fast_global(source: Points, target: Points, upright: bool) -> Pose | None:
    """Fast Global Registration on FPFH, then GICP (Open3D, small_gicp)."""
    reg = library("open3d").pipelines.registration
    option = reg.FastGlobalRegistrationOption(maximum_correspondence_distance=INLIER)

    def find(a: Featured, b: Featured) -> Any:
        return reg.registration_fgr_based_on_feature_matching(a.cloud, b.cloud, a.feature, b.feature, option)

    return _by_features(source, target, find)


def _by_features(source: Points, target: Points, find: Callable[[Featured, Featured], Any]) -> Pose | None:
    unit = diagonal(target)
    a, b = (featured(p, p.mean(axis=0), unit) for p in (source, target))
    if min(len(a.cloud.points), len(b.cloud.points)) < 4:
        return None
    T = np.asarray(find(a, b).transformation)
    return None if np.array_equal(T, np.eye(4)) else refined(source, target, [T])


def kiss(source: Points, target: Points, upright: bool) -> Pose | None:
    """KISS-Matcher, for upright objects with its solver for turns about the vertical, then GICP."""
    if min(len(source), len(target)) < FEWEST:
        return None
    kiss_matcher, unit = library("kiss_matcher"), diagonal(target)
    config = kiss_matcher.KISSMatcherConfig(VOXEL, use_quatro=upright)
    clouds = [((p - p.mean(axis=0)) / unit).astype(np.float32) for p in (source, target)]
    found = kiss_matcher.KISSMatcher(config).estimate(*map(list, clouds))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, found.translation
    return refined(source, target, [T]) if found.valid and np.isfinite(T).all() else None


def many_starts(source: Points, target: Points, upright: bool) -> Pose | None:
    """GICP from 24 turns about the vertical, or from 60 rotations where any is possible; the best fit of all."""
    return refined(source, target, starts(upright))


def starts(upright: bool, free: int = 60) -> list[Pose]:
    """Rotations about the center, as poses: 24 turns, or the group of the icosahedron (60) or cube (24)."""
    turns = np.linspace(0, 2 * np.pi, YAW_STARTS, endpoint=False)[:, None]
    group = Rotation.create_group("I" if free == 60 else "O")
    rotations = (Rotation.from_euler("z", turns) if upright else group).as_matrix()
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = rotations
    return list(poses)


def refined(source: Points, target: Points, poses: Sequence[Pose]) -> Pose | None:
    """GICP from poses between the centered, scaled clouds; the one that fits best, back in meters."""
    found = best_fit(source, target, poses)
    return None if found is None else found[0]


def best_fit(
    source: Points, target: Points, poses: Sequence[Pose], voxel: float = GICP_VOXEL
) -> tuple[Pose, float] | None:
    """The best of the poses after GICP, and how far the clouds then lie apart (shares of the diagonal)."""
    small_gicp, unit = library("small_gicp"), diagonal(target)
    means = source.mean(axis=0), target.mean(axis=0)
    (a, _), (b, tree) = (
        small_gicp.preprocess_points(np.ascontiguousarray((p - m) / unit), voxel, num_neighbors=10)
        for p, m in zip((source, target), means, strict=True)
    )
    if min(a.size(), b.size()) < 10:
        return None
    reach = max(GICP_REACH, 3 * voxel)
    moved = [
        small_gicp.align(
            *(b, a, tree, T), max_correspondence_distance=reach, max_iterations=GICP_STEPS
        ).T_target_source
        for T in poses
    ]
    clouds = a.points()[:, :3], b.points()[:, :3]
    fits = [apart(T, *clouds) for T in moved]
    T = moved[int(np.argmin(fits))]
    if not np.isfinite(T).all():
        return None
    pose = np.eye(4)
    pose[:3, :3] = T[:3, :3]
    pose[:3, 3] = T[:3, 3] * unit + means[1] - T[:3, :3] @ means[0]
    return pose, min(fits)


def apart(T: Pose, source: Points, target: Points) -> float:
    """Mean truncated nearest distance of two clouds under a pose, both ways."""
    moved = source @ T[:3, :3].T + T[:3, 3]
    if not np.isfinite(moved).all():
        return float("inf")
    there, back = KDTree(target).query(moved)[0], KDTree(moved).query(target)[0]
    return float(np.minimum(there, TRUNCATED).mean() + np.minimum(back, TRUNCATED).mean()) / 2


def registrars() -> dict[str, Registrar]:
    """Those that are installed: KISS-Matcher has no wheel for every Python."""
    found: dict[str, Registrar] = {
        "FPFH + RANSAC + GICP": fpfh_ransac,
        "FGR + GICP": fast_global,
        "KISS-Matcher + GICP": kiss,
        "multi-start GICP": many_starts,
    }
    return {k: v for k, v in found.items() if v is not kiss or has("kiss_matcher")}


def all_pairs(
    sources: Sequence[Points], targets: Sequence[Points], upright: bool
) -> Float[np.ndarray, "n m"]:
    """How far every source stays apart from every target after the best of 24 starts of a coarse GICP."""
    poses = starts(upright, free=24)
    apart_by = np.full((len(sources), len(targets)), TRUNCATED)
    for i, j in itertools.product(range(len(sources)), range(len(targets))):
        found = best_fit(sources[i], targets[j], poses, voxel=2 * GICP_VOXEL)
        if found is not None:
            apart_by[i, j] = found[1]
    return apart_by
