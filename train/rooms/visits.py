"""Rooms visited several times: which objects stand where at every visit, and the scans of it (paper §4).

`flying_scene` makes scenes for evaluation from any furniture. Deterministic by the generator's seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from more2_jax.types import Instance, Scan
from train.furniture.collections import SourceMesh, standing
from train.rooms.arrangement import arrange, circle
from train.rooms.cameras import CLEAN, SPARSE, hemisphere_cameras, inside_cameras
from train.rooms.ray_scanner import Camera, PlacedMesh, Pose, RoomCaster, SensorConfig, camera_matrix

__all__ = ["FlyingConfig", "FlyingScene", "TrueObject", "arrange", "flying_scene", "surface_samples"]

Role = Literal["static", "moved", "removed", "added", "returning"]
ARRANGEMENTS, CAMERA_SETS = 12, 6  # tried before a visit is given up
SAMPLES = 1024  # of an object's surface, on which visibility is measured


@dataclass(frozen=True)
class FlyingConfig:
    """A furnished room and its visits. `paper` is FlyingShape (paper §4); `sparse` adds what real scans have.

    `paper`: three clean depth images of the room from the upper hemisphere.
    `sparse`: cameras on one side of the room at a person's height, occlusion, noise, dropout, a floor.
    """

    scans: int = 3
    regime: Literal["paper", "sparse"] = "sparse"
    room_m: tuple[float, float] = (7.0, 6.0)
    static: int = 0  # objects that never move; every other one moves at every visit
    removed: int = 0  # objects absent from some visit on
    added: int = 0  # objects absent before some visit
    free: bool = False  # any orientation instead of upright
    fewest_points: int = 256  # an object seen less than this makes the visit be arranged anew
    sensor: SensorConfig = field(default_factory=lambda: SPARSE)  # of `sparse`; `paper` has its own
    returning: int = 0  # objects absent at some visits in the middle


@dataclass(frozen=True, kw_only=True)
class TrueObject:
    """One object of the room over all visits; the keys are the scans that have it.

    In regime `real` a scan may have an object and not show it: `instance` then lacks the scan. −1 is an object that
    a scan shows and no mask has.
    """

    name: str
    model: str  # of identical objects the same
    category: str
    vertices: Float[np.ndarray, "v 3"]  # meters, model frame: standing on z = 0
    faces: np.ndarray
    instance: dict[int, int]
    T_scan_model: dict[int, Pose]
    role: Role = "moved"
    seen: dict[int, Bool[np.ndarray, " samples"]] = field(default_factory=dict)  # of `surface_samples`
    symmetry_order: int | None = None  # about the vertical, see `symmetry.yaw_symmetry`; None: not measured
    license: str = "unknown"
    source: str = ""
    parts: dict[int, tuple[int, ...]] = field(
        default_factory=dict
    )  # where masks are predicted: all that show it
    merged: frozenset[int] = frozenset()  # scans whose `instance` is mostly another object's
    reshaped: frozenset[int] = frozenset()  # scans in which it has another shape than `vertices`

    def visible(self, scan: int) -> float:
        """Share of the surface that the scan sees."""
        return float(self.seen[scan].mean())

    def overlap(self, a: int, b: int) -> float:
        """Share of the surface seen by either of two scans that both see; 0 if neither sees any."""
        both, either = (self.seen[a] & self.seen[b]).sum(), (self.seen[a] | self.seen[b]).sum()
        return float(both / max(1, either))


@dataclass(frozen=True, kw_only=True)
class FlyingScene:
    """Scans of one room, and the truth about them. All share the room's frame, but where `T_scan_room` is given."""

    scans: tuple[Scan, ...]
    objects: tuple[TrueObject, ...]
    T_scan_camera: tuple[
        Float[np.ndarray, "cameras 4 4"], ...
    ] = ()  # a scan; camera: x right, y down, z forward
    name: str = "room"
    regime: str = "sparse"
    T_scan_room: tuple[Pose, ...] = ()
    # Regime `real`, a scan: how much of an object's last place it saw, and of the place of what came by the next scan.
    looked_at: tuple[dict[str, float], ...] = ()
    looked_at_next: tuple[dict[str, float], ...] = ()
    room_m: tuple[float, float] | None = None  # regime `real`: the floor, x by y, about the room's zero


def flying_scene(
    models: Sequence[SourceMesh], config: FlyingConfig, rng: np.random.Generator, name: str = "room"
) -> FlyingScene:
    """Furnishes a room with `models` (meters, z up; one twice for two identical objects) and scans it.

    Raises ValueError if there are fewer models than roles, too few scans for them, or no room.
    """
    _check(models, config)
    room = Furnished.of(models, config, rng)
    visits: list[Visit] = []
    for index in range(config.scans):
        before = visits[-1].poses if visits else {}
        visits.append(_visit(room, index, before, config, rng, f"{name}_{index}"))
    objects = []
    for n, m in zip(room.vertices, models, strict=True):
        with_it = {k: v for k, v in enumerate(visits) if n in v.poses}
        objects.append(
            TrueObject(
                name=n,
                model=m.name,
                category=m.category,
                vertices=room.vertices[n],
                faces=m.faces,
                instance={k: v.ids[n] for k, v in with_it.items()},
                T_scan_model={k: v.poses[n] for k, v in with_it.items()},
                role=room.roles[n],
                seen={k: v.seen[n] for k, v in with_it.items()},
                license=m.license,
                source=m.source,
            )
        )
    return FlyingScene(
        scans=tuple(v.scan for v in visits),
        objects=tuple(objects),
        T_scan_camera=tuple(np.stack([camera_matrix(c) for c in v.cameras]) for v in visits),
        name=name,
        regime=config.regime,
    )


