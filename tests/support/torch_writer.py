"""Writes the zip format of torch.save without torch: enough of it to make checkpoints for tests."""

from __future__ import annotations

import pickle
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

STORAGES = {
    "float32": "FloatStorage",
    "float64": "DoubleStorage",
    "float16": "HalfStorage",
    "bfloat16": "BFloat16Storage",
    "int64": "LongStorage",
    "int32": "IntStorage",
    "int16": "ShortStorage",
    "int8": "CharStorage",
    "uint8": "ByteStorage",
    "bool": "BoolStorage",
}


def integer(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def integers(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(integer, values)) + b"t"


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def tensor(
    key: str, kind: str, elements: int, offset: int, shape: tuple[int, ...], strides: tuple[int, ...]
) -> bytes:
    """The call that rebuilds a tensor from its storage, as pickle opcodes."""
    storage = b"(" + text("storage") + name("torch", STORAGES.get(kind, kind)) + text(key) + text("cpu")
    storage += integer(elements) + b"tQ"
    arguments = storage + integer(offset) + integers(shape) + integers(strides)
    arguments += b"\x89" + name("collections", "OrderedDict") + b")R"
    return name("torch._utils", "_rebuild_tensor_v2") + b"(" + arguments + b"tR"


def mapping(entries: Mapping[str, bytes]) -> bytes:
    """A dict of already pickled values."""
    return b"}(" + b"".join(text(k) + v for k, v in entries.items()) + b"u"


def write_raw(
    path: Path,
    body: bytes,
    storages: Mapping[str, bytes],
    *,
    root: str = "archive/",
    order: str | None = "little",
) -> Path:
    """A checkpoint whose pickle is `body` (opcodes without protocol and stop)."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{root}data.pkl", b"\x80\x02" + body + b".")
        if order is not None:
            archive.writestr(f"{root}byteorder", order)
        for key, raw in storages.items():
            archive.writestr(f"{root}data/{key}", raw)
    return path


def save(
    path: Path, weights: Mapping[str, np.ndarray], *, order: str = "little", extra: bytes | None = None
) -> Path:
    """A checkpoint of contiguous tensors under `model_state_dict`; `extra` is a pickled value beside it."""
    entries, storages = {}, {}
    for i, (key, array) in enumerate(weights.items()):
        strides = tuple(s // array.itemsize for s in np.ascontiguousarray(array).strides)
        entries[key] = tensor(
            str(i), array.dtype.name, array.size, 0, array.shape, strides if array.ndim else ()
        )
        swap = order == "big" and array.itemsize > 1
        storages[str(i)] = (array.byteswap() if swap else array).tobytes()
    content = {"model_state_dict": mapping(entries)} | ({"extra": extra} if extra else {})
    return write_raw(path, mapping(content), storages, order=order)


def pickled(value: object) -> bytes:
    """Opcodes of a value, without protocol and stop."""
    return pickle.dumps(value, protocol=2)[2:-1]
