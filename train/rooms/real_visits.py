"""Rooms as a person scans them, visit after visit: hand-held, fused, cluttered, in frames of their own, badly masked.

`real_scene` is what `visits.flying_scene` is for the other regimes. Deterministic by the generator's seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from train.furniture.collections import SourceMesh
from train.rooms.arrangement import Circle, arrange, circle
from train.rooms.changed_shape import ShapeChange, shape_change
from train.rooms.coloring import face_colors, model_colors, palette
from train.rooms.depth_sensor import DepthSensor, Frame
from train.rooms.frames import Frames, scan_frames
from train.rooms.furnishing import furnish
from train.rooms.fused_scan import FusedScan, ScanSettings, fused_scan, take_frames
from train.rooms.hand_held import blind_part, turned_away, walk
from train.rooms.mask_flaws import FEWEST
from train.rooms.mask_truth import Shown, shown_by
from train.rooms.ray_scanner import PlacedMesh, Pose, footprint_radius
from train.rooms.surroundings import Shape, loose_clutter, shell
from train.rooms.things_on_furniture import Arranged, furnish_and_lay, is_small
from train.rooms.visits import FlyingConfig, Furnished, TrueObject
from train.rooms.whole_room import WholeRoom, in_sight, seen_of, whole_room

FLOOR_A_CIRCLE = (
    1.7,
    2.8,
)  # area of the floor over that of the circles about the furniture; in any orientation
FLOOR_FREE = (2.6, 3.6)  # circles are kept apart, not boxes
SMALLEST_ROOM_M = 3.2
SKIPPING = 0.25  # of the scans skip a part of the room
NOWHERE = Arranged(poses={}, borne_by={})  # before the first visit
TALL_M = 1.0  # nobody holds a camera over what is higher


@dataclass(frozen=True)
class RealConfig:
    """What changes between visits, and how they are scanned."""

    scans: int = 2
    free: bool = False  # any rest orientation instead of upright
    room_m: tuple[float, float] | None = None  # floor, x by y; None: as the furniture needs
    things_on_furniture: bool = False  # what is small stands on what is not
    reshaped: float = 0.0  # share of the objects that have another shape at every visit after the first
    scanned: ScanSettings = field(default_factory=ScanSettings)


@dataclass(frozen=True, kw_only=True)
class RealScene:
    """Scans of one room, and the truth about them."""

    name: str
    scans: tuple[FusedScan, ...]
    objects: tuple[TrueObject, ...]
    shown: tuple[dict[str, Shown], ...]  # a scan: how masks show the objects that it shows
    looked_at: tuple[dict[str, float], ...]  # a scan: share of each object's last place within sight
    # A scan: the same of the places of what is there at the next visit and was not at this one.
    looked_at_next: tuple[dict[str, float], ...]
    T_room_camera: tuple[np.ndarray, ...]  # a scan: (frames, 4, 4), true
    frames: Frames
    room_m: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Visit:
    """One visit: where everything stood, and its scan."""

    arranged: Arranged
    scan: FusedScan
    shown: dict[str, Shown]
    seen: dict[str, np.ndarray]
    looked_at: dict[str, float]
    path: np.ndarray
    frames: Sequence[Frame] = ()  # while the next visit needs them: many images
    looked_at_next: dict[str, float] = field(default_factory=dict)

    @property
    def poses(self) -> dict[str, Pose]:
        """Where everything stood."""
        return self.arranged.poses


def real_scene(
    models: Sequence[SourceMesh], config: RealConfig, rng: np.random.Generator, name: str = "room"
) -> RealScene:
    """Furnishes a room with `models` (meters, z up), and has a person scan it `config.scans` times.

    Raises ValueError if there is no room for the furniture, or nowhere to stand.
    """
    furnished = Furnished.of(models, _roles(len(models), config, rng), rng)
    on_floor = [v for v in furnished.vertices.values() if not (config.things_on_furniture and is_small(v))]
    radii = [footprint_radius(v) for v in on_floor]
    room_m = config.room_m or _room_for(radii, FLOOR_FREE if config.free else FLOOR_A_CIRCLE, rng)
    kind: Frames = "own" if rng.random() < 0.5 else "aligned"
    frames = scan_frames(kind, config.scans, rng)
    place = Place(
        room=furnished,
        room_m=room_m,
        shell=shell(room_m, rng),
        colors=_colors(furnished, rng),
        config=config,
        changes=_changes(furnished, config, rng),
    )
    visits = place.visits(frames, rng)
    return RealScene(
        name=name,
        scans=tuple(v.scan for v in visits),
        objects=tuple(_object(n, place, visits) for n in furnished.vertices),
        shown=tuple(v.shown for v in visits),
        looked_at=tuple(v.looked_at for v in visits),
        looked_at_next=tuple(v.looked_at_next for v in visits),
        T_room_camera=tuple(v.path for v in visits),
        frames=kind,
        room_m=room_m,
    )


def _roles(count: int, config: RealConfig, rng: np.random.Generator) -> FlyingConfig:
    """Some objects stay, at most one goes, at most one comes, the others move at every visit."""
    removed, added = (int(rng.integers(2)) if config.scans > 1 else 0 for _ in range(2))
    static = int(rng.integers(1, max(2, count - removed - added)))
    return FlyingConfig(scans=config.scans, static=static, removed=removed, added=added, free=config.free)


def _room_for(
    radii: Sequence[float], share: tuple[float, float], rng: np.random.Generator
) -> tuple[float, float]:
    """A floor so many times (least, most) as large as circles of these radii."""
    area = rng.uniform(*share) * np.pi * sum(r * r for r in radii)
    least = max(SMALLEST_ROOM_M, 2 * max(radii) + 0.5)
    y = max(least, float(np.sqrt(area * rng.uniform(0.65, 1.0))))
    return round(max(least, area / y), 3), round(y, 3)


def _changes(
    room: Furnished, config: RealConfig, rng: np.random.Generator
) -> tuple[dict[str, ShapeChange], ...]:
    """A scan: how objects differ from their first shape."""
    if not config.reshaped:
        return ({},) * config.scans
    some = [n for n in room.vertices if rng.random() < config.reshaped]
    later = [{n: shape_change(room.vertices[n], rng) for n in some} for _ in range(config.scans - 1)]
    return ({}, *later)


def _colors(room: Furnished, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Colors of the faces of every object."""
    by_model = model_colors([m.name for m in room.models.values()], palette(rng), rng)
    return {n: face_colors(room.vertices[n], m.faces, by_model[m.name]) for n, m in room.models.items()}


