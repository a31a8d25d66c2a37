"""`more2 …`: the command line. Exit codes: 0 done, 2 bad input, 1 failure, 130 interrupted."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import (
    FlagCreatePairsOff,
    OmitArgPrefixes,
    Positional,
    arg,
    create_mutex_group,
    subcommand,
)

from more2_jax import __version__
from more2_jax.cli import batch, doctor, places, scenes
from more2_jax.cli import living_scenes as building
from more2_jax.cli.options import Reading, Reporting
from more2_jax.cli.prior_commands import PriorCommand
from more2_jax.cli.session import one_line
from more2_jax.cli.settings import scene_config
from more2_jax.cli.settings_page import settings_page
from more2_jax.config import PresetName

TURNS = create_mutex_group(required=False)
BAD_INPUT = (ValueError, FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)


@dataclass(frozen=True)
class Demo:
    """The whole job on the bundled scans with the bundled prior, held against the ground truth.

    Example: more2 demo --out demo_scene
    """

    out: Path = Path("demo_scene")
    """Folder of the living scene, saved after every scan; new, empty, or a living scene to replace."""
    preset: PresetName = "robust"
    """robust: several starts a pair. field: poses by completed shapes alone. paper: as in the paper. Each has a card in
    docs/concepts."""
    upright: bool = True
    """Objects turn about the vertical (z) only."""
    prior: str = "small"
    """Name of shipped weights, or a file."""
    resume: bool = False
    """Go on with the same command after an interruption: keep the scans already in the folder."""
    reporting: Reporting = field(default_factory=Reporting)

    def __call__(self) -> int:
        config = scene_config(self.preset, self.upright, None)
        building.demo(self.out, config, self.prior, resume=self.resume, reporting=self.reporting)
        return 0


@dataclass(frozen=True)
class Run:
    """A living scene from scans in time order. One scan is reconstructed; more are compared.

    Example: more2 run monday.ply friday.ply --out my_room
    """

    scans: Annotated[Positional[tuple[Path, ...]], arg(metavar="SCAN [SCAN ...]")]
    """PLY with an integer property naming the instance, NPZ, or a folder of one PLY per object."""
    out: Path
    """Folder of the living scene, saved after every scan; new, empty, or a living scene to replace."""
    preset: PresetName = "robust"
    """robust: several starts a pair. field: poses by completed shapes alone. paper: as in the paper. Each has a card in
    docs/concepts."""
    upright: Annotated[bool, TURNS, FlagCreatePairsOff] = False
    """Objects turn about the vertical (z) only; by default where the first scan shows a level floor."""
    any_orientation: Annotated[bool, TURNS, FlagCreatePairsOff] = False
    """Objects turn in any way, whatever the first scan shows."""
    prior: str = "small"
    """Name of shipped weights, or a file."""
    masks: tuple[Path, ...] = ()
    """Predicted masks (Mask3D) beside scans without their own: none, or one a scan in the same order."""
    reading: Reading = field(default_factory=Reading)
    keep_masks: bool = False
    """Leave masks as they are: join no parts of one object, divide none that holds two, mend no borders."""
    config: Path | None = None
    """YAML with values that replace the preset's."""
    resume: bool = False
    """Go on with the same command after an interruption: keep the scans already in the folder."""
    reporting: Reporting = field(default_factory=Reporting)

    def __call__(self) -> int:
        upright = True if self.upright else False if self.any_orientation else None
        config = scene_config(self.preset, upright, self.config, keep_masks=self.keep_masks)
        building.run_scans(
            self.scans,
            self.out,
            config,
            self.prior,
            reading=self.reading,
            masks=self.masks,
            resume=self.resume,
            reporting=self.reporting,
        )
        return 0


@dataclass(frozen=True)
class Batch:
    """Many scenes, one a row of a CSV or Parquet file, each as `more2 run` builds it; the same command goes on.

    Example: more2 batch scenes.csv --out buildings --workers 2
    """

    manifest: Positional[Path]
    """Columns: name, scans (in CSV separated by ;), and as needed out, masks, preset, upright, prior, keep_masks,
    config, unit, instance_property, segment, up, depth_frames. Paths are relative to the file."""
    out: Path
    """Folder of all scenes, each named after its row unless the row says out; and of the table of results."""
    workers: int | None = None
    """Processes that stay alive over scenes: 1; with --ray, as many actors as the cluster has room for."""
    ray: str | None = None
    """Address of a Ray cluster whose actors do the work ("local" starts one here); all see the same folders."""
    scene_minutes: float | None = None
    """A process that takes longer for a scene is ended; the scene is tried once more, then fails. None: any time."""
    quiet: bool = False
    """Print warnings and errors only."""

    def __call__(self) -> int:
        return batch.run_batch(
            self.manifest,
            self.out,
            workers=self.workers,
            ray=self.ray,
            scene_minutes=self.scene_minutes,
            quiet=self.quiet,
        )


@dataclass(frozen=True)
class Add:
    """One more scan into a stored living scene, without redoing the others.

    Example: more2 add my_room sunday.ply
    """

    folder: Positional[Path]
    """The living scene."""
    scan: Positional[Path]
    """The scan to add, later than all others."""
    prior: str | None = None
    """The weights the scene was made with, where they are not shipped."""
    masks: Path | None = None
    """Predicted masks (Mask3D) beside a scan without its own."""
    reading: Reading = field(default_factory=Reading)
    reporting: Reporting = field(default_factory=Reporting)

    def __call__(self) -> int:
        building.add(
            self.folder,
            self.scan,
            self.prior,
            reading=self.reading,
            masks=self.masks,
            reporting=self.reporting,
        )
        return 0


