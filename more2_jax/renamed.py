"""Module paths and names of version 0.1.0, kept for one release: each use warns and hands out what lives elsewhere now.

Modules that are gone (`more2_jax.vn`) come from a finder that Python asks last; modules that have become packages
(`more2_jax.geometry`) or lost names (`more2_jax.types`) ask `names_of`. Goes as a whole with the next release.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

ROOT = "more2_jax"
PROGRAMS = ("train", "eval")  # what only these use lives there, outside of the library
ENDS = "the old name goes with the next release"
# Old module → where its names live now.
MODULES = {
    "alignment": "more2_jax.geometry.point_to_plane",
    "batching": "more2_jax.geometry.padding",
    "checkpoint": "more2_jax.network.torch_checkpoint",
    "cli": "more2_jax.cli.main",
    "closing": "more2_jax.refinement.pose_graph_of_objects",
    "color": "more2_jax.matching.color",
    "commands": "more2_jax.cli",
    "commands.building": "more2_jax.cli.living_scenes",
    "commands.options": "more2_jax.cli.options",
    "commands.priors": "more2_jax.cli.priors",
    "commands.scenes": "more2_jax.cli.scenes",
    "commands.server": "more2_jax.cli.server",
    "commands.session": "more2_jax.cli.session",
    "commands.settings": "more2_jax.cli.settings",
    "consensus": "more2_jax.tracking.pose_voting",
    "data": "more2_jax.scans",
    "data.arrangement": "train.rooms.arrangement",
    "data.augmentation": "train.shards.augmentation",
    "data.benchmark": "train.rooms.scene_files",
    "data.closed_models": "train.furniture.closed_models",
    "data.demo": "more2_jax.scans.demo",
    "data.depth_views": "train.shards.depth_views",
    "data.duplicates": "train.furniture.near_duplicates",
    "data.fan_out": "train.furniture.parallel_map",
    "data.flying_cameras": "train.rooms.cameras",
    "data.flying_scenes": "train.rooms.visits",
    "data.flying_shape": "train.rooms.ray_scanner",
    "data.formats": "more2_jax.scans.formats",
    "data.furnishing": "train.rooms.regimes",
    "data.heldout": "train.furniture.heldout",
    "data.inspection": "more2_jax.scans.inspection",
    "data.json_file": "more2_jax.scans.files.json_file",
    "data.labelled": "more2_jax.scans.labeled_cloud",
    "data.masks": "more2_jax.scans.predicted_masks",
    "data.mesh_files": "train.furniture.mesh_files",
    "data.meshes": "train.furniture.collections",
    "data.npz_file": "more2_jax.scans.files.npz",
    "data.packed": "train.furniture.packed",
    "data.ply": "more2_jax.scans.files.ply_cloud",
    "data.ply_mesh": "more2_jax.scans.files.ply_face_mesh",
    "data.procedural": "train.furniture.procedural",
    "data.rgbd_sequence": "more2_jax.scans.files.rgbd_sequence",
    "data.sampling": "train.shards.sampling",
    "data.scans": "more2_jax.scans.read_scan",
    "data.segment_groups": "more2_jax.scans.segment_groups",
    "data.segmentation": "more2_jax.geometry.segmentation",
    "data.shapenet": "train.furniture.shapenet",
    "data.shapes": "train.shards.shapes",
    "data.shards": "train.shards.shards",
    "data.signed_distance": "train.shards.signed_distance",
    "data.solids": "train.furniture.closed_solids",
    "data.source_mesh": "train.furniture.source_mesh",
    "data.structural": "more2_jax.scans.structural_labels",
    "data.sweethome3d": "train.furniture.sweethome3d",
    "data.threerscan_index": "eval.data.threerscan_index",
    "decoder": "more2_jax.network.decoder",
    "demo": "more2_jax.cli.demo_score",
    "descent": "more2_jax.geometry.se3_descent",
    "encoder": "more2_jax.network.encoder",
    "encoding": "more2_jax.network.embedding_batch",
    "evidence": "more2_jax.matching.pair_evidence",
    "fitting": "more2_jax.refinement.joint_of_objects",
    "frames": "more2_jax.tracking.scan_frame",
    "geometry": "more2_jax.geometry.points",
    "in_turn": "more2_jax.network.row_map",
    "io": "more2_jax.storage.scene_folder",
    "joint": "more2_jax.refinement.joint",
    "lattice": "more2_jax.meshing.grid",
    "local_field": "more2_jax.network.local_field",
    "losses": "train.shards.losses",
    "matching": "more2_jax.matching.code_assignment",
    "meshfile": "more2_jax.storage.ply_files",
    "meshing": "more2_jax.meshing.extract",
    "nearest_grid": "more2_jax.geometry.nearest_grid",
    "neighbours": "more2_jax.network.neighbor_scan",
    "objects": "more2_jax.tracking.objects",
    "orientation": "more2_jax.meshing.normal_orientation",
    "outliers": "more2_jax.geometry.outliers",
    "planes": "more2_jax.meshing.planes",
    "pose_graph": "more2_jax.refinement.pose_graph",
    "prior": "more2_jax.network.prior",
    "published": "more2_jax.network.published_weights",
    "registration": "more2_jax.registration.register_pairs",
    "screened_poisson": "more2_jax.meshing.screened_poisson",
    "seen_surface": "more2_jax.meshing.observed_surface",
    "sight": "more2_jax.geometry.free_space",
    "sights": "more2_jax.tracking.object_views",
    "starts": "more2_jax.registration.starting_poses",
    "surface_registration": "more2_jax.registration.surface",
    "tracking": "more2_jax.tracking.identify",
    "verification": "more2_jax.matching.candidates",
    "vn": "more2_jax.network.vector_neurons",
}
# Folders whose modules kept their names: old folder → new folder, modules.
FOLDERS = {
    "data.formats": (
        "more2_jax.scans.formats",
        "arkitscenes e57 las npz_scan pcd ply_folder ply_scan registry replica s3dis scannet scannetpp threerscan",
    ),
    "data.procedural": (
        "train.furniture.procedural",
        "backs fronts furniture others parts seating soft storage supports tables",
    ),
}
MODULES |= {f"{old}.{m}": f"{new}.{m}" for old, (new, modules) in FOLDERS.items() for m in modules.split()}
# Names that left for another module than the rest of their own: old module → new module → names.
NAMES = {
    "checkpoint": {
        "more2_jax.network.parity": "check_prior read_reference weights_of_reference",
    },
    "data.flying_shape": {
        "train.furniture.symmetry": "yaw_symmetry",
    },
    "evidence": {
        "more2_jax.matching.calibration": "Calibration Compared FREE UNASKED "
        "UNKNOWN UPRIGHT calibrated features log_odds weighed",
    },
    "fitting": {
        "more2_jax.geometry.observations": "with_poses",
        "more2_jax.geometry.poses": "local_pose",
        "more2_jax.tracking.accumulated": "embed_accumulated",
    },
    "frames": {
        "more2_jax.geometry.floor": "LAYER_M floor_height",
        "more2_jax.geometry.poses": "lift",
        "more2_jax.geometry.transform": "moved moved_embedding",
        "more2_jax.tracking.rooms": "Rooms",
        "more2_jax.tracking.scan_height": "AS_GOOD_VOTES CLEARLY LEAST_M SPREAD_M "
        "best_vote common_height doubtful height_votes support",
    },
    "objects": {
        "more2_jax.geometry.poses": "Points Pose apply_pose",
    },
    "registration": {
        "more2_jax.registration.older_calls": "world_pose",
        "more2_jax.registration.descent": "STILL refine registration_loss",
    },
    "sights": {
        "more2_jax.geometry.observations": "seen_from",
    },
    "sight": {
        "more2_jax.geometry.transform": "moved_sight scale_sight",
    },
    "types": {
        "more2_jax.geometry.transform": "move_embedding scale_embedding",
    },
    "verification": {
        "more2_jax.geometry.poses": "in_frames",
        "more2_jax.matching.assignment": "AS_GOOD FARTHEST_M LEAST_GAIN LogOdds "
        "NEVER assign interchangeable unmatched",
        "more2_jax.types": "Known",
    },
}
CALLED = {
    "close_objects": "refine_object_poses",
    "Known": "ObservedObject",
    "in_frames": "world_poses",
    "lift": "vertical_shift",
    "local_pose": "local_poses",
    "move_embedding": "transform",
    "moved": "transform",
    "moved_embedding": "transform",
    "moved_sight": "transform",
    "scale_embedding": "rescale",
    "scale_sight": "rescale",
}
SPELLED = {
    "catalogue": "catalog",
    "initialise": "initialize",
    "labelled": "labeled",
    "licence": "license",
    "metres": "meters",
    "neighbour": "neighbor",
    "normalise": "normalize",
    "optimiser": "optimizer",
    "recognise": "recognize",
}


def install() -> None:
    """Has Python ask for former modules after everything else; once."""
    if not any(type(finder) is FormerModules for finder in sys.meta_path):
        sys.meta_path.append(FormerModules())


class FormerModules(MetaPathFinder):
    """Finds the modules of version 0.1.0 that nothing else finds any more."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec of a former module; None for any other."""
        old = _within(fullname)
        if old not in MODULES:
            return None
        holds_modules = any(m.startswith(f"{old}.") for m in MODULES)
        return ModuleSpec(fullname, _FormerModule(), is_package=holds_modules)


