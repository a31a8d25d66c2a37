"""Plots, each as PNG and SVG: distributions of errors, whether probabilities hold, what every further scan adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from eval.harness.extra import library
from eval.scores.figures import Record, Row
from eval.scores.reliability import Bin

ENDINGS = ("png", "svg")


def pyplot() -> Any:
    """Matplotlib without a display. Raises ValueError if it is not installed."""
    matplotlib = library("matplotlib")
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "more2_jax"  # the same figure, the same file
    return library("matplotlib.pyplot")


def save(figure: Any, path: Path) -> list[Path]:
    """Writes both files, and closes the figure."""
    files = [path.with_suffix(f".{ending}") for ending in ENDINGS]
    for file in files:
        figure.savefig(
            file, bbox_inches="tight", dpi=120, metadata={"Date": None} if file.suffix == ".svg" else {}
        )
    pyplot().close(figure)
    return files


def draw_ecdf(
    path: Path, records: Sequence[Record], key: str, label: str, limit: float, by: str = "method"
) -> list[Path]:
    """Share of records with an error at or below each value; one line a value of `by`. Failures never arrive."""
    figure, axes = pyplot().subplots(figsize=(5, 3.6))
    for name in dict.fromkeys(str(r[by]) for r in records if key in r):
        own = np.array([r[key] for r in records if str(r[by]) == name and key in r], float)
        reached = own[
            own <= limit
        ]  # the rest failed (NaN) or lies beyond: censored there, and of the whole all the same
        cdf = stats.ecdf(stats.CensoredData(reached, right=np.full(len(own) - len(reached), limit))).cdf
        share = [0.0, *cdf.probabilities]
        axes.step([0, *cdf.quantiles, limit], [*share, share[-1]], where="post", label=f"{name} ({len(own)})")
    axes.set(xlabel=label, ylabel="share", xlim=(0, limit), ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return save(figure, path)


def draw_reliability(path: Path, curves: Mapping[str, Sequence[Bin]]) -> list[Path]:
    """Share that is true over the probability said, a line a curve, and below how many were said so."""
    figure, (axes, below) = pyplot().subplots(
        2, 1, figsize=(4.2, 5.2), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    axes.plot([0, 1], [0, 1], color="gray", linestyle=":", label="as said")
    for name, curve in curves.items():
        said, count = [b.said for b in curve], [b.count for b in curve]
        (line,) = axes.plot(said, [b.true for b in curve], marker="o", label=f"{name} ({sum(count)})")
        low, wide = [b.low for b in curve], [b.high - b.low for b in curve]
        below.bar(low, count, wide, align="edge", alpha=0.3, color=line.get_color())
    axes.set(ylabel="share that is true", xlim=(0, 1), ylim=(0, 1))
    below.set(xlabel="probability said", ylabel="pairs", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return save(figure, path)


def draw_over_scans(path: Path, rows: Sequence[Row], names: Mapping[str, str]) -> list[Path]:
    """One panel a figure (name → label) over the number of scans, with 95 % intervals; one line a method."""
    figure, panels = pyplot().subplots(1, len(names), figsize=(3.4 * len(names), 3), squeeze=False)
    for axes, (name, label) in zip(panels[0], names.items(), strict=True):
        for method in dict.fromkeys(r.method for r in rows):
            own = [r for r in rows if r.method == method and r.name == name and r.group.startswith("scans ")]
            own = sorted((r for r in own if r.value is not None), key=lambda r: int(r.group.split()[1]))
            if not own:
                continue
            x = [int(r.group.split()[1]) for r in own]
            axes.plot(x, [r.value for r in own], marker="o", label=method)
            low, high = np.array([r.ci95 or (r.value, r.value) for r in own], float).T
            axes.fill_between(x, low, high, alpha=0.15)
            axes.set_xticks(x)
        axes.set(xlabel="scans", ylabel=label)
        axes.grid(alpha=0.3)
    if panels[0][0].lines:
        panels[0][0].legend(fontsize=7)
    figure.tight_layout()
    return save(figure, path)
