"""docs/reference/programs.md: the help of every program of `train` and `eval`, as the program prints it."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import tyro

from docs_build.command_line_page import printed_help

ROOT = Path(__file__).parents[1]
FOLDERS = ("train", "train/tools", "eval", "eval/peers", "eval/peers/learned")
STARTED = re.compile(
    r"^def main\(.*^if __name__ == ", re.MULTILINE | re.DOTALL
)  # in a module that is a program
HEAD = """# Programs of training and evaluation

They are started in a clone of the repository, which the package does not hold. Each with its flags, as
`python -m PROGRAM --help` prints it. Exit codes: 0 done, 2 bad input. Guides: [training](../guides/training.md),
[benchmark rooms](../guides/benchmark_rooms.md), [evaluating](../guides/evaluating.md).

"""


def programs_page() -> str:
    """Markdown: a section a program, training first."""
    return HEAD + "\n".join(f"## {name}\n```text\n{help_of(name)}\n```\n" for name in programs())


def programs() -> list[str]:
    """Modules that are programs, folder by folder."""
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.py"))]
    started = [path for path in files if STARTED.search(path.read_text(encoding="utf-8"))]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in started]


def help_of(name: str) -> str:
    """What a program prints when it is asked for help."""
    main = importlib.import_module(name).main
    return printed_help(lambda: tyro.cli(main, prog=f"python -m {name}", args=["--help"]))
