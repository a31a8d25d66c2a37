"""Labels of what does not move: the room itself, and what annotators marked as no object."""

from __future__ import annotations

import numpy as np
from jaxtyping import Integer

from more2_jax.types import Skipped

# As `normalized` writes them; from the label sets of 3RScan, ScanNet, ScanNet++, Replica and S3DIS.
STRUCTURE = frozenset(
    (
        *("wall", "inner wall", "half wall", "floor", "ceiling", "suspended ceiling", "roof"),
        *("beam", "ceiling beam", "column", "pillar", "structure", "ledge", "baseboard", "skirting board"),
        *("door", "doors", "doorframe", "door frame", "doorway"),
        *("window", "windows", "windowframe", "window frame", "windowsill", "window sill", "window pane"),
        *("stair", "stairs", "staircase", "stairway", "railing", "banister", "handrail"),
        *("pipe", "pipes", "vent", "ventilation"),
    )
)
NOT_OBJECTS = frozenset(
    ("unlabeled", "unlabelled", "unannotated", "undefined", "unknown", "void", "none", "remove", "split", "")
)
BACKGROUND_LABELS = STRUCTURE | NOT_OBJECTS


def normalized(label: str) -> str:
    """Lower case, words parted by one blank: `Door-Frame` and `door_frame` become `door frame`."""
    return " ".join(label.lower().replace("_", " ").replace("-", " ").split())


def is_background(label: str | None) -> bool:
    """Whether the label names a part of the room or no object at all; False for an instance without a label."""
    return label is not None and normalized(label) in BACKGROUND_LABELS


def is_structure(label: str) -> bool:
    """Whether the label names a part of the room."""
    return normalized(label) in STRUCTURE


def drop_background(
    instance: Integer[np.ndarray, "n"], labels: dict[int, str]
) -> tuple[Integer[np.ndarray, "n"], tuple[Skipped, ...]]:
    """Instances with the structural ones set to 0, and one line on each of those that has points."""
    structural = [i for i, label in labels.items() if is_background(label)]
    gone = np.isin(instance, structural)
    present = np.unique(instance[gone]).tolist()
    skipped = tuple(
        Skipped(what=f"instance {i} ({labels[i]})", reason="background: its label is no movable object")
        for i in present
    )
    return np.where(gone, 0, instance), skipped
