"""Catalog furniture: centimeters and y up become meters and z up; rotation is applied before the size."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.exchange.obj import export_obj

from train.furniture.collections import read_meshes
from train.furniture.sweethome3d import kind_of, read_catalog

PROPERTIES = """# a catalog
license=Public domain
name#1=Chair
creator#1=Somebody
model#1=/models/chair.obj
width#1=50
depth#1=60
height#1=90
name#2=Lamp
creator#2=Somebody else
model#2=/models/chair.obj
modelRotation#2=0 0 1 0 1 0 -1 0 0
width#2=20
depth#2=30
height#2=40
"""


@pytest.fixture
def catalog(tmp_path: Path) -> Path:
    """Two pieces that share a model: a cube with a spike at the back on top (y up, front toward +z)."""
    cube = trimesh.creation.box((2, 2, 2))
    spike = trimesh.Trimesh([[-1, 3, -1], [1, 1, -1], [-1, 1, -1]], [[0, 1, 2]], process=False)
    buffer = io.StringIO(export_obj(trimesh.util.concatenate([cube, spike])))
    path = tmp_path / "made.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", PROPERTIES)
        archive.writestr("models/chair.obj", buffer.getvalue())
    return path


def test_pieces_stand_in_meters(catalog: Path):
    chair, lamp = read_catalog(catalog)
    assert (chair.name, chair.creator, chair.license, chair.id) == ("Chair", "Somebody", "Public domain", 1)
    for piece, size in ((chair, (0.5, 0.6, 0.9)), (lamp, (0.2, 0.3, 0.4))):
        low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
        np.testing.assert_allclose(high - low, size, atol=1e-9)
        np.testing.assert_allclose([*(low + high)[:2], low[2]], 0, atol=1e-9)
    top = chair.vertices[np.argmax(chair.vertices[:, 2])]
    np.testing.assert_allclose(top, [-0.25, 0.3, 0.9], atol=1e-9)  # the back (−z there) is +y here
    top = lamp.vertices[np.argmax(lamp.vertices[:, 2])]
    np.testing.assert_allclose(top, [-0.1, -0.15, 0.4], atol=1e-9)  # turned by +90° about the vertical


def test_pieces_are_chosen_by_number(catalog: Path):
    assert [piece.name for piece in read_catalog(catalog, (2,))] == ["Lamp"]


def test_what_is_no_catalog_is_refused(tmp_path: Path):
    (tmp_path / "text.sh3f").write_text("nothing")
    with zipfile.ZipFile(tmp_path / "empty.sh3f", "w") as archive:
        archive.writestr("other", "")
    for name in ("text.sh3f", "empty.sh3f", "missing.sh3f"):
        with pytest.raises(ValueError, match="not a SweetHome3D catalog"):
            list(read_catalog(tmp_path / name))


def test_furniture_gets_its_kind_and_the_rest_is_told(catalog: Path, tmp_path: Path):
    with zipfile.ZipFile(catalog) as archive:
        model = archive.read("models/chair.obj")
    text = PROPERTIES + (
        "name#3=Man\nmodel#3=/models/chair.obj\ncategory#3=Characters\nwidth#3=1\ndepth#3=1\nheight#3=1\n"
        "name#4=Thing\ntags#4=Nightstand, wood\nmodel#4=/models/chair.obj\nwidth#4=1\ndepth#4=1\nheight#4=1\n"
        "name#5=Torn\nmodel#5=/models/torn.obj\nwidth#5=1\ndepth#5=1\nheight#5=1\n"
    )
    path = tmp_path / "more.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", text)
        archive.writestr("models/chair.obj", model)
    told: dict[str, str] = {}
    found = list(read_meshes(path, report=told.__setitem__))
    assert [(m.name, m.category) for m in found] == [
        ("more_001", "chair"),
        ("more_002", "lamp"),
        ("more_004", "cabinet"),
    ]
    assert found[0].license == "Public domain; Chair by Somebody"
    assert "Characters" in told["more_003"]
    assert "not readable" in told["more_005"]


@pytest.mark.parametrize(
    ("words", "kind"),
    [("Desk lamp", "lamp"), ("Bathroom cabinet", "cabinet"), ("Bedside table", "cabinet"), ("Vase", None)],
)
def test_kind_of(words: str, kind: str | None):
    assert kind_of(words) == kind
