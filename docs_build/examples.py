"""Pages of the numbered examples: their text, code, what they print and a picture; and the program that runs them.

The docs build runs no example: it takes what `python -m docs_build.examples` keeps in `examples/outputs/`, and refuses
outputs of code that has changed since.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).parents[1]
OUTPUTS = ROOT / "examples" / "outputs"
SOURCES = OUTPUTS / "sources.json"  # of every example that was run, the hash of its code
PAGE = """# {number}. {title}

{text}

![What the example finds]({picture})

## Code
```python
{code}
```

## Output
```text
{output}
```

Run it from the root of the repository: `python examples/{name}.py`
"""
INDEX = """# Examples

Each is a program of its own on the bundled scans: text, code, what it prints, and a picture.

{rows}
"""


@dataclass(frozen=True)
class Example:
    """One numbered example."""

    path: Path

    @property
    def name(self) -> str:
        """Its file's name without the ending."""
        return self.path.stem

    @property
    def number(self) -> int:
        """Its place among the examples."""
        return int(self.name[:2])

    @property
    def docstring(self) -> str:
        """What it says of itself."""
        return ast.get_docstring(ast.parse(self.path.read_text(encoding="utf-8"))) or ""

    @property
    def title(self) -> str:
        """The first sentence, or what stands before its colon."""
        first = " ".join(self.docstring.split("\n\n")[0].split())
        end = min((at for mark in (": ", "? ", ". ") if (at := first.find(mark)) >= 0), default=len(first))
        return first[: end + 1].rstrip(":.")

    @property
    def code(self) -> str:
        """The source below the docstring."""
        text = self.path.read_text(encoding="utf-8")
        after = ast.parse(text).body[0].end_lineno or 0
        return "\n".join(text.splitlines()[after:]).strip()

    @property
    def digest(self) -> str:
        """Of the code; the docstring may say it better without another run."""
        return hashlib.sha256(self.code.encode()).hexdigest()

    @property
    def output(self) -> Path:
        """What it printed."""
        return OUTPUTS / f"{self.name}.txt"

    @property
    def picture(self) -> Path:
        """What `docs_build.example_pictures` drew of it."""
        return OUTPUTS / f"{self.name}.png"


def all_examples() -> list[Example]:
    """In the order of their numbers."""
    return [Example(path) for path in sorted((ROOT / "examples").glob("[0-9]*.py"))]


def stale_examples() -> list[Example]:
    """Those without outputs of the source as it is."""
    known = json.loads(SOURCES.read_text(encoding="utf-8")) if SOURCES.is_file() else {}
    return [
        e
        for e in all_examples()
        if known.get(e.name) != e.digest or not (e.output.is_file() and e.picture.is_file())
    ]


def example_pages() -> dict[str, str | bytes]:
    """Pages and pictures by their path below docs/. Raises ValueError where an output is none of the source."""
    if stale := [e.name for e in stale_examples()]:
        raise ValueError(
            f"examples/outputs is not of the sources of {', '.join(stale)}; needed: python -m docs_build.examples"
        )
    examples = all_examples()
    rows = "\n".join(f"{e.number}. [{e.title}]({e.name}.md)" for e in examples)
    pages: dict[str, str | bytes] = {"examples/index.md": INDEX.format(rows=rows)}
    for e in examples:
        pages[f"examples/{e.name}.md"] = PAGE.format(
            number=e.number,
            title=e.title,
            text=e.docstring,
            picture=e.picture.name,
            code=e.code,
            output=e.output.read_text(encoding="utf-8").rstrip(),
            name=e.name,
        )
        pages[f"examples/{e.picture.name}"] = e.picture.read_bytes()
    return pages


def run_and_keep(example: Example) -> None:
    """Runs an example in a process of its own; keeps what it prints, and its picture."""
    OUTPUTS.mkdir(exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", "docs_build.example_pictures", str(example.path), str(example.picture)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    example.output.write_text(done.stdout, encoding="utf-8")
    known = json.loads(SOURCES.read_text(encoding="utf-8")) if SOURCES.is_file() else {}
    kept = {e.name: known.get(e.name) for e in all_examples() if e.name in known} | {
        example.name: example.digest
    }
    SOURCES.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n", encoding="utf-8")


def main(*numbers: tyro.conf.Positional[int]) -> None:
    """Runs the examples whose code has changed since their outputs were kept.

    Args:
        numbers: run those of these numbers instead.
    """
    for example in [e for e in all_examples() if e.number in numbers] if numbers else stale_examples():
        print(example.name, flush=True)
        run_and_keep(example)


if __name__ == "__main__":
    tyro.cli(main)
