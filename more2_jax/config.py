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
    """Encoder Φ (paper §3.1); the defaults are the published widths."""

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
    """Decoder Ψ (paper §3.1), a DeepSDF network."""

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
    normals: bool = False  # the anchors' normals, where they are known, are looked up too


@dataclass(frozen=True)
class PriorConfig:
    """The encoder-decoder. The gains bring unit-norm features to unit size per channel for the decoder."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    eqv_gain: float = 1.0
    inv_gain: float = 1.0
    bare_decoder: bool = False  # a second decoder for objects of which no normal is known


@dataclass(frozen=True)
class SurfaceSearch:
    """How a pair's poses are searched: every start aligned by coarse surfaces, the few that fit best kept.

    Lengths are shares of the target cloud's radius unless a name says otherwise. What each is worth:
    docs/developing/notebook/registration_parts.md.
    """

    turns: int = (
        24  # starts about the vertical, upright; in any orientation the 60 rotations of an icosahedron
    )
    points: int = 128  # of either cloud, compared with
    dense: int = 1024  # so many of the other, found by a table
    cells: int = 24  # a side of that table
    steps: int = 12  # of alignment, of every start
    first_reach: float = 0.3  # correspondences this far apart count a quarter, in the first step
    last_reach: float = 0.1  # and in the last
    keep: int = 6  # poses, each turned otherwise
    truncation: float = 0.2  # a point farther from the other cloud counts as this far
    lift_weight: float = 0.1  # upright: cost of a pose that changes the object's height
    free_weight: float = 1.0  # upright: cost of lying where the other scan's sensors looked through, if known
    field_weight: float = 2.0  # cost of lying off the surface that the prior completes the other cloud to


@dataclass(frozen=True)
class CodeMatcher:
    """Matching by the embeddings alone (paper §3.2)."""

    method: Literal["codes"] = "codes"  # names these settings
    score: Literal["inv", "eqv", "both"] = "both"  # Λ, 1/E, Λ ⊘ E
    assignment: Literal["hungarian", "greedy"] = (
        "hungarian"  # the best total, or (published code) best pair first
    )


@dataclass(frozen=True)
class EvidenceMatcher:
    """Matching by surfaces: the embeddings propose pairs, how well a pair's surfaces fit decides (beyond the paper)."""

    method: Literal["evidence"] = "evidence"  # names these settings
    candidates: int = 8  # partners of every object, and of every instance, that are aligned; 0: all
    size_weight: float = (
        0.5  # of |log| of the ratio of the F_s, against the cosine of the F_inv, in what is proposed
    )
    motion_weight: float = 0.2  # log odds that a meter moved costs: decides among identical objects
    # Its evidence is calibrated on poses found without free space, which has its say when they are refined.
    search: SurfaceSearch = SurfaceSearch(free_weight=0.0)


@dataclass(frozen=True)
class DescentRegistration:
    """Registration by descent on the signed distance field, then ICP (paper §3.3)."""

    method: Literal["descent"] = "descent"  # names these settings
    points: int = 1024  # of the farthest-point samples
    sdf_points: int = 1024  # of them, how many are asked of the field
    steps: int = 200  # Adam on SE(3)
    learning_rate: float = 1e-3  # radians, and shares of the target's radius
    sdf_weight: float = 1.0  # of |Ψ| at the moved source's points, in the loss
    chamfer_weight: float = 1.0  # of the Chamfer distance
    chamfer: Literal["squared", "plain"] = (
        "squared"  # of nearest distances, the mean of the squares (paper, supplement), or their own
    )
    icp_steps: int = 30  # after the descent
    trim: float = 1.0  # share of nearest distances that counts
    converged_rms: float = 0.05  # share of the target's radius