def _check(models: Sequence[SourceMesh], config: FlyingConfig) -> None:
    roles = config.static + config.removed + config.added + config.returning
    if not models or roles > len(models) or config.scans < 1:
        raise ValueError(
            f"{len(models)} models for {roles} static, removed, added or returning objects in {config.scans}"
            " scans; needed at least one model, one a role, and a scan"
        )
    if config.returning and config.scans < 3:
        raise ValueError(f"{config.scans} scans for an object that goes and returns; needed 3")


def surface_samples(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray) -> Float[np.ndarray, "samples 3"]:
    """Points spread evenly over a model's surface, always the same: `TrueObject.seen` speaks of these."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])


@dataclass(frozen=True, kw_only=True)
class Furnished:
    """What is in a room over all visits; keys are the objects' names."""

    models: dict[str, SourceMesh]
    vertices: dict[str, np.ndarray]
    samples: dict[str, np.ndarray]
    roles: dict[str, Role]
    present: dict[str, frozenset[int]]  # the scans that have it

    @classmethod
    def of(cls, models: Sequence[SourceMesh], config: FlyingConfig, rng: np.random.Generator) -> Furnished:
        """Gives every model a name and a role."""
        named = {f"object_{k}": m for k, m in enumerate(models)}
        vertices = {n: standing(m.vertices) for n, m in named.items()}
        roles = _roles(list(named), config, rng)
        return cls(
            models=named,
            vertices=vertices,
            samples={n: surface_samples(vertices[n], m.faces) for n, m in named.items()},
            roles=roles,
            present={n: _present(roles[n], config.scans, rng) for n in named},
        )


def _roles(names: list[str], config: FlyingConfig, rng: np.random.Generator) -> dict[str, Role]:
    order = [names[k] for k in rng.permutation(len(names))]
    counts: dict[Role, int] = {
        "static": config.static,
        "removed": config.removed,
        "added": config.added,
        "returning": config.returning,
    }
    given: list[Role] = [role for role, count in counts.items() for _ in range(count)]
    roles = dict(zip(order, [*given, *["moved"] * (len(order) - len(given))], strict=True))
    return {n: roles[n] for n in names}  # pyright: ignore[reportReturnType]


def _present(role: Role, scans: int, rng: np.random.Generator) -> frozenset[int]:
    """The scans that have an object."""
    everywhere = frozenset(range(scans))
    if role == "returning":
        gone = int(rng.integers(1, scans - 1))
        return everywhere - frozenset(range(gone, int(rng.integers(gone + 1, scans))))
    if role not in ("removed", "added"):
        return everywhere
    change = int(rng.integers(1, scans)) if scans > 1 else 1
    return frozenset(range(change) if role == "removed" else range(change, scans))


@dataclass(frozen=True, kw_only=True)
class Visit:
    """One visit to the room: its scan, and where everything stood."""

    scan: Scan
    poses: dict[str, Pose]
    ids: dict[str, int]
    seen: dict[str, np.ndarray]
    cameras: list[Camera]


def _visit(
    room: Furnished,
    index: int,
    before: Mapping[str, Pose],
    config: FlyingConfig,
    rng: np.random.Generator,
    name: str,
) -> Visit:
    """Arranges and scans until every object is seen well enough."""
    present = {n: v for n, v in room.vertices.items() if index in room.present[n]}
    static = [n for n in present if room.roles[n] == "static"]
    sensor = CLEAN if config.regime == "paper" else config.sensor
    for _ in range(ARRANGEMENTS):
        poses = arrange(present, before, static, config.room_m, rng, free=config.free)
        placed = [_placed(room.models[n], v, poses[n]) for n, v in present.items()]
        caster = RoomCaster(placed, None if config.regime == "paper" else config.room_m)
        for _ in range(CAMERA_SETS):
            cameras = _cameras(placed, config, sensor, rng)
            points, owner = caster.scan(cameras, sensor, rng)
            if (np.bincount(owner[owner >= 0], minlength=len(placed)) >= config.fewest_points).all():
                ids = rng.permutation(len(placed)) + 1  # ids say nothing from scan to scan
                labels = [room.models[n].category for n in present]
                samples = {
                    n: room.samples[n] @ p[:3, :3].T + p[:3, 3] for n, p in poses.items() if n in present
                }
                return Visit(
                    scan=_labeled_scan(name, points, owner, ids, labels),
                    poses=poses,
                    ids={n: int(i) for n, i in zip(present, ids, strict=True)},
                    seen={n: caster.sees(cameras, sensor, s) for n, s in samples.items()},
                    cameras=cameras,
                )
    raise ValueError(f"{name}: some object has fewer than {config.fewest_points} points however it stands")


def _placed(model: SourceMesh, vertices: np.ndarray, pose: Pose) -> PlacedMesh:
    return PlacedMesh(model=model.name, vertices=vertices, faces=model.faces, T_room_model=pose)


def _cameras(
    placed: Sequence[PlacedMesh], config: FlyingConfig, sensor: SensorConfig, rng: np.random.Generator
) -> list[Camera]:
    """Cameras as the regime has them."""
    if config.regime == "paper":
        corners = np.concatenate(
            [p.vertices @ p.T_room_model[:3, :3].T + p.T_room_model[:3, 3] for p in placed]
        )
        return hemisphere_cameras(
            float(np.ceil(10 * np.linalg.norm(corners, axis=1).max()) / 10), sensor, rng
        )
    taken = [circle(p.vertices, p.T_room_model, config.free) for p in placed]
    return inside_cameras(config.room_m, taken, sensor, rng)


def _labeled_scan(
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
