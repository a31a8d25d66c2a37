"""Another function in the encoder's place: a hand-made descriptor instead of Φ.

You learn: stages take `Embedding` records and do not care who made them. Needed are an invariant code `inv`, columns
`eqv` that turn with the object, a `scale` and a `center`. Here they come from the principal axes of the cloud: no
network, no weights. `register` still takes a prior: among poses that fit about as well it asks the decoder, which knows
only its own encoder's records; a `field_weight` of 0 leaves that out.
"""

import dataclasses

import jax
import numpy as np

import more2_jax as m2
from more2_jax.cli.demo_score import pose_error
from more2_jax.config import CodeMatcher, SurfaceSearch
from more2_jax.scans.demo import demo_ground_truth, demo_scan_paths

prior = m2.load_prior("small")
CHANNELS = prior.config.encoder.code  # as wide as the decoder of the prior expects


def own_embedding(points: np.ndarray, origin: np.ndarray) -> m2.Embedding:
    """Principal axes as `eqv`, their lengths and a histogram of radii as `inv`; points (n, 3) in meters."""
    center = points.mean(axis=0)
    centered = points - center
    variance, axes = np.linalg.eigh(np.cov(centered.T))
    # Axes have no direction of their own: they point to the side where the points reach farther.
    axes = axes * np.sign(((centered @ axes) ** 3).sum(axis=0))
    axes[:, 2] *= np.linalg.det(axes)
    radius = np.linalg.norm(centered, axis=1)
    histogram = np.histogram(radius / radius.max(), bins=16, range=(0, 1), density=True)[0] / 4
    inv, eqv = np.zeros(CHANNELS, np.float32), np.zeros((3, CHANNELS), np.float32)
    inv[:19] = np.concatenate([3 * np.sqrt(variance / variance.sum()), histogram])
    eqv[:, :3] = axes * np.sqrt(variance)
    return m2.Embedding(
        inv=inv,
        eqv=eqv,
        scale=np.float32(radius.max()),
        center=(center - origin).astype(np.float32),
        origin=origin,
    )


def embed_all(scan: m2.Scan) -> tuple[m2.PointCloud, m2.Embedding]:
    """The padded clouds of a scan and one own embedding each, as batches."""
    cloud = m2.pad_clouds([i.points for i in scan.instances], 2048)
    rows = [own_embedding(i.points, o) for i, o in zip(scan.instances, np.asarray(cloud.origin), strict=True)]
    return cloud, jax.tree.map(lambda *x: np.stack(x), *rows)


old_scan, new_scan = (m2.read_scan(path) for path in demo_scan_paths()[:2])
(old, old_codes), (new, new_codes) = embed_all(old_scan), embed_all(new_scan)
config = m2.preset("robust", upright=True)
size = -np.abs(
    np.log(new_codes.scale[:, None] / old_codes.scale)
)  # evidence beside the codes: things keep theirs
matches = m2.match_instances(new_codes, old_codes, CodeMatcher(score="inv"), bonus=size)
partner = np.asarray(matches.target_index)

truth = demo_ground_truth()
pairs = [(n, o) for n, o in enumerate(partner) if o >= 0]
names = [(truth.at(0, old_scan.instances[o].id), truth.at(1, new_scan.instances[n].id)) for n, o in pairs]
right = [a.model == b.model for a, b in names]
print(f"matched by the own descriptor alone: {sum(right)} of 6 right, {len(right) - sum(right)} wrong")

rows_new, rows_old = (np.array(side) for side in zip(*pairs, strict=True))
registration = dataclasses.replace(config.registration, search=SurfaceSearch(field_weight=0.0))
batch = m2.pair_up(m2.batch_of(new, new_codes).take(rows_new), m2.batch_of(old, old_codes).take(rows_old))
found = m2.register(prior, batch, registration, "upright")
T_old_new = batch.to_world(found.T_target_source)
errors = []
for k in range(len(pairs)):
    if right[k]:
        errors.append(pose_error(*names[k], T_old_new[k], truth)[0])
        print(f"{truth.names[names[k][0].model]}: rotation error {errors[-1]:.1f}°")
print(f"median rotation error of right matches: {np.median(errors):.1f}°")
