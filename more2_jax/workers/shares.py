"""Shares of work that know nothing of one another: `--shard 2/8` is the second of eight, whoever does the others."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One of `count` shares, from 1."""

    number: int = 1
    count: int = 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def of(self, parts: Sequence[T]) -> list[T]:
        """Every `count`-th part, from the `number`-th."""
        return list(parts[self.number - 1 :: self.count])


def shard_of(text: str) -> Shard:
    """The shard that `i/n` names. Raises ValueError for what is none."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    number, count = (int(found[1]), int(found[2])) if found else (0, 0)
    if not 1 <= number <= count:
        raise ValueError(f"--shard {text}; needed i/n with 1 ≤ i ≤ n, such as 2/8")
    return Shard(number=number, count=count)
