"""Rooms visited several times: which objects stand where at every visit, and the scans of it (METHOD 7).

`flying_scene` makes scenes for evaluation from any furniture. Deterministic by the generator's seed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from more2_jax.data.flying_shape import (
    PlacedMesh,
    Pose,
    SensorConfig,
    footprint_radius,
    free_spot,
    hemisphere_scan,
    scan_room,
    upright_pose,
)
from more2_jax.data.meshes import SourceMesh, standing
from more2_jax.types import Instance, Scan

TRIES = 500


@dataclass(frozen=True)
class FlyingConfig:
    """A furnished room and its visits. `paper` is METHOD 7; `sparse` adds what real scans have.

    `paper`: every object alone, three clean depth images from the upper hemisphere.
    `sparse`: cameras in the room, occlusion between objects, noise, dropout, a floor.
    """

    scans: int = 3
    regime: Literal["paper", "sparse"] = "sparse"
    room_m: tuple[float, float] = (7.0, 6.0)
    static: int = 0  # objects that never move; every other one moves at every visit
    removed: int = 0  # objects absent from some visit on
    added: int = 0  # objects absent before some visit
    free: bool = False  # any orientation instead of upright
    fewest_points: int = 256  # an object seen less than this makes the visit be arranged anew
    sensor: SensorConfig = field(default_factory=SensorConfig)


@dataclass(frozen=True, kw_only=True)
class TrueObject:
    """One object of the room over all visits; the keys are the scans that have it."""

    name: str
    model: str  # of identical objects the same
    category: str
    vertices: Float[np.ndarray, "v 3"]  # metres, model frame: standing on z = 0
    faces: np.ndarray
    instance: dict[int, int]
    T_scan_model: dict[int, Pose]


@dataclass(frozen=True, kw_only=True)
class FlyingScene:
    """Scans of one room, and the truth about them. All scans share the room's frame."""

    scans: tuple[Scan, ...]
    objects: tuple[TrueObject, ...]


def flying_scene(
    models: Sequence[SourceMesh], config: FlyingConfig, rng: np.random.Generator, name: str = "room"
) -> FlyingScene:
    """Furnishes a room with `models` (metres, z up; one twice for two identical objects) and scans it.

    Raises ValueError if there are fewer models than roles, or no room for them.
    """
    roles = config.static + config.removed + config.added
    if not models or roles > len(models) or config.scans < 1:
        raise ValueError(
            f"{len(models)} models for {roles} static, removed or added objects in {config.scans} scans;"
            " needed at least one model, one a role, and a scan"
        )
    vertices = {f"object_{k}": standing(m.vertices) for k, m in enumerate(models)}
    static, spans = _roles(list(vertices), config, rng)
    scans, poses, seen = [], {}, {n: ({}, {}) for n in vertices}
    for index in range(config.scans):
        present = {n: v for n, v in vertices.items() if index in spans[n]}
        poses, scan, ids = _visit(present, poses, models, static, config, rng, f"{name}_{index}")
        scans.append(scan)
        for n in present:
            seen[n][0][index], seen[n][1][index] = ids[n], poses[n]
    objects = [
        TrueObject(
            name=n,
            model=m.name,
            category=m.category,
            vertices=vertices[n],
            faces=m.faces,
            instance=seen[n][0],
            T_scan_model=seen[n][1],
        )
        for n, m in zip(vertices, models, strict=True)
    ]
    return FlyingScene(scans=tuple(scans), objects=tuple(objects))


def _roles(
    names: list[str], config: FlyingConfig, rng: np.random.Generator
) -> tuple[frozenset[str], dict[str, range]]:
    """Who is static, and at which visits each object is present."""
    order = [names[k] for k in rng.permutation(len(names))]
    static, rest = order[: config.static], order[config.static :]
    spans = {n: range(config.scans) for n in names}
    for k, n in enumerate(rest[: config.removed + config.added]):
        change = int(rng.integers(1, config.scans)) if config.scans > 1 else 1
        spans[n] = range(change) if k < config.removed else range(change, config.scans)
    return frozenset(static), spans


