"""Which way is up in a scan whose z is roughly up: the one normal of its floors, table tops, ceilings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from more2_jax.geometry.poses import Points, Pose

Direction = Float[np.ndarray, "3"]

MAX_TILT_DEG = 10.0  # farther from z nothing is looked for: z is then not meant to be up
GRIDS_DEG = (1.0, 0.25, 0.08)  # between the directions tried: all about z, then those about the best
BIN_M = 0.02  # of the histograms of heights
BAND_M = 0.03  # half the thickness of a level: a floor's waves and a depth camera's noise
ROUNDS = 8  # of finding levels and fitting their normal
SCALE_M = 0.015  # of the Geman-McClure weights: a point that far off its level counts a quarter
LEAST_ON_LEVELS = 0.05  # share of the points that levels must hold together, walls through them left out,
LEAST_ON_LEVEL = 0.02  # and each of them
LEAST_POINTS = 200
LEAST_WIDTH_M = (
    0.15  # standard deviation of the levels' points, the narrower way: of a strip half a meter wide
)
# Of the points about a floor or a ceiling so many lie within `SCALE_M`: clutter lies at any height.
LEAST_THIN = 0.45
# Floors and ceilings are at the ends of a room; tops of furniture, whose edges masks leave, have legs below and lamps
# above them. Levels at an end hold so much of the fullest.
LEAST_AT_END = 0.6
LEAST_GAIN = 1.1  # levels hold so many times what they hold along z, or up is z
# Share of a scan below its floor, or above its ceiling: noise, a stair seen through a door.
MOST_BEYOND = 0.05
BEYOND_M = 0.15  # so far below it: drift bends floors by a few centimeters; legs of tables are longer
REACH_M = 50.0  # along an axis: a stray point a kilometer off must not make a million layers
TRIED_POINTS = 5000  # at even steps, along the directions tried
MOST_POINTS = 20_000  # at even steps, for the rest


@dataclass(frozen=True, kw_only=True)
class Gravity:
    """The upward normal of a scan's levels."""

    up: Direction  # unit length, in the scan's frame
    share: float  # of the points on levels, walls through them left out

    @property
    def tilt_deg(self) -> float:
        """Angle between up and the scan's z."""
        return float(np.rad2deg(np.arctan2(np.linalg.norm(self.up[:2]), self.up[2])))

    def level(self, about: Direction) -> Pose:
        """The pose that turns up to z by the least turn, about a point that stays."""
        T = np.eye(4)
        T[:3, :3] = least_turn(self.up)
        T[:3, 3] = about - T[:3, :3] @ about
        return T


