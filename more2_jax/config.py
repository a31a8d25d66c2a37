"""Settings: one small frozen dataclass a stage, two presets, strict YAML."""

from __future__ import annotations

import dataclasses
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

C = TypeVar("C")


@dataclass(frozen=True)
class EncoderConfig:
    """Encoder Φ (METHOD 1); the defaults are the published widths."""

    widths: tuple[int, ...] = (32, 32, 64, 64, 128, 256, 512)
    code: int = 256
    neighbors: int = 16
    linear_blocks: int = 2  # the first blocks have no attention
    head_channels: int = 16
    downsample_blocks: tuple[int, ...] = (2, 4, 5)  # 0-based: thinned on entering these
    downsample_factors: tuple[int, ...] = (2, 4, 4)
    leak: float = 0.2
    output_scale: float = 64000.0  # F_s and F_c are in units of this; chosen so that F_s ≈ 1 at step 0
    points: int = 1024  # input size after farthest-point sampling


@dataclass(frozen=True)
class DecoderConfig:
    """Decoder Ψ (METHOD 1), a DeepSDF network."""

    hidden: int = 768
    layers: int = 8  # hidden layers
    skip_layer: int = 4  # 0-based: the input is concatenated before this one
    dropout: float = 0.2  # while training
    narrow_skip: bool = True  # as published: the layer before gives way, so that the skip layer sees `hidden`
    local_blocks: tuple[
        int, ...
    ] = ()  # 0-based encoder blocks whose points and features the decoder looks up
    local_channels: int = 16  # of every level and bandwidth
    bandwidths: tuple[float, ...] = (0.05, 0.15)  # at the start of training, canonical units


@dataclass(frozen=True)
class PriorConfig:
    """The encoder-decoder. The gains bring unit-norm features to unit size per channel for the decoder."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    eqv_gain: float = 1.0
    inv_gain: float = 1.0


@dataclass(frozen=True)
class MatchingConfig:
    """Instance matching (METHOD 3)."""

    score: Literal["inv", "eqv", "both"] = "both"  # Λ, 1/E, Λ ⊘ E
    assignment: Literal["hungarian", "greedy"] = "hungarian"
    size_weight: float = 0.0  # how much of a mismatch in metric size is held against a pair
    max_size_ratio: float = 0.0  # 0: any
    motion_weight: float = 0.0  # a meter moved costs this much score: decides among identical objects
    # Beyond the paper: surfaces decide, pairs less likely one object than two are none, the score is in log odds.
    verify: bool = False
    candidates: int = 8  # partners of every object, and of every instance, that are tried


@dataclass(frozen=True)
class RegistrationConfig:
    """Registration of a matched pair (METHOD 4); the defaults are the paper's."""

    points: int = 1024  # of the farthest-point samples
    sdf_points: int = 1024  # of them, how many are asked of the field
    dense: bool = False  # ICP and residual compare a sample with all of the other cloud
    starts: Literal["embedding", "many"] = "embedding"
    identity_start: bool = False  # also try "it did not move", for scans in one frame
    yaw_starts: int = 0  # turns about the vertical, when upright
    coarse_points: int = 128
    coarse_steps: int = 12  # trimmed ICP on every start
    keep_starts: int = 1  # how many of the starts are refined
    steps: int = 200  # Adam on SE(3)
    learning_rate: float = 1e-3  # radians, and shares of the target's radius
    sdf_weight: float = 1.0
    chamfer_weight: float = 1.0
    icp_steps: int = 30
    trim: float = 1.0  # share of nearest distances that counts
    converged_rms: float = 0.05  # share of the target's radius
    refine: Literal["descent", "surface"] = "descent"  # Adam on the loss and ICP, or point-to-plane both ways
    coarse_dense: int = 1024  # of a cloud, what the `coarse_points` of another are compared with, by a table
    cells: int = 24  # a side, of the table of nearest points
    surface_points: int = 256  # of each cloud, compared with all of the other
    surface_steps: int = 15
    search_reach: float = 0.3  # of a correspondence, shares of the target's radius: of every start at first,
    first_reach: float = 0.1  # of the starts that are kept,
    last_reach: float = 0.03  # and in the end
    lift_weight: float = 0.0  # of a pose that changes an upright object's height, where scans share a frame
    polish_points: int = 512  # then, for the best pose alone
    polish_steps: int = 10
    polish_reach: float = 0.02
    field_weight: float = 0.0  # of both clouds' distance from the other's field, in the choice among poses
    free_weight: float = (
        0.0  # of both clouds' share in space that the other's sensors looked through, if known
    )
    truncation: float = 0.1  # a point farther than this from the other cloud counts as this far


