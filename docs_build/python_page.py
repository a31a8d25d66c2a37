"""docs/reference/python.md: every public name, for mkdocstrings to fill with signature and docstring."""

from __future__ import annotations

import importlib

import more2_jax

HEAD = """# Python

`import more2_jax as m2` has these names. Lengths are in meters, angles in radians unless a name ends in `_deg`. `T_a_b`
takes points of frame b to frame a. Points are rows, (n, 3).

"""
# In the order of use; a module that is not named stands at the end under its own name.
TITLES = {
    "scene": "The whole method",
    "scans": "Scans",
    "storage": "Stored scenes",
    "network": "Weights and the encoder-decoder",
    "geometry": "Clouds",
    "matching": "Matching",
    "registration": "Registration",
    "refinement": "Joint optimization",
    "meshing": "Meshes",
    "config": "Settings",
    "types": "Records",
}


def python_page() -> str:
    """Markdown: the public names under what they are for."""
    sections: dict[str, list[str]] = {title: [] for title in TITLES.values()}
    for name in more2_jax.__all__:
        path = path_of(name)
        part = path.split(".")[1]
        sections.setdefault(TITLES.get(part, part), []).append(path)
    return HEAD + "\n".join(
        f"## {title}\n" + "".join(f"::: {path}\n" for path in paths)
        for title, paths in sections.items()
        if paths
    )


def path_of(name: str) -> str:
    """Where a public name is defined."""
    module = more2_jax._HOME_OF[name]
    full = f"more2_jax.{module}"
    assert hasattr(importlib.import_module(full), name)
    return f"{full}.{name}"
