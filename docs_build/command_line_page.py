"""docs/reference/command_line.md: the help of every command of `more2`, as the command prints it."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from unittest.mock import patch

from more2_jax.cli.main import main

WIDTH = 100  # characters a line of help
COMMAND = re.compile(r"^[│ ]\s+• ([\w-]+)", re.MULTILINE)  # of the list that a help ends with
HEAD = """# Command line

Every command with its flags, as `more2 COMMAND --help` prints it. Exit codes: 0 done, 1 failure, 2 bad input,
130 interrupted. `more2 --version` tells the version.

"""


def command_line_page() -> str:
    """Markdown: a section a command, in the order of the help."""
    return HEAD + "\n".join(section(words) for words in (["more2"], *below([])))


def below(words: list[str]) -> list[list[str]]:
    """The commands of `more2 WORDS …`, each followed by its own."""
    found = []
    for name in COMMAND.findall(help_of(words)):
        found += [["more2", *words, name], *below([*words, name])]
    return found


def section(words: list[str]) -> str:
    """One command under its name."""
    return f"## {' '.join(words)}\n```text\n{help_of(words[1:])}\n```\n"


def help_of(words: list[str]) -> str:
    """What a command prints when it is asked for help."""
    return printed_help(lambda: main([*words, "--help"]))


def printed_help(ask: Callable[[], object]) -> str:
    """What `ask` prints before it ends the program, without colors."""
    printed = io.StringIO()
    plain = patch.dict(os.environ, {"COLUMNS": str(WIDTH), "NO_COLOR": "1"})
    with plain, redirect_stdout(printed), suppress(SystemExit):  # with which help ends
        ask()
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines()).strip()
