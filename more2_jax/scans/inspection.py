"""What a scan holds, before anything is computed from it: `more2 inspect`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from more2_jax.geometry.up_axis import likely_up_axis
from more2_jax.scans.read_scan import likely_unit, median_diagonal
from more2_jax.types import Instance, Scan, Skipped


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