def gravity(points: Points) -> Gravity | None:
    """The common normal of the levels of a background, within about `MAX_TILT_DEG` of z.

    None where levels hold less than `LEAST_ON_LEVELS` of the points, or none of the fullest is a floor or a ceiling:
    neither is seen, or z is not up. z itself where the scan's levels hold hardly less along it.
    """
    points = about_middle(points[:: max(1, -(-len(points) // MOST_POINTS))])
    if len(points) < LEAST_POINTS:
        return None
    up, share = sharpest(points[:: max(1, -(-len(points) // TRIED_POINTS))]), 0.0
    for _ in range(ROUNDS):
        levels = list(levels_along(points @ up))
        share = sum(held for _, held in levels)
        if share < LEAST_ON_LEVELS:
            return None
        fitted = common_normal(points, up, [height for height, _ in levels])
        if fitted is None:
            return None
        up = fitted
    if not is_bounded(points @ up):
        return None
    along_z = sum(held for _, held in levels_along(points[:, 2]))
    if share < LEAST_GAIN * along_z:
        return Gravity(up=np.array([0.0, 0.0, 1.0]), share=float(along_z))
    found = Gravity(up=up, share=float(share))
    return found if found.tilt_deg <= MAX_TILT_DEG + GRIDS_DEG[0] else None


def is_bounded(along: Float[np.ndarray, " n"]) -> bool:
    """Whether a level at an end of the heights, a floor or a ceiling, is thin and among the fullest."""
    levels = list(levels_along(along))
    return any(
        share >= LEAST_AT_END * levels[0][1]
        and min(beyond(along, height), beyond(-along, -height)) <= MOST_BEYOND
        and thinness(along, height) >= LEAST_THIN
        for height, share in levels
    )


def stand_on_floor(points: Points, up: Direction) -> bool:
    """Whether nearly all points of a scan, things and background, lie on or above a level across `up`.

    A wall before a camera that looks along z is a level, too, with everything below it.
    """
    along = about_middle(points[:: max(1, -(-len(points) // MOST_POINTS))]) @ up
    return any(beyond(along, height) <= MOST_BEYOND for height, _ in levels_along(along))


def beyond(along: Float[np.ndarray, " n"], height: float) -> float:
    """Share of the points well below a level."""
    return float(np.mean(along < height - BEYOND_M))


def least_turn(up: Direction) -> Float[np.ndarray, "3 3"]:
    """The rotation by the least angle that takes a unit direction, not straight down, to z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    if sine == 0.0:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()


def about_middle(points: Points) -> Points:
    """The points within `REACH_M` of their median along every axis, about it."""
    if not len(points):
        return points
    points = points - np.median(points, axis=0)
    return points[np.abs(points).max(axis=1) <= REACH_M]


def sharpest(points: Points) -> Direction:
    """Of the directions near z, the one along which heights gather most: the largest sum of squared counts."""
    slope, reach_deg = np.zeros(2), MAX_TILT_DEG
    for step_deg in GRIDS_DEG:
        tried = slopes_about(slope, reach_deg, step_deg)
        heights = points[:, 2] + tried @ points[:, :2].T
        scores = [np.sum(np.convolve(counted(h), [1, 2, 1]) ** 2) for h in heights]
        slope, reach_deg = tried[int(np.argmax(scores))], step_deg
    up = np.array([*slope, 1.0])
    return up / np.linalg.norm(up)


def slopes_about(
    slope: Float[np.ndarray, "2"], reach_deg: float, step_deg: float
) -> Float[np.ndarray, "k 2"]:
    """Slopes (x and y to a z of 1) on a square grid within `reach_deg` of one."""
    steps = np.tan(np.deg2rad(np.arange(-reach_deg, reach_deg + step_deg / 2, step_deg)))
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return slope + grid[np.hypot(*grid.T) <= np.tan(np.deg2rad(reach_deg + step_deg / 2))]


def counted(height: Float[np.ndarray, " n"]) -> Int[np.ndarray, " b"]:
    """The histogram of heights, from the lowest up."""
    return np.bincount(((height - height.min()) / BIN_M).astype(int))


def levels_along(height: Float[np.ndarray, " n"]) -> Iterator[tuple[float, float]]:
    """The levels, fullest first: height, and the share of points within `BAND_M`, less the fuller neighbor's.

    Walls fill neighboring bands evenly, so that nothing of them is left.
    """
    ordered = np.sort(height)
    middles = ordered[0] + BIN_M * (np.arange(len(counted(height))) + 0.5)
    edges = [np.searchsorted(ordered, middles + k * BAND_M) for k in (-3, -1, 1, 3)]
    below, near, above = np.diff(edges, axis=0)
    share = (near - np.maximum(below, above)) / len(height)
    for k in np.argsort(-share, kind="stable"):
        if share[k] < LEAST_ON_LEVEL:
            return
        if share[k] == share[max(0, k - 4) : k + 5].max():
            yield float(middles[k]), float(share[k])


def thinness(along: Float[np.ndarray, " n"], height: float) -> float:
    """Of the points about a level, the share that lies on it: near 1 of a floor, a quarter of what fills the space.

    Less those of walls, which are as dense beyond the level as about it.
    """
    off = np.abs(along - np.median(along[np.abs(along - height) <= BAND_M]))
    on, about, beyond = ((off <= reach).sum() for reach in (SCALE_M, 2 * BAND_M, 4 * BAND_M))
    wall = (beyond - about) / (2 * BAND_M)  # a meter of height, both sides
    return float((on - wall * SCALE_M) / max(about - wall * 2 * BAND_M, LEAST_ON_LEVEL * len(along)))


def common_normal(points: Points, up: Direction, heights: list[float]) -> Direction | None:
    """The upward normal that fits the levels at these heights along `up` best; None where they are too narrow."""
    along = points @ up
    scatter, total = np.zeros((3, 3)), 0.0
    for height in heights:
        on = np.abs(along - height) <= 2 * BAND_M
        middle = np.median(along[np.abs(along - height) <= BAND_M])
        off = along[on] - middle
        weight = (SCALE_M**2 / (SCALE_M**2 + off**2)) ** 2
        centered = points[on] - weight @ points[on] / weight.sum()
        scatter += centered.T @ (weight[:, None] * centered)
        total += float(weight.sum())
    spread, axes = np.linalg.eigh(scatter / total)
    if spread[1] < LEAST_WIDTH_M**2:
        return None
    return axes[:, 0] * np.copysign(1.0, axes[2, 0])