@dataclass(frozen=True)
class JointConfig:
    """Joint optimization of code and poses (paper §3.5); the defaults are the paper's."""

    steps: int = 200  # of Adam. 0: codes and poses stay
    points: int = 1024  # farthest points of every observation
    start: Literal["best", "accumulated"] = (
        "best"  # F_0: the code of the observation with the lowest loss, or that of all together
    )
    eqv_learning_rate: float = 1e-4
    pose_learning_rate: float = 5e-5
    inv_learning_rate: float = 1e-5
    center_learning_rate: float = 1e-5


@dataclass(frozen=True)
class MeshingConfig:
    """Mesh extraction: multi-resolution iso-surface extraction (paper §3.4), drawn to observed points (not in it).

    Lengths are in canonical units. The values of `robust` and what they were chosen by: docs/design_notes.md.
    """

    coarse_resolution: int = 32  # cells a side of the first grid
    resolution: int = 64  # of the last: `coarse_resolution`, doubled some times
    field_resolution: int = (
        0  # the finest grid that the network is asked on; finer ones interpolate. 0: all ask
    )
    level: Literal["zero", "observed"] = (
        "zero"  # the surface's level: 0, or the field's median at the observed points
    )
    mls_bandwidth: float = 0.0  # of implicit moving least squares at observed points. 0: the field alone
    # ℓ of the screened Poisson equation, on grids finer than `field_resolution`: so near to observed points their
    # normals say what is inside, farther off the field does. 0: no such equation.
    screening_length: float = 0.0
    screening_length_multi_scan: float = 0.0  # of points without noise that several scans saw. 0: the same
    # Points with a larger local outlier factor are left out. 0: all points stay.
    outlier_factor: float = 0.0
    outlier_factor_multi_scan: float = 0.0  # where several scans saw the object, and confirm one another
    clip_to_floor: bool = False  # of upright scans with a visible floor: nothing reaches below it


@dataclass(frozen=True)
class PoseGraphConfig:
    """Pose-graph optimization of all observations of an object, before its mesh is made; not in the paper."""

    steps: int = 0  # of Gauss-Newton. 0: poses stay as registered


@dataclass(frozen=True)
class SceneConfig:
    """The whole method; `preset('paper')` is METHOD to the letter, `preset('robust')` the default."""

    preset: str = "paper"
    upright: bool = False
    min_points: int = 64  # objects seen with fewer are skipped, and reported
    static_deg: float = 1.0  # below both: static
    static_m: float = 0.05
    accumulate_target: bool = (
        False  # match and register against all seen so far, not the reference observation
    )
    accumulate_misfit: float = 1.0  # an observation whose registration fits worse is left out of the shape
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    pose_graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    meshing: MeshingConfig = field(default_factory=MeshingConfig)


@dataclass(frozen=True)
class TrainingConfig:
    """Training of the prior (METHOD 2); lengths in canonical units (longest edge 0.9)."""

    steps: int = 200_000
    batch: int = 64  # shapes; two partial clouds each
    learning_rate: float = 1e-4
    warmup_steps: int = 200
    # or ×0.3 at 60, 75 and 90 % of the steps, as published; or constant, and falling in the last fifth
    schedule: Literal["cosine", "steps", "trapezoid"] = "cosine"
    clip: float = 1.0
    ema: float = 0.999
    queries: int = 1024  # a cloud: half uniform, half near the surface
    raw_points: int = 2048  # before farthest-point sampling
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
    center_jitter: float = 0.0  # standard deviation of a shift of cloud, queries and center; published 0.05
    stretch: float = 0.0  # axes are scaled by up to this share, at random
    near_surface: float = 0.1  # |SDF| below it weighs 1, else 0.5
    center_weight: float = 0.2
    scale_weight: float = 0.01
    contrast_weight: float = 0.05  # InfoNCE on F_inv between two partial clouds of one shape
    contrast_temperature: float = 0.07
    turn_weight: float = 0.5  # ‖F_eqv − F_eqv'‖² between them: same orientation in, same vectors out
    rotation_weight: float = 0.0  # how far Kabsch's algorithm is from the identity between them
    sign_weight: float = 0.0  # cross-entropy of inside and outside
    sign_width: float = 0.01  # canonical units: where its sigmoid has half of its height
    up_weight: float = 0.0  # the first third of F_eqv should point up
    validate_every: int = 250
    picture_every: int = 1000  # steps; drawn at the next validation
    seed: int = 0


