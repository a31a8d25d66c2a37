"""Settings: one small frozen dataclass for each stage, three presets, strict YAML."""

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
    """Encoder Φ (paper §3.1); the defaults are the published widths."""

    widths: tuple[int, ...] = (32, 32, 64, 64, 128, 256, 512)  # Channels of every block.
    code: int = 256  # Channels of F_inv, and vectors of F_eqv.
    neighbors: int = 16  # Nearest neighbors of a point, in feature space.
    linear_blocks: int = 2  # The first blocks have no attention.
    head_channels: int = 16  # Channels of one head of attention.
    # The points are thinned before these blocks, counted from 0.
    downsample_blocks: tuple[int, ...] = (2, 4, 5)
    downsample_factors: tuple[int, ...] = (2, 4, 4)  # One point in this many stays, at each of them.
    leak: float = 0.2  # Slope of the leaky ReLU.
    # F_s and F_c are in units of this, chosen so that F_s is about 1 at step 0.
    output_scale: float = 64000.0
    points: int = 1024  # Input size after farthest-point sampling.


@dataclass(frozen=True)
class DecoderConfig:
    """Decoder Ψ (paper §3.1), a DeepSDF network."""

    hidden: int = 768  # Width of the hidden layers.
    layers: int = 8  # Number of hidden layers.
    skip_layer: int = 4  # The input is concatenated before this layer, counted from 0.
    dropout: float = 0.2  # Share of a layer's outputs that are dropped while training.
    # As published: the layer before the skip is narrower, so that the skip layer has `hidden` inputs.
    narrow_skip: bool = True
    # The decoder looks up points and features of these encoder blocks, counted from 0.
    local_blocks: tuple[int, ...] = ()
    local_channels: int = 16  # Channels of every level and bandwidth that is looked up.
    # Widths of the look-up when training starts, canonical units.
    bandwidths: tuple[float, ...] = (0.05, 0.15)
    normals: bool = False  # The anchors' normals are looked up too, where they are known.
    # Observed points that are looked up beside the anchors, with their normals and without features.
    surface_points: int = 0
    # Widths of that look-up when training starts, canonical units.
    surface_bandwidths: tuple[float, ...] = (0.02, 0.04, 0.08, 0.16)


