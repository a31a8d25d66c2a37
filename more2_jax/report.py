"""The page a person looks at: one HTML file that needs nothing else."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from jaxtyping import Float

from more2_jax.objects import motion_between, observation_in, points_of
from more2_jax.types import Changes, LivingScene, ScanRecord, SceneObject

POINTS_SHOWN = 400  # of one object in one plan
MARGIN = 0.06  # around a plan, share of its longer side
STATES = ("moved", "static", "added", "removed")

Points = Float[np.ndarray, "n 3"]


def write_report(scene: LivingScene, path: str | Path) -> None:
    """Writes the scene's page: plans of all scans, objects, changes, what was left out, seconds a stage."""
    Path(path).write_text(report_html(scene), encoding="utf-8")


def report_html(scene: LivingScene) -> str:
    """The page as text. Names that came from files are escaped; nothing is loaded from anywhere."""
    template = Template((resources.files("more2_jax") / "assets" / "report.html").read_text(encoding="utf-8"))
    names = ", ".join(s.name for s in scene.scans)
    return template.substitute(
        title=escape(names),
        summary=escape(
            f"{_count(len(scene.scans), 'scan')} ({names}), {_count(len(scene.objects), 'object')}; "
            f"preset {scene.preset}, prior {scene.prior}{', upright' if scene.upright else ''}."
        ),
        plans="".join(_plans(scene)),
        objects=_object_table(scene),
        changes=_change_table(scene) if scene.changes else "<p>One scan only: nothing to compare.</p>",
        skipped=_skipped(scene.scans),
        timing=_table(("stage", "s"), ([escape(k), f"{v:.2f}"] for k, v in scene.timing_s.items())),
    )


def motion_text(o: SceneObject, change: Changes) -> str:
    """What happened to the object between two scans: `moved 2.00 m, 90.0°`, `static`, … or `absent`."""
    state = next((s for s in STATES if o.id in getattr(change, s)), "absent")
    before, after = observation_in(o, change.from_scan), observation_in(o, change.to_scan)
    if before is None or after is None:
        return state
    distance, angle_deg = motion_between(o, before, after)
    return f"{state} {distance:.2f} m, {angle_deg:.1f}°"


# --- tables -------------------------------------------------------------------------------------------------


def _object_table(scene: LivingScene) -> str:
    pairs = [f"{_name(scene, c.from_scan)} → {_name(scene, c.to_scan)}" for c in scene.changes]
    head = ("object", "label", *pairs, "lowest score", "largest rms [mm]", "points")
    return _table(head, (_object_row(scene, k, o) for k, o in enumerate(scene.objects)))


def _object_row(scene: LivingScene, number: int, o: SceneObject) -> list[str]:
    later = [seen for seen in o.observations if seen.scan != o.reference_scan]
    doubt = "" if all(seen.converged for seen in later) else " (not converged)"
    return [
        f'<span class="dot" style="background:{color(number)}"></span>{escape(o.id)}',
        escape(o.label or "–"),
        *(_state_cell(motion_text(o, c)) for c in scene.changes),
        f"{min(seen.score for seen in later):.3f}" if later else "–",
        f"{1000 * max(seen.rms_m for seen in later):.1f}{doubt}" if later else "–",
        str(len(o.points)),
    ]


def _state_cell(text: str) -> str:
    return f'<span class="{text.split()[0]}">{escape(text)}</span>'


def _change_table(scene: LivingScene) -> str:
    rows = (
        [
            f"{_name(scene, c.from_scan)} → {_name(scene, c.to_scan)}",
            *(escape(", ".join(getattr(c, s)) or "–") for s in STATES),
        ]
        for c in scene.changes
    )
    return _table(("scans", *STATES), rows)


def _skipped(scans: Sequence[ScanRecord]) -> str:
    rows = [[escape(s.name), escape(k.what), escape(k.reason)] for s in scans for k in s.skipped]
    if not rows:
        return "<p>Nothing.</p>"
    return f'<div class="scroll">{_table(("scan", "what", "why"), rows)}</div>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{h}</th>" for h in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _name(scene: LivingScene, scan: int) -> str:
    return escape(scene.scans[scan].name)


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


# --- plans --------------------------------------------------------------------------------------------------


def rgb(number: int) -> tuple[int, int, int]:
    """A colour of its own for every object, 0 to 255: hues a golden angle apart."""
    r, g, b = colorsys.hls_to_rgb(number * 137.508 / 360 % 1, 0.5, 0.65)
    return round(255 * r), round(255 * g), round(255 * b)


def color(number: int) -> str:
    """The same for CSS."""
    return "#{:02x}{:02x}{:02x}".format(*rgb(number))


def _plans(scene: LivingScene) -> list[str]:
    """One plan a scan, all over the same ground, so that what moved is seen to have moved."""
    seen = {(k, s.scan): points_of(o, s) for k, o in enumerate(scene.objects) for s in o.observations}
    flat = np.concatenate([p[:, :2] for p in seen.values()])
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = max(float((high - low).max()), 1e-6)
    box = (low - MARGIN * size, high - low + 2 * MARGIN * size, size)
    return [_plan(scene, record, seen, box) for record in scene.scans]


def _plan(
    scene: LivingScene,
    record: ScanRecord,
    seen: dict[tuple[int, int], Points],
    box: tuple[np.ndarray, np.ndarray, float],
) -> str:
    (x, y), (width, height), size = box
    shapes: list[str] = []
    for k, o in enumerate(scene.objects):
        if (k, record.index) not in seen:
            continue
        plan = (seen[k, record.index][:, :2] - (x, y)) * (1, -1) + (0, height)  # y up, from the corner
        shapes.append(_cloud(plan, color(k), size, o.id))
        if (before := seen.get((k, record.index - 1))) is not None:
            was = (before[:, :2] - (x, y)) * (1, -1) + (0, height)
            shapes.append(_arrow(was.mean(axis=0), plan.mean(axis=0), size))
    caption = f"<b>{escape(record.name)}</b> {_count(len(record.instances), 'object')}"
    widths = f'font-size="{0.035 * size:.4f}" stroke-width="{0.006 * size:.4f}"'
    view = f'viewBox="0 0 {width:.3f} {height:.3f}" {widths}'
    return (
        f'<figure><svg {view} role="img">{"".join(shapes)}</svg><figcaption>{caption}</figcaption></figure>'
    )


def _cloud(plan: Float[np.ndarray, "n 2"], paint: str, size: float, name: str) -> str:
    shown = plan[:: max(1, -(-len(plan) // POINTS_SHOWN))]
    dots = "".join(f"M{u:.3f} {v:.3f}h0" for u, v in shown)
    u, v = plan.mean(axis=0)
    label = f'<text x="{u:.3f}" y="{v:.3f}">{escape(name.removeprefix("object_"))}</text>'
    return f'<path class="cloud" stroke="{paint}" stroke-width="{0.012 * size:.4f}" d="{dots}"/>{label}'


def _arrow(a: Float[np.ndarray, 2], b: Float[np.ndarray, 2], size: float) -> str:
    if np.linalg.norm(b - a) < 0.02 * size:
        return ""
    return f'<path class="arrow" marker-end="url(#head)" d="M{a[0]:.3f} {a[1]:.3f}L{b[0]:.3f} {b[1]:.3f}"/>'
