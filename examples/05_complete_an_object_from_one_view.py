"""What the far side of a chair may look like: a mesh from one view.

You learn: `encode` one cloud, ask the field for its level on the seen points, `extract_mesh`, and measure the result
against the truth. The shipped weights give a closed hull, but no good far side: measured here, the unseen surface lies
about as far from the mesh as from the points that were seen. Better weights change the numbers, not the calls.
"""

import jax
import numpy as np
import trimesh

import more2_jax as m2
from more2_jax.geometry.poses import apply_pose
from more2_jax.meshing.extract import observed_level
from more2_jax.metrics import accuracy
from more2_jax.scans.demo import demo_ground_truth, demo_scan_paths

truth = demo_ground_truth()
chair = truth.at(0, 5)
surface = apply_pose(chair.T_scan_model, truth.surfaces[chair.model])  # true points of all sides, meters
seen = next(i for i in m2.read_scan(demo_scan_paths()[0]).instances if i.id == chair.instance).points
view = seen[seen[:, 0] > np.median(seen[:, 0])]  # only the half toward +x

prior = m2.load_prior("small")
code = jax.tree.map(lambda x: np.asarray(x)[0], m2.encode(prior, m2.pad_clouds([view])))
config = m2.preset("robust").meshing
mesh = m2.extract_mesh(
    prior, code, config, half_width=0.9, level=observed_level(prior, code, view), seen=view
)
if mesh is None:
    raise SystemExit("the field has no surface at this level")

hull = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
on_mesh = np.asarray(trimesh.sample.sample_surface(hull, 20_000, seed=0)[0])
unseen = surface[surface[:, 0] < np.median(seen[:, 0])]
print(f"seen: {len(view)} of {len(seen)} points; mesh: {len(mesh.faces)} faces, closed: {hull.is_watertight}")
by_view, by_mesh = accuracy(unseen, view), accuracy(unseen, on_mesh)
print(f"unseen surface to the nearest seen point: {100 * by_view:.1f} cm on average")
print(f"unseen surface to the mesh: {100 * by_mesh:.1f} cm on average")
print(f"the mesh tells {'more' if by_mesh < by_view else 'no more'} of the far side than the points do")
print(f"mesh to the true surface: {100 * accuracy(on_mesh, surface):.1f} cm on average")
