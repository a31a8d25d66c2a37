"""Scenes whose merged masks a method divided: each half is scored as a mask of its own."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from eval.data.masks import LOST
from eval.data.truth import KnownObject, KnownScene
from eval.scores.tracks import Track
from more2_jax.geometry.poses import apply_pose


def with_divided_masks(scene: KnownScene, tracks: Sequence[Track]) -> tuple[KnownScene, list[Track]]:
    """Gives every half of a divided mask an id of its own, and says whose it is: of the object that it lies nearest.

    The owner's half keeps the mask's id. Only an object without a mask of its own (`KnownObject.shared`) gains one.
    """
    tracks = list(tracks)
    for scan in range(len(scene.scans)):
        for mask, held in sorted(Counter(t.instance[scan] for t in tracks if scan in t.instance).items()):
            if held == 1:
                continue
            rows = [n for n, t in enumerate(tracks) if t.instance.get(scan) == mask]
            hidden = [o for o in scene.objects if o.shared.get(scan) == mask and o.instance.get(scan) == LOST]
            owner = scene.owner(scan, mask)
            if owner is not None:
                scene, tracks = _divided(scene, tracks, scan, mask, rows, owner, hidden)
    return scene, tracks


def _divided(
    scene: KnownScene,
    tracks: list[Track],
    scan: int,
    mask: int,
    rows: Sequence[int],
    owner: KnownObject,
    hidden: Sequence[KnownObject],
) -> tuple[KnownScene, list[Track]]:
    """One mask: its owner's half is the one that lies nearest to it; other halves get new ids."""
    own = min(rows, key=lambda n: distance_m(tracks[n].seen[scan], owner, scan))
    whole, instances = scene.instance(scan, mask), list(scene.scans[scan].instances)
    objects, given = list(scene.objects), set[str]()
    for n in rows:
        half = tracks[n].seen[scan]
        id_ = mask if n == own else 1 + max(i.id for i in instances)
        part = dataclasses.replace(whole, id=id_, points=half, colors=None, normals=None)
        instances = [i for i in instances if i.id != id_] + [part]
        tracks[n] = dataclasses.replace(tracks[n], instance=tracks[n].instance | {scan: id_})
        free = [o for o in hidden if o.name not in given]
        if n != own and free:
            nearest = min(free, key=lambda o: distance_m(half, o, scan))
            given.add(nearest.name)
            at = next(row for row, o in enumerate(objects) if o is nearest)
            objects[at] = dataclasses.replace(nearest, instance=nearest.instance | {scan: id_})
    scans = list(scene.scans)
    scans[scan] = dataclasses.replace(scans[scan], instances=tuple(instances))
    return dataclasses.replace(scene, scans=tuple(scans), objects=tuple(objects)), tracks


def distance_m(points: Float[np.ndarray, "n 3"], o: KnownObject, scan: int) -> float:
    """Mean distance of a scan's points to the vertices of an object's true mesh, meters."""
    assert o.mesh is not None
    return float(KDTree(apply_pose(o.T_scan_model[scan], o.mesh.vertices)).query(points)[0].mean())
