"""Free space: the volume along the view rays of sensors at known positions holds nothing of an object.

Not in the paper. A view is a coarse depth image about one object, made of all points of its scan (the object's, its
neighbors', the room's): along a ray the space is free up to the nearest point in that pixel or beside it, less a
margin that grows as a depth camera's noise does. A pixel without points says nothing. No image of the sensor is
needed, only where it stood; so a surface that no sensor caught, as it was seen too steeply or not sampled, may be
taken for free by mistake: free space is evidence, not a constraint.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree

from more2_jax.geometry.near_points import NearPoints
from more2_jax.geometry.poses import Points
from more2_jax.types import Sight

VIEWS = 8  # of an object: the sensors whose directions lie farthest apart
PIXELS = 96  # at most, a side of a view: that bounds its memory
MIN_PIXELS = 16
IMAGE_MARGIN = 1.2  # half the width of a view, in that of the object's image
PIXEL_SPACINGS = (
    2.5  # a pixel is so many times the median angle between neighboring points, so that few are empty
)
SPACINGS = 2_000  # points, at most, whose nearest neighbor is looked for
MIN_DEPTH_M = 0.05  # sensors see nothing nearer
MARGIN_M, MARGIN_PER_M2 = (
    0.02,
    0.005,
)  # noise of a depth camera: constant, and with the square of the distance


@dataclass(frozen=True, kw_only=True)
class Around:
    """What of a large scan may stand around an object: the points in some of its cells."""

    scan: NearPoints
    cells: Int[np.ndarray, " c"]


def sight_of(cloud: Points, room: Points | Around, sensors: Points) -> Sight | None:
    """What sensors (positions) saw around a cloud, `room` being all points of the scan; all in its frame, meters.

    `VIEWS` sensors at most are asked. None where none of them stands clear of the cloud.
    """
    center = cloud.mean(axis=0)
    views = [view_of(cloud, room, sensors[k]) for k in spread(list(sensors), center)]
    return stacked([v for v in views if v is not None])


def spread(sensors: Sequence[np.ndarray], center: Float[np.ndarray, "3"]) -> list[int]:
    """Which of the sensors to take: `VIEWS` at most, those whose directions from `center` lie farthest apart."""
    if len(sensors) <= VIEWS:
        return list(range(len(sensors)))
    ways = np.stack(sensors) - center
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    chosen, apart = [0], np.full(len(ways), np.inf)
    while len(chosen) < VIEWS:
        apart = np.minimum(apart, np.linalg.norm(ways - ways[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return chosen


def view_of(cloud: Points, room: Points | Around, eye: Float[np.ndarray, "3"]) -> Sight | None:
    """The view of one sensor, unbatched. None where the cloud comes too near it or nearly around it."""
    turn = axes_toward(cloud.mean(axis=0) - eye)
    own = (cloud - eye) @ turn.T
    if (own[:, 2] < MIN_DEPTH_M).any():
        return None
    image = own[:, :2] / own[:, 2:]
    half = IMAGE_MARGIN * float(np.abs(image).max()) + 1e-6
    spacing = median_spacing(image) if len(image) > 1 else half
    side = int(np.clip(2 * half / (PIXEL_SPACINGS * spacing + 1e-9), MIN_PIXELS, PIXELS))
    if isinstance(room, Around):
        room = room.scan.in_view(room.cells, eye, turn[2], half)
    seen = (room - eye) @ turn.T
    seen = seen[seen[:, 2] > MIN_DEPTH_M]
    pixel = np.floor((seen[:, :2] / seen[:, 2:] / half + 1) / 2 * side).astype(int)
    within = ((pixel >= 0) & (pixel < side)).all(axis=1)
    depth = np.full((side, side), np.inf)
    np.minimum.at(depth, tuple(pixel[within].T), np.linalg.norm(seen[within], axis=1))
    depth = minimum_filter(depth, size=3)
    clear = np.zeros((PIXELS, PIXELS), np.float32)
    clear[:side, :side] = np.where(np.isfinite(depth), depth - margin(np.minimum(depth, 1e3)), 0.0)
    return Sight(
        eye=np.asarray(eye, np.float64), turn=turn, half=np.asarray(half), side=np.asarray(side), clear=clear
    )


def median_spacing(points: Float[np.ndarray, "n d"]) -> float:
    """Of points to the nearest other one; asked at `SPACINGS` of them at most."""
    # Made in less time than a balanced one, as it is for few questions.
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)
    asked = points[:: -(-len(points) // SPACINGS)]
    return float(np.median(tree.query(asked, k=2)[0][:, 1]))


def margin(depth: Float[np.ndarray, "*_"] | float) -> Float[np.ndarray, "*_"] | float:
    """How far in front of a seen point space is not yet taken as free, meters."""
    return MARGIN_M + MARGIN_PER_M2 * depth**2


def axes_toward(way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation into a camera's axes: two rows of the image plane, and the unit direction of `way`, right-handed."""
    forward = way / np.linalg.norm(way)
    sideways = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    sideways /= np.linalg.norm(sideways)
    return np.stack([sideways, np.cross(forward, sideways), forward])


