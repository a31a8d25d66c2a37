"""Where did the chair go? Two partial clouds of one object, and the pose that takes one onto the other.

You learn: `observe` pads and encodes clouds, `pair_up` makes pairs of them, `register` finds their poses, and
`to_world` turns those into 4×4 poses between the scans' own frames.
"""

import numpy as np
from scipy.spatial.transform import Rotation

import more2_jax as m2
from more2_jax.geometry.poses import apply_pose, rotation_error_deg
from more2_jax.scans.demo import demo_scan_paths

rng = np.random.default_rng(0)
scan = m2.read_scan(demo_scan_paths()[0])
chair = next(i for i in scan.instances if i.id == 5).points  # meters, (n, 3)

# The chair is scanned twice: different points, 2 mm of noise, and a turn by 70° and a shift in between.
order = rng.permutation(len(chair))
before, after_unmoved = chair[order[::2]], chair[order[1::2]]
T_after_before = np.eye(4)
T_after_before[:3, :3] = Rotation.from_euler("z", 70, degrees=True).as_matrix()
T_after_before[:3, 3] = [1.5, -0.4, 0.0]
after = apply_pose(T_after_before, after_unmoved) + rng.normal(scale=0.002, size=after_unmoved.shape)

prior = m2.load_prior("small")
method = m2.preset("robust", upright=True).registration
pairs = m2.pair_up(m2.observe(prior, [before]), m2.observe(prior, [after]))  # one pair: source, target
found = m2.register(prior, pairs, method, "upright")
T = pairs.to_world(found.T_target_source)[0]

center = before.mean(axis=0, keepdims=True)
off = float(np.linalg.norm(apply_pose(T, center) - apply_pose(T_after_before, center)))
print(np.round(T, 3))
print(f"rotation error: {rotation_error_deg(T[:3, :3], T_after_before[:3, :3]):.2f}°")
print(f"position error: {100 * off:.2f} cm")
print(f"residual: {1000 * float(found.rms_m[0]):.1f} mm, converged: {bool(found.converged[0])}")