def _visit(
    present: Mapping[str, np.ndarray],
    before: Mapping[str, Pose],
    models: Sequence[SourceMesh],
    static: Collection[str],
    config: FlyingConfig,
    rng: np.random.Generator,
    name: str,
) -> tuple[dict[str, Pose], Scan, dict[str, int]]:
    """Arranges and scans until every object is seen well enough."""
    number = {n: int(n.removeprefix("object_")) for n in present}
    for _ in range(10):
        poses = arrange(present, before, static, config.room_m, rng, free=config.free)
        placed = [
            PlacedMesh(
                model=models[number[n]].name, vertices=v, faces=models[number[n]].faces, T_room_model=poses[n]
            )
            for n, v in present.items()
        ]
        if config.regime == "paper":
            points, owner = hemisphere_scan(placed, rng)
        else:
            points, owner = scan_room(placed, config.room_m, config.sensor, rng)
        if all((owner == k).sum() >= config.fewest_points for k in range(len(placed))):
            ids = rng.permutation(len(placed)) + 1  # ids say nothing from scan to scan
            labels = [models[number[n]].category for n in present]
            scan = _labelled_scan(name, points, owner, ids, labels)
            return poses, scan, {n: int(i) for n, i in zip(present, ids, strict=True)}
    raise ValueError(f"{name}: some object has fewer than {config.fewest_points} points however it stands")


def _labelled_scan(
    name: str, points: np.ndarray, owner: np.ndarray, ids: np.ndarray, labels: Sequence[str]
) -> Scan:
    instances = [
        Instance(id=int(i), points=points[owner == k], label=label)
        for k, (i, label) in enumerate(zip(ids, labels, strict=True))
    ]
    return Scan(
        name=name,
        source="rendered",
        instances=tuple(sorted(instances, key=lambda instance: instance.id)),
        background=points[owner < 0],
    )


def arrange(
    present: Mapping[str, Float[np.ndarray, "v 3"]],
    before: Mapping[str, Pose],
    static: Collection[str],
    room_m: tuple[float, float],
    rng: np.random.Generator,
    *,
    free: bool = False,
    moved_m: tuple[float, float] = (0.3, np.inf),
) -> dict[str, Pose]:
    """A pose in the room for the vertices of every object present, none touching another.

    Static objects stay where they were `before`; the others come to stand `moved_m` (least, most) from there.
    Raises ValueError when the room is too full.
    """
    for _ in range(TRIES):
        poses = {n: before[n] for n in present if n in static and n in before}
        taken = [(p[0, 3], p[1, 3], _reach(present[n], free)) for n, p in poses.items()]
        try:
            for n in (n for n in present if n not in poses):
                spot = free_spot(rng, radius := _reach(present[n], free), taken, room_m)
                taken.append((*spot, radius))
                poses[n] = _pose(present[n], spot, rng, free)
        except ValueError:
            continue
        moved = [n for n in present if n in before and n not in static]
        if all(moved_m[0] < np.linalg.norm(poses[n][:2, 3] - before[n][:2, 3]) < moved_m[1] for n in moved):
            return poses
    raise ValueError(
        f"no arrangement of {len(present)} objects in {room_m[0]} × {room_m[1]} m; needed more room"
    )


def _reach(vertices: Float[np.ndarray, "v 3"], free: bool) -> float:
    """Radius about the model's origin that holds the footprint, however it is turned."""
    return float(np.linalg.norm(vertices, axis=1).max()) if free else footprint_radius(vertices)


def _pose(
    vertices: Float[np.ndarray, "v 3"], spot: tuple[float, float], rng: np.random.Generator, free: bool
) -> Pose:
    if not free:
        return upright_pose(rng.uniform(0, 2 * np.pi), *spot)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    pose[:3, 3] = *spot, -(vertices @ pose[2, :3]).min()  # touching the floor
    return pose
