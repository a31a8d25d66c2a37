"""Fenced blocks and commands of a page of the guide."""

import re
from pathlib import Path

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of every fenced block, in order."""
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def lines(script: str) -> list[str]:
    """The commands of a bash block, continued ones joined."""
    return [line for line in script.replace("\\\n", " ").splitlines() if line.strip()]


def commands(page: Path) -> list[str]:
    """The commands of all bash blocks of a page."""
    return [line for language, body in blocks(page) if language == "bash" for line in lines(body)]
