"""Small scenes with known truth for the evaluation's tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from eval.data.truth import KnownObject, KnownScene
from more2_jax.types import Instance, Scan
from train.furniture.symmetry import SymmetryGroup


def pose(turn_deg, shift, axis="z"):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, turn_deg, degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


def known_scene(copies=("a", "b", "b", "c"), scans=3, points=200, seed=0):
    """Boxes of random points that move in every scan; ids are 10·scan + number. Equal `copies`, equal shapes."""
    rng = np.random.default_rng(seed)
    shapes = {c: rng.uniform(-0.5, 0.5, (points, 3)) * rng.uniform(0.4, 1.2, 3) for c in sorted(set(copies))}
    objects, seen = [], [[] for _ in range(scans)]
    for n, c in enumerate(copies):
        poses = {k: pose(rng.uniform(-180, 180), [3.0 * n, 2.0 * k, 0.5]) for k in range(scans)}
        for k, T in poses.items():
            cloud = shapes[c] @ T[:3, :3].T + T[:3, 3]
            seen[k].append(Instance(id=10 * k + n, points=cloud, label="box"))
        objects.append(
            KnownObject(
                name=f"object_{n}",
                category="box",
                copies=c,
                instance={k: 10 * k + n for k in range(scans)},
                T_scan_model=poses,
                symmetry=SymmetryGroup.trivial(),
                moved={k: k > 0 for k in range(scans)},
            )
        )
    made = tuple(Scan(name=f"scan {k}", source="made", instances=tuple(i)) for k, i in enumerate(seen))
    return KnownScene(name="made", scans=made, objects=tuple(objects))