@dataclass(frozen=True)
class SurfaceRegistration:
    """Registration by point-to-plane alignment of both surfaces (beyond the paper); lengths in shares of the radius.

    Refines the poses that matching found, or those of `search` where it is given none.
    """

    method: Literal["surface"] = "surface"  # names these settings
    search: SurfaceSearch = field(default_factory=SurfaceSearch)
    try_stayed: bool = True  # also "it did not move", which is chosen if it fits nearly as well as the best
    points: int = 256  # of each cloud, compared with all of the other
    steps: int = 15  # of alignment, of every pose
    first_reach: float = 0.1  # of a correspondence, in the first step
    last_reach: float = 0.03  # and in the last
    choose_among: int = (
        3  # refined poses, each turned otherwise, that the prior tells apart; and "it did not move"
    )
    field_points: int = 1024  # of each cloud, asked of the other's completed surface
    polish_points: int = 512  # then, for the best pose alone
    polish_steps: int = 10  # of alignment, of the best pose
    polish_reach: float = 0.02  # of a correspondence, in its last step
    trim: float = 0.7  # share of nearest distances that counts in the residual
    converged_rms: float = 0.05  # residual below which a pose that has settled is called converged


@dataclass(frozen=True)
class FieldRegistration:
    """Registration on the completed surfaces alone (beyond the paper, without ICP); lengths in shares of the radius."""

    method: Literal["field"] = "field"  # names these settings
    turns: int = (
        24  # of the codes' rotation, about the vertical, upright; in any orientation all 60 of an icosahedron
    )
    search_points: int = 64  # of each cloud, asked of the other's field while all starts are aligned
    search_steps: int = 6  # of Gauss-Newton, of every start
    first_reach: float = 0.3  # a point so far off the surface counts a quarter, in the first step
    search_reach: float = 0.1  # in the last of the search, and the first that refines
    keep: int = 4  # poses, each turned otherwise, that are refined
    points: int = 512  # of each cloud, then
    steps: int = 10  # of Gauss-Newton, of the poses that are refined
    last_reach: float = 0.02  # in the last of these
    trim: float = 0.7  # share of nearest distances that counts in the residual
    converged_rms: float = 0.05  # residual below which a pose that has settled is called converged


Matcher = CodeMatcher | EvidenceMatcher
RegistrationMethod = DescentRegistration | SurfaceRegistration | FieldRegistration
# How objects move between scans: any rigid motion, or shifts and turns about the vertical (z) only.
MotionModel = Literal["free", "upright"]
PresetName = Literal["robust", "field", "paper"]


@dataclass(frozen=True)
class JointConfig:
    """Joint optimization of code and poses (paper §3.5); the defaults are the paper's."""

    steps: int = 200  # of Adam. 0: codes and poses stay
    points: int = 1024  # farthest points of every observation
    start: Literal["best", "accumulated"] = (
        "best"  # F_0: the code of the observation with the lowest loss, or that of all together
    )
    eqv_learning_rate: float = 1e-4  # of Adam, for F_eqv,
    pose_learning_rate: float = 5e-5  # the poses (radians, and shares of the radius),
    inv_learning_rate: float = 1e-5  # F_inv,
    center_learning_rate: float = 1e-5  # and F_c


@dataclass(frozen=True)
class MeshingConfig:
    """Mesh extraction: multi-resolution iso-surface extraction (paper §3.4), drawn to observed points (not in it).

    Lengths are in canonical units. The values of `robust` and what they were chosen by:
    docs/developing/notebook/mesh_surface.md.
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
    """The whole method; `preset('paper')` follows the paper, `preset('robust')` is the default."""

    preset: str = "paper"  # whose settings these are, or began as
    # Objects turn about the vertical (z) only; None: where the first scan shows a level floor.
    upright: bool | None = None
    min_points: int = 64  # objects seen with fewer are skipped, and reported
    static_deg: float = 1.0  # an object that turned by less,
    static_m: float = 0.05  # and moved by less, is static
    # Match and register against all seen so far, not the reference observation.
    accumulate_target: bool = False
    # What pairs that are registered together, and objects that are meshed side by side, may take of the memory beside
    # the scene; results do not depend on it.
    memory_mb: int = 1024
    # Join what masks split, divide what they merge, leave out floor and neighbors, take in what they cut off.
    repair_masks: bool = False
    accumulate_misfit: float = 1.0  # an observation whose registration fits worse is left out of the shape
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
    screening_length=0.12,
    screening_length_multi_scan=0.3,
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
