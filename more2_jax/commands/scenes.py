"""`more2 demo | run | add | inspect | show | export`."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.markup import escape
from rich.table import Table

from more2_jax.commands.session import Session, keep_compiled_programs
from more2_jax.config import SceneConfig

if TYPE_CHECKING:
    from more2_jax.prior import Prior
    from more2_jax.types import LivingScene, Scan

Segment = Literal["geometric"] | None


def run_scans(
    paths: Sequence[Path],
    out: Path,
    config: SceneConfig,
    prior_name: str,
    *,
    unit: str = "m",
    instance_property: str | None = None,
    segment: Segment = None,
) -> LivingScene:
    """Builds and saves the living scene of scans in time order; bad input is refused before long work."""
    from more2_jax.io import check_output, save_scene
    from more2_jax.prior import load_prior
    from more2_jax.scene import add_scan, reconstruct, start_scene

    if not paths:
        raise ValueError("no scans; needed at least one")
    check_output(out)
    session = Session()
    session.log(f"settings: preset {config.preset}, prior {prior_name}, upright {config.upright}")
    scans = [_read(session, path, config, unit, instance_property, segment) for path in paths]
    keep_compiled_programs()
    prior = load_prior(prior_name)
    with session.stage(f"encoding {scans[0].name}"):
        scene = start_scene(prior, scans[0], config)
    for scan in scans[1:]:
        with session.stage(f"matching and registering {scan.name}"):
            scene = add_scan(prior, scene, scan, config)
    with session.stage("reconstructing"):
        scene = reconstruct(prior, scene, config)
    _tell(session, scene)
    save_scene(scene, out, config, log=session.text())
    session.say(f"wrote {out}; page: {out / 'report.html'}")
    return scene


def add(
    folder: Path,
    path: Path,
    prior_name: str | None,
    unit: str,
    instance_property: str | None,
    segment: Segment = None,
) -> None:
    """Adds one scan to a stored living scene; objects it does not show are left as they are."""
    from more2_jax.io import check_output, load_scene, save_scene
    from more2_jax.scene import add_scan, reconstruct

    scene, config = load_scene(folder)
    check_output(folder)
    session = Session()
    scan = _read(session, path, config, unit, instance_property, segment)
    keep_compiled_programs()
    prior = _same_prior(scene, prior_name)
    with session.stage(f"matching and registering {scan.name}"):
        scene = add_scan(prior, scene, scan, config)
    with session.stage("reconstructing"):
        scene = reconstruct(prior, scene, config)
    _tell(session, scene)
    save_scene(scene, folder, config, log=session.text())
    session.say(f"wrote {folder}; page: {folder / 'report.html'}")


def _same_prior(scene: LivingScene, name: str | None) -> Prior:
    """The prior the scene was made with: codes of another would mean nothing to it."""
    from more2_jax.prior import load_prior, shipped_priors

    if name is None and scene.prior not in shipped_priors():
        raise ValueError(
            f"the scene was made with prior {scene.prior!r}, which is not shipped; pass --prior PATH"
        )
    prior = load_prior(scene.prior if name is None else name)
    if prior.name != scene.prior:
        raise ValueError(f"prior {prior.name!r}; the scene was made with, and needs, {scene.prior!r}")
    return prior


def _read(
    session: Session,
    path: Path,
    config: SceneConfig,
    unit: str,
    instance_property: str | None,
    segment: Segment,
) -> Scan:
    from more2_jax.data.scans import read_scan

    scan = read_scan(
        path,
        instance_property=instance_property,
        unit=unit,
        min_points=config.min_points,
        segment=segment,
    )
    for warning in scan.warnings:
        session.warn(f"{scan.name}: {warning}")
    session.say(f"read {scan.source}: {len(scan.instances)} instances")
    for skipped in scan.skipped:
        session.say(f"  skipped {skipped.what}: {skipped.reason}")
    return scan


def _tell(session: Session, scene: LivingScene) -> None:
    session.show(objects_table(scene))
    for c in scene.changes:
        session.log(
            f"{c.from_scan} → {c.to_scan}: moved {list(c.moved)}, static {list(c.static)}, "
            f"added {list(c.added)}, removed {list(c.removed)}"
        )
    seconds = ", ".join(f"{stage} {s:.1f}" for stage, s in scene.timing_s.items())
    session.say(f"{len(scene.objects)} objects over {len(scene.scans)} scans; seconds: {seconds}")


def objects_table(scene: LivingScene) -> Table:
    """What became of every object between scans that follow each other."""
    from more2_jax.report import motion_text

    table = Table(title="Objects")
    pairs = [f"{scene.scans[c.from_scan].name} → {scene.scans[c.to_scan].name}" for c in scene.changes]
    for head in ("object", "label", *pairs, "score", "rms [mm]"):
        table.add_column(escape(head))
    for o in scene.objects:
        later = [seen for seen in o.observations if seen.scan != o.reference_scan]
        score = f"{min(seen.score for seen in later):.3f}" if later else "-"
        rms = f"{1000 * max(seen.rms_m for seen in later):.1f}" if later else "-"
        motions = [motion_text(o, c) for c in scene.changes]
        table.add_row(*(escape(cell) for cell in (o.id, o.label or "-", *motions, score, rms)))
    return table


def demo(out: Path, config: SceneConfig, prior_name: str) -> None:
    """The whole job on the bundled scans, held against their ground truth."""
    from more2_jax.data.demo import demo_scan_paths
    from more2_jax.demo import demo_table

    scene = run_scans(demo_scan_paths(), out, config, prior_name)
    table, summary = demo_table(scene)
    session = Session()
    session.show(table)
    session.say(summary)


def inspect(
    path: Path, unit: str, instance_property: str | None, min_points: int, segment: Segment = None
) -> None:
    """Prints what a scan holds."""
    from more2_jax.data.inspection import format_report, inspect_scan
    from more2_jax.data.scans import read_scan

    scan = read_scan(
        path, instance_property=instance_property, unit=unit, min_points=min_points, segment=segment
    )
    Session().say(format_report(inspect_scan(scan)))


def show(folder: Path, open_page: bool) -> None:
    """Prints where the page lies and, with a display, opens it."""
    from more2_jax.io import stored_at

    page = stored_at(folder) / "report.html"
    if not (page.parent / "scene.json").is_file() or not page.is_file():
        raise ValueError(f"{folder}: no living scene with a page; `more2 run` makes one")
    Session().say(str(page))
    if open_page and has_display():
        webbrowser.open(page.as_uri())


def has_display() -> bool:
    """Whether a browser could open a window here."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def export(folder: Path, format: str, out: Path | None, scan: int) -> None:
    """Writes a stored living scene as one file for other tools; beside its folder unless `out` says where."""
    from more2_jax.export import SUFFIXES, export_scene
    from more2_jax.io import load_scene

    scene, _ = load_scene(folder)
    whole = folder.resolve()
    target = whole.with_name(whole.name + SUFFIXES[format]) if out is None else out
    path = export_scene(scene, target, format, scan=scan)
    Session().say(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB, {len(scene.objects)} objects)")
