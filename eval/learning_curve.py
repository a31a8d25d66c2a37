"""How a prior's scores rise with the clouds it has seen, and at how many its targets lie if they go on like that.

`python -m eval.learning_curve --clouds 51200 89600 --scores runs/at_51200 runs/at_89600 --out runs/curve`

`scores` are folders that `eval.prior_scores` wrote for weights of one training at different times.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from eval.harness.plots import pyplot, save
from train.run.program import run

# What `small` is meant to reach with clouds of three views and of one.
TARGETS: dict[str, dict[str, float]] = {
    "near-surface sign": {"3 views": 0.93, "1 views": 0.88},
    "IoU": {"3 views": 0.55, "1 views": 0.40},
    "Kabsch, RE < 10°": {"3 views": 0.60, "1 views": 0.35},
    "instance recall": {"3 views": 0.85, "1 views": 0.75},
}

LEAST_GAIN = 1e-3  # a doubling; a score that rises less does not rise


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One score over the clouds seen, and the line through it over their logarithm."""

    name: str
    views: str
    clouds: tuple[int, ...]
    scores: tuple[float, ...]
    target: float
    gain: float  # a doubling
    needed: float | None  # clouds at the target; None if the score does not rise


def main(clouds: tuple[int, ...], scores: tuple[Path, ...], out: Path) -> None:
    """Draws the curves and says what they extrapolate to.

    Args:
        clouds: seen by each of the weights.
        scores: folders with results.json, in the same order.
        out: folder for curve.png, curve.svg and curve.json.
    """
    curves = read_curves(clouds, [json.loads(results_of(folder).read_text()) for folder in scores])
    out.mkdir(parents=True, exist_ok=True)
    (out / "curve.json").write_text(json.dumps([asdict(c) for c in curves], indent=1))
    draw(out / "curve", curves)
    Console().print(table(curves))


def results_of(folder: Path) -> Path:
    """The file of scores. Raises ValueError if there is none."""
    path = folder / "results.json"
    if not path.is_file():
        raise ValueError(f"{folder}: no results.json; needed a folder that eval.prior_scores wrote")
    return path


def read_curves(clouds: Sequence[int], results: Sequence[dict]) -> list[Curve]:
    """A curve for every target that all results have a score for.

    Raises ValueError unless there is one result for each of at least two different numbers of clouds.
    """
    if len(clouds) != len(results) or len(set(clouds)) < 2 or min(clouds) < 1:
        raise ValueError(
            f"got {len(results)} scores for clouds {tuple(clouds)}; needed as many, of two or more different"
        )
    found = []
    for name, by_views in TARGETS.items():
        for views, target in by_views.items():
            if all(views in r for r in results):
                values = [float(r[views][name]["value"]) for r in results]
                found.append(fitted(name, views, clouds, values, target))
    return found


def fitted(name: str, views: str, clouds: Sequence[int], values: Sequence[float], target: float) -> Curve:
    """Least squares over log2 of the clouds. Scores are bounded and rises slow down, so this is the hopeful side."""
    gain, zero = np.polyfit(np.log2(clouds), values, 1)
    needed = float(2 ** ((target - zero) / gain)) if gain > LEAST_GAIN else None
    return Curve(
        name=name,
        views=views,
        clouds=tuple(clouds),
        scores=tuple(values),
        target=target,
        gain=float(gain),
        needed=needed,
    )


def draw(path: Path, curves: Sequence[Curve]) -> list[Path]:
    """A panel a score; dashed: the target."""
    names = list(dict.fromkeys(c.name for c in curves))
    figure, panels = pyplot().subplots(1, len(names), figsize=(3.2 * len(names), 2.8), squeeze=False)
    for axes, name in zip(panels[0], names, strict=True):
        for k, curve in enumerate(c for c in curves if c.name == name):
            order = np.argsort(curve.clouds)
            x, y = np.array(curve.clouds)[order], np.array(curve.scores)[order]
            axes.plot(x, y, marker="o", color=f"C{k}", label=curve.views.replace("1 views", "1 view"))
            axes.axhline(curve.target, color=f"C{k}", linestyle="--", linewidth=0.8)
        axes.set(title=name, xlabel="clouds seen", xscale="log", ylim=(0, 1))
        axes.grid(alpha=0.3)
    panels[0][0].legend(fontsize=7)
    figure.tight_layout()
    return save(figure, path)


def table(curves: Sequence[Curve]) -> Table:
    """A row a curve."""
    shown = Table("score", "views", "last", "target", "a doubling adds", "target at, if it goes on")
    for c in curves:
        last = c.scores[int(np.argmax(c.clouds))]
        when = "reached" if last >= c.target else "never" if c.needed is None else f"{c.needed:.1e} clouds"
        shown.add_row(c.name, c.views[0], f"{last:.3f}", f"{c.target:.2f}", f"{c.gain:+.3f}", when)
    return shown


if __name__ == "__main__":
    run(main)
