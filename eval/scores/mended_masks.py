"""Scenes whose masks a method mended: halves of divided masks, and masks that it added, are scored as masks."""

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
from more2_jax.types import Instance


def with_mended_masks(scene: KnownScene, tracks: Sequence[Track]) -> tuple[KnownScene, list[Track]]:
    """The scene as if its masks had been those of the tracks, which get ids of their own."""
    return with_added_masks(*with_divided_masks(scene, tracks))


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


def with_added_masks(scene: KnownScene, tracks: Sequence[Track]) -> tuple[KnownScene, list[Track]]:
    """Of every instance that is no mask of its scan, says whose it is: of the object that it lies nearest.

    Only an object without a mask (`LOST`) gains one, and only one.
    """
    tracks = list(tracks)
    for scan in range(len(scene.scans)):
        for n, track in enumerate(tracks):
            known = {i.id for i in scene.scans[scan].instances}
            if scan in track.instance and track.instance[scan] not in known:
                id_ = 1 + max(known, default=0)
                scene = _added(scene, scan, id_, track.seen[scan])
                tracks[n] = dataclasses.replace(track, instance=track.instance | {scan: id_})
    return scene, tracks


def _added(scene: KnownScene, scan: int, id_: int, points: Float[np.ndarray, "n 3"]) -> KnownScene:
    """One mask more, and the object that it shows."""
    there = [o for o in scene.objects if scan in o.T_scan_model and o.mesh is not None]
    nearest = min(there, key=lambda o: distance_m(points, o, scan), default=None)
    objects = tuple(
        dataclasses.replace(o, instance=o.instance | {scan: id_})
        if o is nearest and o.instance.get(scan) == LOST
        else o
        for o in scene.objects
    )
    scans = list(scene.scans)
    more = Instance(id=id_, points=points)
    scans[scan] = dataclasses.replace(scans[scan], instances=(*scans[scan].instances, more))
    return dataclasses.replace(scene, scans=tuple(scans), objects=objects)


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
