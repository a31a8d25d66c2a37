"""What folders of shards hold, checked anew: `python -m train.tools.census --shards data/real data/procedural`.

Finds near-duplicates across splits over all folders and writes `excluded.json` into each, which every loader
respects; checks that every solid is closed and that signs agree with winding numbers; prints the census.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import point_cloud_utils as pcu
import trimesh

from more2_jax.whole_file import whole_file
from train.furniture.near_duplicates import THRESHOLD, Twin, twins_across_splits
from train.run.program import run
from train.shards.shards import EXCLUDED, read_meta, read_solids, shard_folders


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What was measured on the shapes themselves."""

    shapes: int
    closed: int
    sign_queries: int
    sign_agreement: float  # share of random points
    coverage: float  # mean share of the visible surface that the depth views see
    least_coverage: float


def main(shards: tuple[Path, ...], out: Path | None = None, threshold: float = THRESHOLD) -> None:
    """Counts, checks, and leaves out near-duplicates.

    Args:
        shards: folders that `train.prepare` wrote.
        out: Markdown file for the census; it is printed anyway.
        threshold: of near-duplicates, mean difference of signed distances in canonical units.
    """
    folders = [(folder, shard) for folder in shards for shard in shard_folders(folder)]
    meta = [(folder, row) for folder, shard in folders for row in read_meta(shard)]
    if not meta:
        raise ValueError(f"{', '.join(map(str, shards))}: no shapes; needed some")
    prints = np.concatenate([np.load(s / "fingerprint.npy") for _, s in folders if read_meta(s)])
    twins = twins_across_splits(
        [m["name"] for _, m in meta], [m["split"] for _, m in meta], prints, threshold
    )
    names = {t.name for t in twins}
    for folder in shards:
        own = [t for t in twins if any(f == folder and m["name"] == t.name for f, m in meta)]
        write_excluded(folder, own, threshold)
    checks = check_shapes([shard for _, shard in folders], [m for _, m in meta])
    kept = [m for _, m in meta if m["name"] not in names]
    rejected = Counter(reason for folder in shards for reason in reasons(folder))
    text = census(kept, twins, checks, rejected, threshold)
    print(text)
    if out is not None:
        out.write_text(text + "\n")


def write_excluded(folder: Path, twins: Sequence[Twin], threshold: float) -> None:
    """Names what no split of the folder may use; atomically."""
    content = {"threshold": threshold, "names": [t.name for t in twins], "twins": [asdict(t) for t in twins]}
    with whole_file(folder / EXCLUDED) as partial:
        partial.write_text(json.dumps(content, indent=1))


def check_shapes(shards: Iterable[Path], meta: Sequence[dict[str, Any]], points: int = 500) -> Checks:
    """Closedness of every solid, and signs of `points` random queries a shape against winding numbers."""
    closed = agreed = queries = 0
    for shard in shards:
        for k, solid in enumerate(read_solids(shard)):
            mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
            closed += bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)
            stored = np.load(shard / "sdf_uniform.npy", mmap_mode="r")[k, :points].astype(np.float64)
            winding = pcu.triangle_soup_fast_winding_number(
                np.ascontiguousarray(solid.vertices),
                np.ascontiguousarray(solid.faces, np.int32),
                np.ascontiguousarray(stored[:, :3]),
            )
            agreed += int(((winding > 0.5) == (stored[:, 3] < 0)).sum())
            queries += len(stored)
    seen = [m["coverage"] for m in meta]
    return Checks(
        shapes=len(meta),
        closed=closed,
        sign_queries=queries,
        sign_agreement=agreed / max(1, queries),
        coverage=float(np.mean(seen)),
        least_coverage=float(np.min(seen)),
    )


def reasons(folder: Path) -> list[str]:
    """Why meshes were left out of a folder, numbers taken out so that like reasons count together."""
    report = json.loads((folder / "report.json").read_text())
    given = [*report["rejected"].values(), *report.get("unreadable", {}).values()]
    return [
        re.sub(r"[\d.]+", "…", reason.split(";")[0].split("(")[0].split(":")[0]).strip() for reason in given
    ]


def census(
    kept: Sequence[dict[str, Any]],
    twins: Sequence[Twin],
    checks: Checks,
    rejected: Counter[str],
    threshold: float,
) -> str:
    """The census in Markdown."""
    lines = ["# Census of the training data", "", "Written by `python -m train.tools.census`.", ""]
    lines += ["| source | license | method | train | val | test |", "|---|---|---|---|---|---|"]
    groups = Counter(
        (m["source"], m.get("license", m.get("licence", "")).split(";")[0][:60], m["method"], m["split"])
        for m in kept
    )
    for source, license, method in sorted({g[:3] for g in groups}):
        counts = [groups[source, license, method, s] for s in ("train", "val", "test")]
        lines.append(f"| {source} | {license} | {method} | {' | '.join(map(str, counts))} |")
    total = Counter(m["split"] for m in kept)
    lines.append(f"| all | | | {total['train']} | {total['val']} | {total['test']} |")
    lines += ["", "| category | train | val | test |", "|---|---|---|---|"]
    by_category = Counter((m["category"].lower(), m["split"]) for m in kept)
    for category in sorted({c for c, _ in by_category}):
        counts = [by_category[category, s] for s in ("train", "val", "test")]
        lines.append(f"| {category} | {' | '.join(map(str, counts))} |")
    lines += ["", "| left out because | meshes |", "|---|---|"]
    lines += [f"| {reason} | {count} |" for reason, count in rejected.most_common()]
    pairs = Counter((t.split, t.of_split) for t in twins)
    lines += [
        f"| {a} shape nearly the same as a {b} shape (below {threshold}) | {n} |"
        for (a, b), n in pairs.items()
    ]
    lines += [
        "",
        f"Closed solids: {checks.closed} of {checks.shapes}. Signs that agree with winding numbers: "
        f"{100 * checks.sign_agreement:.3f} % of {checks.sign_queries} random points. Visible surface that the "
        f"24 views see: {100 * checks.coverage:.1f} % on average, {100 * checks.least_coverage:.0f} % at least.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    run(main)