@dataclass(frozen=True)
class TrainingRun:
    """One configuration file of train/prior.py."""

    model: PriorConfig = field(default_factory=PriorConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)


ROBUST_MESHING = MeshingConfig(
    coarse_resolution=16,
    resolution=128,
    field_resolution=32,
    level="observed",
    mls_bandwidth=0.02,
    screening_length=0.12,
    screening_length_multi_scan=0.3,
    outlier_factor=1.5,
    outlier_factor_multi_scan=1.25,
    clip_to_floor=True,
)


def preset(name: str, *, upright: bool = False) -> SceneConfig:
    """Returns the settings called `paper` or `robust`."""
    if name == "paper":
        return SceneConfig(upright=upright)
    if name == "robust":
        return SceneConfig(
            preset="robust",
            upright=upright,
            accumulate_target=True,
            accumulate_misfit=0.5,
            matching=MatchingConfig(score="inv", size_weight=0.5, motion_weight=0.2, verify=True),
            registration=RegistrationConfig(
                points=256,
                sdf_points=1024,
                dense=True,
                starts="many",
                identity_start=True,
                yaw_starts=24 if upright else 0,
                keep_starts=6,
                trim=0.7,
                refine="surface",
                lift_weight=0.1,
                truncation=0.2,
                field_weight=2.0,
                free_weight=1.0 if upright else 0.0,
            ),
            meshing=ROBUST_MESHING,
            pose_graph=PoseGraphConfig(steps=16),
            # No step: after alignment by surfaces it buys neither poses nor meshes (docs/design_notes.md).
            joint=JointConfig(points=128, start="accumulated", steps=0, eqv_learning_rate=1e-3),
        )
    raise ValueError(f"preset {name!r}; needed 'paper' or 'robust'")


# Keys of older weight files and settings.
RENAMED = {
    "neighbours": "neighbors",
    "normal_neighbours": "normal_neighbors",
    "core_neighbours": "core_neighbors",
    "closing": "pose_graph",
    "coarse": "coarse_resolution",
    "seen_reach": "mls_bandwidth",
    "screening": "screening_length",
    "screening_of_many": "screening_length_multi_scan",
    "outlier_factor_of_many": "outlier_factor_multi_scan",
    "floor": "clip_to_floor",
}

# Settings of older files that are constants now, by class, with the only value they may have.
NOW_CONSTANT: dict[str, dict[str, Any]] = {
    "MeshingConfig": {"half_width": 0.65},
    "PoseGraphConfig": {"points": 1024, "first_reach": 0.05, "last_reach": 0.001, "most_turn_deg": 3.0},
}


def from_dict(cls: type[C], values: dict[str, Any], where: str = "") -> C:
    """Builds dataclass `cls` from plain values; raises ValueError on keys it does not have or wrong types."""
    if not isinstance(values, dict):
        raise ValueError(f"{where or 'settings'}: got {values!r}, needed a mapping")
    values = {RENAMED.get(key, key): value for key, value in values.items()}
    for key, only in NOW_CONSTANT.get(cls.__name__, {}).items():
        if values.pop(key, only) != only:
            raise ValueError(f"{where or 'settings'}: {key} is no setting any more; needed {only}, or none")
    hints = typing.get_type_hints(cls)
    names = {f.name for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    if unknown := sorted(set(values) - names):
        raise ValueError(
            f"{where or 'settings'}: unknown {', '.join(unknown)}; known are {', '.join(sorted(names))}"
        )
    built = {key: _convert(hints[key], value, f"{where}.{key}".lstrip(".")) for key, value in values.items()}
    return cls(**built)


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(hint, value, where)  # type: ignore[arg-type]
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            raise ValueError(
                f"{where}: got {value!r}, needed one of {', '.join(map(repr, typing.get_args(hint)))}"
            )
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{where}: got {value!r}, needed a list")
        inner = typing.get_args(hint)[0]
        return tuple(_convert(inner, v, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is types.UnionType:
        return value if value is None else _convert(typing.get_args(hint)[0], value, where)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ValueError(f"{where}: got {value!r}, needed {hint.__name__}")
    return value


def load_config(path: str | Path, cls: type[C]) -> C:
    """Reads YAML into dataclass `cls`, strictly; missing keys keep their defaults."""
    text = Path(path).read_text()
    return from_dict(cls, yaml.safe_load(text) or {}, where=Path(path).name)


def to_yaml(config: Any) -> str:
    """The settings as YAML that `load_config` reads back."""
    return yaml.safe_dump(_plain(dataclasses.asdict(config)), sort_keys=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value
