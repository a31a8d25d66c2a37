"""The rigid motion between two scans' frames on which most objects agree, and how surely it is known.

Every pair that fits says where the scan would lie had that object not moved. What moved says anything; what stayed
says the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.config import MotionModel
from more2_jax.geometry.poses import Points, Pose, apply_pose

NEAR_M = 0.1  # votes that agree bring an object's mean this near, or nearer
NEAR_DEG = 8.0  # and turn it so little otherwise; symmetric objects agree in the mean alone
FEWEST = 3  # objects that must agree on another frame than the one given,
TIMES = 2  # and as many times those that agree with the one given, and one more
SCALE_M = 0.02  # of the Geman-McClure weights: an object that moved by it counts a quarter
ROUNDS = 10  # of reweighting
MOST_TRIED = 1024  # frames that are tried: of a room all; of a building what stayed proposes its frame often
ARM_M = 0.3  # of the points that stand for an object's turn
ROOM_REACH_M = 0.1  # a background's point farther from the other background counts as this far
ROOM_POINTS = 2000
ROOM_WORSE = 1.1  # times the misfit of backgrounds in the frame given: more speaks against another frame


@dataclass(frozen=True, kw_only=True)
class Votes:
    """Where pairs of an object and an instance would put the scan if the object had not moved, each in some ways."""

    T_scene_scan: Float[np.ndarray, "p h 4 4"]
    center: Float[np.ndarray, "p 3"]  # of the instance's points, in the scan's frame, meters
    object: Int[np.ndarray, " p"]
    instance: Int[np.ndarray, " p"]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A frame by least squares over the votes that agree."""

    T_scene_scan: Pose
    agreeing: int  # votes
    covariance: Float[np.ndarray, "6 6"]  # of (shift m, turn rad) about `middle`
    middle: Float[np.ndarray, "3"]  # in the scene's frame
    cost: float  # what is left of the votes: 0 where all agree, 1 where none does


def turns_deg(R: Float[np.ndarray, "*b 3 3"], other: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "*b"]:
    """Angles between rotations and another one."""
    cosine = (np.einsum("...ij,ij->...", R, other) - 1) / 2
    return np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))


