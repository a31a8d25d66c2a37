"""The records that pass between stages: device records are pytrees, host records hold NumPy arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar, dataclass_transform

import flax.struct
import jax
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Integer

T = TypeVar("T")
NO_POINTS = partial(np.zeros, (0, 3))  # of a scan that has none

if TYPE_CHECKING:
    AnyArray = Array  # to a checker of types; records between compiled calls hold NumPy arrays as well
else:
    AnyArray = Array | np.ndarray

# How a quantity changes when its record is moved by T = (R, t) or rescaled by s (`geometry.transform`): "position" s·x,
# R x + t · "offset" (between positions) s·x, R x · "direction" x, R x · "columns" (directions in columns) x, R x ·
# "length" s·x, x · "pose" (between frames) and "covariance" (of shift and turn) rescaled only · "axis-aligned" s·x,
# cannot be turned · "origin" of positions · "record" as its own quantities do · "invariant" neither.
Quantity = Literal[
    "position",
    "offset",
    "direction",
    "columns",
    "length",
    "pose",
    "covariance",
    "axis-aligned",
    "origin",
    "record",
    "invariant",
]
if not TYPE_CHECKING:  # where a checker must not believe that every name exists
    from more2_jax.renamed import names_of

    __getattr__ = names_of(__name__)


def quantity(kind: Quantity, **options: Any) -> Any:
    """A field of a record that says how it changes when the record is moved or rescaled."""
    return flax.struct.field(metadata={"quantity": kind}, **options)


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(quantity, flax.struct.field)
)
def pytree(cls: type[T]) -> type[T]:
    """Makes `cls` a frozen, keyword-only dataclass that JAX maps over."""
    decorate: Callable[[type[T]], type[T]] = flax.struct.dataclass
    return decorate(cls, kw_only=True)  # type: ignore[call-arg]


# --- on the device: what stages take and return -------------------------------------------------------------


@pytree
class PointCloud:
    """A padded point cloud; rows where `mask` is False carry no meaning.

    `points` are meters relative to `origin`, float64 on the host: an object a kilometer from zero keeps its precision
    in float32. Inside compiled programs `origin` is None.
    """

    points: Float[Array, "*batch n 3"] = quantity("position")  # meters, relative to `origin`
    mask: Bool[Array, "*batch n"] = quantity("invariant")  # True where the point is real
    origin: Float[Array | np.ndarray, "*batch 3"] | None = quantity("origin", default=None)  # scan's frame
    # Unit normals of the surface, outward; zeros where not known. None: nowhere.
    normals: Float[Array, "*batch n 3"] | None = quantity("direction", default=None)


@pytree
class Sampled:
    """A cloud as a farthest-point sample (`points`) and in full (`dense`): sparse points are compared with the
    other's dense ones, so that a residual measures misfit and not the spacing of the samples."""

    points: Float[Array, "*b n 3"] = quantity("position")
    mask: Bool[Array, "*b n"] = quantity("invariant")
    dense: Float[Array, "*b m 3"] = quantity("position")
    dense_mask: Bool[Array, "*b m"] = quantity("invariant")


@pytree
class Anchors:
    """Points of the observed surface, as a rule with the encoder's features there: what a local decoder looks up."""

    offset: Float[Array, "*batch a 3"] = quantity("offset")  # meters, relative to the embedding's `center`
    # Unit norm over (3, f). None: of points that the encoder has no features of.
    features: Float[Array, "*batch a 3 f"] | None = quantity("columns")
    mask: Bool[Array, "*batch a"] = quantity("invariant")  # True where the anchor is real
    # Unit normals of the surface, outward; zeros where not known. None: nowhere.
    normal: Float[Array, "*batch a 3"] | None = quantity("direction", default=None)


@pytree
class Sight:
    """What sensors at known places saw around one object: depth images that say how far space is free
    (`geometry.free_space`); in the object's frame, meters."""

    eye: Float[Array | np.ndarray, "*batch v 3"] = quantity("position")  # where each stood
    turn: Float[Array | np.ndarray, "*batch v 3 3"] = quantity("direction")  # rows: across, down, forward
    half: Float[Array | np.ndarray, "*batch v"] = quantity("invariant")  # tangent of half the image's angle
    side: Float[Array | np.ndarray, "*batch v"] = quantity("invariant")  # pixels of a row, first of `clear`
    clear: Float[Array | np.ndarray, "*batch v p p"] = quantity("length")  # free along a ray; 0: not known