# --- views stacked and padded -------------------------------------------------------------------------------


def stacked(views: Sequence[Sight]) -> Sight | None:
    """Views as one sight; None of none."""
    if not views:
        return None
    return Sight(**{f.name: np.stack([getattr(v, f.name) for v in views]) for f in dataclasses.fields(Sight)})


def padded_sights(
    sights: Sequence[Sight | None], origins: Float[np.ndarray, "b 3"], always: bool = False
) -> Sight | None:
    """One of `VIEWS` views for every row of a batch, about its origin, float32; views without free space fill up.

    None where no row has any, unless `always`.
    """
    if not always and all(s is None for s in sights):
        return None
    blank = Sight(
        eye=np.zeros((VIEWS, 3)),
        turn=np.tile(np.eye(3), (VIEWS, 1, 1)),
        half=np.ones(VIEWS),
        side=np.full(VIEWS, MIN_PIXELS),
        clear=np.zeros((VIEWS, PIXELS, PIXELS)),
    )
    rows = []
    for k, origin in enumerate(origins):
        s = sights[k] if k < len(sights) else None
        row = {f.name: np.array(getattr(blank, f.name), np.float32) for f in dataclasses.fields(Sight)}
        if s is not None:
            local = dataclasses.replace(s, eye=np.asarray(s.eye) - origin)
            for name, value in row.items():
                value[: len(s.half)] = getattr(local, name)
        rows.append(Sight(**row))
    return stacked(rows)


# --- traced -------------------------------------------------------------------------------------------------


def clearance(s: Sight, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """How far every point lies in front of where space stops being free; 0 where no view knows it to be free."""

    def of_view(view: Sight) -> Float[Array, " n"]:
        x, y, z = ((points - view.eye) @ view.turn.T).T
        depth = jnp.where(z > 0, z, 1.0)
        row, column = (jnp.floor((v / depth / view.half + 1) / 2 * view.side) for v in (x, y))
        within = (z > 0) & (jnp.minimum(row, column) >= 0) & (jnp.maximum(row, column) < view.side)
        row, column = (jnp.clip(p, 0, PIXELS - 1).astype(jnp.int32) for p in (row, column))
        ahead = view.clear[row, column] - jnp.linalg.norm(points - view.eye, axis=1)
        return jnp.where(within, jnp.maximum(ahead, 0.0), 0.0)

    return jax.vmap(of_view)(s).max(axis=0)


def looked_through(
    s: Sight, points: Float[Array, "n 3"], mask: Bool[Array, " n"], full: float
) -> Float[Array, ""]:
    """Share of the points that lie in free space; one that does by less than `full` counts in proportion."""
    share = jnp.where(mask, jnp.minimum(clearance(s, points) / full, 1.0), 0.0)
    return share.sum() / jnp.maximum(mask.sum(), 1)
