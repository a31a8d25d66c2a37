"""`more2 demo | run | add`: living scenes built, saved after every scan, gone on with after an interruption."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from more2_jax.cli.options import Reading, Reporting
from more2_jax.cli.session import Session, keep_compiled_programs
from more2_jax.config import SceneConfig
from more2_jax.freed_memory import LARGE

if TYPE_CHECKING:
    from more2_jax.network.prior import Prior
    from more2_jax.types import LivingScene, Scan


def run_scans(
    paths: Sequence[Path],
    out: Path,
    config: SceneConfig,
    prior_name: str,
    *,
    reading: Reading | None = None,
    masks: Sequence[Path] = (),
    resume: bool = False,
    reporting: Reporting | None = None,
    session: Session | None = None,
    load: Callable[[str], Prior] | None = None,
) -> LivingScene:
    """Builds and saves the living scene of scans in time order; bad input is refused before long work.

    The folder is saved after every scan, meshes at the end: an interruption leaves the scans so far, and with
    `resume` the same call goes on from there. `masks` are none, or one a scan in the same order. `session` says things
    in place of one by `reporting`; `load` finds weights in place of `load_prior`.
    """
    from more2_jax.network.prior import load_prior
    from more2_jax.storage.scene_folder import check_output
    from more2_jax.storage.scene_lock import scene_lock

    reading, reporting = reading or Reading(), reporting or Reporting()
    if not paths:
        raise ValueError("no scans; needed at least one")
    if len(masks) not in (0, len(paths)):
        raise ValueError(
            f"{len(masks)} masks for {len(paths)} scans; needed none, or one a scan in the same order"
        )
    check_output(out)
    _check_log(reporting, out)
    with scene_lock(out), session or Session(reporting) as session:
        turns = "as the first scan shows" if config.upright is None else config.upright
        session.log(f"settings: preset {config.preset}, prior {prior_name}, upright {turns}")
        scans = read_all(session, paths, config, reading, masks or [None] * len(paths))
        keep_compiled_programs()
        prior = (load or load_prior)(prior_name)
        begun = _begun(session, out, scans, config, prior) if resume else None
        return _build(session, prior, scans, out, config, begun)


def _build(
    session: Session,
    prior: Prior,
    scans: list[Scan],
    out: Path,
    config: SceneConfig,
    scene: LivingScene | None,
) -> LivingScene:
    """Adds the scans `scene` lacks, saves after each, reconstructs and saves. What stops it says what is kept."""
    from more2_jax.scene import add_scan, start_scene

    kept, count = 0 if scene is None else len(scene.scans), len(scans)
    session.steps = (1 if kept == 0 else 0) + _stages_of_add(config) * (count - max(kept, 1)) + 2
    del scans[:kept]
    try:
        while scans:
            if scene is None:
                scene = start_scene(prior, scans[0], config, progress=session.watch)
                _say_how_objects_move(session, scene, scans[0], config)
            else:
                scene = add_scan(prior, scene, scans[0], config, progress=session.watch)
            del scans[0]  # none stays in memory once it is added
            _say_done(session, scene)
            _store(session, scene, out, config)
            kept += 1
        if scene is None:
            raise ValueError("no scans; needed at least one")
        return _finished(session, prior, scene, out, config)
    except (KeyboardInterrupt, OSError) as error:
        how = f"{kept} of {count} scans are kept in {out}; the same command with --resume goes on"
        if isinstance(error, OSError):
            raise type(error)(f"{reason_of(error)}; {how if kept else f'{out} is as it was'}") from error
        if not kept:
            raise
        raise KeyboardInterrupt(how) from error


def _say_how_objects_move(session: Session, scene: LivingScene, scan: Scan, config: SceneConfig) -> None:
    """Where the settings left it to the first scan."""
    import numpy as np

    from more2_jax.geometry.up_axis import likely_up_axis
    from more2_jax.report import upright_text

    if config.upright is None:
        points = np.concatenate([scan.background, *(i.points for i in scan.instances)])
        session.say(upright_text(scan.name, scene.upright, likely_up_axis(points)[0]))


def reason_of(error: OSError) -> str:
    """What the operating system refused, and where."""
    return str(error) if error.strerror is None else f"{error.filename or 'writing'}: {error.strerror}"


def _say_done(session: Session, scene: LivingScene) -> None:
    """By how much the last scan was leveled, if it was, how it lies, how noisy it is, and which masks were mended."""
    from more2_jax.report import frame_text, leveled_text, noise_text, repair_text

    last = scene.scans[-1]
    for told in (leveled_text, frame_text, noise_text):
        if text := told(scene, last):
            session.say(text)
    for repair in last.repairs:
        session.say(repair_text(last, repair))


def _stages_of_add(config: SceneConfig) -> int:
    """Encode, match, register, and encoding again where clouds are accumulated."""
    return 4 if config.accumulate_target else 3


def _begun(
    session: Session, out: Path, scans: Sequence[Scan], config: SceneConfig, prior: Prior
) -> LivingScene | None:
    """The stored scene, if it is the beginning of what is asked for; None if nothing is stored yet."""
    from more2_jax.scene import usable
    from more2_jax.storage.scene_folder import load_scene, stored_at

    if not (stored_at(out) / "scene.json").is_file():
        session.say(f"nothing is stored in {out} yet; begins with {scans[0].name}")
        return None
    scene, stored_config = load_scene(out)
    if stored_config != config:
        raise ValueError(f"{out}: made with other settings; --resume needs the same")
    if scene.prior != prior.name:
        raise ValueError(f"{out}: made with prior {scene.prior!r}; --resume needs it, got {prior.name!r}")
    if len(scene.scans) > len(scans):
        raise ValueError(
            f"{out}: holds {len(scene.scans)} scans; --resume needs as many or more, got {len(scans)}"
        )
    for record, scan in zip(scene.scans, scans, strict=False):
        ids = tuple(i.id for i in usable(scan, config)[0])
        if (record.name, record.source, record.instances) != (scan.name, scan.source, ids):
            raise ValueError(
                f"{out}: scan {record.index} is {record.source} ({len(record.instances)} instances); --resume "
                f"needs it there, got {scan.source} ({len(ids)} instances)"
            )
    session.say(f"goes on from {out}: {len(scene.scans)} of {len(scans)} scans are there")
    return scene


def _check_log(reporting: Reporting, folder: Path) -> None:
    path = reporting.log_json
    if path is not None and path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(
            f"{path}: inside the living scene, which is replaced as a whole; needed another folder"
        )


def add(
    folder: Path,
    path: Path,
    prior_name: str | None,
    *,
    reading: Reading,
    masks: Path | None,
    reporting: Reporting,
) -> None:
    """Adds one scan to a stored living scene; objects it does not show are left as they are."""
    from more2_jax.storage.scene_folder import check_output, load_scene, stored_at
    from more2_jax.storage.scene_lock import scene_lock

    if not stored_at(folder).is_dir():
        load_scene(folder)  # which says so, before a lock is laid beside what is not there
    check_output(folder)
    _check_log(reporting, folder)
    with scene_lock(folder):
        scene, config = load_scene(folder)
        try:
            _add(folder, scene, config, path, prior_name, reading, masks, reporting)
        except OSError as error:
            raise type(error)(f"{reason_of(error)}; {folder} is as it was") from error


def _add(
    folder: Path,
    scene: LivingScene,
    config: SceneConfig,
    path: Path,
    prior_name: str | None,
    reading: Reading,
    masks: Path | None,
    reporting: Reporting,
) -> None:
    from more2_jax.scene import add_scan

    with Session(reporting, steps=_stages_of_add(config) + 2) as session:
        earlier = [_last_source(folder, scene)] if reading.segment == "changes" else []
        (scan,) = read_all(session, [path], config, reading, [masks], earlier)
        keep_compiled_programs()
        prior = _same_prior(scene, prior_name)
        scene = add_scan(prior, scene, scan, config, progress=session.watch)
        _say_done(session, scene)
        _finished(session, prior, scene, folder, config)


def _finished(
    session: Session, prior: Prior, scene: LivingScene, folder: Path, config: SceneConfig
) -> LivingScene:
    """The scene with its meshes, said and saved. In a large scene they wait in files, and can be read until then."""
    from more2_jax.scene import reconstruct
    from more2_jax.storage.waiting_meshes import WaitingMeshes

    with WaitingMeshes.beside(folder) if len(scene.objects) > LARGE else nullcontext() as keep:
        scene = reconstruct(prior, scene, config, progress=session.watch, keep=keep)
        tell(session, scene)
        _save(session, scene, folder, config)
    return scene


def _save(session: Session, scene: LivingScene, folder: Path, config: SceneConfig) -> None:
    from more2_jax.storage.scene_folder import PAGE

    _store(session, scene, folder, config)
    session.say(f"wrote {folder}; page: {folder / PAGE}")


def _store(session: Session, scene: LivingScene, folder: Path, config: SceneConfig) -> None:
    """Writes the folder and its page together: what is cut short leaves both as they were."""
    from more2_jax.report import report_details, report_html
    from more2_jax.storage.scene_folder import save_scene

    page, details = report_html(scene, config), report_details(scene)
    save_scene(scene, folder, config, log=session.unsaved(), page=page, details=details)


def _same_prior(scene: LivingScene, name: str | None) -> Prior:
    """The prior the scene was made with: codes of another would mean nothing to it."""
    from more2_jax.network.prior import load_prior, shipped_priors

    if name is None and scene.prior not in shipped_priors():
        raise ValueError(
            f"the scene was made with prior {scene.prior!r}, which is not shipped; pass --prior PATH"
        )
    prior = load_prior(scene.prior if name is None else name)
    if prior.name != scene.prior:
        raise ValueError(f"prior {prior.name!r}; the scene was made with, and needs, {scene.prior!r}")
    return prior


def _last_source(folder: Path, scene: LivingScene) -> Path:
    """The file of a stored scene's last scan: what a new one is compared with."""
    source = Path(scene.scans[-1].source)
    if not source.exists():
        raise ValueError(
            f"{folder}: its last scan was read from {source}, where nothing is now; --segment changes needs it to"
            " compare with (--segment geometric does not)"
        )
    return source


