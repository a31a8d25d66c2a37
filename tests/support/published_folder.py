"""A scene as the published evaluation of FlyingShape reads it."""

import numpy as np
from known_scenes import known_scene

SCENE = known_scene(points=128)


def write_published(folder, scene=SCENE, rows=3):
    """As the published evaluation reads them: the same row of every file is the same object."""
    folder.mkdir(parents=True)
    for k, scan in enumerate(scene.scans):
        np.savez(
            folder / f"{k:05d}.npz",
            pc=np.stack([i.points for i in scan.instances]).astype(np.float32),
            transform=np.stack([o.T_scan_model[k][:rows] for o in scene.objects]),
            class_id=np.array(["03001627"] * len(scene.objects)),
            obj_id=np.array([o.copies for o in scene.objects]),
        )
