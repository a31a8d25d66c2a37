"""The chart of the README: ours beside the best peer of the same run, from what runs left in docs/figures.

`python -m eval.docs_figures` draws it along with the tables. The picture holds the figures that it shows, so that a
test can tell an old one.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

OURS = "ours"  # methods whose names begin so
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
FIGURES_KEY = "Figures"  # of the PNG's texts
COLORS = {"ours": "#0b6fb8", "peer": "#b9c2cb"}

# Of a figure by run: ours, and the best of the others.
Bars = dict[str, list[tuple[float, float]]]


def bars_of(figures: Path) -> Bars | None:
    """What the chart shows, in percent; None where a run is not kept."""
    paths = [figures / f"{name}.json" for name in RUNS]
    if not all(path.is_file() for path in paths):
        return None
    kept = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    return {figure: [pair_of(run, figure) for run in kept] for figure in SHOWN}


def pair_of(kept: dict[str, Any], figure: str) -> tuple[float, float]:
    """Ours, and the best of the others, of one run."""
    rows = [r for r in kept["rows"] if (r["name"], r["column"]) == (figure, "strict")]
    ours, others = (
        [r["value"] for r in rows if r["method"].startswith(OURS) is mine] for mine in (True, False)
    )
    return max(ours), max(others)


def shown_in(picture: Path) -> Bars:
    """The figures that a chart was drawn of."""
    from PIL import Image

    with Image.open(picture) as image:
        return json.loads(image.info[FIGURES_KEY])


def plain(bars: Bars) -> Any:
    """As JSON gives them back."""
    return json.loads(json.dumps(bars))


def draw(docs: Path) -> None:
    """Draws the chart anew where all its runs are kept and the figures have changed."""
    bars, out = bars_of(docs / "figures"), docs / CHART
    if bars is None or (out.is_file() and shown_in(out) == plain(bars)):
        return
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(SHOWN), figsize=(9, 2.8), sharey=True, layout="constrained")
    for ax, (name, title) in zip(axes, SHOWN.items(), strict=True):
        panel(ax, bars[name], title)
    axes[0].set_ylabel("%")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    out.parent.mkdir(exist_ok=True)
    figure.savefig(out, dpi=110, metadata={FIGURES_KEY: json.dumps(bars)})
    plt.close(figure)


def panel(ax: Any, pairs: list[tuple[float, float]], title: str) -> None:
    """Two bars a run, each with its value."""
    for k, (who, label) in enumerate((("ours", "more2_jax, robust"), ("peer", "all-pairs GICP"))):
        drawn = ax.bar(
            [x + 0.4 * (k - 0.5) for x in range(len(pairs))],
            [pair[k] for pair in pairs],
            width=0.38,
            color=COLORS[who],
            label=label,
        )
        ax.bar_label(drawn, fmt="%.0f", fontsize=8)
    ax.set_title(title, fontsize=10)
    ax.set_xticks(range(len(pairs)), list(RUNS.values()))
    ax.set_ylim(0, 110)
    ax.spines[["top", "right"]].set_visible(False)
