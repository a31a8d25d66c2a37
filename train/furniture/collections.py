"""Source meshes, whatever they come in: the door to all collections."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from train.furniture.mesh_files import MESH_SUFFIXES, Report, read_folder, read_table
from train.furniture.packed import read_packed, write_packed
from train.furniture.shapenet import is_shapenet, read_shapenet
from train.furniture.source_mesh import SourceMesh, check_mesh, name_digest, standing
from train.furniture.sweethome3d import read_furniture

__all__ = ["SourceMesh", "check_mesh", "name_digest", "read_meshes", "standing", "write_packed"]


def read_meshes(path: str | Path, report: Report | None = None) -> Iterator[SourceMesh]:
    """The meshes of a collection, as they came.

    `path` is a packed .npz, a SweetHome3D catalog (.sh3f), a .csv that lists mesh files, a folder in
    ShapeNet's layout, or a folder of mesh files (one category a sub-folder). A mesh that cannot be read goes
    to `report` (name, reason); without one it raises ValueError. Raises ValueError if `path` is none of these.
    """
    path = Path(path)
    if path.is_dir():
        yield from (read_shapenet if is_shapenet(path) else read_folder)(path, report)
    elif not path.is_file() or path.suffix.lower() not in (".npz", ".sh3f", ".csv"):
        raise ValueError(
            f"{path}: needed a packed .npz, a .sh3f catalog, a .csv of mesh files"
            f" or a folder of {', '.join(MESH_SUFFIXES)}"
        )
    elif path.suffix.lower() == ".npz":
        yield from read_packed(path)
    else:
        yield from (read_table if path.suffix.lower() == ".csv" else read_furniture)(path, report)
