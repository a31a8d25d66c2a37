"""`more2 index | find`: objects over many living scenes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from more2_jax.cli.session import Session


def index(folders: Sequence[Path], out: Path) -> None:
    """Writes the index of stored scenes."""
    from more2_jax.storage.scene_index import index_folders, save_index

    made = index_folders(folders)
    save_index(made, out)
    Session().say(f"wrote {out} ({len(made)} objects of {len(folders)} scenes)")


def find(index_file: Path, folder: Path, object_id: str, top: int, everywhere: bool) -> None:
    """Prints where in the index things like one object of a stored scene stand.

    Raises ValueError where the scene has no such object, or codes of another prior than the index.
    """
    from rich.table import Table

    from more2_jax.storage.scene_folder import load_scene
    from more2_jax.storage.scene_index import find, load_index

    known, (scene, _) = load_index(index_file), load_scene(folder)
    o = next((o for o in scene.objects if o.id == object_id), None)
    if o is None:
        raise ValueError(
            f"{folder}: no object {object_id!r}; it has {', '.join(o.id for o in scene.objects)}"
        )
    if scene.prior != known.prior:
        raise ValueError(
            f"{folder}: codes of prior {scene.prior!r}; needed {known.prior!r}, as {index_file} has"
        )
    table = Table("scene", "object", "label", "seen last in", "where (m)", "size (m)", "score")
    for hit in find(known, o, top, None if everywhere else str(folder.resolve())):
        k = hit.row
        where, size = (" ".join(f"{x:.2f}" for x in part[k]) for part in (known.place_m, known.extent_m))
        seen = f"{known.scan[k]}{'' if known.there[k] else ' (not since)'}"
        names = (known.scene[k], known.object[k], known.label[k])
        table.add_row(*map(str, names), seen, where, size, f"{hit.score:.3f}")
    session = Session()
    session.show(table)