@dataclass(frozen=True)
class PriorConfig:
    """The encoder-decoder. The gains bring unit-norm features to unit size per channel for the decoder."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    eqv_gain: float = 1.0  # F_eqv is multiplied by this for the decoder.
    inv_gain: float = 1.0  # F_inv is multiplied by this for the decoder.
    bare_decoder: bool = False  # Whether a second decoder serves objects without normals.
    draws: int = 1  # A code is the mean over so many draws of the cloud, other than in training.


@dataclass(frozen=True)
class SurfaceSearch:
    """The search for a pair's poses: every start is aligned on coarse surfaces, and the few that fit best are kept.

    Lengths are shares of the target cloud's radius unless a name says otherwise. What each is worth:
    docs/developing/notebook/registration_parts.md.
    """

    # Starts about the vertical, if upright. In any orientation the 60 rotations of an icosahedron are tried.
    turns: int = 24
    points: int = 128  # Points of each cloud that are compared with the other.
    dense: int = 1024  # Points of the other cloud, found through a table.
    cells: int = 24  # Cells of the table along each side.
    steps: int = 12  # Steps that align every start.
    first_reach: float = 0.3  # Distance at which a correspondence counts a quarter in the first step.
    last_reach: float = 0.1  # The same in the last step.
    keep: int = 6  # Poses that are kept, of different rotations.
    truncation: float = 0.2  # A point farther from the other cloud counts as being this far away.
    lift_weight: float = 0.1  # Cost of a pose that changes the object's height, if upright.
    # Cost of lying where the other scan's sensors looked through, if upright and known.
    free_weight: float = 1.0
    field_weight: float = 2.0  # Cost of lying off the other cloud's surface as the prior completes it.


@dataclass(frozen=True)
class CodeMatcher:
    """Matching by the embeddings alone (paper §3.2)."""

    method: Literal["codes"] = "codes"  # It names these settings.
    score: Literal["inv", "eqv", "both"] = "both"  # Score of a pair: Λ, 1/E or Λ ⊘ E.
    # The best total, or (published code) the best pair first.
    assignment: Literal["hungarian", "greedy"] = "hungarian"


@dataclass(frozen=True)
class EvidenceMatcher:
    """Matching by surfaces: codes propose pairs, and the fit of their surfaces decides (beyond the paper)."""

    method: Literal["evidence"] = "evidence"  # It names these settings.
    candidates: int = 8  # Partners of every object, and of every instance, that are aligned. 0: all.
    # Weight in the proposal of |log F_s ratio|, beside the cosine of the F_inv.
    size_weight: float = 0.5
    # Log odds that each meter moved costs, a quarter of it in any orientation. It decides among identical objects.
    motion_weight: float = 0.2
    # Log odds that a pair gains that fits where it would be had nothing moved: identical objects rarely change places.
    stayed_weight: float = 6.0
    # The evidence is calibrated on poses found without free space, which counts when they are refined.
    search: SurfaceSearch = SurfaceSearch(free_weight=0.0)


@dataclass(frozen=True)
class DescentRegistration:
    """Registration by descent on the signed distance field, then ICP (paper §3.3)."""

    method: Literal["descent"] = "descent"  # It names these settings.
    points: int = 1024  # Size of the farthest-point samples.
    sdf_points: int = 1024  # Points at which the field is evaluated.
    steps: int = 200  # Steps of Adam on SE(3).
    learning_rate: float = 1e-3  # Radians, and shares of the target's radius.
    sdf_weight: float = 1.0  # Weight in the loss of |Ψ| at the moved source's points.
    chamfer_weight: float = 1.0  # Weight in the loss of the Chamfer distance.
    # The mean of the nearest distances' squares (paper, supplement), or of the distances themselves.
    chamfer: Literal["squared", "plain"] = "squared"
    icp_steps: int = 30  # Steps of ICP after the descent.
    trim: float = 1.0  # This share of the nearest distances counts.
    converged_rms: float = 0.05  # A pose with a lower residual has converged; a share of the target's radius.


@dataclass(frozen=True)
class SurfaceRegistration:
    """Registration by point-to-plane alignment of both surfaces (beyond the paper); lengths in shares of the radius.

    Refines the poses that matching found, or those of `search` if it is given none.
    """

    method: Literal["surface"] = "surface"  # It names these settings.
    search: SurfaceSearch = field(default_factory=SurfaceSearch)
    # Whether "it did not move" is tried, and chosen if it fits nearly as well as the best.
    try_stayed: bool = True
    points: int = 256  # Points of each cloud that are compared with all of the other.
    steps: int = 15  # Steps that align every pose.
    first_reach: float = 0.1  # Reach of a correspondence in the first step.
    last_reach: float = 0.03  # Reach of a correspondence in the last step.
    # Refined poses of different rotations among which the prior chooses, beside "it did not move".
    choose_among: int = 3
    field_points: int = 1024  # Points of each cloud whose distance to the other's completed surface counts.
    polish_points: int = 1024  # Points that are compared in the last alignment, of the best pose.
    polish_steps: int = 10  # Steps of that last alignment.
    polish_reach: float = 0.02  # Reach of a correspondence in its last step.
    trim: float = 0.7  # This share of the nearest distances counts in the residual.
    converged_rms: float = 0.05  # A pose that has settled has converged if its residual is lower.


@dataclass(frozen=True)
class FieldRegistration:
    """Registration on the completed surfaces alone (beyond the paper, without ICP); lengths in shares of the radius."""

    method: Literal["field"] = "field"  # It names these settings.
    # Turns of the codes' rotation about the vertical, if upright. In any orientation all 60 of an icosahedron are
    # tried.
    turns: int = 24
    # Points of each cloud at which the other's field is evaluated while all starts are aligned.
    search_points: int = 64
    search_steps: int = 6  # Gauss-Newton steps that align every start.
    first_reach: float = 0.3  # Distance to the surface at which a point counts a quarter in the first step.
    search_reach: float = 0.1  # The same in the last step of the search, and in the first that refines.
    keep: int = 4  # Poses that are refined, of different rotations.
    points: int = 512  # The same points, while those poses are refined.
    steps: int = 10  # Gauss-Newton steps that refine those poses.
    last_reach: float = 0.02  # The same distance in the last of these steps.
    trim: float = 0.7  # This share of the nearest distances counts in the residual.
    converged_rms: float = 0.05  # A pose that has settled has converged if its residual is lower.


Matcher = CodeMatcher | EvidenceMatcher
RegistrationMethod = DescentRegistration | SurfaceRegistration | FieldRegistration
# How objects move between scans: any rigid motion, or shifts and turns about the vertical (z) only.
MotionModel = Literal["free", "upright"]
PresetName = Literal["robust", "field", "paper"]


@dataclass(frozen=True)
class JointConfig:
    """Joint optimization of code and poses (paper §3.5); the defaults are the paper's."""

    steps: int = 200  # Steps of Adam. 0: codes and poses stay.
    points: int = 1024  # Points of every observation, by farthest-point sampling.
    # F_0 is the code of the observation with the lowest loss, or that of all together.
    start: Literal["best", "accumulated"] = "best"
    eqv_learning_rate: float = 1e-4  # Learning rate of F_eqv.
    pose_learning_rate: float = 5e-5  # Learning rate of the poses: radians, and shares of the radius.
    inv_learning_rate: float = 1e-5  # Learning rate of F_inv.
    center_learning_rate: float = 1e-5  # Learning rate of F_c.


