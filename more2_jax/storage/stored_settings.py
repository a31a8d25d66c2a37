"""Settings stored beside a living scene, those of version 0.1 too: there one class held what two algorithms read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from more2_jax.config import SceneConfig, from_dict

# Old name → new one, of what each algorithm still reads.
SEARCH = {
    "yaw_starts": "turns",
    "coarse_points": "points",
    "coarse_dense": "dense",
    "cells": "cells",
    "coarse_steps": "steps",
    "search_reach": "first_reach",
    "first_reach": "last_reach",
    "keep_starts": "keep",
    "truncation": "truncation",
    "lift_weight": "lift_weight",
    "free_weight": "free_weight",
    "field_weight": "field_weight",
}
SURFACE = {
    "identity_start": "try_stayed",
    "surface_points": "points",
    "surface_steps": "steps",
    "first_reach": "first_reach",
    "last_reach": "last_reach",
    "sdf_points": "field_points",
    "polish_points": "polish_points",
    "polish_steps": "polish_steps",
    "polish_reach": "polish_reach",
    "trim": "trim",
    "converged_rms": "converged_rms",
}
DESCENT = (
    "points",
    "sdf_points",
    "steps",
    "learning_rate",
    "sdf_weight",
    "chamfer_weight",
    "icp_steps",
    "trim",
    "converged_rms",
)
CODES = ("score", "assignment")
EVIDENCE = ("candidates", "size_weight", "motion_weight")


def read_settings(path: Path) -> SceneConfig:
    """The settings of a stored scene. Raises ValueError for values that do not fit."""
    values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    return from_dict(SceneConfig, of_today(values), where=path.name)


def of_today(values: Any) -> Any:
    """Settings as version 0.1 stored them, in today's classes; today's own as they are."""
    if not isinstance(values, dict):
        return values
    registration, matching = values.get("registration"), values.get("matching")
    if not isinstance(registration, dict) or "refine" not in registration:
        return values
    search = _renamed(registration, SEARCH)
    # In any orientation 0.1 stored no turns about the vertical and no free space: neither is asked there.
    search = {k: v for k, v in search.items() if v or k not in ("turns", "free_weight")}
    if registration["refine"] == "surface":
        registration = {"method": "surface", "search": search, **_renamed(registration, SURFACE)}
    else:
        registration = {"method": "descent", **{k: registration[k] for k in DESCENT if k in registration}}
    if isinstance(matching, dict) and matching.get("verify"):
        matching = {
            "method": "evidence",
            "search": search,
            **{k: matching[k] for k in EVIDENCE if k in matching},
        }
    elif isinstance(matching, dict):
        matching = {"method": "codes", **{k: matching[k] for k in CODES if k in matching}}
    return values | {"registration": registration, "matching": matching}


def _renamed(values: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    return {new: values[old] for old, new in names.items() if old in values}
