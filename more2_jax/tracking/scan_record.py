"""What the scene remembers of a scan."""

from __future__ import annotations

from collections.abc import Sequence

from more2_jax.tracking.object_views import few_sensors
from more2_jax.tracking.objects import SCENE_FRAME
from more2_jax.tracking.room_points import remembered
from more2_jax.types import Frame, Instance, Repair, Scan, ScanRecord, Skipped


def record(
    index: int,
    scan: Scan,
    instances: list[Instance],
    skipped: tuple[Skipped, ...],
    frame: Frame = SCENE_FRAME,
    unseen: Sequence[str] = (),
    repairs: tuple[Repair, ...] = (),
) -> ScanRecord:
    """What the scene remembers of a scan."""
    return ScanRecord(
        index=index,
        name=scan.name,
        source=scan.source,
        instances=tuple(i.id for i in instances),
        skipped=skipped,
        not_seen=tuple(unseen),
        repairs=repairs,
        frame=frame,
        background=remembered(scan.background),
        sensors=few_sensors(scan),
    )
