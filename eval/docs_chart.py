"""The charts of the README and of the results: ours beside peers, from what runs left in docs/figures.

`python -m eval.docs_figures` draws them along with the tables. Each picture holds the figures that it shows, so that a
test can tell an old one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from eval.harness.options import OURS

RUNS = {  # kept figures, and what the chart calls them
    "real_mix404": "mix",
    "real_cut606": "cut",
    "real_split606": "split",
    "real_dirty606": "dirty",
    "real_merged606": "merged",
    "fresh_real_mix": "fresh\nmix",
}
SHOWN = {"instance recall": "matched right (recall)", "MR": "matched and posed right (MR)"}
CHART = Path("pictures") / "peers.png"  # below docs/
REGISTRATION = ("sparse404_registration", "sparse505f_registration")
REGISTRATION_TITLES = ("upright", "any orientation")
REGISTRATION_CHART = Path("pictures") / "registration.png"
WITHIN = "RR, RE < 5°"  # strict
FIGURES_KEY = "Figures"  # of the PNG's texts
COLORS = {"ours": "#0b6fb8", "peer": "#b9c2cb"}

# Of a figure by run: ours, and the best of the others.
Bars = dict[str, list[tuple[float, float]]]
# Of a run: percent by method.
Shares = dict[str, dict[str, float]]


def kept_of(figures: Path, names: tuple[str, ...]) -> list[dict[str, Any]] | None:
    """The figures of runs; None where one is not kept."""
    paths = [figures / f"{name}.json" for name in names]
    if not all(path.is_file() for path in paths):
        return None
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


def bars_of(figures: Path) -> Bars | None:
    """What the chart of the README shows, in percent; None where a run is not kept."""
    kept = kept_of(figures, tuple(RUNS))
    if not kept:
        return None
    return {figure: [pair_of(run, figure) for run in kept] for figure in SHOWN}


def pair_of(kept: dict[str, Any], figure: str) -> tuple[float, float]:
    """Ours, and the best of the others, of one run."""
    every = [r for r in kept["rows"] if r.get("group", "all") == "all"]
    rows = [r for r in every if (r["name"], r["column"]) == (figure, "strict")]
    ours, others = (
        [r["value"] for r in rows if r["method"].startswith(OURS) is mine] for mine in (True, False)
    )
    return max(ours), max(others)


def shares_of(figures: Path) -> Shares | None:
    """What the chart of registration shows; None where a run is not kept."""
    kept = kept_of(figures, REGISTRATION)
    if not kept:
        return None
    return {
        title: {
            r["method"]: r["value"] for r in run["rows"] if (r["name"], r["column"]) == (WITHIN, "strict")
        }
        for title, run in zip(REGISTRATION_TITLES, kept, strict=True)
    }


def shown_in(picture: Path) -> Any:
    """The figures that a chart was drawn of."""
    from PIL import Image

    with Image.open(picture) as image:
        return json.loads(image.info[FIGURES_KEY])


def plain(shown: Any) -> Any:
    """As JSON gives them back."""
    return json.loads(json.dumps(shown))


def draw(docs: Path) -> None:
    """Draws each chart anew where all its runs are kept and the figures have changed."""
    for path, shown, paint in (
        (CHART, bars_of(docs / "figures"), paint_bars),
        (REGISTRATION_CHART, shares_of(docs / "figures"), paint_shares),
    ):
        if shown is not None and not ((docs / path).is_file() and shown_in(docs / path) == plain(shown)):
            paint_to(docs / path, shown, paint)


def paint_to(out: Path, shown: Any, paint: Callable[[Any, Any], None]) -> None:
    """Writes one picture: two panels side by side, and the figures themselves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 2.8), sharey=True, layout="constrained")
    paint(axes, shown)
    out.parent.mkdir(exist_ok=True)
    figure.savefig(out, dpi=110, metadata={FIGURES_KEY: json.dumps(shown)})
    plt.close(figure)


def paint_bars(axes: Any, bars: Bars) -> None:
    """A panel a figure: two bars a run, each with its value."""
    for ax, (name, title) in zip(axes, SHOWN.items(), strict=True):
        pairs = bars[name]
        for k, (who, label) in enumerate((("ours", "more2_jax, robust"), ("peer", "all-pairs GICP"))):
            at = [x + 0.4 * (k - 0.5) for x in range(len(pairs))]
            drawn = ax.bar(at, [pair[k] for pair in pairs], width=0.38, color=COLORS[who], label=label)
            ax.bar_label(drawn, fmt="%.0f", fontsize=8)
        ax.set_title(title, fontsize=10)
        ax.set_xticks(range(len(pairs)), list(RUNS.values()))
        ax.set_ylim(0, 110)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("%")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)


def paint_shares(axes: Any, shares: Shares) -> None:
    """A panel a run: a bar a method, ours in color; a method that a run lacks has none."""
    methods = list(dict.fromkeys(m for run in shares.values() for m in run))[::-1]
    for ax, (title, run) in zip(axes, shares.items(), strict=True):
        there = [k for k, m in enumerate(methods) if m in run]
        colors = [COLORS["ours" if methods[k].startswith(OURS) else "peer"] for k in there]
        drawn = ax.barh(there, [run[methods[k]] for k in there], color=colors)
        ax.bar_label(drawn, fmt="%.0f", fontsize=7, padding=2)
        ax.set_title(f"registered to within 5° [%], {title}", fontsize=10)
        ax.set_yticks(range(len(methods)), methods, fontsize=8)
        ax.set_xlim(0, 110)
        ax.spines[["top", "right"]].set_visible(False)
