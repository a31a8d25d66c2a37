"""A scan comes in a week later: the stored scene is loaded, the scan added, nothing redone.

You learn: `save_scene` and `load_scene` keep everything needed, and `add_scan` only registers the new scan.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

import more2_jax as m2
from more2_jax.scans.demo import demo_scan_paths

prior, config = m2.load_prior("small"), m2.preset("robust", upright=True)
monday, friday, next_week = (m2.read_scan(path) for path in demo_scan_paths())

with tempfile.TemporaryDirectory() as folder:
    room = Path(folder) / "room"
    scene = m2.add_scan(prior, m2.start_scene(prior, monday, config), friday, config)
    m2.save_scene(scene, room, config)
    print(f"stored: {len(scene.scans)} scans, {len(scene.objects)} objects")
    stored, config = m2.load_scene(room)

begin = time.perf_counter()
later = m2.add_scan(prior, stored, next_week, config)
print(f"added: {later.scans[-1].name} in {time.perf_counter() - begin:.1f} s, {len(later.objects)} objects")
again = sum(o.observations[-1].scan == 2 for o in later.objects)
print(f"found again: {again} of {len(next_week.instances)} instances")
kept = all(
    np.array_equal(old.T_ref_scan, new.T_ref_scan)
    for o, p in zip(scene.objects, later.objects, strict=False)
    for old, new in zip(o.observations, p.observations, strict=False)
)
print(f"earlier poses unchanged: {'yes' if kept else 'no'}")
