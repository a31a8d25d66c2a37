"""How heavy the page is: file size, first paint and time a frame for a large room, in a real browser.

So is the page of a building of 1,000 objects, which has finer shapes beside it.

`python -m eval.page_speed --out runs/page_speed`; needs Chromium on the PATH. Without a graphics card Chromium draws
in software, which is the case measured.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from rich.console import Console

from eval.harness.results import cost, write_rows
from eval.harness.tables import on_screen
from eval.scores.figures import Row
from more2_jax.config import SceneConfig
from more2_jax.network.prior import encode_ordered, load_prior, points_read
from more2_jax.report import write_report
from more2_jax.report.details import DETAILS
from more2_jax.types import Changes, Embedding, LivingScene, Mesh, Observation, ScanRecord, SceneObject
from train.run.program import run

SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES = 15
LOADS = 3
DRAG_STEPS = 200
GLIDE_MS = 1000  # a glide and its end
SPACING_M = 1.5
PAINT = "performance.getEntriesByName('first-contentful-paint').map(e => e.startTime)[0] ?? null"


def main(
    out: Path,
    objects: int = 60,
    points: int = 500_000,
    many: int = 1000,
    many_points: int = 8_000_000,
    scans: int = 3,
    width: int = 1280,
    height: int = 720,
) -> None:
    """Writes the pages of a made-up room and of a made-up building, and measures them.

    Args:
        out: folder for results.json and for one folder a page.
        objects: in the room, each seen in every scan.
        points: of all objects of the room together.
        many: objects of the building, whose page has details beside it; 0 leaves it out.
        many_points: of all objects of the building together.
        scans: visits.
        width: of the window, pixels.
        height: of the window, pixels.
    """
    sizes = {"room": (objects, points)} | ({"building": (many, many_points)} if many else {})
    rows = [
        row
        for name, (count, total) in sizes.items()
        for row in rows_of(out / name, room(count, total // count, scans), total, (width, height))
    ]
    stated = {"objects": objects, "points": points, "many": many, "many_points": many_points, "scans": scans}
    write_rows(out, rows, program="page_speed", **stated)
    Console().print(on_screen(rows, "The page"))


def rows_of(folder: Path, scene: LivingScene, points: int, window: tuple[int, int]) -> list[Row]:
    """Writes the page of a scene with so many points into the folder, and measures it."""
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "report.html"
    write_report(scene, page, SceneConfig())
    beside = list((folder / DETAILS).glob("*"))
    file = cost("file", f"{len(scene.objects):,} objects, {points:,} points", megabytes([page]), "MB")
    details = [replace(file, name="files beside it", value=megabytes(beside))] if beside else []
    return [file, *details, *(replace(file, **figure) for figure in measured(page, *window))]


def megabytes(files: Sequence[Path]) -> float:
    """Size of all files."""
    return sum(p.stat().st_size for p in files) / 1e6


def room(objects: int, points: int, scans: int) -> LivingScene:
    """Objects in a grid; every other one moves 0.4 m between scans."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(objects)))
    embedding = some_embedding()
    made = []
    for k in range(objects):
        place = np.array([k % side, k // side, 0.0]) * SPACING_M
        solid = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
        shape = np.array(solid.vertices) * rng.uniform(0.5, 1.3, 3)
        cloud = shape[rng.integers(0, len(shape), points)] + rng.normal(0, 0.005, (points, 3)) + place
        seen = tuple(observation(s, k, -0.4 * s * (k % 2)) for s in range(scans))
        made.append(
            SceneObject(
                id=f"object_{k + 1:03d}",
                label=f"thing {k}",
                reference_scan=0,
                observations=seen,
                points=cloud,
                point_scan=np.sort(rng.integers(0, scans, points)),
                embedding=embedding,
                mesh=Mesh(vertices=shape + place, faces=np.array(solid.faces, np.int32)),
            )
        )
    return LivingScene(
        preset="robust",
        prior="small",
        upright=True,
        scans=tuple(
            ScanRecord(index=s, name=f"visit {s}", source="made up", instances=tuple(range(objects)))
            for s in range(scans)
        ),
        objects=tuple(made),
        changes=tuple(changes(s, made) for s in range(scans - 1)),
    )


def changes(scan: int, objects: list[SceneObject]) -> Changes:
    """What happened after visit `scan`."""
    names = [o.id for o in objects]
    return Changes(from_scan=scan, to_scan=scan + 1, moved=tuple(names[1::2]), static=tuple(names[::2]))


def observation(scan: int, instance: int, shift: float) -> Observation:
    """Seen `shift` meters along x from where the reference scan saw it."""
    T = np.eye(4)
    T[0, 3] = shift
    return Observation(scan=scan, instance=instance, T_ref_scan=T, score=0.9, rms_m=0.01, converged=True)


def some_embedding() -> Embedding:
    """An embedding of the right shapes; the page does not show it."""
    prior = load_prior("small")
    count = points_read(prior.config)
    points = jax.random.normal(jax.random.key(0), (count, 3))
    return jax.tree.map(np.asarray, encode_ordered(prior, points, jnp.ones(count, bool)))


def measured(path: Path, width: int, height: int) -> list[dict[str, Any]]:
    """First paint, drawn in full, and milliseconds a frame: all of it at rest; while the mouse drags; while objects
    glide. Name, unit and value of each."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise ValueError("no Chromium on the PATH; needed to open the page (`apt-get install chromium`)")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=SOFTWARE_GL)
        loads = [load_times(browser, path, width, height) for _ in range(LOADS)]
        page = opened(browser, path, width, height)
        page.screenshot(path=str(path.with_suffix(".png")))
        found = [
            {"name": name, "unit": "s", "value": float(np.median(times)) / 1000}
            for name, times in zip(("first paint", "drawn in full"), zip(*loads, strict=True), strict=True)
        ]
        found += pace("with all of it", page, turn, lambda level: level == 0)
        found += pace("while the mouse drags", page, drag, lambda level: level > 0)
        found += pace("while objects glide", page, glide, lambda level: level > 0)
        if page.evaluate("Boolean(window.more2.details)"):
            found.append({"name": "fine once selected", "unit": "s", "value": seconds_until_fine(page)})
        browser.close()
    return found


def opened(browser: Any, path: Path, width: int, height: int) -> Any:
    """A fresh page, its 3D view drawn in full."""
    page = browser.new_page(viewport={"width": width, "height": height}, bypass_csp=True)
    page.goto(path.resolve().as_uri())
    page.wait_for_function("window.more2?.ready && window.more2.settled", timeout=120_000)
    return page


def load_times(browser: Any, path: Path, width: int, height: int) -> tuple[float, float]:
    """First contentful paint and the time until the 3D view is drawn in full, both in milliseconds."""
    page = opened(browser, path, width, height)
    times = page.evaluate(PAINT), page.evaluate("performance.now()")
    page.close()
    return times


def seconds_until_fine(page: Any) -> float:
    """From the choice of an object until its detail is read and drawn; the median of some objects."""
    times = []
    for k in range(LOADS):
        began = page.evaluate(f"more2.select(scene.objects[{k}].id) ?? performance.now()")
        fine = f"more2.details.held.has(stage.builds[{k}]) && !more2.details.reading && more2.settled"
        page.wait_for_function(fine, timeout=120_000)
        times.append(page.evaluate("stage.pace.frames.at(-1)[0]") - began)
    return float(np.median(times)) / 1000


def turn(page: Any) -> None:
    """Turns the view step by step, all of it drawn at every step."""
    page.evaluate(f"window.more2.measure({FRAMES}, 0)")


def drag(page: Any) -> None:
    """Turns the view with the mouse, without a pause, for some seconds."""
    box = page.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for k in range(DRAG_STEPS):
        page.mouse.move(x + 200 * np.sin(k / 20), y + 60 * np.sin(k / 33))
    page.mouse.up()


def glide(page: Any) -> None:
    """Steps through the scans as the slider does; objects glide from place to place."""
    for time in (0, 1, 2, 1, 2):
        page.evaluate(f"window.more2.setTime({time})")
        page.wait_for_timeout(GLIDE_MS)


def pace(
    name: str, page: Any, act: Callable[[Any], None], counts: Callable[[int], bool]
) -> list[dict[str, Any]]:
    """Milliseconds of the frames drawn meanwhile, if their level of quality `counts`, under names of their own.

    The browser's processor time a frame does not depend on what else the machine does; it holds what the browser
    needs to put the frame on the screen, and the one full picture at the end.
    """
    page.evaluate("window.more2.paceLog().length = 0")
    before = processor_ms()
    act(page)
    page.wait_for_function("window.more2.settled", timeout=120_000)
    used = processor_ms() - before
    frames = page.evaluate("window.more2.paceLog()")
    times = [took for _, took, level in frames if counts(level)]
    found = {
        f"a frame {name}": float(np.median(times)),
        f"a frame {name}, 95 % below": float(np.percentile(times, 95)),
        f"a frame {name}, processor": used / len(frames),
    }
    return [{"name": k, "unit": "ms", "value": v, "count": len(times)} for k, v in found.items()]


def processor_ms() -> float:
    """Processor time of the browser so far: all its processes, all cores."""
    import psutil

    return 1000 * sum(sum(p.cpu_times()[:2]) for p in psutil.Process().children(recursive=True))


if __name__ == "__main__":
    run(main)
