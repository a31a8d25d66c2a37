"""Every setting of a preset with its value and meaning, read off the settings' own source."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import tokenize
from collections.abc import Iterator
from typing import Any

from more2_jax.config import SceneConfig

HEAD = """# Every setting of preset `{preset}`

Written by `more2 settings --preset {preset}`. A YAML file given to `--config` replaces values by these names
(docs/guides/settings.md says how).
"""


def settings_page(config: SceneConfig) -> str:
    """Markdown: a table of names, values and meanings for the scene and for each algorithm that it names."""
    parts = [HEAD.format(preset=config.preset), *_sections(config, "")]
    return "\n".join(parts)


def _sections(settings: Any, where: str) -> Iterator[str]:
    meanings, inner = meanings_of(type(settings)), []
    title = where or "The scene"
    first_line = (type(settings).__doc__ or "").split("\n")[0]
    yield f"## {title if not where else f'`{where}`'}\n{first_line}\n\n| setting | value | meaning |\n|---|---|---|"
    for f in dataclasses.fields(settings):
        value, name = getattr(settings, f.name), f"{where}.{f.name}".lstrip(".")
        if dataclasses.is_dataclass(value):
            inner.append((value, name))
        else:
            shown = value if isinstance(value, str) else repr(value)
            yield f"| `{name}` | {shown} | {meanings[f.name].replace('|', chr(92) + '|')} |"
    yield ""
    for value, name in inner:
        yield from _sections(value, name)


def meanings_of(settings: type) -> dict[str, str]:
    """What the comments beside and above each field of a settings class say."""
    source = inspect.getsource(settings)
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    lines = source.split("\n")
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            above = node.lineno - 1
            while above in comments and lines[above - 1].lstrip().startswith("#"):
                above -= 1
            words = [
                comments[n] for n in range(above + 1, (node.end_lineno or node.lineno) + 1) if n in comments
            ]
            found[node.target.id] = " ".join(words)
    return found
