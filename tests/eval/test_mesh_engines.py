"""How far two meshes lie apart, of bodies where it is known; seconds are per mesh."""

import numpy as np
import pytest
import trimesh

from eval.mesh_engines import Compared, distances_cm, printed, seconds_a_mesh
from eval.performance.stopwatch import Seconds
from more2_jax.types import Mesh

PLACE = np.array([1000.0, -2000.0, 5.0])


def ball(radius):
    body = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Mesh(vertices=np.asarray(body.vertices) + PLACE, faces=np.asarray(body.faces))


def test_balls_of_other_radii_are_as_far_apart_as_these_say():
    same, apart = distances_cm(ball(0.5), ball(0.5)), distances_cm(ball(0.5), ball(0.51))
    assert max(same) < 0.01
    assert apart[0] == pytest.approx(1.0, abs=0.02) and apart[1] == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(distances_cm(ball(0.51), ball(0.5)), apart, atol=0.02)


def test_seconds_are_of_the_processor_and_of_one_mesh():
    taken = {"host": Seconds(9.0, 4.0), "device": Seconds(9.0, 8.0), "work": Seconds(9.0, 0.4)}
    found = seconds_a_mesh(taken, 4)
    assert found == {"host_s": 1.0, "device_s": 2.0, "device_host_work_s": 0.1}
    row = Compared(
        scans="one",
        objects=4,
        **found,
        apart_cm=0.1,
        worst_percent_cm=0.5,
        volume_differs=0.01,
        triangles=1.0,
        watertight=4,
    )
    assert printed([row]).row_count == 1
