"""What a scan holds, before anything is computed from it: `more2 inspect`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from more2_jax.scans.read_scan import likely_unit, median_diagonal
from more2_jax.types import Instance, Scan, Skipped

SLABS = 64  # the scan is cut into this many along each axis to look for its floor
FLOOR_SHARE = 0.12  # of all points in one end slab makes it a floor; an even spread gives 1/64


@dataclass(frozen=True, kw_only=True)
class InstanceReport:
    """One instance in figures; meters, along the scan's axes."""

    id: int
    label: str | None
    points: int
    extent: Float[np.ndarray, "3"]
    center: Float[np.ndarray, "3"]  # of the bounding box


@dataclass(frozen=True, kw_only=True)
class ScanReport:
    """One scan in figures; meters."""

    name: str
    source: str
    instances: tuple[InstanceReport, ...]
    points: int  # of instances and background together
    background_points: int
    extent: Float[np.ndarray, "3"]  # of instances and background together
    likely_unit: str  # in which the coordinates, as read, make sense: m, cm or mm
    likely_up: str | None  # +x, -x, +y, -y, +z or -z; None where nothing points to one
    up_reason: str
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...]


def inspect_scan(scan: Scan) -> ScanReport:
    """Counts and measures a scan, guesses its unit and up axis. Raises ValueError if it has no instances."""
    if not scan.instances:
        raise ValueError(f"scan {scan.name!r} has no instances; needed at least one")
    points = np.concatenate([*(i.points for i in scan.instances), scan.background])
    up, reason = likely_up_axis(points)
    return ScanReport(
        name=scan.name,
        source=scan.source,
        instances=tuple(_measure(instance) for instance in scan.instances),
        points=len(points),
        background_points=len(scan.background),
        extent=np.ptp(points, axis=0),
        likely_unit=likely_unit(median_diagonal(scan.instances)),
        likely_up=up,
        up_reason=reason,
        skipped=scan.skipped,
        warnings=scan.warnings,
    )


def _measure(instance: Instance) -> InstanceReport:
    low, high = instance.points.min(axis=0), instance.points.max(axis=0)
    return InstanceReport(
        id=instance.id,
        label=instance.label,
        points=len(instance.points),
        extent=high - low,
        center=(low + high) / 2,
    )


def likely_up_axis(points: Float[np.ndarray, "n 3"]) -> tuple[str | None, str]:
    """The axis away from the floor, and why: a floor is an end slab of the scan that is dense and wide.

    Without a floor, the shortest side of the scan is taken for its height, provided the scan is clearly
    flatter along it (rooms are); up is then where fewer points lie. None where that says nothing either.
    """
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    if (size <= 0).all():
        return None, "all points coincide"
    slab = np.clip((points - low) / np.where(size > 0, size, 1.0) * SLABS, 0, SLABS - 1).astype(int)
    ends = {("+", a): slab[:, a] == 0 for a in range(3)} | {
        ("-", a): slab[:, a] == SLABS - 1 for a in range(3)
    }
    scores = {end: _floor_score(points[rows], end[1], size, len(points)) for end, rows in ends.items()}
    (sign, axis), best = max(scores.items(), key=lambda item: item[1])
    if best > FLOOR_SHARE:
        return f"{sign}{'xyz'[axis]}", f"a wide plane holds {100 * best:.0f} % of the points at the other end"
    return _flattest(points, low, size)


def _floor_score(slab: Float[np.ndarray, "m 3"], axis: int, size: np.ndarray, total: int) -> float:
    """Share of all points in the slab, times how much of the scan's cross-section the slab spans."""
    if not len(slab):
        return 0.0
    across = [a for a in range(3) if a != axis]
    span = np.ptp(slab, axis=0)[across] / np.where(size[across] > 0, size[across], 1.0)
    return float(len(slab) / total * span.prod())


def _flattest(points: np.ndarray, low: np.ndarray, size: np.ndarray) -> tuple[str | None, str]:
    shortest, next_shortest = np.sort(size)[:2]
    if shortest > 0.7 * next_shortest:
        return None, "no floor, and no axis along which the scan is clearly flatter"
    axis = int(np.argmin(size))
    heavy_below = np.median(points[:, axis]) <= low[axis] + size[axis] / 2
    return (
        f"{'+' if heavy_below else '-'}{'xyz'[axis]}",
        "no floor seen; the scan is flattest along this axis",
    )


def format_report(report: ScanReport) -> str:
    """The report as lines of text for a terminal."""
    head = [
        f"{report.name} ({report.source})",
        f"  {report.points} points, {report.background_points} of them background",
        f"  {len(report.instances)} instances",
        f"  extent {_lengths(report.extent)} m; likely unit: {report.likely_unit}",
        f"  likely up: {report.likely_up or 'unknown'} ({report.up_reason})",
        f"  {'instance':>8}  {'points':>8}  {'extent [m]':>24}  {'center [m]':>27}  label",
    ]
    rows = [
        f"  {i.id:>8}  {i.points:>8}  {_lengths(i.extent):>24}  {_position(i.center):>27}  {i.label or '-'}"
        for i in report.instances
    ]
    ignored = [f"  ignored: {s.what} ({s.reason})" for s in report.skipped] or [
        "  ignored: nothing but background"
    ]
    return "\n".join([*head, *rows, *ignored, *(f"  warning: {w}" for w in report.warnings)])


def _lengths(values: np.ndarray) -> str:
    return " x ".join(f"{v:.3f}" for v in values)


def _position(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"