@pytree
class Embedding:
    """What the encoder says of one object (paper §3.1): `Φ(sRX + t) = (inv, R·eqv, s·scale, sR·center + t)`."""

    inv: Float[Array, "*batch c"] = quantity("invariant")  # F_inv, no unit
    eqv: Float[Array, "*batch 3 c"] = quantity("columns")  # F_eqv
    scale: Float[Array, "*batch"] = quantity("length")  # F_s, meters per canonical unit
    center: Float[Array, "*batch 3"] = quantity("position")  # F_c, meters, relative to `origin`
    # In the scan's frame, meters, float64; None inside compiled programs.
    origin: Float[Array | np.ndarray, "*batch 3"] | None = quantity("origin", default=None)
    # A level each; none where the decoder reads the four codes alone.
    anchors: tuple[Anchors, ...] = quantity("record", default=())

    def scan_center(self) -> Float[np.ndarray, "*batch 3"]:
        """F_c in the scan's frame, meters, float64. Raises ValueError for a code in a local frame."""
        if self.origin is None:
            raise ValueError("a code in a local frame has no place in a scan; needed one with its origin")
        return np.asarray(self.center, np.float64) + np.asarray(self.origin, np.float64)


@pytree
class LocalBatch:
    """A batch of objects, each in a local frame about its own `origin`, which stays float64 on the host.

    `cloud` and `code` are relative to `origin` and have none of their own.
    """

    cloud: PointCloud = quantity("record")
    code: Embedding = quantity("record")
    sight: Sight | None = quantity("record", default=None)
    # What its scan shows around each object, neither its own nor floor or wall; about the same origin.
    around: PointCloud | None = quantity("record", default=None)
    origin: Float[Array | np.ndarray, "*batch 3"] | None = quantity("origin", default=None)

    def take(self, rows: Sequence[int] | Integer[np.ndarray, " k"]) -> LocalBatch:
        """The objects in `rows`, in that order."""
        at = np.asarray(rows, int)
        local = dataclasses.replace(self, origin=None)
        chosen = jax.tree.map(lambda x: x[at], local)
        return dataclasses.replace(chosen, origin=None if self.origin is None else self.origin[at])


@pytree
class Matches:
    """An assignment of the objects of one scan to those of another (paper §3.2)."""

    target_index: Integer[Array, "*batch sources"]  # −1: no partner
    score: Float[Array, "*batch sources"]  # the entry of H (or Λ) that was chosen; 0 without partner


@pytree
class Registration:
    """A pose per pair, with its own loss (paper §3.3)."""

    T_target_source: jaxlie.SE3 = quantity("pose")  # source's local frame to target's local frame
    loss: Float[Array, "*batch"] = quantity("invariant")  # what was minimized, at this very pose
    # Trimmed root mean square of nearest distances, both ways, meters.
    rms_m: Float[Array, "*batch"] = quantity("length")
    # The pose stopped moving and explains both clouds.
    converged: Bool[Array, "*batch"] = quantity("invariant")
    # The rest only of `SurfaceRegistration`. Of the surfaces: 0 none, 1 nothing of both clouds agrees.
    misfit: Float[Array, "*batch"] | None = quantity("invariant", default=None)
    # Of (shift m, turn rad), about the target's local zero.
    covariance: Float[Array, "*batch 6 6"] | None = quantity("covariance", default=None)
    aligned: jaxlie.SE3 | None = quantity("pose", default=None)  # by the surfaces, also of what stayed
    competing: jaxlie.SE3 | None = quantity("pose", default=None)  # (*batch, k): other poses tried to the end
    # Which of them explain both clouds as well, turned otherwise.
    competes: Bool[Array, "*batch k"] | None = quantity("invariant", default=None)


@pytree
class JointFit:
    """Shape code and poses of one object, optimized together over its observations (paper §3.5)."""

    embedding: Embedding = quantity("record")  # in the frame of the reference observation
    T_ref_obs: jaxlie.SE3 = quantity("pose")  # one a observation
    loss: Float[Array, "*batch"] = quantity("invariant")


