"""What lived-in rooms are made of: all furniture, and as many training pieces as are asked for, the same every time."""

import numpy as np
import pytest
import trimesh

from train.furniture.closed_models import read_models
from train.furniture.collections import SourceMesh, write_packed
from train.rooms.things_on_furniture import is_small
from train.tools.lived_in_models import FURNITURE, PIECES, SMALL, main


def box(name: str, longest_m: float) -> SourceMesh:
    mesh = trimesh.creation.box((longest_m, longest_m / 2, longest_m / 3))
    vertices = np.asarray(mesh.vertices) - mesh.bounds[0]
    return SourceMesh(
        name=name,
        category="box",
        vertices=vertices,
        faces=np.asarray(mesh.faces),
        source="made here",
        license="CC0-1.0",
    )


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """The packed file, twice; of the training pieces there are 20 a collection, every second of them small."""
    data = tmp_path_factory.mktemp("data")
    write_packed(data / f"{FURNITURE}.npz", [box(f"Chair_{k}", 1.0 + k) for k in range(3)])
    for name in PIECES:
        boxes = [box(f"{name}_{k:02d}", 0.2 + 0.01 * k if k % 2 else 1.0 + 0.01 * k) for k in range(40)]
        write_packed(data / f"{name}.npz", boxes)
    for out in ("once.npz", "again.npz"):
        main(data=data, out=data / out)
    return data / "once.npz", data / "again.npz"


def test_all_furniture_and_so_many_pieces_of_every_collection(packed):
    models = read_models(packed[0])
    assert sum(m.name.startswith("Chair_") for m in models) == 3
    counts = {name: sum(m.name.startswith(f"{name}_") for m in models) for name in PIECES}
    assert counts == PIECES
    assert len({m.name for m in models}) == len(models) == 3 + sum(PIECES.values())


def test_of_one_collection_small_pieces_alone(packed):
    models = read_models(packed[0])
    assert all(is_small(m.vertices) for m in models if m.name.startswith(f"{SMALL}_"))
    assert not all(is_small(m.vertices) for m in models if m.name.startswith("infinigen_Pillow_"))


def test_every_run_draws_the_same(packed):
    once, again = map(read_models, packed)
    assert [m.name for m in once] == [m.name for m in again]
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
