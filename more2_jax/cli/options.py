"""Options that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Unit = Literal["m", "cm", "mm"]
Segment = Literal["changes", "geometric"]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True)
class Reading:
    """What the caller knows of scans beyond their format."""

    unit: Unit = "m"
    """Unit of the scans' coordinates."""
    instance_property: str | None = None
    """Property of the points that names the instance, where it is none of the usual."""
    segment: Segment | None = None
    """How to cut scans without masks. changes: by what changed between two or more scans of one room. geometric: one
    scan alone into planes and clusters. Masks from a network are better."""
    up: Axis = "z"
    """Axis that is up in the files (y in what many phones export); the scene's is z."""
    depth_frames: bool = False
    """Points from the raw depth of a 3RScan folder rather than from its mesh."""


@dataclass(frozen=True)
class Reporting:
    """What is said while a command works."""

    quiet: bool = False
    """Print warnings and errors only."""
    log_json: Path | None = None
    """File for one JSON object a line and event: stages with counts and seconds, messages, errors."""
