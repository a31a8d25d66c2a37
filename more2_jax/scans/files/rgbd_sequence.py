"""The raw depth frames of a 3RScan sequence: `sequence/` or `sequence.zip` (paper §4).

`_info.txt` holds the pinhole intrinsics (row-major 4×4) and the units of depth in a meter; `frame-*.depth.pgm`
is 16 bit, most significant byte first; `frame-*.pose.txt` is `T_world_camera`, row-major, meters. The camera
looks along +z, x to the right, y down.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Integer

from more2_jax.scans.labeled_cloud import UNREADABLE, one_line

INFO, DEPTH, POSE = "_info.txt", ".depth.pgm", ".pose.txt"
LARGEST_FILE = 4 * 2**20  # bytes of a frame: two million pixels, 50 times what the sensor has
RIGID = 1e-2  # how far a tracked rotation, rounded in the file, may be from one
GAP = rb"(?:\s|#[^\n]*\n)+"  # blanks and comments
PGM = re.compile(rb"P5" + GAP + rb"(\d{1,6})" + GAP + rb"(\d{1,6})" + GAP + rb"(\d{1,5})\s")


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera; pixels, and units of depth in a meter."""

    fx: float
    fy: float
    cx: float
    cy: float
    depth_shift: float


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """The frames of a scan, opened: `load` reads a file by name, or raises ValueError in one line."""

    where: Path
    intrinsics: Intrinsics
    frames: tuple[str, ...]  # names without ending, in time order
    files: frozenset[str]
    load: Callable[[str], bytes]


def open_sequence(folder: Path) -> Sequence:
    """The sequence of a scan's folder, unpacked or zipped.

    Raises ValueError, in one line, when there is none, it is damaged, or it has no `_info.txt` or no frames.
    """
    unpacked, packed = folder / "sequence", folder / "sequence.zip"
    if unpacked.is_dir():
        where, files, load = unpacked, _names(unpacked), _folder_loader(unpacked)
    elif packed.is_file():
        where, (files, load) = packed, _zip_loader(packed)
    else:
        raise ValueError(f"{folder}: no sequence.zip or sequence/; needed the raw depth frames")
    if INFO not in files:
        raise ValueError(f"{where}: no {INFO}; needed the intrinsics of the depth camera")
    frames = sorted(name.removesuffix(DEPTH) for name in files if name.endswith(DEPTH))
    if not frames:
        raise ValueError(f"{where}: no *{DEPTH}; needed depth frames")
    intrinsics = read_info(load(INFO), f"{where}: {INFO}")
    return Sequence(where=where, intrinsics=intrinsics, frames=tuple(frames), files=files, load=load)


def _names(folder: Path) -> frozenset[str]:
    return frozenset(file.name for file in folder.iterdir() if file.is_file())


def _folder_loader(folder: Path) -> Callable[[str], bytes]:
    def load(name: str) -> bytes:
        try:
            with (folder / name).open("rb") as file:
                content = file.read(LARGEST_FILE + 1)
        except OSError as error:
            raise ValueError(f"{folder}: {name} is not readable ({one_line(error)})") from error
        return _bounded(content, f"{folder}: {name}")

    return load


def _zip_loader(path: Path) -> tuple[frozenset[str], Callable[[str], bytes]]:
    """Members by file name: archives hold them at the top or below one folder."""
    try:
        archive = zipfile.ZipFile(path)
        members = {Path(name).name: name for name in archive.namelist()}
    except (*UNREADABLE, NotImplementedError) as error:
        raise ValueError(f"{path}: not a readable zip ({one_line(error)})") from error

    def load(name: str) -> bytes:
        try:
            with archive.open(members[name]) as file:
                content = file.read(LARGEST_FILE + 1)
        except (*UNREADABLE, NotImplementedError) as error:
            raise ValueError(f"{path}: {name} is damaged ({one_line(error)})") from error
        return _bounded(content, f"{path}: {name}")

    return frozenset(members), load


def _bounded(content: bytes, where: str) -> bytes:
    if len(content) > LARGEST_FILE:
        raise ValueError(f"{where}: more than {LARGEST_FILE} bytes; needed a depth frame of a phone")
    return content


def read_info(content: bytes, where: str) -> Intrinsics:
    """Intrinsics from lines `name = value`. ValueError, in one line, if one is missing or is no camera."""
    lines = (line.partition("=") for line in content.decode("utf-8", "replace").splitlines())
    values = {name.strip(): value.split() for name, _, value in lines}
    shift = _floats(values, "m_depthShift", 1, where)
    matrix = _floats(values, "m_calibrationDepthIntrinsic", 16, where).reshape(4, 4)
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or shift[0] <= 0:
        raise ValueError(
            f"{where}: focal lengths {matrix[0, 0]}, {matrix[1, 1]} and m_depthShift {shift[0]}; needed > 0"
        )
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return Intrinsics(fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), depth_shift=float(shift[0]))


def _floats(values: dict[str, list[str]], name: str, count: int, where: str) -> Float[np.ndarray, "count"]:
    words = values.get(name)
    if words is None:
        raise ValueError(f"{where}: no line {name}")
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise ValueError(f"{where}: {name} is not numbers") from error
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{where}: {name} has {len(numbers)} numbers; needed {count} finite ones")
    return numbers


def read_pgm(content: bytes, where: str) -> Integer[np.ndarray, "h w"]:
    """A binary PGM of 8 or 16 bits. ValueError, in one line, if it is damaged or cut short."""
    header = PGM.match(content[:1024])
    if header is None:
        raise ValueError(f"{where}: not a binary PGM; needed P5, width, height and largest value")
    width, height, largest = (int(group) for group in header.groups())
    dtype = np.dtype(">u2" if largest > 255 else "u1")
    pixels = content[header.end() :]
    if len(pixels) < width * height * dtype.itemsize:
        raise ValueError(f"{where}: {len(pixels)} bytes for {width}×{height} pixels; needed a complete file")
    return np.frombuffer(pixels, dtype, width * height).reshape(height, width)


def read_pose(content: bytes) -> Float[np.ndarray, "4 4"] | None:
    """`T_world_camera` of a frame; None where tracking was lost: no 4×4 numbers that are a rigid motion."""
    try:
        numbers = np.array([float(word) for word in content.split()])
    except ValueError:
        return None
    return numbers.reshape(4, 4) if numbers.shape == (16,) and is_rigid(numbers.reshape(4, 4)) else None


def is_rigid(T: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a matrix is finite, a proper rotation to within `RIGID`, and a shift below a thousand kilometers."""
    if not np.isfinite(T).all() or np.abs(T).max() > 1e6 or np.abs(T[:3, :3]).max() > 2:
        return False
    R = T[:3, :3]
    orthonormal = np.abs(R @ R.T - np.eye(3)).max() < RIGID and np.linalg.det(R) > 0
    return bool(orthonormal and np.abs(T[3] - [0, 0, 0, 1]).max() < RIGID)


def back_project(
    depth: Integer[np.ndarray, "h w"],
    intrinsics: Intrinsics,
    T_world_camera: Float[np.ndarray, "4 4"],
    stride: int,
) -> Float[np.ndarray, "n 3"]:
    """Points in the world of every `stride`-th pixel both ways that has a depth; row by row, meters (paper §4)."""
    row, column = np.nonzero(depth[::stride, ::stride])
    row, column = row * stride, column * stride
    z = depth[row, column] / intrinsics.depth_shift
    x = (column - intrinsics.cx) / intrinsics.fx * z
    y = (row - intrinsics.cy) / intrinsics.fy * z
    return np.stack([x, y, z], axis=-1) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
