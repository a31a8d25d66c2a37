"""Fenced blocks and commands of a page of the guide."""

import re
from pathlib import Path

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks_of(text: str) -> list[tuple[str, str]]:
    """Language and text of every fenced block, in order."""
    return BLOCK.findall(text)


def lines_of(script: str) -> list[str]:
    """The commands of a block, continued lines joined."""
    return [line for line in script.replace("\\\n", " ").splitlines() if line.strip()]


def commands_of(page: Path) -> list[str]:
    """The commands of all bash blocks of a page."""
    found = blocks_of(page.read_text(encoding="utf-8"))
    return [line for language, body in found if language == "bash" for line in lines_of(body)]