@dataclass(frozen=True)
class Inspect:
    """What a scan holds: instances, points, extents, likely unit and up axis, what was ignored and why.

    Example: more2 inspect monday.ply
    """

    scan: Positional[Path]
    """PLY, NPZ, or a folder of one PLY per object."""
    masks: Path | None = None
    """Predicted masks (Mask3D) beside a scan without its own."""
    reading: Reading = field(default_factory=Reading)
    min_points: int = 64
    """Objects of fewer points are left out."""

    def __call__(self) -> int:
        scenes.inspect(self.scan, self.reading, self.masks, self.min_points)
        return 0


@dataclass(frozen=True)
class Show:
    """Path of the page of a living scene; with a display, opens it. Or serves it, to this machine only.

    Example: more2 show my_room --serve
    """

    folder: Positional[Path]
    """The living scene."""
    open: bool = True
    """Open the page where there is a display."""
    serve: bool = False
    """Serve the page and the exports at 127.0.0.1 until ctrl-C."""
    port: int = 0
    """With serve: the port; 0 takes a free one."""

    def __call__(self) -> int:
        if self.port and not self.serve:
            raise ValueError(f"--port {self.port} without --serve; needed both, or neither")
        scenes.show(self.folder, self.open, self.serve, self.port)
        return 0


@dataclass(frozen=True)
class Export:
    """A living scene as one file for other tools.

    Example: more2 export my_room --format glb --scan 0
    """

    folder: Positional[Path]
    """The living scene."""
    format: Literal["glb", "usd", "ply", "json"]
    """glb: meshes, animated over the scans, y up. usd: the same as time samples. ply: points of one scan. json:
    poses and changes."""
    out: Path | None = None
    """File or folder to write to; by default a file beside the living scene's folder."""
    scan: int = -1
    """The scan shown by ply, and by glb at rest, from 0; -1 is the last."""

    def __call__(self) -> int:
        scenes.export(self.folder, self.format, self.out, self.scan)
        return 0


@dataclass(frozen=True)
class Index:
    """One file that says what the objects of many living scenes are like and where they stand.

    Example: more2 index offices/room_1 offices/room_2 --out offices.npz
    """

    folders: Positional[tuple[Path, ...]]
    """The living scenes."""
    out: Path
    """The file to write; one of that name is replaced."""

    def __call__(self) -> int:
        places.index(self.folders, self.out)
        return 0


@dataclass(frozen=True)
class Find:
    """Where is this chair now? The objects of an index that are most like one of a living scene.

    Example: more2 find offices.npz offices/room_1 object_003
    """

    index: Positional[Path]
    """What `more2 index` wrote."""
    folder: Positional[Path]
    """A living scene that knows the object,"""
    object: Positional[str]
    """and the object's id there."""
    top: int = 5
    """How many to show."""
    everywhere: bool = False
    """Also those of the same scene."""

    def __call__(self) -> int:
        places.find(self.index, self.folder, self.object, self.top, self.everywhere)
        return 0


@dataclass(frozen=True)
class Settings:
    """Every setting of a preset on one page, as Markdown: name, value, meaning.

    Example: more2 settings --preset robust
    """

    preset: PresetName = "robust"
    """robust: several starts a pair. field: poses by completed shapes alone. paper: as in the paper. Each has a card in
    docs/concepts."""

    def __call__(self) -> int:
        print(settings_page(scene_config(self.preset, None, None)), end="")
        return 0


@dataclass(frozen=True)
class Doctor:
    """Whether this installation works: versions, devices, cache, extras, memory, and a short test of the method.

    Example: more2 doctor --json
    """

    json: bool = False
    """Print one JSON object."""

    def __call__(self) -> int:
        return doctor.doctor(as_json=self.json)


@dataclass(frozen=True)
class Completion:
    """A script that completes commands and flags in a shell; goes to standard output.

    Example: more2 completion bash
    """

    shell: Positional[Literal["bash", "zsh", "fish"]]
    """The shell that reads it, as in `eval "$(more2 completion bash)"`."""

    def __call__(self) -> int:
        parsed(["--tyro-write-completion", self.shell, "-"])  # prints it and ends the process
        return 0


Command = (
    Annotated[Demo, subcommand("demo")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Batch, subcommand("batch")]
    | Annotated[Add, subcommand("add")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Show, subcommand("show")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Index, subcommand("index")]
    | Annotated[Find, subcommand("find")]
    | Annotated[Settings, subcommand("settings")]
    | Annotated[PriorCommand, subcommand("prior")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Completion, subcommand("completion")]
)


def parsed(argv: Sequence[str] | None) -> Command:
    """The command that the words name; ends the process where they ask for help or do not fit."""
    return tyro.cli(
        Command,  # type: ignore[arg-type]
        args=argv,
        prog="more2",
        description="Living scenes: objects found again and reconstructed over scans of one place.",
        config=(OmitArgPrefixes,),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code. Unforeseen exceptions pass through, with their traceback."""
    words = sys.argv[1:] if argv is None else list(argv)
    if words == ["--version"]:
        print(f"more2 {__version__}")
        return 0
    command = parsed(words)
    try:
        return command()
    except BAD_INPUT as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        print(f"interrupted; {error}" if error.args else "interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
