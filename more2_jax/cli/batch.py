"""`more2 batch`: many scenes, each as `more2 run --resume` builds it, by processes that hold weights and programs."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from more2_jax.cli.living_scenes import run_scans
from more2_jax.cli.manifest import RottenRow, SceneJob, read_manifest
from more2_jax.cli.options import Reporting
from more2_jax.cli.session import Session, keep_compiled_programs
from more2_jax.cli.tables import write_table
from more2_jax.whole_file import check_writable
from more2_jax.workers.dealing import Handler, Team, work_through
from more2_jax.workers.largest_first import largest_first
from more2_jax.workers.local import LocalTeam
from more2_jax.workers.ray_cluster import RayTeam
from more2_jax.workers.time_limit import limit_of

RESULTS = "results"  # beside the scenes
COLUMNS: dict[str, type] = {
    "row": int,
    "name": str,
    "status": str,
    "error": str,
    "scans": int,
    "objects": int,
    "moved": int,
    "added": int,
    "removed": int,
    "not_seen": int,
    "discovered": int,
    "seconds": float,  # of all stages, as the scene keeps them
    "out": str,
}
COUNTED = ("moved", "added", "removed", "not_seen", "discovered")  # of all changes between following scans
DAMAGE = (OSError, ValueError, KeyError, TypeError)


def run_batch(
    manifest: Path,
    out: Path,
    *,
    workers: int | None = None,
    ray: str | None = None,
    scene_minutes: float | None = None,
    quiet: bool = False,
) -> int:
    """Builds the scenes that are not finished; returns 1 if any row failed, else 0.

    A row that fails says so in one line on standard error and costs no other. `workers`: processes, one by default;
    with `ray`, actors: by default as many as the cluster at that address has room for. A process that takes longer
    than `scene_minutes` for a scene is ended, and the scene tried once more. The largest scenes begin first. Raises
    ValueError if the manifest cannot be read.
    """
    limit_s = limit_of(scene_minutes)
    if workers is not None and workers < 1:
        raise ValueError(f"--workers {workers}; needed 1 or more")
    rows = read_manifest(manifest, out)
    check_writable(out / RESULTS)
    out.mkdir(parents=True, exist_ok=True)
    results = Results(session=Session(Reporting(quiet=quiet)), count=len(rows))
    todo = unfinished(rows, results)
    try:
        for outcome in work_through(todo, team_of(workers, ray, len(todo), limit_s)) if todo else ():
            if outcome.answer.error:
                results.failed(outcome.task, outcome.answer.error)
            else:
                results.finished(outcome.task, "done")
    finally:
        path = write_table(out / RESULTS, COLUMNS, [results.rows[k] for k in sorted(results.rows)])
    return results.summed_up(path)


def unfinished(rows: Sequence[SceneJob | RottenRow], results: Results) -> list[SceneJob]:
    """The scenes that are left to build, the largest first; what the other rows came to is noted."""
    todo: list[SceneJob] = []
    for row in rows:
        if isinstance(row, RottenRow):
            results.failed(row, row.error)
        elif is_finished(row):
            results.finished(row, "kept")
        else:
            todo.append(row)
    return largest_first(todo, lambda job: job.scans)


@dataclass
class Results:
    """What became of the rows so far; says it as it comes."""

    session: Session
    count: int  # rows there are
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)

    def failed(self, row: SceneJob | RottenRow, error: str) -> None:
        """A row that came to nothing: one line on standard error."""
        self.rows[row.row] = {"row": row.row, "name": row.name, "status": "failed", "error": error}
        if isinstance(row, SceneJob):
            self.rows[row.row]["out"] = str(row.out)
        print(f"error: row {row.row} ({row.name}): {error}", file=sys.stderr, flush=True)

    def finished(self, row: SceneJob, status: str) -> None:
        """A row whose scene is there, as its folder tells."""
        about = facts(row.out)
        head = {"row": row.row, "name": row.name, "status": status, "out": str(row.out)}
        self.rows[row.row] = head | about
        if status == "done":
            text = f"{about['objects']} objects, {about['seconds']:.1f} s; {len(self.rows)} of {self.count}"
            self.session.say(f"row {row.row} ({row.name}): {text}")

    def summed_up(self, path: Path) -> int:
        """Says how many rows came to what; the exit code."""
        done, kept, failed = (
            sum(r["status"] == s for r in self.rows.values()) for s in ("done", "kept", "failed")
        )
        self.session.say(f"{done} scenes done, {kept} were finished before, {failed} failed; {path}")
        return 1 if failed else 0


def team_of(workers: int | None, ray: str | None, tasks: int, limit_s: float | None) -> Team:
    """Local processes, or actors of a cluster; no more than there are tasks. `limit_s`: seconds a task may take."""
    maker = SceneMaker()
    if ray is not None:
        return RayTeam(maker, ray, min(workers or tasks, tasks), limit_s)
    return LocalTeam(maker, min(workers or 1, tasks), limit_s)


@dataclass(frozen=True, kw_only=True)
class SceneMaker:
    """Made in every worker: weights, once read, and compiled programs stay there over scenes."""

    def __call__(self) -> Handler:
        """Builds the scene of a job; raises ValueError where `more2 run` does."""
        keep_compiled_programs()
        from more2_jax.network.prior import load_prior

        load = functools.lru_cache(maxsize=2)(load_prior)
        return functools.partial(build, load=load)


def build(job: SceneJob, load: Callable[[str], Any]) -> None:
    """As `more2 run --resume` does; what it says goes to the scene's run.log alone.

    A worker that was killed may have finished the scene before.
    """
    if is_finished(job):
        return
    run_scans(
        job.scans,
        job.out,
        job.settings(),
        job.prior,
        reading=job.reading,
        masks=job.masks,
        resume=True,
        session=Session(silent=True),
        load=load,
    )


def is_finished(job: SceneJob) -> bool:
    """Whether the folder holds this very scene: its scans, settings and weights, and a mesh of every object.

    A scene of which some object could not be meshed is tried again: that costs no more than that object.
    """
    from more2_jax.network.prior import prior_name
    from more2_jax.storage.scene_folder import stored_at
    from more2_jax.storage.stored_settings import read_settings

    at = stored_at(job.out)
    try:
        content = json.loads((at / "scene.json").read_text(encoding="utf-8"))
        return (
            [s["source"] for s in content["scans"]] == [str(p) for p in job.scans]
            and all(o["mesh"] is not None for o in content["objects"])
            and content["prior"] == prior_name(job.prior)
            and read_settings(at / "config.yaml") == job.settings()
        )
    except DAMAGE:  # building it says what is wrong
        return False


def facts(folder: Path) -> dict[str, Any]:
    """What the results say of a stored scene."""
    from more2_jax.storage.scene_folder import stored_at

    content = json.loads((stored_at(folder) / "scene.json").read_text(encoding="utf-8"))
    return {
        "scans": len(content["scans"]),
        "objects": len(content["objects"]),
        "seconds": float(sum(content["timing_s"].values())),
        **{kind: sum(len(c.get(kind, ())) for c in content["changes"]) for kind in COUNTED},
    }
