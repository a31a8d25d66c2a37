"""Settings of training samples and of the losses on them; lengths in canonical units (longest edge 0.9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

NORMAL_STEPS = 127  # of a normal's coordinate in shards, one byte; a normal of zeros is not known


@dataclass(frozen=True)
class SampleConfig:
    """What is drawn of a shape: two partial clouds with the flaws of real scans, and queries of known distance."""

    queries: int = 1024  # a cloud: half uniform, half near the surface
    raw_points: int = 2048  # before farthest-point sampling
    min_views: int = 1
    max_views: int = 8
    noise: float = 0.005
    augment_probability: float = 0.6  # of a cloud to be open to the flaws below (as published)
    one_view_probability: float = 0.2  # seen from one side; what follows are shares of the augmented clouds
    crop_probability: float = 0.5  # a half-space cut off, as by a truncated mask
    ball_probability: float = 0.5  # a ball removed, as by occlusion
    junk_probability: float = 0.5  # a fragment of another object, or a patch of floor or wall, added
    depth_noise_probability: float = 0.4  # the camera's: along the ray, quantized, with lost edges
    depth_noise: float = 0.002  # standard deviation of inverse depth, 1 / canonical unit
    depth_step: float = 0.002  # of inverse depth
    normal_noise_deg: float = (
        10.0  # standard deviation of a normal's tilt, each of two ways; a cloud's own varies
    )
    normals_unknown_probability: float = 0.35  # of a cloud to have no normals, be it augmented or not
    normals_lost_probability: float = (
        0.5  # up to half of the points have none; of augmented clouds, as is what follows
    )
    flip_probability: float = 0.2  # a ball in which normals point inward
    flipped: float = 0.02  # share of the points whose normals point inward, anywhere


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of the training loss, and what they are measured by."""

    train: Literal["all", "decoder"] = (
        "all"  # decoder: the encoder, hence all codes, stay; nor is any term of them
    )
    near_surface: float = 0.1  # |SDF| below it weighs 1, else 0.5
    center_weight: float = 0.2
    scale_weight: float = 0.01
    scale_error: Literal["log", "absolute"] = (
        "log"  # |log F_s|; or |1 − F_s|, as published, with little pull left where F_s vanishes
    )
    contrast_weight: float = 0.05  # InfoNCE on F_inv between two partial clouds of one shape
    contrast_temperature: float = 0.07
    turn_weight: float = 0.5  # ‖F_eqv − F_eqv'‖² between them: same orientation in, same vectors out
    rotation_weight: float = 0.0  # how far Kabsch's algorithm is from the identity between them
    sign_weight: float = 0.0  # cross-entropy of inside and outside
    sign_width: float = 0.01  # canonical units: where its sigmoid has half of its height
    up_weight: float = 0.0  # the first third of F_eqv should point up
