"""Padded clouds of two scans to poses, field values and surface values: the pipeline as one pure function."""

from functools import partial

import jax
import numpy as np

import more2_jax as m2
from more2_jax.config import (
    DescentRegistration,
    MeshingConfig,
    RegistrationMethod,
    SurfaceRegistration,
    SurfaceSearch,
    preset,
)
from more2_jax.meshing.device.values import observed_object, surface_values

DESCENT = DescentRegistration(points=32, sdf_points=32, steps=2, icp_steps=2)
SEARCH = SurfaceSearch(turns=4, keep=2, points=32, dense=64, cells=8, steps=3)
SURFACE = SurfaceRegistration(
    search=SEARCH, points=32, steps=2, field_points=32, polish_points=32, polish_steps=1
)
QUERIES = np.random.default_rng(1).uniform(-0.4, 0.4, (20, 3)).astype(np.float32)


def little(name="robust") -> MeshingConfig:
    """A preset's meshes in few cells."""
    settings = preset(name, upright=True).meshing
    return MeshingConfig(**vars(settings) | {"coarse_resolution": 8, "field_resolution": 8, "resolution": 16})


def poses_and_values(prior, scans, mask, method: RegistrationMethod, queries=QUERIES) -> dict[str, jax.Array]:
    """Of objects (b, n, 3) in two scans: how the second moves onto the first, and both fields of the second.

    Queries are the same for all.
    """
    clouds = [m2.PointCloud(points=points, mask=mask) for points in scans]
    first, second = (m2.batch_of(cloud, m2.encode(prior, cloud)) for cloud in clouds)
    found = m2.register(prior, m2.pair_up(second, first), method)
    values = partial(surface_values, prior, config=little())
    rows = jax.vmap(observed_object)(second.code, scans[1], mask)
    asked = np.broadcast_to(queries, (len(mask), *queries.shape))
    return {
        "pose": found.T_target_source.wxyz_xyz,
        "sdf": m2.sdf(prior, second.code, asked),
        "surface": jax.vmap(lambda o: values(o=o))(rows),
    }