@dataclass(frozen=True, kw_only=True)
class Place:
    """A room over all visits."""

    room: Furnished
    room_m: tuple[float, float]
    shell: list[Shape]
    colors: dict[str, np.ndarray]
    config: RealConfig
    changes: tuple[dict[str, ShapeChange], ...]  # a scan: how objects differ from their first shape

    def visits(self, T_scan_room: Float[np.ndarray, "scans 4 4"], rng: np.random.Generator) -> list[Visit]:
        """One visit a scan, each of the room as the one before left it."""
        visits: list[Visit] = []
        last: dict[str, Pose] = {}  # where each object stood when it was there last
        for index, T in enumerate(T_scan_room):
            visit = self.visit(index, visits[-1].arranged if visits else NOWHERE, last, T, rng)
            if visits:
                ahead = self.looked_at_by(visits[-1], index, visit.poses)
                visits[-1] = replace(visits[-1], frames=(), looked_at_next=ahead)
            visits.append(visit)
            last |= visit.poses
        return visits

    def visit(
        self,
        index: int,
        before: Arranged,
        last: Mapping[str, Pose],
        T_scan_room: Pose,
        rng: np.random.Generator,
    ) -> Visit:
        """Arranges the room and scans it."""
        shape = self.changes[index]
        present = {
            n: shape[n](v) if n in shape else v
            for n, v in self.room.vertices.items()
            if index in self.room.present[n]
        }
        static = [n for n in present if self.room.roles[n] == "static"]
        arranged = self._arranged(present, before, static, rng)
        poses = arranged.poses
        whole = self._whole(present, poses, rng)
        sensor = self.config.scanned.sensor
        path = self._path(present, poses, rng)
        frames = take_frames(whole, path, sensor, rng)
        names = list(present)
        scan = fused_scan(whole, frames, len(names), T_scan_room, self.config.scanned, rng)
        shown = shown_by(scan.instance, scan.owner, len(names), FEWEST)
        where = {n: self.samples_at(index, n, p) for n, p in poses.items()}
        expected = {n: self.samples_at(index, n, p) for n, p in {**poses, **last}.items()}
        return Visit(
            arranged=arranged,
            scan=scan,
            shown={names[k]: s for k, s in shown.items()},
            seen={n: seen_of(where[n], k, whole.owner, frames, sensor) for k, n in enumerate(names)},
            looked_at=_shares_in_sight(expected, frames, sensor),
            path=path,
            frames=frames,
        )

    def samples_at(self, index: int, name: str, pose: Pose) -> np.ndarray:
        """Samples of an object's surface at a visit, room's frame."""
        samples, change = self.room.samples[name], self.changes[index].get(name)
        return _placed(change(samples) if change else samples, pose)

    def looked_at_by(self, visit: Visit, index: int, after: Mapping[str, Pose]) -> dict[str, float]:
        """Of what is there at visit `index`, after this one, and was not at it: the share of its place within sight."""
        places = {n: self.samples_at(index, n, p) for n, p in after.items() if n not in visit.poses}
        return _shares_in_sight(places, visit.frames, self.config.scanned.sensor)

    def _arranged(
        self,
        present: Mapping[str, np.ndarray],
        before: Arranged,
        static: Sequence[str],
        rng: np.random.Generator,
    ) -> Arranged:
        """Where everything present stands now."""
        if self.config.things_on_furniture:
            meshes = {n: (v, self.room.models[n].faces) for n, v in present.items()}
            return furnish_and_lay(meshes, before, static, self.room_m, rng)
        if self.config.free:
            poses = arrange(present, before.poses, static, self.room_m, rng, free=True)
        else:
            poses = furnish(present, before.poses, static, self.room_m, rng)
        return Arranged(poses=poses, borne_by={})

    def _whole(
        self, present: Mapping[str, np.ndarray], poses: Mapping[str, Pose], rng: np.random.Generator
    ) -> WholeRoom:
        """Furniture as it stands, with clutter of this visit."""
        placed = [
            PlacedMesh(model=n, vertices=v, faces=self.room.models[n].faces, T_room_model=poses[n])
            for n, v in present.items()
        ]
        taken = [circle(v, poses[n], self.config.free) for n, v in present.items()]
        shapes = [*self.shell, *loose_clutter(self.room_m, taken, rng)]
        return whole_room(placed, [self.colors[n] for n in present], shapes)

    def _path(
        self, present: Mapping[str, np.ndarray], poses: Mapping[str, Pose], rng: np.random.Generator
    ) -> np.ndarray:
        """A walk that looks at every object, but for those in the part that one scan in four skips."""
        standing = {n: _placed(v, poses[n]) for n, v in present.items()}
        targets = [(v.min(axis=0) + v.max(axis=0)) / 2 for v in standing.values()]
        blind = blind_part(targets, self.room_m, rng) if rng.random() < SKIPPING else None
        taken: list[Circle] = []
        for n, v in present.items():
            if self.config.things_on_furniture and is_small(v):
                continue
            x, y, r = circle(v, poses[n], self.config.free)
            taken.append((x, y, r + 0.1 if standing[n][:, 2].max() > TALL_M else 0.7 * r))
        path = walk(targets, taken, self.room_m, self.config.scanned.walk, blind, rng)
        return path if blind is None else turned_away(path, blind, self.config.scanned.sensor)


def _shares_in_sight(
    places: Mapping[str, np.ndarray], frames: Sequence[Frame], sensor: DepthSensor
) -> dict[str, float]:
    return {n: float(in_sight(p, frames, sensor).mean()) for n, p in places.items()}


def _placed(points: np.ndarray, pose: Pose) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _object(name: str, place: Place, visits: Sequence[Visit]) -> TrueObject:
    """The truth about one object; its poses are in the frames of the scans, also of those that do not show it."""
    room, there = place.room, {k: v for k, v in enumerate(visits) if name in v.poses}
    model, role = room.models[name], room.roles[name]
    if role == "static" and any((v.poses[name] != visits[0].poses[name]).any() for v in there.values()):
        role = "moved"  # with what bears it
    return TrueObject(
        name=name,
        model=model.name,
        category=model.category,
        vertices=room.vertices[name],
        faces=model.faces,
        instance={k: v.shown[name].instance for k, v in there.items() if name in v.shown},
        T_scan_model={k: np.round(v.scan.T_scan_room @ v.poses[name], 9) for k, v in there.items()},
        role=role,
        seen={k: v.seen[name] for k, v in there.items()},
        reshaped=frozenset(k for k in there if name in place.changes[k]),
        license=model.license,
        source=model.source,
    )
