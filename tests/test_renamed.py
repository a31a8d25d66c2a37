"""Module paths and names of version 0.1.0 work for one release, and say where they went."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys

import pytest
from places import ROOT

import more2_jax
from more2_jax import renamed

# Every module of version 0.1.0 that has another path now, as its own list of files had them.
FORMER_LIST = """
alignment batching checkpoint closing color commands commands.building commands.options commands.priors
commands.scenes commands.server commands.session commands.settings consensus data.arrangement
data.augmentation data.benchmark data.closed_models data.demo data.depth_views data.duplicates
data.fan_out data.flying_cameras data.flying_scenes data.flying_shape data.formats
data.formats.arkitscenes data.formats.e57 data.formats.las data.formats.npz_scan data.formats.pcd
data.formats.ply_folder data.formats.ply_scan data.formats.registry data.formats.replica
data.formats.s3dis data.formats.scannet data.formats.scannetpp data.formats.threerscan data.furnishing
data.heldout data.inspection data.json_file data.labelled data.masks
data.mesh_files data.meshes data.npz_file data.packed data.ply data.ply_mesh data.procedural
data.procedural.backs data.procedural.fronts data.procedural.furniture data.procedural.others
data.procedural.parts data.procedural.seating data.procedural.soft data.procedural.storage
data.procedural.supports data.procedural.tables data.rgbd_sequence data.sampling data.scans
data.segment_groups data.segmentation data.shapenet data.shapes data.shards data.signed_distance
data.solids data.source_mesh data.structural data.threerscan_index data.sweethome3d 
decoder demo descent encoder encoding evidence fitting frames in_turn io joint lattice local_field
losses meshfile nearest_grid neighbours objects orientation outliers planes pose_graph prior published
screened_poisson seen_surface sight sights starts surface_registration verification vn
"""
BECAME_PACKAGES = ("cli", "geometry", "matching", "meshing", "registration", "tracking")
KEPT_LIST = (
    "config export export.glb export.placing export.ply export.poses export.usd metrics progress report "
    "report.blob report.coverage report.lists report.page report.palette report.payload report.thinning "
    "report.wording scene types"
)
# The reference of version 0.1.0 named these by their modules.
DOCUMENTED_LIST = """
io.save_scene io.load_scene batching.pad_clouds prior.encode prior.sdf matching.match_instances
registration.world_pose closing.close_objects joint.fit_jointly meshing.extract_mesh geometry.kabsch
geometry.chamfer_distance prior.Prior prior.init_prior prior.load_prior prior.save_prior
"""
FORMER, KEPT, DOCUMENTED = FORMER_LIST.split(), KEPT_LIST.split(), DOCUMENTED_LIST.split()
# A module has the place of a function now: it is reached by the command `more2`.
HIDDEN = {("cli", "main")}
# Functions of today in modules of their own name: 0.1.0 had neither.
NEW = {("meshing", "observed_surface"), ("tracking", "identify")}


def former(module: str, monkeypatch):
    """The former module, imported as if for the first time."""
    for name in [n for n in sys.modules if n == f"more2_jax.{module}" and module not in BECAME_PACKAGES]:
        monkeypatch.delitem(sys.modules, name)
    return importlib.import_module(f"more2_jax.{module}")


def own_names(module) -> list[str]:
    """The public functions and classes that a module defines itself."""
    of = getattr(module, "__all__", vars(module))
    objects = [(n, getattr(module, n)) for n in of if not n.startswith("_")]
    return [
        n
        for n, x in objects
        if (inspect.isfunction(x) or inspect.isclass(x)) and getattr(x, "__module__", "") == module.__name__
    ]


def test_the_table_names_every_former_module_and_no_other():
    assert set(renamed.MODULES) == {*FORMER, *BECAME_PACKAGES, "data"}


@pytest.mark.parametrize("module", FORMER)
def test_a_former_module_warns_and_holds_what_the_new_one_does(module, monkeypatch):
    home = renamed.MODULES[module]
    with pytest.warns(DeprecationWarning, match=re.escape(f"more2_jax.{module} is {home} now")):
        old = former(module, monkeypatch)
    new = importlib.import_module(home)
    for name in own_names(new):
        with pytest.warns(DeprecationWarning, match=rf"\.{name} is (more2_jax|train|eval)\."):
            assert getattr(old, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = old.nonsense


@pytest.mark.parametrize("path", DOCUMENTED)
def test_documented_names_are_found_where_they_were(path, monkeypatch):
    module, name = path.rsplit(".", 1)
    with pytest.warns(DeprecationWarning, match=re.escape(f"more2_jax.{path} is ")):
        found = getattr(former(module, monkeypatch), name)
    public = getattr(more2_jax, name, None)
    assert found is public or (name == "close_objects" and callable(found))


@pytest.mark.parametrize(
    ("module", "home", "name"),
    [(m, home, n) for m, homes in renamed.NAMES.items() for home, ns in homes.items() for n in ns.split()],
)
def test_names_that_left_their_module_are_found(module, home, name, monkeypatch):
    now = renamed.CALLED.get(name, name)
    with pytest.warns(DeprecationWarning, match=re.escape(f"more2_jax.{module}.{name} is {home}.{now} now")):
        found = getattr(former(module, monkeypatch), name)
    assert found is getattr(importlib.import_module(home), now)


@pytest.mark.parametrize("module", KEPT)
def test_modules_that_stayed_do_not_warn(module, recwarn):
    importlib.import_module(f"more2_jax.{module}")
    assert [str(w.message) for w in recwarn if "next release" in str(w.message)] == []


def test_british_spelling_finds_the_american_name(monkeypatch):
    from more2_jax.network.encoder import neighbor_counts

    with pytest.warns(
        DeprecationWarning, match=r"neighbour_counts is more2_jax\.network\.encoder\.neighbor_counts"
    ):
        assert former("encoder", monkeypatch).neighbour_counts is neighbor_counts


def test_the_warning_points_at_who_asks():
    with pytest.warns(DeprecationWarning, match=r"geometry\.points\.kabsch") as caught:
        from more2_jax.geometry import kabsch  # noqa: F401
    assert {w.filename for w in caught} == {__file__}


def test_former_names_hide_no_new_module():
    hidden = set()
    for package in BECAME_PACKAGES:
        parts = {m.name for m in pkgutil.iter_modules([str(ROOT / "more2_jax" / package)])}
        home = importlib.import_module(renamed.MODULES[package])
        hidden |= {(package, name) for name in parts & set(own_names(home))}
    assert hidden - NEW == HIDDEN
    from more2_jax.geometry import padding, points  # modules, and no warning

    assert (padding.__name__, points.__name__) == ("more2_jax.geometry.padding", "more2_jax.geometry.points")


@pytest.mark.parametrize("module", ["nonsense", "data.nonsense", "data.formats.nonsense", "vn.nonsense"])
def test_unknown_modules_fail_as_ever(module):
    with pytest.raises(ModuleNotFoundError, match="nonsense"):
        importlib.import_module(f"more2_jax.{module}")


def test_an_unknown_name_of_a_package_fails_as_ever():
    with pytest.raises(ImportError, match="cannot import name 'nonsense'"):
        from more2_jax.geometry import nonsense  # noqa: F401


def test_what_only_training_uses_says_so_without_the_training_programs(monkeypatch):
    for name in [n for n in sys.modules if n.split(".")[0] == "train"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "train", None)
    with pytest.raises(
        ImportError, match=r"more2_jax\.losses is train\.shards\.losses now, part of the repository"
    ):
        former("losses", monkeypatch)


def test_the_library_alone_loads_no_jax_and_one_finder():
    code = (
        "import importlib, sys, more2_jax\n"
        "assert 'jax' not in sys.modules and 'numpy' not in sys.modules\n"
        "importlib.reload(more2_jax)\n"
        "assert sum(type(f).__name__ == 'FormerModules' for f in sys.meta_path) == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
