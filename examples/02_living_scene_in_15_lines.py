"""A whole living scene from the three bundled scans: which object is which, where each moved, what came and went.

You learn: the three calls of the method (`start_scene`, `add_scan`, `reconstruct`) and what a scene holds.
"""

import more2_jax as m2
from more2_jax.scans.demo import demo_scan_paths

prior, config = m2.load_prior("small"), m2.preset("robust", upright=True)
first, *later = [m2.read_scan(path) for path in demo_scan_paths()]
scene = m2.start_scene(prior, first, config)
for scan in later:
    scene = m2.add_scan(prior, scene, scan, config)
scene = m2.reconstruct(prior, scene, config)
for o in scene.objects:
    where = ", ".join(f"scan {seen.scan} as instance {seen.instance}" for seen in o.observations)
    print(f"{o.id}: {where}; mesh of {0 if o.mesh is None else len(o.mesh.faces)} faces")
for c in scene.changes:
    print(f"scan {c.from_scan} to {c.to_scan}: {len(c.moved)} moved, {len(c.static)} static", end=", ")
    print(f"added {', '.join(c.added) or 'none'}, removed {', '.join(c.removed) or 'none'}")
