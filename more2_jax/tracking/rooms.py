"""Two rooms as wholes: what is not an instance, and how all of both fits where it does not lie as given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from more2_jax.geometry.near_points import NearClouds
from more2_jax.geometry.poses import Points, apply_pose
from more2_jax.geometry.room_alignment import (
    CLEARLY,
    RoomFit,
    RoomShape,
    closeness,
    fit_as_given,
    fits_from_any_yaw,
    room_shape,
)
from more2_jax.tracking.looked_at import last_place
from more2_jax.types import Instance, LivingScene, Scan, SceneObject

LEAST_BACKGROUND = 200  # points: objects alone are no room
WIDEST_M = 100.0  # so are wider scans, or what strays from one


@dataclass(frozen=True, kw_only=True)
class Rooms:
    """The scene so far (scene's frame) and a new scan (its own): backgrounds, meters, and all else.

    Objects are placed only where rooms are compared: those of a building would take as much memory again.
    """

    scene: Points = field(default_factory=lambda: np.zeros((0, 3)))
    scan: Points = field(default_factory=lambda: np.zeros((0, 3)))
    objects: Sequence[SceneObject] = ()
    instances: Sequence[Instance] = ()

    @cached_property
    def shapes(self) -> tuple[RoomShape | None, RoomShape | None]:
        """All of either at even spacing; None where it shows too little of a room."""
        return (
            shape_of(self.scene, map(last_place, self.objects)),
            shape_of(self.scan, (i.points for i in self.instances)),
        )

    @cached_property
    def surfaces(self) -> tuple[NearClouds, NearClouds] | None:
        """All that either shows, to be asked what lies near a place; None where one shows too little of a room."""
        if min(len(self.scene), len(self.scan)) < LEAST_BACKGROUND:
            return None
        return (
            NearClouds([partial(last_place, o) for o in self.objects], self.scene),
            NearClouds([partial(getattr, i, "points") for i in self.instances], self.scan),
        )

    @cached_property
    def scene_surfaces(self) -> RoomShape | None:
        """What is no object of the scene, at even spacing; None where that is too little, or too wide."""
        return shape_of(self.scene, ())

    @cached_property
    def near_given(self) -> RoomFit | None:
        """The pose near the one given at which the rooms fit; None where there is none, or one shows too little.

        Whatever masks are joined and divided, this and `fits` stay.
        """
        a, b = self.shapes
        return None if a is None or b is None else fit_as_given(a, b)

    @cached_property
    def fits(self) -> list[RoomFit]:
        """The poses of the scan at which the rooms fit; none where they do near the given one, or show too little."""
        a, b = self.shapes
        if a is None or b is None or self.near_given is not None:
            return []
        return fits_from_any_yaw(a, b)

    def clearly_near_given(self) -> RoomFit | None:
        """`near_given` where the rooms clearly fit better so than as they are given."""
        a, b = self.shapes
        fit = self.near_given
        if a is None or b is None or fit is None:
            return None
        return fit if closeness(a, b, np.eye(4)) < CLEARLY * fit.closeness else None


def shape_of(background: Points, clouds: Iterable[Points]) -> RoomShape | None:
    """What is compared of a scan; None where it shows too little of a room, or is too wide to be one."""
    if len(background) < LEAST_BACKGROUND:
        return None
    points = np.concatenate([background, *clouds])
    return room_shape(points) if np.ptp(points, axis=0).max() < WIDEST_M else None


def rooms_of(scene: LivingScene, scan: Scan) -> Rooms:
    """The scene as its last scan of a known frame shows it, and a new one, both leveled; objects where seen last."""
    last = next(s for s in reversed(scene.scans) if not s.frame.unknown)  # the first one's is the scene's
    return Rooms(
        scene=apply_pose(last.frame.T_scene_scan, last.background),
        scan=scan.background,
        objects=scene.objects,
        instances=scan.instances,
    )
