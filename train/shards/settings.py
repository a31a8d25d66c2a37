"""Settings of training samples and of the losses on them; lengths in canonical units (longest edge 0.9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

NORMAL_STEPS = 127  # of a normal's coordinate in shards, one byte; a normal of zeros is not known


@dataclass(frozen=True)
class SampleConfig:
    """What is drawn of a shape: two partial clouds with the flaws of real scans, and queries of known distance."""

    queries: int = 1024  # Queries a cloud, half of them uniform, half near the surface.
    raw_points: int = 2048  # Points a cloud before farthest-point sampling.
    min_views: int = 1  # Fewest depth views that a cloud is merged from.
    max_views: int = 8  # Most of them.
    noise: float = 0.005  # Standard deviation of the points' noise.
    # If it is above `noise`, clouds open to flaws draw theirs between the two, evenly in the logarithm.
    most_noise: float = 0.0
    augment_probability: float = 0.6  # Probability of a cloud to be open to the flaws below (as published).
    # Seen from one side alone. This and what follows are shares of the augmented clouds.
    one_view_probability: float = 0.2
    crop_probability: float = 0.5  # A half-space is cut off, as by a truncated mask.
    ball_probability: float = 0.5  # A ball is removed, as by occlusion.
    junk_probability: float = 0.5  # A fragment of another object, or a patch of floor or wall, is added.
    depth_noise_probability: float = 0.4  # The camera's noise: along the ray, quantized, with lost edges.
    depth_noise: float = 0.002  # Standard deviation of inverse depth, 1 / canonical unit.
    depth_step: float = 0.002  # Step of the quantized inverse depth.
    drift_probability: float = 0.0  # Each view is shifted and turned, as a hand-held camera's pose drifts.
    drift: float = 0.015  # Standard deviation of a view's shift, each of three ways; a cloud's own varies.
    drift_deg: float = 1.0  # The same of its turn.
    # Surfaces swell, shrink and wave, and edges are rounded, as in fusion on a grid of voxels.
    fused_probability: float = 0.0
    fused: float = 0.01  # Standard deviation of the waves along the normal; a cloud's own varies.
    voxel: float = 0.03  # Side of the cells in which points and normals are averaged; a cloud's own varies.
    # Standard deviation of a normal's tilt, each of two ways; a cloud's own varies.
    normal_noise_deg: float = 10.0
    # Probability of a cloud to have no normals, be it augmented or not.
    normals_unknown_probability: float = 0.35
    # Up to half of the points have no normal. This and what follows are of augmented clouds.
    normals_lost_probability: float = 0.5
    flip_probability: float = 0.2  # Normals point inward in a ball.
    flipped: float = 0.02  # Share of the points whose normals point inward, anywhere.


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of the training loss, and what they are measured by."""

    # With `decoder` the encoder, hence all codes, stay; nor is there any term of them.
    train: Literal["all", "decoder"] = "all"
    near_surface: float = 0.1  # Where |SDF| is lower a query weighs 1, else 0.5.
    center_weight: float = 0.2  # Weight of ‖F_c‖.
    scale_weight: float = 0.01  # Weight of the error of F_s.
    # |log F_s|; or |1 − F_s|, as published, with little pull left where F_s vanishes.
    scale_error: Literal["log", "absolute"] = "log"
    contrast_weight: float = 0.05  # Weight of InfoNCE on F_inv between two partial clouds of one shape.
    contrast_temperature: float = 0.07  # Temperature of InfoNCE.
    # Weight of ‖F_eqv − F_eqv'‖² between them: same orientation in, same vectors out.
    turn_weight: float = 0.5
    rotation_weight: float = 0.0  # Weight of how far Kabsch's algorithm is from the identity between them.
    sign_weight: float = 0.0  # Weight of the cross-entropy of inside and outside.
    sign_width: float = 0.01  # Its sigmoid has half of its height there, canonical units.
    up_weight: float = 0.0  # Weight of a term by which the first third of F_eqv points up.
