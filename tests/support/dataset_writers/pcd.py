"""Writes PCD 0.7 in its three encodings, with an LZF compressor of literals and references back."""

import struct
from pathlib import Path

import numpy as np


def lzf(data: bytes) -> bytes:
    """Greedy LZF: the last place of every three bytes is remembered."""
    out, literals, seen, at = bytearray(), bytearray(), {}, 0

    def flush() -> None:
        for k in range(0, len(literals), 32):
            run = literals[k : k + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        before = seen.get(key, -1)
        seen[key] = at
        back = at - before - 1
        if len(key) < 3 or before < 0 or back >= 8192:
            literals.append(data[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(data) and data[before + length] == data[at + length]:
            length += 1
        flush()
        short = length - 2
        out.append(min(short, 7) << 5 | back >> 8)
        if short >= 7:
            out.append(short - 7)
        out.append(back & 255)
        at += length
    flush()
    return bytes(out)


def write_pcd(path: Path, fields: dict[str, np.ndarray], data: str, viewpoint: str = "0 0 0 1 0 0 0") -> Path:
    """Fields (n,) in their own types, in this order."""
    kinds = {"f": "F", "i": "I", "u": "U"}
    n = len(next(iter(fields.values())))
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(fields)}\n"
        f"SIZE {' '.join(str(v.dtype.itemsize) for v in fields.values())}\n"
        f"TYPE {' '.join(kinds[v.dtype.kind] for v in fields.values())}\nCOUNT {' '.join('1' for _ in fields)}\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {n}\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        rows = zip(*(v.tolist() for v in fields.values()), strict=True)
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    elif data == "binary":
        body = b"".join(b"".join(v[k].tobytes() for v in fields.values()) for k in range(n))
    else:
        plain = b"".join(v.tobytes() for v in fields.values())
        packed = lzf(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes(header + body)
    return path