def read_all(
    session: Session,
    paths: Sequence[Path],
    config: SceneConfig,
    reading: Reading,
    masks: Sequence[Path | None],
    earlier: Sequence[Path] = (),
) -> list[Scan]:
    """Reads scans and says what they hold; with `--segment changes` together, and with `earlier` ones of the room."""
    if reading.segment != "changes":
        return [read(session, path, config, reading, mask) for path, mask in zip(paths, masks, strict=True)]
    from more2_jax.scans.read_changed_scans import read_changed_scans

    options = dataclasses.asdict(reading)
    del options["segment"]
    scans = read_changed_scans(paths, earlier=earlier, masks=masks, min_points=config.min_points, **options)
    for scan in scans:
        _say_read(session, scan)
    return list(scans)


def read(session: Session, path: Path, config: SceneConfig, reading: Reading, masks: Path | None) -> Scan:
    """Reads one scan and says what it holds and what was left out."""
    from more2_jax.scans.read_scan import read_scan

    scan = read_scan(path, min_points=config.min_points, masks=masks, **dataclasses.asdict(reading))
    _say_read(session, scan)
    return scan


def _say_read(session: Session, scan: Scan) -> None:
    for warning in scan.warnings:
        session.warn(f"{scan.name}: {warning}")
    session.say(f"read {scan.source}: {len(scan.instances)} instances")
    for skipped in scan.skipped:
        session.say(f"  skipped {skipped.what}: {skipped.reason}")


def tell(session: Session, scene: LivingScene) -> None:
    """Prints what became of the objects; logs the changes."""
    session.show(objects_table(scene))
    for c in scene.changes:
        session.log(
            f"{c.from_scan} → {c.to_scan}: moved {list(c.moved)}, static {list(c.static)}, "
            f"added {list(c.added)}, removed {list(c.removed)}"
            + (f", not seen {list(c.not_seen)}" if c.not_seen else "")
            + (f", discovered {list(c.discovered)}" if c.discovered else "")
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


def demo(
    out: Path,
    config: SceneConfig,
    prior_name: str,
    *,
    resume: bool = False,
    reporting: Reporting | None = None,
) -> None:
    """The whole job on the bundled scans, held against their ground truth."""
    from more2_jax.cli.demo_score import demo_table
    from more2_jax.scans.demo import demo_scan_paths

    scene = run_scans(demo_scan_paths(), out, config, prior_name, resume=resume, reporting=reporting)
    table, summary = demo_table(scene)
    session = Session(Reporting(quiet=reporting is not None and reporting.quiet))
    session.show(table)
    session.say(summary)
