"""Two scans of one room laid onto one another as wholes, on the host: by what stayed, which is most of a room.

Point-to-plane ICP (Chen and Medioni, 1991) with Geman-McClure weights, from the frames as they are given; where that
does not fit, from every turn about the vertical at which the walls are parallel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import fftconvolve
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from more2_jax.geometry.floor import floor_height
from more2_jax.geometry.gravity import gravity
from more2_jax.geometry.poses import Points, Pose, apply_pose
from more2_jax.geometry.voxels import voxel_means, voxel_normals

VOXEL_M = 0.05  # clouds are compared at this spacing, whatever theirs is
NEIGHBORS = 16  # of a voxel's normal
REACHES_M = (0.3, 0.2, 0.1, 0.06)  # of correspondences, from far to near; at most `ROUNDS` each
ROUNDS = 6
STILL = 1e-3  # radians and meters: after a smaller step the next reach has its turn
PARALLEL = 0.8  # cosine between the normals of what corresponds
FITS_M = 0.06  # a voxel is where the other scan has it: walls are 1 to 3 cm thick in either
LEAST_FACING = 0.05  # share of the voxels that face a direction which counts
FITS = 0.3  # share from which scans show one room: furnished rooms reach 0.6, wrong poses 0.1
CLOSE_M = 0.03
CLEARLY = 0.95  # of the best's closeness, at most, that a pose elsewhere may reach
DIFFERENT_M = 0.3  # two poses that far apart, on average, are two
LEAST_VOXELS = 200
UPRIGHT = 0.3  # cosine to z: normals of walls
ANGLES = 360  # of wall normals over half a turn
YAWS = 4  # turns tried, each with its half turn
SHIFTS = 3  # for each
CELL_M = 0.1  # of the maps from above
ROUGH_VOXELS = 2500  # while many poses are tried
THREADS = 4  # of a search in a tree, at most: few, as scenes may be worked on side by side
POINTS_A_THREAD = 2000  # starting one takes as long as a hundred points
MOST_VOXELS = 8000  # at even steps, of the moving scan


@dataclass(frozen=True, kw_only=True)
class RoomFit:
    """How scan b lies in the frame of scan a."""

    T_a_b: Pose
    share: (
        float  # of the surfaces that face each of the room's three directions, the least that lies on scan a
    )
    closeness: float  # share of all voxels within `CLOSE_M` of the other scan, both ways added


@dataclass(frozen=True, kw_only=True)
class RoomShape:
    """A scan at even spacing."""

    points: Points
    normals: Points
    tree: KDTree


def threads_for(points: Points) -> int:
    """How many threads search a tree for so many points."""
    return min(THREADS, 1 + len(points) // POINTS_A_THREAD)


def _refined(a: RoomShape, b: RoomShape, T_a_b: Pose, reaches_m: Sequence[float]) -> Pose:
    """The pose after ICP."""
    rows = slice(None, None, max(1, -(-len(b.points) // MOST_VOXELS)))
    points, normals = b.points[rows], b.normals[rows]
    for reach_m in reaches_m:
        for _ in range(ROUNDS):
            step = _step(a, apply_pose(T_a_b, points), _turned(T_a_b, normals), reach_m)
            T_a_b = step @ T_a_b
            if np.abs(step - np.eye(4)).max() < STILL:
                break
    return T_a_b


def _step(a: RoomShape, points: Points, normals: Points, reach_m: float) -> Pose:
    """The motion that takes the points closer to the tangent planes of what they lie nearest."""
    distance, near = map(
        np.asarray, a.tree.query(points, distance_upper_bound=reach_m, workers=threads_for(points))
    )
    near = np.minimum(near, len(a.points) - 1)
    rows = np.isfinite(distance) & (np.abs(np.einsum("ni,ni->n", normals, a.normals[near])) > PARALLEL)
    if rows.sum() < 6:
        return np.eye(4)
    points, near = points[rows], near[rows]
    middle = points.mean(axis=0)
    n = a.normals[near]
    off = np.einsum("ni,ni->n", a.points[near] - points, n)
    scale = reach_m / 3
    weight = (scale**2 / (scale**2 + off**2)) ** 2
    J = np.concatenate([np.cross(points - middle, n), n], axis=1)
    H = J.T @ (weight[:, None] * J)
    H += 1e-6 * np.trace(H) * np.eye(6)  # what no surface holds stays where it is
    x = np.linalg.solve(H, J.T @ (weight * off))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix()
    T[:3, 3] = x[3:] + middle - T[:3, :3] @ middle
    return T


def align_rooms(a: RoomShape, b: RoomShape) -> RoomFit | None:
    """`T_a_b` of two scans that show one room: as they are given, else from any yaw."""
    return fit_as_given(a, b) or fit_from_any_yaw(a, b)


def room_shape(points: Points) -> RoomShape | None:
    """What is compared of a scan (meters); None for one too small to tell. Raises ValueError where it is too wide."""
    if not len(points):
        return None
    voxels, _ = voxel_means(points, VOXEL_M)
    if len(voxels) < LEAST_VOXELS:
        return None
    return RoomShape(points=voxels, normals=voxel_normals(voxels, NEIGHBORS), tree=KDTree(voxels))


def fit_as_given(a: RoomShape, b: RoomShape) -> RoomFit | None:
    """`T_a_b` of scans whose frames are one to about 0.3 m and 5°; None where they do not fit."""
    given = _fit(a, b, np.eye(4))
    return given if given.share >= FITS else None


def closeness(a: RoomShape, b: RoomShape, T_a_b: Pose) -> float:
    """How closely the scans lie on one another at a pose, as `RoomFit.closeness`."""
    return _fit(a, b, T_a_b, ()).closeness


def fit_from_any_yaw(a: RoomShape, b: RoomShape) -> RoomFit | None:
    """`T_a_b` of scans whose z is up to about 10° where floors are seen, else to a few degrees, wherever they lie.

    None where no pose fits, or two fit that differ.
    """
    fits = fits_from_any_yaw(a, b)
    return fits[0] if fits and all(f.closeness < CLEARLY * fits[0].closeness for f in fits[1:]) else None


def fits_from_any_yaw(a: RoomShape, b: RoomShape) -> list[RoomFit]:
    """All poses that fit and differ, the closest first. Scans as `fit_from_any_yaw` takes them."""
    few = _fewer(b)
    rough = [_fit(a, few, T, REACHES_M[:2]) for T in _begun(a, b)]
    most = max((f.share for f in rough), default=0.0)
    fits = [_fit(a, b, f.T_a_b, REACHES_M[1:]) for f in rough if f.share >= max(FITS, most) / 2]
    fits = _different([f for f in fits if f.share >= FITS], b)
    turned = [_fit(a, b, _half_turned(a, b, f.T_a_b)) for f in fits]
    return _different(fits + [f for f in turned if f.share >= FITS], b)


def _different(fits: list[RoomFit], b: RoomShape) -> list[RoomFit]:
    """Of fits that put scan b in about the same place the closest, the closest of all first."""
    found: list[RoomFit] = []
    for f in sorted(fits, key=lambda f: -f.closeness):
        if all(_apart_m(f, g, b.points) > DIFFERENT_M for g in found):
            found.append(f)
    return found


def _fewer(s: RoomShape) -> RoomShape:
    """At most `ROUGH_VOXELS` of them, at even steps."""
    rows = slice(None, None, -(-len(s.points) // ROUGH_VOXELS))
    return RoomShape(points=s.points[rows], normals=s.normals[rows], tree=KDTree(s.points[rows]))


def _fit(a: RoomShape, b: RoomShape, T_a_b: Pose, reaches_m: Sequence[float] = REACHES_M) -> RoomFit:
    """The pose after ICP, and how well it fits: by the scan that has less which the other lacks."""
    T_a_b = _refined(a, b, T_a_b, reaches_m)
    shares = [_on_other(a, b, T_a_b), _on_other(b, a, np.linalg.inv(T_a_b))]
    return RoomFit(
        T_a_b=T_a_b, share=max(least for least, _ in shares), closeness=sum(close for _, close in shares)
    )


def _on_other(a: RoomShape, b: RoomShape, T_a_b: Pose) -> tuple[float, float]:
    """Over the three directions that b's normals gather about, the least share of voxels that lie on a; and the
    share of all that lie on it closely.

    Floors lie on floors at any shift along them: they alone say nothing. How closely tells a room from itself turned
    by half a turn, where walls fit, and what stands before them does not.
    """
    normals = _turned(T_a_b, b.normals)
    # Bounded: of a pose that does not fit most lies far off, where a search would be long.
    there = apply_pose(T_a_b, b.points)
    distance, near = map(
        np.asarray, a.tree.query(there, distance_upper_bound=FITS_M, workers=threads_for(there))
    )
    near = np.minimum(near, len(a.points) - 1)
    parallel = np.abs(np.einsum("ni,ni->n", normals, a.normals[near])) > PARALLEL
    on = (distance < FITS_M) & parallel
    axis = np.abs(normals @ np.linalg.eigh(normals.T @ normals)[1]).argmax(axis=1)
    shares = [float(on[axis == k].mean()) for k in range(3) if (axis == k).mean() > LEAST_FACING]
    return min(shares), float(((distance < CLOSE_M) & parallel).mean())


def _turned(T_a_b: Pose, directions: Points) -> Points:
    return directions @ T_a_b[:3, :3].T


def _apart_m(f: RoomFit, g: RoomFit, points: Points) -> float:
    """Mean distance between the places that two poses give to points."""
    return float(np.linalg.norm(apply_pose(f.T_a_b, points) - apply_pose(g.T_a_b, points), axis=1).mean())


# --- from any yaw ---------------------------------------------------------------------------------------------


def _begun(a: RoomShape, b: RoomShape) -> Iterator[Pose]:
    """Poses to begin from: leveled, walls parallel, and where most of what stands lies over what stands."""
    levels = [_level(s) for s in (a, b)]
    first, second = (apply_pose(T, s.points) for T, s in zip(levels, (a, b), strict=True))
    lift = np.eye(4)
    lift[2, 3] = (floor_height(first) or 0.0) - (floor_height(second) or 0.0)
    for yaw in _yaws(*(_turned(T, s.normals) for T, s in zip(levels, (a, b), strict=True))):
        T = lift.copy()
        T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        for shift in _shifts(first, apply_pose(T, second)):
            T[:2, 3] = shift
            yield np.linalg.inv(levels[0]) @ T @ levels[1]


def _level(s: RoomShape) -> Pose:
    """The pose that levels a scan by its floor; where none is seen, z is taken as up."""
    up = gravity(s.points)
    return np.eye(4) if up is None else up.level(np.zeros(3))


def _yaws(a: Points, b: Points) -> Float[np.ndarray, " k"]:
    """Turns of b about z, radians, that make most walls parallel; walls have no sides, so with every half turn."""
    counts = []
    for normals in (a, b):
        flat = normals[np.abs(normals[:, 2]) < UPRIGHT]
        angle = np.mod(np.arctan2(flat[:, 1], flat[:, 0]), np.pi)
        counts.append(np.histogram(angle, bins=ANGLES, range=(0, np.pi))[0].astype(float))
    spectrum = [np.fft.rfft(c) for c in counts]
    agree = np.fft.irfft(spectrum[0] * np.conj(spectrum[1]), ANGLES)
    smooth = agree + np.roll(agree, 1) + np.roll(agree, -1)
    peaks = [k for k in range(ANGLES) if smooth[k] == max(smooth[np.arange(k - 10, k + 11) % ANGLES])]
    best = sorted(peaks, key=lambda k: -smooth[k])[:YAWS]
    return np.array([k * np.pi / ANGLES + half for k in best for half in (0, np.pi)])


def _shifts(a: Points, b: Points) -> list[Float[np.ndarray, "2"]]:
    """Shifts of b in the plane that lay most of it over a: peaks of the correlation of both maps from above."""
    low = [p[:, :2].min(axis=0) for p in (a, b)]
    maps = [_map(p[:, :2] - c) for p, c in zip((a, b), low, strict=True)]
    score = fftconvolve(maps[0], maps[1][::-1, ::-1])
    found = []
    for _ in range(SHIFTS):
        cell = np.array(np.unravel_index(int(score.argmax()), score.shape))
        found.append(low[0] - low[1] + (cell - np.array(maps[1].shape) + 1) * CELL_M)
        x, y = np.maximum(cell - 3, 0)
        score[x : x + 7, y : y + 7] = -np.inf
    return found


def _half_turned(a: RoomShape, b: RoomShape, T_a_b: Pose) -> Pose:
    """The pose turned by half a turn about the vertical, its middle between the walls put where that of `a` is.

    A rectangular room fits itself so; which it is must not depend on which of the two was begun from.
    """
    flat = a.normals[np.abs(a.normals[:, 2]) < UPRIGHT]
    angle = np.angle(np.exp(4j * np.arctan2(flat[:, 1], flat[:, 0])).sum()) / 4
    to_walls = Rotation.from_euler("z", -angle).as_matrix()
    ends = [np.percentile(p @ to_walls.T, (1, 99), axis=0) for p in (a.points, apply_pose(T_a_b, b.points))]
    here, there = (to_walls.T @ (e.mean(axis=0) * [1, 1, 0]) for e in ends)
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    half[:3, 3] = here - half[:3, :3] @ there
    return half @ T_a_b


def _map(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "w h"]:
    """Voxels over each cell: walls count for their height, floors for one."""
    cell = np.floor(points / CELL_M).astype(int)
    seen = np.zeros(cell.max(axis=0) + 1)
    np.add.at(seen, tuple(cell.T), 1.0)
    return np.sqrt(seen) - np.sqrt(seen).mean()
