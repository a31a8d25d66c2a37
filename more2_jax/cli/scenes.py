"""`more2 inspect | show | export`."""

from __future__ import annotations

import dataclasses
import os
import sys
import webbrowser
from pathlib import Path

from more2_jax.cli.options import Reading
from more2_jax.cli.server import address_of, scene_server, serve_until_interrupted
from more2_jax.cli.session import Session


def inspect(path: Path, reading: Reading, masks: Path | None, min_points: int) -> None:
    """Prints what a scan holds."""
    from more2_jax.scans.inspection import format_report, inspect_scan
    from more2_jax.scans.read_scan import read_scan

    scan = read_scan(path, min_points=min_points, masks=masks, **dataclasses.asdict(reading))
    Session().say(format_report(inspect_scan(scan)))


def show(folder: Path, open_page: bool, serve: bool = False, port: int = 0) -> None:
    """Prints where the page lies and, with a display, opens it; or serves it to this machine until ctrl-C."""
    page = _page_of(folder)
    server = scene_server(page.parent, port) if serve else None
    address = page.as_uri() if server is None else address_of(server)
    Session().say(str(page) if server is None else f"{address} (ctrl-C ends)")
    if open_page and has_display():
        webbrowser.open(address)
    if server is not None:
        serve_until_interrupted(server)


def _page_of(folder: Path) -> Path:
    """The page of a stored living scene; made where the scene was saved without one, from Python."""
    from more2_jax.storage.scene_folder import PAGE, load_scene, stored_at

    page = stored_at(folder) / PAGE
    if not (page.parent / "scene.json").is_file():
        raise ValueError(f"{folder}: no living scene with a page; `more2 run` makes one")
    if not page.is_file():
        from more2_jax.report import write_report

        scene, config = load_scene(folder)
        write_report(scene, page, config)
    return page


def has_display() -> bool:
    """Whether a browser could open a window here."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def export(folder: Path, format: str, out: Path | None, scan: int) -> None:
    """Writes a stored living scene as one file for other tools; beside its folder unless `out` says where."""
    from more2_jax.export import SUFFIXES, export_scene
    from more2_jax.storage.scene_folder import load_scene

    scene, _ = load_scene(folder)
    whole = folder.resolve()
    target = whole.with_name(whole.name + SUFFIXES[format]) if out is None else out
    path = export_scene(scene, target, format, scan=scan)
    Session().say(f"wrote {path} ({path.stat().st_size / 1e6:.2f} MB, {len(scene.objects)} objects)")