def nearest_way(
    T: Pose, votes: Votes
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p 4 4"], Bool[np.ndarray, " p"]]:
    """Of every pair, how far a frame is off (meters, at the mean), the nearest of its ways, and whether turns agree."""
    there = np.einsum("phij,pj->phi", votes.T_scene_scan[..., :3, :3], votes.center)
    there += votes.T_scene_scan[..., :3, 3]
    gap = np.linalg.norm(there - apply_pose(T, votes.center)[:, None], axis=-1)
    turn = turns_deg(votes.T_scene_scan[..., :3, :3], T[:3, :3])
    alike = turn < NEAR_DEG
    best = np.argmin(
        np.where(gap < NEAR_M, gap - alike, gap), axis=1
    )  # one that also turns alike, if there is
    rows = np.arange(len(gap))
    return gap[rows, best], votes.T_scene_scan[rows, best], alike[rows, best]


def agreement(T: Pose, votes: Votes) -> tuple[int, float]:
    """How many objects agree with a frame, each with an instance of its own; and a figure by which to break ties."""
    gap, _, alike = nearest_way(T, votes)
    near = gap < NEAR_M
    count = min(len(set(votes.object[near])), len(set(votes.instance[near])))
    return count, count + float((np.where(near, 0.1 + alike, 0.0) * (1 - gap / NEAR_M))[near].sum()) / 100


def most_agreed(votes: Votes, motion: MotionModel, given: Pose) -> Pose:
    """The frame that most objects agree on; `given` unless clearly more agree on another."""
    ways = votes.T_scene_scan.reshape(-1, 4, 4)
    if len(votes.center) < FEWEST:
        return given
    tried = ways[:: max(1, -(-len(ways) // MOST_TRIED))]
    best = max(tried, key=lambda T: agreement(T, votes)[1])
    best = estimate(best, votes, motion).T_scene_scan
    count, before = agreement(best, votes)[0], agreement(given, votes)[0]
    return best if count >= max(FEWEST, TIMES * before + 1) else given


def estimate(
    T: Pose, votes: Votes, motion: MotionModel, sigma_m: Float[np.ndarray, " p"] | None = None
) -> Estimate:
    """The frame near `T` that fits the votes best; what moved loses its weight. `sigma_m`: errors of the votes."""
    error = np.full(len(votes.center), 0.01) if sigma_m is None else np.hypot(sigma_m, 0.003)
    scale = 2 * NEAR_M / 3
    for _ in range(ROUNDS):
        gap, way, alike = nearest_way(T, votes)
        trust = np.where(gap < NEAR_M, (scale**2 / (scale**2 + gap**2)) ** 2, 0.0)
        if not trust.any():
            break
        T = best_motion(way, votes.center, trust / error**2, alike, motion)
        scale = max(SCALE_M, scale * 0.7)
    return with_errors(T, votes, motion)


def best_motion(
    way: Float[np.ndarray, "p 4 4"],
    center: Float[np.ndarray, "p 3"],
    weight: Float[np.ndarray, " p"],
    alike: Bool[np.ndarray, " p"],
    motion: MotionModel,
) -> Pose:
    """The motion that puts means (and, where turns agree, points about them) where the pairs' own poses do."""
    arms = np.concatenate([np.zeros((1, 3)), ARM_M * np.eye(3), -ARM_M * np.eye(3)])
    a = center[:, None] + np.where(alike[:, None, None], arms, 0.0)
    b = np.einsum("pij,paj->pai", way[:, :3, :3], a) + way[:, None, :3, 3]
    w = np.repeat(weight / weight.sum(), len(arms)) / len(arms)
    a, b = a.reshape(-1, 3), b.reshape(-1, 3)
    mean_a, mean_b = w @ a, w @ b
    T = np.eye(4)
    if motion == "upright":
        H = (a - mean_a).T @ (w[:, None] * (b - mean_b))
        angle = np.arctan2(H[0, 1] - H[1, 0], H[0, 0] + H[1, 1])
        T[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    else:
        T[:3, :3] = Rotation.align_vectors(b - mean_b, a - mean_a, weights=w)[0].as_matrix()
    T[:3, 3] = mean_b - T[:3, :3] @ mean_a
    return T


def with_errors(T: Pose, votes: Votes, motion: MotionModel) -> Estimate:
    """The frame with what the scatter of the agreeing votes says of its errors."""
    gap, way, alike = nearest_way(T, votes)
    near = gap < NEAR_M
    trust = np.where(near, (SCALE_M**2 / (SCALE_M**2 + gap**2)) ** 2, 0.0)
    cost = float((gap**2 / (SCALE_M**2 + gap**2)).mean()) if len(gap) else 1.0
    at = apply_pose(T, votes.center)
    middle = trust @ at / trust.sum() if trust.any() else np.zeros(3)
    turns_freely = motion == "free"
    free = np.array([1, 1, 1, turns_freely, turns_freely, 1], bool)
    H = np.zeros((6, 6))
    for p, w, turned in zip(at - middle, trust, alike, strict=True):
        J = np.hstack([np.eye(3), -np.cross(np.eye(3), p)])
        H += w * (J.T @ J + turned * np.diag([0, 0, 0, 1, 1, 1]) * ARM_M**2)
    known = 3 * trust.sum() + alike @ trust * (3 if turns_freely else 1) - free.sum()
    left = trust @ (gap**2 + alike * (ARM_M * np.deg2rad(turns_deg(way[:, :3, :3], T[:3, :3]))) ** 2)
    variance = left / known if known > 0 else np.inf
    covariance = np.zeros((6, 6))
    inverse = np.linalg.inv(H[np.ix_(free, free)] + 1e-9 * np.eye(free.sum()))
    covariance[np.ix_(free, free)] = inverse * min(variance, NEAR_M**2)
    agreeing = agreement(T, votes)[0] if len(gap) else 0
    return Estimate(T_scene_scan=T, agreeing=agreeing, covariance=covariance, middle=middle, cost=cost)


def position_sigma(e: Estimate, points: Points) -> float:
    """Standard error of what a frame makes of the worst of some places (scene's frame), meters."""
    J = [np.hstack([np.eye(3), -np.cross(np.eye(3), p - e.middle)]) for p in points]
    return float(np.sqrt(max(np.trace(j @ e.covariance @ j.T) for j in J)))


def room_misfit(T: Pose, scene: Points, scan: Points) -> float:
    """Mean truncated distance between two backgrounds both ways, in shares of the truncation; 0 without points."""
    if not len(scene) or not len(scan):
        return 0.0
    a, b = (p[:: max(1, len(p) // ROOM_POINTS)] for p in (scene, apply_pose(T, scan)))
    ways = [
        KDTree(x).query(y, distance_upper_bound=ROOM_REACH_M)[0]
        for x, y in ((scene, b), (apply_pose(T, scan), a))
    ]
    return float(np.mean([np.minimum(d, ROOM_REACH_M).mean() for d in ways]) / ROOM_REACH_M)
