"""The page as text: a template, its style and program, the library they need, and the scene's data."""

from __future__ import annotations

import json
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from more2_jax.config import SceneConfig
from more2_jax.report.details import DETAILS, report_details, write_details
from more2_jax.report.lists import (
    changes_list,
    object_list,
    repairs_list,
    skipped_table,
    status_counts,
    timing_table,
)
from more2_jax.report.payload import payload
from more2_jax.report.wording import frame_text, leveled_text, noise_text
from more2_jax.types import LivingScene
from more2_jax.whole_file import whole_file

# In the order in which they need each other; all share one scope.
PROGRAM = ("data", "room", "trails", "pace", "stage", "labels", "panel", "controls", "main")
# What a page with details may load: scripts of its own origin. Not every browser takes a folder on disk for one.
LOADS = " 'self' file:"
TOGGLES = (  # name, what it says, on at first
    ("meshes", "Surfaces", True),
    ("clouds", "Points of this scan", True),
    ("accumulated", "Points of all scans", False),
    ("background", "Background", True),
    ("trails", "Motion", True),
    ("labels", "Numbers", True),
    ("split", "Before and after", False),
)


def write_report(scene: LivingScene, path: str | Path, config: SceneConfig) -> None:
    """Writes the scene's page, `report_html`, and the folder of its details beside it, where it has any."""
    write_details(Path(path).with_name(DETAILS), report_details(scene))
    with whole_file(path) as partial:
        partial.write_text(report_html(scene, config), encoding="utf-8")


def report_html(scene: LivingScene, config: SceneConfig) -> str:
    """The page as text. What came from files is shown as text, never run.

    It loads nothing; that of a large scene shows all objects coarsely and finer ones from `report_details` beside it.
    `config` says what counts as static between scans that do not follow each other.
    Raises ValueError without objects.
    """
    if not scene.objects:
        raise ValueError("the living scene has no objects; needed at least one")
    data, blob = payload(scene, config)
    last = len(scene.scans) - 1
    shown = data["pairs"][f"0-{last}"]
    names = ", ".join(s.name for s in scene.scans)
    large = "details" in data
    return Template(_asset("page.html")).substitute(
        loads=LOADS if large else "",
        title=escape(names),
        style=_asset("page.css"),
        headline=escape(shown["headline"]),
        summary=escape(_summary(scene, names)),
        last=last,
        ticks="".join(f"<li>{escape(s.name)}</li>" for s in scene.scans),
        time_hidden="" if last else "hidden",
        base_hidden="" if last > 1 else "hidden",
        toggles=_toggles(scene),
        counts=status_counts(shown["verdicts"]),
        objects=object_list(data["objects"], shown["verdicts"]),
        steps=changes_list(scene, data),
        skipped=skipped_table(scene.scans),
        repairs=repairs_list(scene.scans),
        timing=timing_table(scene.timing_s),
        scene=_inert(json.dumps(data, separators=(",", ":"), allow_nan=False)),
        blob=blob,
        library=_asset("three.min.js"),
        license=escape(_asset("three.LICENSE")),
        program="\n".join(_asset(f"{name}.js") for name in PROGRAM + ("details",) * large),
    )


@cache
def _asset(name: str) -> str:
    return (resources.files("more2_jax") / "assets" / "page" / name).read_text(encoding="utf-8")


def _inert(text: str) -> str:
    """JSON that cannot end the script element it stands in, whatever names hold."""
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _summary(scene: LivingScene, names: str) -> str:
    scans, objects = len(scene.scans), len(scene.objects)
    return (
        f"{scans} scan{'' if scans == 1 else 's'} ({names}), {objects} object{'' if objects == 1 else 's'} in all; "
        f"preset {scene.preset}, prior {scene.prior}{', upright' if scene.upright else ''}."
        + "".join(
            f" {text}."
            for s in scene.scans
            for told in (leveled_text, frame_text, noise_text)
            if (text := told(scene, s))
        )
    )


def _toggles(scene: LivingScene) -> str:
    useless = {
        "meshes": all(o.mesh is None for o in scene.objects),
        "background": not any(len(s.background) for s in scene.scans),
        "trails": len(scene.scans) == 1,
        "split": len(scene.scans) == 1,
    }
    why = {
        "meshes": "No object has a surface",
        "background": "The scans hold nothing but objects",
        "trails": "One scan only",
        "split": "One scan only",
    }
    parts = []
    for name, says, on in TOGGLES:
        off = useless.get(name, False)
        state = f'disabled title="{why[name]}"' if off else "checked" if on else ""
        parts.append(
            f'<label class="toggle"><input type="checkbox" data-toggle="{name}" id="toggle_{name}" {state}>'
            f"{says}</label>"
        )
    return "".join(parts)
