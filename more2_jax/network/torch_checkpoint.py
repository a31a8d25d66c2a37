"""PyTorch checkpoints, read without PyTorch and without running anything a pickle asks for; proof of parity.

A `.pt` file is a zip of one pickle, which describes tensors, and one raw file per storage. A pickle may name
any function and have it called, so the reader here knows three builders and the storage types, all of them
stand-ins of its own; every other name becomes an object that does nothing.
"""

from __future__ import annotations

import pickle
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any

import ml_dtypes
import numpy as np

STORAGES: dict[str, np.dtype[Any]] = {
    "FloatStorage": np.dtype("f4"),
    "DoubleStorage": np.dtype("f8"),
    "HalfStorage": np.dtype("f2"),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "LongStorage": np.dtype("i8"),
    "IntStorage": np.dtype("i4"),
    "ShortStorage": np.dtype("i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}


# --- the pickle, defused ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoredTensor:
    """Where a tensor lies in its storage, in elements; nothing is read yet."""

    dtype: np.dtype[Any]
    key: str  # name of the storage's file
    elements: int  # of the storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class Inert:
    """Stands for any class or function a checkpoint names: takes everything, does nothing."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        pass

    def __new__(cls, *args: object, **kwargs: object) -> Inert:
        return super().__new__(cls)

    def __call__(self, *args: object, **kwargs: object) -> Inert:
        return Inert()

    # What a pickle may do to an object it built: state, items, elements.
    def __setstate__(self, state: object) -> None:
        pass

    def __setitem__(self, key: object, value: object) -> None:
        pass

    append = extend = add = __setstate__


class DefusedUnpickler(pickle.Unpickler):
    """Resolves no name by importing it. Names it does not know are kept in `refused`."""

    def __init__(self, file: IO[bytes] | BufferedIOBase) -> None:
        super().__init__(file)
        self.refused: set[str] = set()

    def find_class(self, module: str, name: str) -> Any:
        """A stand-in for `module.name`; never the thing itself, `OrderedDict` excepted."""
        match module, name:
            case "collections", "OrderedDict":
                return OrderedDict
            case "torch._utils", "_rebuild_tensor_v2":
                return partial(_stored_tensor)
            case "torch._utils", "_rebuild_parameter":
                return partial(_parameter)
            case "torch", _ if name in STORAGES:
                return STORAGES[name]
        self.refused.add(f"{module}.{name}")
        # A class of its own each time: whatever state the pickle sets on it stays with it.
        return type("Inert", (Inert,), {})

    def persistent_load(self, pid: Any) -> Any:
        """A storage: its dtype, file name and size."""
        if isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], np.dtype):
            return pid[1], str(pid[2]), pid[4]
        return Inert()


def _stored_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_unused: Any) -> Any:
    """`torch._utils._rebuild_tensor_v2`, as a description; of an unknown storage, nothing."""
    if not isinstance(storage, tuple):
        return Inert()
    dtype, key, elements = storage
    numbers = (elements, offset, *shape, *strides)
    if len(shape) != len(strides) or not all(isinstance(n, int) and n >= 0 for n in numbers):
        raise ValueError(
            f"a tensor of shape {shape}, strides {strides}, offset {offset} in {elements} elements"
        )
    return StoredTensor(dtype, key, elements, offset, tuple(shape), tuple(strides))


def _parameter(data: Any, *_unused: Any) -> Any:
    """`torch._utils._rebuild_parameter`: the tensor itself."""
    return data


# --- the file -----------------------------------------------------------------------------------------------


def read_checkpoint(path: str | Path) -> dict[str, np.ndarray]:
    """The tensors under `model_state_dict` of a PyTorch checkpoint, by name, each in its own dtype.

    Needs no torch and runs no code from the file; optimizer state and the like are not even read. Raises
    ValueError, in one line, for a missing file, one that is no zip-format checkpoint (PyTorch ≥ 1.6 writes
    those), a damaged one, or one without `model_state_dict`.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f"{path}: {_what_instead(path)}; needed a checkpoint that torch.save of 1.6 or later wrote"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            root = _root(archive)
            stored = _state_dict(archive, root)
            order = ">" if _record(archive, f"{root}byteorder", b"little") == b"big" else "<"
            return {name: _load(archive, f"{root}data/", tensor, order) for name, tensor in stored.items()}
    except DAMAGED as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: not a checkpoint that can be read: {reason}") from error


# What a damaged zip or a hostile pickle makes the standard library raise.
DAMAGED = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    IndexError,
    EOFError,
    OSError,
    OverflowError,
    MemoryError,
    RuntimeError,
    pickle.UnpicklingError,
    zipfile.BadZipFile,
)


def _what_instead(path: Path) -> str:
    with path.open("rb") as file:
        first = file.read(2)
    return "a pickle of the format before zip" if first[:1] == b"\x80" else "not a zip file, or truncated"


def _root(archive: zipfile.ZipFile) -> str:
    """The folder inside the archive that everything lies in, with its slash."""
    for name in archive.namelist():
        if name == "data.pkl" or name.endswith("/data.pkl"):
            return name.removesuffix("data.pkl")
    raise ValueError("the zip file holds no data.pkl")


def _record(archive: zipfile.ZipFile, name: str, otherwise: bytes) -> bytes:
    return archive.read(name).strip() if name in archive.namelist() else otherwise


def _state_dict(archive: zipfile.ZipFile, root: str) -> dict[str, StoredTensor]:
    with archive.open(f"{root}data.pkl") as file:
        unpickler = DefusedUnpickler(file)
        content = unpickler.load()
    state = content.get("model_state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict):
        keys = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"it holds {keys}; needed model_state_dict")
    for name, tensor in state.items():
        if not isinstance(name, str) or not isinstance(tensor, StoredTensor):
            refused = f" (not loaded: {', '.join(sorted(unpickler.refused))})" if unpickler.refused else ""
            raise ValueError(f"model_state_dict has {name!r} that is no plain tensor{refused}")
    return dict(state)


def _load(archive: zipfile.ZipFile, folder: str, tensor: StoredTensor, order: str) -> np.ndarray:
    """Copies one tensor out of its storage; checks first that it lies inside."""
    size = tensor.elements * tensor.dtype.itemsize
    record = archive.getinfo(f"{folder}{tensor.key}")
    last = tensor.offset + sum((n - 1) * s for n, s in zip(tensor.shape, tensor.strides, strict=True))
    count = int(np.prod(tensor.shape, dtype=object))
    if record.file_size != size or count > tensor.elements or (count and last >= tensor.elements):
        raise ValueError(
            f"storage {tensor.key} of {record.file_size} bytes does not hold a tensor of {tensor.shape}"
        )
    bits = np.frombuffer(archive.read(record), f"{order}u{tensor.dtype.itemsize}")
    raw = bits.astype(bits.dtype.newbyteorder("=")).view(tensor.dtype)
    if not count:
        return np.zeros(tensor.shape, tensor.dtype)
    strides = [s * raw.itemsize for s in tensor.strides]
    view = np.lib.stride_tricks.as_strided(raw[tensor.offset :], tensor.shape, strides, writeable=False)
    return view.copy()