# --- on the host: what people load, keep and write ----------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """A triangle mesh; meters."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Integer[np.ndarray, "f 3"]


@dataclass(frozen=True, kw_only=True)
class Color:
    """The mean color of points in CIE L*a*b* (D65), and of how many."""

    points: int
    lab: Float[np.ndarray, "3"]


@dataclass(frozen=True, kw_only=True)
class Instance:
    """One object as one scan saw it; meters, in the scan's frame, float64."""

    id: int
    points: Float[np.ndarray, "n 3"]
    label: str | None = None
    colors: Integer[np.ndarray, "n 3"] | None = None  # uint8
    # Unit, outward; 0 where a point's is not known. None: the scan says nothing.
    normals: Float[np.ndarray, "n 3"] | None = None


@dataclass(frozen=True, kw_only=True)
class ObservedObject:
    """An object as matching and registration take it: all that was seen of it, in one frame."""

    points: Float[np.ndarray, "_ 3"] = quantity("position")  # meters, float64
    embedding: Embedding = quantity("record")  # NumPy leaves, unbatched
    color: Color | None = quantity("invariant", default=None)
    # What sensors saw around it, where their places are known.
    sight: Sight | None = quantity("record", default=None)
    normals: Float[np.ndarray, "_ 3"] | None = quantity("direction", default=None)  # as in `Instance`
    # What its scans show around it that is in no mask, neither floor nor wall.
    around: Float[np.ndarray, "_ 3"] | None = quantity("position", default=None)


@dataclass(frozen=True, kw_only=True)
class AccumulatedObject:
    """An object with the k observations that make up its shape, as refinement and meshing take it; meters, float64.

    Points lie in the object's frame. What observation j saw alone is `inverse(poses[j]) @ points[observation == j]`,
    in the frame of its scan (`geometry.observations`). `background` was no object in the scan that saw it first.
    """

    points: Float[np.ndarray, "n 3"]
    observation: Integer[np.ndarray, " n"]  # that each point is of, 0 to k − 1
    poses: Float[np.ndarray, "k 4 4"]  # T_ref_scan; the first observation is held where others are moved
    embedding: Embedding  # NumPy leaves, unbatched; of all points together
    normals: Float[np.ndarray, "n 3"] | None = None  # unit, outward; zeros where not known. None: nowhere
    # Of each observation, where its scan's sensors stood, in that scan's frame; (0, 3) where not known.
    sensors: tuple[Float[np.ndarray, "_ 3"], ...]
    background: Float[np.ndarray, "b 3"] = field(default_factory=NO_POINTS)  # in the object's frame
    seen_beneath: float = 0.0  # largest share of its footprint with background beneath (`open_below`)


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """Something in a scan that was left out, and why."""

    what: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Scan:
    """One visit to the place: its instances, its background, and what was ignored."""

    name: str
    source: str
    instances: tuple[Instance, ...]
    background: Float[np.ndarray, "b 3"] = field(default_factory=NO_POINTS)
    # Where its sensors stood, in its frame, meters; none: not known.
    sensors: Float[np.ndarray, "s 3"] = field(default_factory=NO_POINTS)
    skipped: tuple[Skipped, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Frame:
    """How a scan's frame lies in the scene's, which is that of the first scan: upright, leveled."""

    T_scene_scan: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))  # float64, row-major
    sigma_m: float = 0.0  # standard errors of what it makes of a place and of a direction; 0 where it was
    sigma_deg: float = 0.0  # taken as given
    noise_m: float = 0.0  # how far its surfaces lie off the scene's, noise and drift; 0 where it is not known
    unknown: bool = False  # nothing tells how it lies: what moved, and how far, is in doubt

    @property
    def tilt_deg(self) -> float:
        """Angle between the scan's z and the scene's: upright, that by which the scan was leveled."""
        x, y, z = self.T_scene_scan[:3, 2]
        return float(np.rad2deg(np.arctan2(np.hypot(x, y), z)))


