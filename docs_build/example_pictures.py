"""Runs one example and draws what it found, from the names that it leaves: `python -m docs_build.example_pictures`."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

Names = dict[str, Any]
BEFORE, AFTER, FOUND = "#b0b7c3", "#2f6fb5", "#d9622b"
COLORS = plt.get_cmap("tab10").colors  # type: ignore[attr-defined]


def top_view(axes: Any, points: np.ndarray, color: Any, label: str | None = None, size: float = 1.0) -> None:
    """Points from above, in meters."""
    axes.scatter(points[:, 0], points[:, 1], s=size, color=color, label=label, linewidths=0)
    axes.set_aspect("equal")


def two_clouds(names: Names) -> Figure:
    """Before and after, and the first laid onto the second by the pose that was found."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
    before, after, T = names["before"], names["after"], names["T"]
    moved = before @ T[:3, :3].T + T[:3, 3]
    top_view(left, before, BEFORE, "before")
    top_view(left, after, AFTER, "after")
    top_view(right, after, AFTER, "after", 3)
    top_view(right, moved, FOUND, "before, by the pose found")
    for axes in (left, right):
        axes.legend(fontsize=7, markerscale=4)
        axes.margins(0.25)
        axes.set_xlabel("x, m")
    return figure


def rooms(names: Names) -> Figure:
    """Every scan from above, an object in one color wherever it was seen."""
    scans = [names["first"], *names["later"]] if "later" in names and "first" in names else names["scans"]
    scene = names["scene"]
    figure, row = plt.subplots(1, len(scans), figsize=(9, 3.4), layout="constrained")
    for number, (axes, scan) in enumerate(zip(row, scans, strict=True)):
        points = {i.id: i.points for i in scan.instances}
        for k, o in enumerate(scene.objects):
            for seen in o.observations:
                if seen.scan == number:
                    top_view(axes, points[seen.instance], COLORS[k % len(COLORS)], o.id)
        axes.set_title(f"scan {number}")
        axes.legend(fontsize=5, markerscale=4)
    return figure


def later_scan(names: Names) -> Figure:
    """The same of the scene with the scan that came later."""
    scans = [names[name] for name in ("monday", "friday", "next_week")]
    return rooms({"scans": scans, "scene": names["later"]})


def gradient_of_points(names: Names) -> Figure:
    """The cloud from above, colored by how much the loss depends on each point."""
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    cloud, gradient = np.asarray(names["cloud"]), np.asarray(names["gradient"])
    slope = np.linalg.norm(gradient, axis=1)
    used = (
        slope > 1e-6 * slope.max()
    )  # registration looks at some of the points, the encoder at their neighbors
    top_view(axes, cloud[~used], BEFORE, "no part in the loss", 8)
    shown = axes.scatter(*cloud[used, :2].T, c=np.log10(slope[used]), s=14, cmap="viridis")
    axes.legend(fontsize=7, loc="lower left")
    figure.colorbar(shown, label="log10 of the gradient at a point", shrink=0.7)
    return figure


def errors_of_pairs(names: Names) -> Figure:
    """Share of pairs with a rotation error at or below each value."""
    figure, axes = plt.subplots(figsize=(5, 3.2), layout="constrained")
    axes.ecdf(names["errors"], color=AFTER)
    axes.set(xscale="log", xlabel="rotation error, degrees", ylabel="share of the pairs", ylim=(0, 1))
    axes.grid(alpha=0.3)
    return figure


def mesh_of_one_view(names: Names) -> Figure:
    """What was seen, the mesh made of it, and the true surface, from the side."""
    figure, row = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained", sharey=True, sharex=True)
    shown = {"seen": (names["view"], AFTER), "mesh": (names["on_mesh"][::4], FOUND)}
    shown["true surface"] = (names["surface"][::2], BEFORE)
    for axes, (title, (points, color)) in zip(row, shown.items(), strict=True):
        top_view(axes, points[:, [0, 2]], color)
        axes.set_title(title)
    return figure


def errors_of_descriptor(names: Names) -> Figure:
    """Rotation errors of the right matches."""
    figure, axes = plt.subplots(figsize=(5, 2.6), layout="constrained")
    right = [pair for pair, good in zip(names["names"], names["right"], strict=True) if good]
    labels = [names["truth"].names[new.model] for new, _ in right]
    axes.barh(range(len(labels)), names["errors"], color=AFTER, tick_label=labels)
    axes.set_xlabel("rotation error, degrees")
    return figure


DRAWN: dict[str, Callable[[Names], Figure]] = {
    "01": two_clouds,
    "02": rooms,
    "03": gradient_of_points,
    "04": errors_of_pairs,
    "05": mesh_of_one_view,
    "06": later_scan,
    "07": errors_of_descriptor,
}


def main(path: Path, picture: Path) -> None:
    """Runs the example at `path` as a program and draws what it found."""
    names = runpy.run_path(str(path), run_name="__main__")
    figure = DRAWN[path.name[:2]](names)
    figure.savefig(picture, dpi=90, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
