"""What is true of a benchmark's scenes, in one form for every data set."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from more2_jax.geometry.poses import Points, Pose
from more2_jax.types import Instance, Mesh, Scan
from train.furniture.symmetry import SymmetryGroup

PACKED = re.compile(r"[^/]+/([a-z]+)_")  # category/collection_piece


@dataclass(frozen=True, kw_only=True)
class KnownObject:
    """One object over all scans. The keys of `T_scan_model` are the scans that have it, those of `instance` the scans
    that show it: where a person did not look, an object is there and not seen.

    Objects with the same `copies` look alike and share a model frame, so each may stand in for the other.
    """

    name: str
    category: str
    copies: str
    instance: dict[int, int]
    T_scan_model: dict[int, Pose]
    symmetry: SymmetryGroup
    mesh: Mesh | None = None  # closed, model frame; None where the data set has none
    forgiven_deg: tuple[float, ...] = (90.0, 180.0)  # by the published evaluation
    moved: dict[int, bool] = field(default_factory=dict)  # since the first scan; absent: not known
    rigid: frozenset[int] | None = None  # scans whose own pose of it is annotated (3RScan's rigid); None: all
    canonical: float = 1.0  # canonical units a meter
    parts: dict[int, tuple[int, ...]] = field(
        default_factory=dict
    )  # where masks are split: all that are mostly its own
    shared: dict[int, int] = field(
        default_factory=dict
    )  # where it has no mask of its own: another's that holds it
    reshaped: frozenset[int] = frozenset()  # scans where its shape is not the one of `mesh`

    @property
    def collection(self) -> str:
        """Where packed furniture comes from, as in "chair/kenney_chairDesk"; empty where names do not say it."""
        named = PACKED.match(self.copies)
        return named[1] if named else ""

    @property
    def first(self) -> int:
        """The scan in which it is seen first."""
        return min(self.instance)

    def same_shape(self, a: int, b: int) -> bool:
        """Whether it has one shape in two scans, so that some pose lays one onto the other."""
        return not {a, b} & self.reshaped

    def masks(self, scan: int) -> tuple[int, ...]:
        """Every instance of a scan that shows it."""
        main = (self.instance[scan],) if scan in self.instance else ()
        return self.parts.get(scan, main)

    def true_pose(self, other: KnownObject, scan: int, ref: int) -> Pose:
        """`T_ref_scan` that lays `other` (itself, or a copy) as scan `scan` saw it onto this one in scan `ref`."""
        return self.T_scan_model[ref] @ np.linalg.inv(other.T_scan_model[scan])


@dataclass(frozen=True, kw_only=True)
class KnownScene:
    """Scans of one place and the truth about them."""

    name: str
    scans: tuple[Scan, ...]
    objects: tuple[KnownObject, ...]
    facts: dict[str, Any] = field(default_factory=dict)
    # By scan, the points that are really each object's, by its name; (): those of its masks. None: not known.
    true_points: tuple[dict[str, Points], ...] | None = ()
    # By scan, the share within sight of the last place of each object, by its name, and of the place of what came by
    # the next scan; (): not known.
    looked_at: tuple[dict[str, float], ...] = ()
    looked_at_next: tuple[dict[str, float], ...] = ()
    # Of rooms with loose things that are no known object: T_scan_room by scan, and the floor, x by y; (): not known.
    T_scan_room: tuple[Pose, ...] = ()
    room_m: tuple[float, float] = (0.0, 0.0)
    # By scan, ids of instances that show such things: what is told of them counts neither way.
    loose: tuple[frozenset[int], ...] = ()

    def true_masks(self) -> tuple[dict[str, Points], ...] | None:
        """By scan, the points that are really each object's, by its name; in the scan's frame, meters.

        None where a scan has instances that belong to no known object: nobody knows what those are.
        """
        if self.true_points != ():
            return self.true_points
        scans = range(len(self.scans))
        if any(self.owner(k, i.id) is None for k in scans for i in self.scans[k].instances):
            return None
        return tuple(
            {
                o.name: np.concatenate([self.instance(k, i).points for i in o.masks(k)])
                for o in self.objects
                if k in o.instance
            }
            for k in scans
        )

    def first_scans(self, count: int) -> KnownScene:
        """The scene as if only its first scans had been made; 0 for all."""
        if not count or count >= len(self.scans):
            return self
        objects = [
            replace(
                o,
                instance={k: i for k, i in o.instance.items() if k < count},
                T_scan_model={k: T for k, T in o.T_scan_model.items() if k < count},
            )
            for o in self.objects
        ]
        return replace(
            self,
            scans=self.scans[:count],
            objects=tuple(o for o in objects if o.instance),
            true_points=self.true_points and self.true_points[:count],
            looked_at=self.looked_at[:count],
            looked_at_next=self.looked_at_next[:count],
        )

    def in_sight(self, o: KnownObject, scan: int, there: int) -> float:
        """Share of the place that an object has in scan `there`, one before or after, that `scan` looked at.

        1 where that is not known.
        """
        shares = self.looked_at if there < scan else self.looked_at_next
        return shares[scan].get(o.name, 1.0) if scan < len(shares) else 1.0

    def owner(self, scan: int, instance: int) -> KnownObject | None:
        """The object that an instance of a scan shows, be it the smaller part of a split one."""
        return next((o for o in self.objects if instance in o.masks(scan)), None)

    def instance(self, scan: int, id_: int) -> Instance:
        """An instance by its id; KeyError if the scan has none of it."""
        found = next((i for i in self.scans[scan].instances if i.id == id_), None)
        if found is None:
            raise KeyError(f"scan {scan} of {self.name} has no instance {id_}")
        return found


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Scenes by name, read one at a time."""

    names: tuple[str, ...]
    read: Callable[[str], KnownScene]
    facts: dict[str, Any]  # data set, regime, version: what a result belongs to
    upright: bool  # objects only turn about the vertical
    right_deg: float  # a rotation error below it is a success (paper §4)
    files: Callable[[str], Sequence[Path]] = lambda name: ()  # files and folders of a scene, where known
