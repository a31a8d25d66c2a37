"""The short test of `more2 doctor`: known answers of the shipped prior on a piece of the bundled scans."""

from __future__ import annotations

import time
from dataclasses import dataclass

# Single precision gives 1e-6 (tests/network/test_shipped.py); matrix units that round inputs to ten bits, 1e-2.
MOST_DEVIATION = 1e-3
MOST_ROTATION_DEG, MOST_POSITION_M = 5.0, 0.05  # ten times what the pair below gives
OBJECTS = (
    3  # of the first bundled scan: rounding may decide a neighbor in one cloud of twenty, the median holds
)
TURN_DEG, SHIFT_M = 70.0, (1.5, -0.4, 0.0)  # of the chair, between before and after
CHAIR = 5  # its instance


@dataclass(frozen=True)
class SelfTest:
    """What came out. Angles in degrees, lengths in meters."""

    equivariance: float  # median over objects of the largest |Φ(RX) − R Φ(X)|, relative to the largest |Φ(X)|
    rotation_error_deg: float  # of the pose found for the chair
    position_error_m: float  # of its center
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether all is as near as it should be."""
        return (
            self.equivariance <= MOST_DEVIATION
            and self.rotation_error_deg <= MOST_ROTATION_DEG
            and self.position_error_m <= MOST_POSITION_M
        )


def self_test() -> SelfTest:
    """Encodes objects as scanned and turned, and registers a chair with itself moved, other points of it."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    import more2_jax as m2
    from more2_jax.geometry.poses import apply_pose, rotation_error_deg
    from more2_jax.scans.demo import demo_scan_paths

    began = time.perf_counter()
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", TURN_DEG, degrees=True).as_matrix()
    T[:3, 3] = SHIFT_M
    scan, prior = m2.read_scan(demo_scan_paths()[0]), m2.load_prior("small")
    chair = next(i.points for i in scan.instances if i.id == CHAIR)
    before, after = chair[::2], apply_pose(T, chair[1::2])
    clouds = [i.points for i in scan.instances if i.id != CHAIR][:OBJECTS]
    turned = [apply_pose(T, points) for points in clouds]
    batch = m2.observe(prior, [before, after, *clouds, *turned])
    eqv = np.asarray(batch.code.eqv)
    expected, got = T[:3, :3] @ eqv[2 : 2 + OBJECTS], eqv[2 + OBJECTS : 2 + 2 * OBJECTS]
    off = np.abs(got - expected).max((1, 2)) / np.abs(expected).max((1, 2))

    pairs = m2.pair_up(batch.take(np.array([0])), batch.take(np.array([1])))
    method = m2.preset("robust", upright=True).registration
    found = pairs.to_world(m2.register(prior, pairs, method, "upright").T_target_source)[0]
    center = before.mean(axis=0, keepdims=True)
    return SelfTest(
        equivariance=float(np.median(off)),
        rotation_error_deg=rotation_error_deg(found[:3, :3], T[:3, :3]),
        position_error_m=float(np.linalg.norm(apply_pose(found, center) - apply_pose(T, center))),
        seconds=time.perf_counter() - began,
    )
