"""Settings of how scans without masks are cut."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SegmentationConfig:
    """Settings of `segment_geometric`; lengths in meters."""

    voxel_m: float = 0.03
    normal_neighbors: int = 20
    plane_distance_m: float = 0.05  # a voxel this near belongs to the plane
    plane_angle_deg: float = 30.0  # and if its normal turns less than this from the plane's
    plane_tries: int = 400
    planes: int = 12  # looked at, whether removed or not
    structure_area_m2: float = 0.6  # smaller planes are parts of objects
    behind_share: float = 0.04  # of the scene may lie beyond a floor or wall
    structure_share: float = 0.35  # of the scene's extent that a floor or wall spans at least
    room_m: float = 1.8  # floor and ceiling, or two facing walls, are this far apart: a table top is neither
    link_m: float = 0.06  # voxels this near touch where points are dense
    dense_points: float = 3.0  # a voxel, on average among neighbors
    link_spacing: float = 1.0  # where points are sparse: times the distance of the last core neighbor
    largest_link_m: float = 0.2
    beside_m: float = 0.12  # what lies this close to a floor or wall joins no two parts,
    beside_deg: float = 45.0  # and whose normal turns less than this from the plane's,
    beside_reach_m: float = 0.2  # and belongs to a part that it touches along this way
    core_neighbors: int = 9  # fewer within reach: a voxel joins no two parts
    join_area_m2: float = 0.1  # a smaller cluster is a piece of a neighbor
    join_m: float = 0.15  # if one is this near
    flat_m: float = 0.15  # a cluster that lies this close to a floor or wall is a part of it
    flat_share: float = 0.9  # with this share of its voxels
    strip_m: float = 1.0  # so is a longer one that lies this close to any of several
    top_area_m2: float = 0.08  # of a level that something may stand on: a table top, the floor
    top_m: float = 0.03  # how far from its height its voxels lie
    foot_m: float = 0.1  # a thing stands by what of it lies this close above the level,
    foot_share: float = 0.6  # whose outline has at most this share of the level's area,
    inside_share: float = 0.6  # and lies within that, all but the rest,
    around_m: float = 0.15  # and has the level around it, this near,
    around: int = 5  # in so many of twelve directions
    lowest_m: float = 0.08  # what rises less above the floor is a part of it
    smallest_area_m2: float = 0.03  # of its voxels
    smallest_extent_m: float = 0.2
    seed: int = 0
