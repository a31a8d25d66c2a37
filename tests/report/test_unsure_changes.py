"""What a scan cannot tell is written as not seen or discovered, not as removed or added."""

import dataclasses

from factories import living_scene
from report_html_parser import Page

from more2_jax.config import SceneConfig
from more2_jax.report import motion_text, report_html

SCENE, CONFIG = living_scene(), SceneConfig()


def test_what_was_not_seen_is_told_so_and_not_as_removed():
    changes = [dataclasses.replace(c, removed=(), not_seen=c.removed) for c in SCENE.changes]
    gone = tuple(o for c in changes for o in c.not_seen)
    scans = [dataclasses.replace(s, not_seen=gone) for s in SCENE.scans[1:]]
    scene = dataclasses.replace(SCENE, changes=tuple(changes), scans=(SCENE.scans[0], *scans))
    page = Page(report_html(scene, CONFIG))
    assert (
        "not seen: the scan did not look where it stood, or shows it without a mask"
        in page.buttons["object_002"]
    )
    assert "1 was not seen" in report_html(scene, CONFIG) and "was removed" not in report_html(scene, CONFIG)
    told = {motion_text(scene.objects[2], c) for c in changes}
    assert "not seen" in told and "removed" not in told


def test_what_was_found_where_no_scan_had_looked_is_told_so_and_not_as_added():
    changes = [dataclasses.replace(c, added=(), discovered=c.added) for c in SCENE.changes]
    new = {o: c.to_scan for c in changes for o in c.discovered}
    scans = [
        dataclasses.replace(s, not_seen=tuple(o for o, k in new.items() if s.index < k)) for s in SCENE.scans
    ]
    text = report_html(dataclasses.replace(SCENE, changes=tuple(changes), scans=tuple(scans)), CONFIG)
    assert new and "discovered: no scan had looked here, or one shows it without a mask" in text
    assert "discovered" in text and "was added" not in text and "were added" not in text