@dataclass(frozen=True, kw_only=True)
class Observation:
    """One object in one scan. `T_ref_scan` maps the scan's points, as given, onto the object's reference observation.

    That of the reference observation itself is the identity, but where its scan was leveled.
    """

    scan: int
    instance: int
    T_ref_scan: Float[np.ndarray, "4 4"]  # float64, row-major
    score: float  # of the match (`robust`: its probability); 1 for the reference observation itself
    rms_m: float
    converged: bool
    interchangeable: bool = False  # another assignment explains the scans as well: one of identical copies
    sigma_m: float = 0.0  # standard error of the position of its points' mean, and
    sigma_deg: float = 0.0  # of its rotation, as registration has it; 0 where it has none
    frame: Frame = field(default_factory=Frame)  # of its scan
    misfit: float = 0.0  # of registration: 0 none, 1 nothing of both clouds agrees; 0 where it has none
    accumulated: bool = True  # its points are part of the object's shape; False where the pose is in doubt


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object of the living scene over all scans.

    `points` are accumulated in the frame of the reference observation; `point_scan` names the scan each
    came from, so every single observation can be had back: `inverse(T_ref_scan) @ points[point_scan == s]`.
    Code and mesh are of the accumulated observations alone (`objects.accumulated_points`).
    """

    id: str
    label: str | None
    reference_scan: int
    observations: tuple[Observation, ...]
    points: Float[np.ndarray, "n 3"]  # float64
    point_scan: Integer[np.ndarray, "n"]
    embedding: Embedding  # NumPy leaves, unbatched; frame of the reference observation
    normals: Float[np.ndarray, "n 3"] | None = None  # unit, outward; zeros where not known. None: nowhere
    mesh: Mesh | None = None
    color: Color | None = None  # of the accumulated observations whose scans have colors


@dataclass(frozen=True, kw_only=True)
class Changes:
    """What happened between two scans that follow each other; object ids."""

    from_scan: int
    to_scan: int
    moved: tuple[str, ...] = ()
    static: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    not_seen: tuple[str, ...] = ()  # known before; the later scan cannot tell that they are gone
    discovered: tuple[str, ...] = ()  # new; no scan before can tell that they were not there
    probability: dict[str, float] = field(default_factory=dict)  # of what is said of an object, where known


@dataclass(frozen=True, kw_only=True)
class Repair:
    """A mask that was mended on the evidence of another scan."""

    object: str  # id of the whole
    instances: tuple[int, ...] = ()  # of the scan, that are parts of it, the one that was matched first
    absorbed: tuple[str, ...] = ()  # ids that parts of it had in the scene before
    divided: str | None = None  # id of the other object that one mask, `instances`, held
    dropped: int = 0  # points of one mask (without `instances`: of an earlier scan) that are not its object's
    neighbor: str | None = None  # id of the object that they are of
    regained: int = 0  # points beside a mask that are the object's
    unmasked: int = 0  # points of the object where no mask shows it, found as a new one of `instances`
    points: int = 0  # of the mask, before
    share: float = 1.0  # how sure: of a part, what lies on the whole; of points, beyond doubt; else the match
    smooth: float = 0.0  # share of the border between parts, where no other scan shows the whole


@dataclass(frozen=True, kw_only=True)
class ScanRecord:
    """What a living scene remembers of a scan."""

    index: int
    name: str
    source: str
    instances: tuple[int, ...]
    skipped: tuple[Skipped, ...] = ()
    not_seen: tuple[str, ...] = ()  # ids of objects, known then or since, that it cannot tell it lacks
    repairs: tuple[Repair, ...] = ()  # that it led to
    frame: Frame = field(default_factory=Frame, compare=False)
    # In the scan's frame, meters, float64: its background, thinned, and where its sensors stood.
    background: Float[np.ndarray, "b 3"] = field(default_factory=NO_POINTS, compare=False, repr=False)
    sensors: Float[np.ndarray, "s 3"] = field(default_factory=NO_POINTS, compare=False, repr=False)


@dataclass(frozen=True, kw_only=True)
class LivingScene:
    """All objects over all scans, and what changed between scans."""

    preset: str
    prior: str
    upright: bool
    scans: tuple[ScanRecord, ...]
    objects: tuple[SceneObject, ...]
    changes: tuple[Changes, ...]
    timing_s: dict[str, float] = field(default_factory=dict)
    unit: str = "m"