class _FormerModule(Loader):
    """Loads a stand-in for a former module, whose names are looked up where they live now."""

    def create_module(self, spec: ModuleSpec) -> None:
        """None: a module as Python makes them."""

    def exec_module(self, module: ModuleType) -> None:
        """Warns, and fails here and now where the new module is not installed."""
        home = MODULES[_within(module.__name__)]
        _imported(module.__name__, home)
        warnings.warn(f"{module.__name__} is {home} now; {ENDS}", DeprecationWarning, stacklevel=2)
        module.__doc__ = f"Is {home} now."
        module.__dict__["__getattr__"] = names_of(module.__name__)


def names_of(module: str) -> Callable[[str], Any]:
    """The `__getattr__` of a module whose path version 0.1.0 knew: finds the public names that it held then."""

    def __getattr__(name: str) -> Any:
        if name.startswith("_") or _is_part(module, name):
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        return _named(module, name)

    return __getattr__


def _is_part(module: str, name: str) -> bool:
    """Whether the name is a module of the package, to be imported and not looked up."""
    is_package = "__path__" in vars(sys.modules[module])
    return is_package and importlib.util.find_spec(f"{module}.{name}") is not None


def _named(module: str, name: str) -> Any:
    """What a former module called `name`, with a warning to whoever asks for it."""
    old = _within(module)
    left = (home for home, names in NAMES.get(old, {}).items() if name in names.split())
    home = next(left, MODULES.get(old))
    here = None if home is None else _imported(module, home)
    now = next((n for n in (CALLED.get(name, name), _american(name)) if hasattr(here, n)), None)
    if here is None or now is None:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warnings.warn(f"{module}.{name} is {home}.{now} now; {ENDS}", DeprecationWarning, stacklevel=3)
    return getattr(here, now)


def _imported(old: str, home: str) -> ModuleType:
    """The new module. Raises ImportError, saying where it went, if it is no part of what is installed."""
    try:
        return importlib.import_module(home)
    except ModuleNotFoundError as error:
        if home.partition(".")[0] not in PROGRAMS or not home.startswith(error.name or home):
            raise
        where = "the repository's programs, which are not installed with the library"
        raise ImportError(f"{old} is {home} now, part of {where}; run from a checkout", name=old) from error


def _within(fullname: str) -> str:
    """The dotted name below more2_jax; empty for any other."""
    root, _, inner = fullname.partition(".")
    return inner if root == ROOT else ""


def _american(name: str) -> str:
    """The name in the spelling that all names have now."""
    for british, american in SPELLED.items():
        for case in (str.lower, str.title, str.upper):
            name = name.replace(case(british), case(american))
    return name
