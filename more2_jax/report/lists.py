"""The parts of the page that are read: objects, changes, what was left out, seconds a stage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from more2_jax.progress import STAGES
from more2_jax.report.wording import STATES, repair_text
from more2_jax.types import LivingScene, ScanRecord

WORDS = {
    "moved": "moved",
    "added": "added",
    "removed": "removed",
    "static": "stayed",
    "not_seen": "not seen",
    "discovered": "discovered",
}


def object_list(objects: Sequence[Mapping[str, Any]], verdicts: Sequence[Mapping[str, Any]]) -> str:
    """An item with a button for every object; `controls.js` puts new verdicts into the same places."""
    return "".join(_object_item(o, v) for o, v in zip(objects, verdicts, strict=True))


def _object_item(o: Mapping[str, Any], v: Mapping[str, Any]) -> str:
    hidden = "" if v["doubts"] else " hidden"
    return (
        f'<li><button type="button" class="object {v["status"]}" data-id="{escape(o["id"])}" aria-pressed="false">'
        f'<span class="swatch" style="background:{o["color"]};color:{o["ink"]}" aria-hidden="true">{o["number"]}</span>'
        f'<span class="first"><span class="name">{escape(o["name"])}</span>'
        f'<span class="status {v["status"]}">{escape(v["text"])}</span>'
        f'<span class="doubt" title="{escape("; ".join(v["doubts"]))}"{hidden}>unsure</span></span>'
        f'<span class="facts">{escape(_facts(o))}</span></button></li>'
    )


def _facts(o: Mapping[str, Any]) -> str:
    """`match 0.62 · 13,500 points · 81 % seen`; the match is the lowest over all scans."""
    scores = [seen["score"] for seen in o["observations"] if seen["score"] is not None]
    points = sum(seen["points"] for seen in o["observations"])
    return " · ".join(
        [
            f"match {min(scores):.2f}" if scores else "in one scan only",
            f"{points:,} point{'' if points == 1 else 's'}",
            "no surface" if o["coverage"] is None else f"{100 * o['coverage']:.0f} % seen",
        ]
    )


def status_counts(verdicts: Iterable[Mapping[str, Any]]) -> str:
    """How many objects of each status, as a list's items."""
    verdicts = list(verdicts)
    counts = Counter(v["status"] for v in verdicts)
    items = [f"<li>{counts[s]} {WORDS[s]}</li>" for s in STATES if counts[s]]
    if unsure := sum(bool(v["doubts"]) for v in verdicts):
        items.append(f'<li class="unsure">{unsure} unsure</li>')
    return "".join(items)


def changes_list(scene: LivingScene, data: Mapping[str, Any]) -> str:
    """One item a pair of scans that follow each other: its sentence, and who did what."""
    if not scene.changes:
        return "<p>One scan only: nothing to compare.</p>"
    items = []
    for c in scene.changes:
        pair = data["pairs"][f"{c.from_scan}-{c.to_scan}"]
        who = "".join(
            f"<li>{escape(o['name'])}: {escape(v['text'])}</li>"
            for o, v in zip(data["objects"], pair["verdicts"], strict=True)
            if v["status"] in ("moved", "added", "removed", "not_seen", "discovered")
        )
        items.append(f"<li>{escape(pair['headline'])}{f'<ul>{who}</ul>' if who else ''}</li>")
    return f'<ol class="steps">{"".join(items)}</ol>'


def skipped_table(scans: Sequence[ScanRecord]) -> str:
    """What was in the scans but is no object, and why."""
    rows = [[escape(s.name), escape(k.what), escape(k.reason)] for s in scans for k in s.skipped]
    return _table(("scan", "what", "why"), rows) if rows else "<p>Nothing was left out.</p>"


def repairs_list(scans: Sequence[ScanRecord]) -> str:
    """Masks that were mended: which, why, how surely."""
    items = [f"<li>{escape(repair_text(s, r))}</li>" for s in scans for r in s.repairs]
    return f"<ul>{''.join(items)}</ul>" if items else "<p>Masks are as they were given.</p>"


def timing_table(timing_s: Mapping[str, float]) -> str:
    """Seconds a stage as bars, and their sum; stages in the order they ran."""
    longest = max([*timing_s.values(), 1e-9])
    rows = [
        [
            escape(STAGES[stage].title if stage in STAGES else stage),
            f'<span class="meter" style="width:{100 * seconds / longest:.1f}%"></span>',
            f"{seconds:.1f} s",
        ]
        for stage, seconds in timing_s.items()
    ]
    rows.append(["All", "", f"{sum(timing_s.values()):.1f} s"])
    return _table(("stage", "share", "seconds"), rows, "bars")


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    top = "".join(f'<th scope="col">{h}</th>' for h in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
