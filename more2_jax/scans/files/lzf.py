"""LZF, the compression inside binary_compressed PCD files: runs of literals and references back."""

from __future__ import annotations

LONGEST = 264  # bytes that one reference of three bytes yields


def decompress(data: bytes, size: int) -> bytes:
    """The `size` bytes that `data` stands for.

    ValueError if `data` yields another number of bytes, ends early or refers to before the beginning. What
    it could yield at most is held against `size` before anything is allocated.
    """
    if size > len(data) * LONGEST:
        raise ValueError(f"{len(data)} compressed bytes cannot yield {size}")
    out = bytearray()
    at, end = 0, len(data)
    while at < end and len(out) <= size:
        control = data[at]
        at += 1
        if control < 32:
            if at + control >= end:
                raise ValueError("compressed bytes end within a run")
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        extended = length == 7
        if at + extended >= end:
            raise ValueError("compressed bytes end within a reference")
        length += 2 + (data[at] if extended else 0)
        back = ((control & 31) << 8) + data[at + extended] + 1
        at += 1 + extended
        _repeat(out, back, length)
    if len(out) != size:
        raise ValueError(
            f"compressed bytes yield {'more than ' * (len(out) > size)}{min(len(out), size)}"
            f" bytes; needed {size}"
        )
    return bytes(out)


def _repeat(out: bytearray, back: int, length: int) -> None:
    """Appends `length` bytes from `back` before the end; where they overlap the end, they repeat."""
    start = len(out) - back
    if start < 0:
        raise ValueError("compressed bytes refer to before the beginning")
    if back >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // back + 1))[:length]
