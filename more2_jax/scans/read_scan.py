"""Scans as people have them, read into a `Scan` by whichever of `FORMATS` recognizes the path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Integer

from more2_jax.geometry.segmentation import segment_geometric
from more2_jax.geometry.segmentation_config import SegmentationConfig
from more2_jax.geometry.up_axis import R_UP
from more2_jax.scans.formats.registry import FORMATS, WITH_DEPTH_FRAMES
from more2_jax.scans.labeled_cloud import CUT_WITHOUT, LabeledCloud, ReadOptions, one_line
from more2_jax.scans.large_instances import thinned_instances
from more2_jax.scans.normal_sides import outward
from more2_jax.scans.predicted_masks import lay_masks
from more2_jax.scans.structural_labels import drop_background, is_structure
from more2_jax.scans.structural_shapes import drop_structure, warning
from more2_jax.types import Instance, Scan, Skipped

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SMALLEST_M, LARGEST_M = 0.02, 20.0  # a median object beyond these means another unit than was said
MASKS_ARE_BETTER = (
    "instances are clusters, found without a network: objects that touch are one. Masks from a network are"
    " better: pass Mask3D's output with --masks, or name an instance property with --instance-property"
)
LARGEST_COORDINATE = 1e12  # in any unit; beyond, squares and sums lose all meaning
# Steps of coordinates: from the first on they are no less than what scanners err by; with the second, legs are lost.
STEPS_SHOW_M, STEPS_SPOIL_M = 0.002, 0.03
CM_OR_MM = 380.0  # between 120 and 1200, a chair in either


def read_scan(
    path: str | Path,
    *,
    instance_property: str | None = None,
    unit: str = "m",
    min_points: int = 64,
    masks: str | Path | None = None,
    min_score: float = 0.5,
    segment: Literal["changes", "geometric"] | None = None,
    depth_frames: bool = False,
    up: str = "z",
) -> Scan:
    """Reads one scan: instances in meters (float64, the scan's own frame), and what was left out.

    `path` is a PLY whose vertices have an integer property naming the instance (`instance`, `instance_id`, `objectId`,
    `object_id` or `label`, in this order; `instance_property` names another); an NPZ with `points` (n, 3), `instance`
    (n,) and optional `label` (n,), `color` or `colors` (n, 3), `normal` or `normals` (n, 3), `sensors` (s, 3); a folder
    of one PLY per object; or another format of `scans.formats.registry`. `<scan>.sensors.txt` beside it may hold the
    positions of its sensors. Instance ids ≤ 0 are background, and so are floors and walls, by their labels or, without,
    by their shape (`structural_shapes`). Normals are the file's, else those of its faces.

    `unit` is the file's: m, cm or mm. `up` names the file's up axis (x, y, z, -x, -y, -z); the scan is turned so that
    it is z. `masks` are predicted ones (`scans.predicted_masks`): those scored `min_score` or more replace the scan's
    own. `segment="geometric"` cuts a cloud without instances into planes and clusters. `depth_frames` reads the raw
    depth of 3RScan (paper §4). Instances of fewer than `min_points` points are named in `Scan.skipped`. Those of more
    than `scans.large_instances.MOST_POINTS` are thinned to that many, evenly in space; `Scan.warnings` says so, and
    names sizes that look like another unit.

    Raises ValueError, in one line, when the file is missing, unknown, damaged, has no instance property, has
    coordinates that are not finite, or no instance is left.
    """
    path = Path(path)
    check_told(unit, up)
    _check_alone(path, segment)
    at, needed = None if masks is None else Path(masks), segment is None and masks is None
    options = ReadOptions(
        instance_property=instance_property, masks=at, masks_needed=needed, depth_frames=depth_frames, up=up
    )
    cloud = read_masked(path, options, min_score)
    return scan_of(path, cloud if segment is None else _segmented(path, cloud, unit), unit, min_points)


def _check_alone(path: Path, segment: str | None) -> None:
    if segment not in (None, "geometric"):
        raise ValueError(
            f"{path}: segment {segment!r} of one scan; needed geometric or None (changes are between scans: more2 run"
            " with two or more, or read_changed_scans)"
        )


def _segmented(path: Path, cloud: LabeledCloud, unit: str) -> LabeledCloud:
    """Clusters as instances where the cloud has none of its own; says what was done."""
    if cloud.instance is not None:
        said = "the scan has instance masks, so --segment geometric is not used"
        return replace(cloud, warnings=(*cloud.warnings, said))
    check_points(path, cloud.points)
    try:
        found = segment_geometric(cloud.points * UNITS_M[cloud.unit or unit], SegmentationConfig())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not found.instance.any():
        raise ValueError(f"{path}: no instances left after segmentation; {'; '.join(found.sentences())}")
    return replace(
        cloud,
        instance=found.instance,
        skipped=(*cloud.skipped, *found.skipped),
        warnings=(*cloud.warnings, MASKS_ARE_BETTER, *found.sentences()),
    )


def read_masked(path: Path, options: ReadOptions, min_score: float) -> LabeledCloud:
    """The cloud with the predicted masks, if there are any, those scored `min_score` or more, as its instances."""
    cloud = read_cloud(path, options)
    return cloud if options.masks is None else lay_masks(cloud, path, options.masks, min_score)


def read_cloud(path: Path, options: ReadOptions) -> LabeledCloud:
    """What the first format that recognizes the path reads, in the file's unit, and its sensors; up is z.

    Raises ValueError in one line.
    """
    cloud = _as_filed(path, options)
    return turned_to_z(replace(cloud, sensors=_sensors(path, cloud)), options.up)


def _as_filed(path: Path, options: ReadOptions) -> LabeledCloud:
    """The cloud as its format reads it."""
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    for form in FORMATS:
        if form.recognizes(path):
            if options.depth_frames and form not in WITH_DEPTH_FRAMES:
                raise ValueError(f"{path}: depth frames asked for; needed the folder of a 3RScan scan")
            try:
                with np.errstate(
                    over="ignore", invalid="ignore"
                ):  # inf and NaN: refused once they are points
                    return form.read(path, options)
            except OSError as error:
                raise ValueError(f"{path}: not readable ({one_line(error)})") from error
            except ValueError as error:
                if str(error).isprintable():
                    raise
                raise ValueError(one_line(error)) from error  # names from the file may hold anything
    what = "a folder without .ply files" if path.is_dir() else f"suffix {path.suffix!r}"
    raise ValueError(
        f"{path}: {what}; needed a .ply, .npz, .pcd, .las, .laz, .e57, .obj, .glb, .stl or .off, or a folder of"
        " one .ply per object"
    )


def check_told(unit: str, up: str) -> None:
    """Raises ValueError for a unit that is none of `UNITS_M`, and for what is no axis of `R_UP`."""
    if unit not in UNITS_M:
        raise ValueError(f"unit {unit!r}; needed m, cm or mm")
    if up not in R_UP:
        raise ValueError(f"up {up!r}; needed {', '.join(R_UP)}")


def turned_to_z(cloud: LabeledCloud, up: str) -> LabeledCloud:
    """The cloud with another of its axes as z; to the bit as it is where z is up."""
    if up == "z":
        return cloud

    def turned(rows: Float[np.ndarray, "n 3"] | None) -> Float[np.ndarray, "n 3"] | None:
        return None if rows is None else rows @ R_UP[up].T

    return replace(
        cloud, points=cloud.points @ R_UP[up].T, normals=turned(cloud.normals), sensors=turned(cloud.sensors)
    )


def check_points(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    """Raises ValueError, in one line, for no points, and for coordinates that are not finite or too large."""
    if not len(points):
        raise ValueError(f"{path}: no instances left; the scan has no points")
    if bad := int((~np.isfinite(points).all(axis=1)).sum()):
        raise ValueError(f"{path}: {bad} of {len(points)} points have NaN or infinite coordinates")
    if bad := int((np.abs(points) > LARGEST_COORDINATE).any(axis=1).sum()):
        raise ValueError(
            f"{path}: {bad} of {len(points)} points have coordinates beyond {LARGEST_COORDINATE:g}"
        )


def _rounded(path: Path, points: Float[np.ndarray, "n 3"], unit: str) -> tuple[str, ...]:
    """A warning where coordinates of 32 bits have steps that show. ValueError where they spoil shapes."""
    far = float(np.median(np.abs(points).max(axis=1)))  # of most points: some may be strays
    step_m = float(np.spacing(np.float32(far))) * UNITS_M[unit]
    if step_m < STEPS_SHOW_M or (points != points.astype(np.float32)).any():
        return ()
    said = f"coordinates about {far:.3g} are stored in 32 bits, in steps of {step_m:.2g} m"
    if step_m >= STEPS_SPOIL_M:
        raise ValueError(f"{path}: {said}; needed 64 bits, or coordinates near the origin")
    return (f"{said}; with 64 bits, or coordinates near the origin, nothing is lost",)


# --- from labeled points to instances ----------------------------------------------------------------------


def scan_of(path: Path, cloud: LabeledCloud, unit: str, min_points: int) -> Scan:
    """The labeled points of a file as instances, in meters. Raises ValueError, in one line, where none is left."""
    unit = cloud.unit or unit
    if cloud.instance is None:
        raise ValueError(
            f"{path}: no instance masks; pass predicted ones with --masks, or cut it without: {CUT_WITHOUT}"
        )
    check_points(path, cloud.points)
    coarse = _rounded(path, cloud.points, unit)
    points = cloud.points * UNITS_M[unit]
    sensors = np.zeros((0, 3)) if cloud.sensors is None else cloud.sensors
    labels = _labels(cloud, cloud.instance)
    instance, named = drop_background(
        cloud.instance, {i: x for i, x in labels.items() if i > 0 and is_structure(x)}
    )
    instance, shaped = drop_structure(points, instance, labels)
    background = points[instance <= 0]
    normals, turned = _outward_normals(cloud, instance, sensors)
    whole, skipped = _instances(replace(cloud, normals=normals, labels=labels), instance, points, min_points)
    kept, thinned = thinned_instances(whole)
    if not kept:
        raise ValueError(f"{path}: no instances left; {_why_none(len(background), skipped, min_points)}")
    return Scan(
        name=path.stem if path.is_file() else path.resolve().name,
        source=str(path),
        instances=kept,
        background=background,
        sensors=sensors * UNITS_M[unit],
        skipped=(*cloud.skipped, *named, *shaped, *skipped),
        warnings=(*cloud.warnings, *warning(shaped), *coarse, *turned, *thinned, *_unit_warnings(kept, unit)),
    )


def _outward_normals(
    cloud: LabeledCloud, instance: Integer[np.ndarray, " n"], sensors: Float[np.ndarray, "s 3"]
) -> tuple[Float[np.ndarray, "n 3"] | None, tuple[str, ...]]:
    """The cloud's normals, out of the matter, and a warning where they had to be turned."""
    if cloud.normals is None:
        return None, ()
    normals, turned = outward(cloud.points, cloud.normals, instance, sensors)
    said = ("normals point into the surfaces, away from the room; they are turned around",) if turned else ()
    return normals, said


def _sensors(path: Path, cloud: LabeledCloud) -> Float[np.ndarray, "s 3"]:
    """Where the scan's sensors stood: what `<scan>.sensors.txt` beside it says, else what the scan itself says.

    A line a place, x y z as the scan's points. None (0 rows) where neither says. Raises ValueError, in one line,
    where that is no list of finite places.
    """
    beside = path.with_name(f"{path.stem if path.is_file() else path.name}.sensors.txt")
    sensors = np.zeros((0, 3)) if cloud.sensors is None else cloud.sensors
    if beside.is_file():
        path = beside
        try:
            lines = [line for line in beside.read_text(encoding="utf-8").splitlines() if line.strip()]
            sensors = np.loadtxt(lines, np.float64, ndmin=2) if lines else np.zeros((0, 0))
        except (ValueError, OSError) as error:
            raise ValueError(f"{beside}: not numbers ({one_line(error)}); needed lines of x y z") from error
    if sensors.shape[1:] != (3,) or not np.isfinite(sensors).all():
        raise ValueError(f"{path}: places of sensors {sensors.shape}; needed (s, 3) finite numbers")
    return sensors


def _instances(
    cloud: LabeledCloud,
    instance: Integer[np.ndarray, " n"],
    points: Float[np.ndarray, "n 3"],
    min_points: int,
) -> tuple[tuple[Instance, ...], tuple[Skipped, ...]]:
    """Splits the points by instance in one sort; ids ascend, points keep the file's order."""
    order = np.argsort(instance, kind="stable")
    ids, starts = np.unique(instance[order], return_index=True)
    kept: list[Instance] = []
    skipped: list[Skipped] = []
    for index, rows in zip(ids.tolist(), np.split(order, starts[1:]), strict=True):
        if index <= 0:
            continue
        if len(rows) < min_points:
            reason = f"{len(rows)} points; needed {min_points}"
            skipped.append(Skipped(what=f"instance {index}", reason=reason))
            continue
        colors = None if cloud.colors is None else cloud.colors[rows]
        normals = None if cloud.normals is None else cloud.normals[rows]
        label = cloud.labels.get(index)
        kept.append(Instance(id=index, points=points[rows], label=label, colors=colors, normals=normals))
    return tuple(kept), tuple(skipped)


def _labels(cloud: LabeledCloud, instance: Integer[np.ndarray, " n"]) -> dict[int, str]:
    """By instance, what most of its points say; the first in order where two say it equally often."""
    if cloud.point_labels is None:
        return cloud.labels
    labels, name = np.unique(cloud.point_labels, return_inverse=True)
    ids, which = np.unique(instance, return_inverse=True)
    pairs, counts = np.unique(which * len(labels) + name, return_counts=True)
    which, name = np.divmod(pairs, len(labels))
    best = np.lexsort((name, -counts, which))
    texts = (_text(labels[k]) for k in name[best[np.unique(which[best], return_index=True)[1]]])
    return {i: text for i, text in zip(ids.tolist(), texts, strict=True) if text}


def _text(label: Any) -> str:
    """A label as text."""
    return label.decode("utf-8", "replace") if isinstance(label, bytes) else str(label)


def _why_none(background: int, skipped: tuple[Skipped, ...], min_points: int) -> str:
    if not skipped:
        return f"all {background} points are background (instance ≤ 0)"
    return f"{len(skipped)} had fewer than {min_points} points; {background} points are background"


def median_diagonal(instances: tuple[Instance, ...]) -> float:
    """Median over instances of the diagonal of the bounding box, in the unit of their points."""
    return float(np.median([np.linalg.norm(np.ptp(i.points, axis=0)) for i in instances]))


def likely_unit(diagonal: float) -> str:
    """The unit in which furniture would have this diagonal: 1 or 2 m, 100 or 200 cm, 1000 or 2000 mm."""
    if diagonal <= LARGEST_M:
        return "m"
    return "cm" if diagonal <= CM_OR_MM else "mm"


def _unit_warnings(instances: tuple[Instance, ...], unit: str) -> tuple[str, ...]:
    diagonal_m = median_diagonal(instances)
    if SMALLEST_M <= diagonal_m <= LARGEST_M:
        return ()
    likely = likely_unit(diagonal_m / UNITS_M[unit])
    advice = f"; if the scan is in {likely}, pass --unit {likely}" if likely != unit else ""
    return (f"the median object measures {diagonal_m:.4g} m across, which is unlikely for furniture{advice}",)