@dataclass(frozen=True)
class MeshingConfig:
    """Mesh extraction: multi-resolution iso-surface extraction (paper §3.4), drawn to observed points (not in it).

    Lengths are in canonical units. The values of `robust` and what they were chosen by:
    docs/developing/notebook/mesh_surface.md.
    """

    coarse_resolution: int = 32  # Cells of the first grid along each side.
    resolution: int = 64  # Cells of the last grid: `coarse_resolution` times a power of two.
    # Cells of the finest grid on which the network is evaluated; finer grids interpolate. 0: no limit.
    field_resolution: int = 0
    # The surface is where the field is 0, or its median at the observed points.
    level: Literal["zero", "observed"] = "zero"
    # Bandwidth of implicit moving least squares at observed points. 0: the field alone decides.
    mls_bandwidth: float = 0.0
    # ℓ of the screened Poisson equation, on grids finer than `field_resolution`. Nearer to observed points their
    # normals say what is inside, farther off the field does. 0: no such equation.
    screening_length: float = 0.0
    # The same for points without noise that several scans saw. 0: as for one scan.
    screening_length_multi_scan: float = 0.0
    unseen_rise: float = 0.0  # Of things on legs: by what share of the distance to seen points a field rises.
    outlier_factor: float = 0.0  # Points with a larger local outlier factor are left out. 0: all points stay.
    outlier_factor_multi_scan: float = 0.0  # The same for an object that several scans saw.
    clip_to_floor: bool = False  # Whether meshes end at the floor, if scans are upright and show it.
    # Where meshes are made: one at a time on the host, or many at once on the device. "auto": on CPUs the host, which
    # is faster there; on accelerators the device, of which one demo has been timed there.
    engine: Literal["auto", "host", "device"] = "auto"


@dataclass(frozen=True)
class PoseGraphConfig:
    """Pose-graph optimization of all observations of an object, before its mesh is made; not in the paper."""

    steps: int = 0  # Steps of Gauss-Newton. 0: poses stay as registered.


@dataclass(frozen=True)
class SceneConfig:
    """Settings of the whole method; `preset('robust')` is the default, `preset('paper')` follows the paper."""

    preset: str = "paper"  # The preset that these settings are, or began as.
    # Objects turn about the vertical (z) only. None: they do if the first scan shows a level floor.
    upright: bool | None = None
    min_points: int = 64  # Objects seen with fewer points are skipped, and reported.
    # An object is static if it turned by less than this, degrees, and moved by less than `static_m`.
    static_deg: float = 1.0
    # An object is static if it moved by less than this, meters, and turned by less than `static_deg`.
    static_m: float = 0.05
    # Match and register against all points seen so far, not against the first observation.
    accumulate_target: bool = False
    # Memory for pairs that are registered together and objects that are meshed side by side, beside the scene.
    # Results do not depend on it.
    memory_mb: int = 1024
    # Join split masks, divide merged ones, leave out floor and neighbors, take in what was cut off.
    repair_masks: bool = False
    accumulate_misfit: float = 1.0  # What fits worse is no part of the shape, unless it shows all of it.
    matching: Matcher = field(default_factory=CodeMatcher)
    registration: RegistrationMethod = field(default_factory=DescentRegistration)
    pose_graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    meshing: MeshingConfig = field(default_factory=MeshingConfig)

    @property
    def motion(self) -> MotionModel:
        """How objects may move; in any way while `upright` is not settled."""
        return "upright" if self.upright else "free"


ROBUST_MESHING = MeshingConfig(
    coarse_resolution=16,
    resolution=128,
    field_resolution=32,
    level="observed",
    mls_bandwidth=0.02,
    screening_length=0.03,
    unseen_rise=0.5,
    outlier_factor=1.5,
    outlier_factor_multi_scan=1.25,
    clip_to_floor=True,
)


def preset(name: str, *, upright: bool | None = None) -> SceneConfig:
    """Returns the settings called `paper`, `field` (its poses by the completed fields alone) or `robust`."""
    if name == "paper":
        return SceneConfig(upright=upright)
    if name == "field":
        return SceneConfig(preset="field", upright=upright, registration=FieldRegistration())
    if name == "robust":
        return SceneConfig(
            preset="robust",
            upright=upright,
            static_deg=3.0,  # what drift alone turns things by in hand-held scans
            accumulate_target=True,
            accumulate_misfit=0.5,
            repair_masks=True,
            matching=EvidenceMatcher(),
            registration=SurfaceRegistration(),
            meshing=ROBUST_MESHING,
            pose_graph=PoseGraphConfig(steps=16),
            # No step: after alignment by surfaces it buys neither poses nor meshes
            # (docs/developing/notebook/design_decisions.md).
            joint=JointConfig(points=128, start="accumulated", steps=0, eqv_learning_rate=1e-3),
        )
    raise ValueError(f"preset {name!r}; needed 'paper', 'field' or 'robust'")


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


def from_dict(cls: type[C], values: Any, where: str = "") -> C:
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
    origin, inner_types = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType and all(map(dataclasses.is_dataclass, inner_types)):
        return from_dict(_named_method(inner_types, value, where), value, where)
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


def _named_method(methods: tuple[Any, ...], values: Any, where: str) -> Any:
    """The settings class whose `method` the values name."""
    names = {m.method: m for m in methods}
    got = values.get("method") if isinstance(values, dict) else values
    if not isinstance(got, str) or got not in names:
        raise ValueError(f"{where}.method: got {got!r}, needed one of {', '.join(map(repr, names))}")
    return names[got]


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
