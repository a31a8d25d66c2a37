"""The settings of a run: a preset, and what a YAML file replaces in it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import yaml

from more2_jax.config import SceneConfig, from_dict, preset


def scene_config(
    name: str, upright: bool | None, path: Path | None, *, keep_masks: bool = False
) -> SceneConfig:
    """The preset called `name` with the values of the YAML file at `path`, if any, in place of its own.

    `keep_masks` has masks left as they are. Raises ValueError, in one line, for an unknown preset or a file that is
    missing, no YAML, or does not fit.
    """
    config = _from_file(preset(name, upright=upright), path)
    return dataclasses.replace(config, repair_masks=False) if keep_masks else config


def _from_file(base: SceneConfig, path: Path | None) -> SceneConfig:
    if path is None:
        return base
    if not path.is_file():
        raise ValueError(f"{path}: no such settings file")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not YAML ({' '.join(str(error).split())})") from error
    return from_dict(SceneConfig, _replaced(dataclasses.asdict(base), values), where=path.name)


def _replaced(base: dict[str, Any], values: Any) -> Any:
    """`base` with `values` in place, by section; what does not fit is left for `from_dict` to name.

    A section that names another method has settings of its own: nothing of `base` is part of it.
    """
    if not isinstance(values, dict) or values.get("method", base.get("method")) != base.get("method"):
        return values
    inner = {
        k: _replaced(base[k], v) if isinstance(base.get(k), dict) and v is not None else v
        for k, v in values.items()
    }
    return base | inner
