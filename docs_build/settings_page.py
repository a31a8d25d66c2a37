"""docs/reference/settings.md: every settings class, with defaults and meanings, all presets side by side."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any, Literal

from more2_jax.cli.settings_page import meanings_of
from more2_jax.config import PriorConfig, SceneConfig, preset
from train.run.settings import TrainingConfig

HEAD = """# Settings

Every setting with its value in the presets `paper`, `field` and `robust`, and what it means. From Python,
`m2.preset("robust")` gives them and `dataclasses.replace` changes them. On the command line, `--config` names a YAML
file that replaces values. `more2 settings --preset robust` prints those of one preset.

```yaml
static_m: 0.1
registration:
  steps: 20
```

"""
METHOD = "## The method\n"
TRAINING = """## Network and training
What `python -m train.prior` reads from a YAML file.
"""
PRESETS = ("paper", "field", "robust")  # columns of the table
ABSENT = ""  # of a setting of an algorithm that the preset does not use


def settings_reference() -> str:
    """Markdown: the scene and its algorithms, then the network and its training."""
    presets = {name: preset(name) for name in PRESETS}
    sections = [METHOD, *scene_sections(SceneConfig, "", presets), TRAINING]
    for settings, where in ((PriorConfig, "model"), (TrainingConfig, "training")):
        sections += default_sections(settings, where)
    return HEAD + "\n".join(sections)


def scene_sections(settings: type, where: str, values: dict[str, Any]) -> Iterator[str]:
    """A table of one class, and of those within; `values`: what each preset holds at `where`, of any class."""
    rows, inner = [], []
    hints, meanings = typing.get_type_hints(settings), meanings_of_all(settings)
    for f in dataclasses.fields(settings):
        name = f"{where}.{f.name}".lstrip(".")
        held = {p: getattr(v, f.name) for p, v in values.items() if isinstance(v, settings)}
        classes = [c for c in (hints[f.name], *typing.get_args(hints[f.name])) if dataclasses.is_dataclass(c)]
        if classes:
            inner += [(c, name, held) for c in classes]
            continue
        shown = (code(held[p]) if p in held else ABSENT for p in values)
        rows.append(
            f"| `{name}` | {type_of(hints[f.name])} | {' | '.join(shown)} | {escaped(meanings[f.name])} |"
        )
    users = [p for p, v in values.items() if isinstance(v, settings)]
    yield heading(settings, where, "" if len(users) == len(values) else f" Used by `{'`, `'.join(users)}`.")
    head = f"| setting | type | {' | '.join(values)} | meaning |"
    yield "\n".join([head, "|---|---|---|---|---|---|", *rows, ""])
    for c, name, held in inner:
        yield from scene_sections(c, name, {p: held.get(p) for p in values})


def default_sections(settings: type, where: str) -> Iterator[str]:
    """A table of one class with its defaults, and of those within."""
    rows, inner = [], []
    hints, meanings = typing.get_type_hints(settings), meanings_of_all(settings)
    default = settings()
    for f in dataclasses.fields(settings):
        if dataclasses.is_dataclass(hints[f.name]):
            inner.append((hints[f.name], f"{where}.{f.name}"))
            continue
        value = code(getattr(default, f.name))
        rows.append(
            f"| `{where}.{f.name}` | {type_of(hints[f.name])} | {value} | {escaped(meanings[f.name])} |"
        )
    yield heading(settings, where, "")
    if rows:
        yield "\n".join(["| setting | type | default | meaning |", "|---|---|---|---|", *rows, ""])
    for c, name in inner:
        yield from default_sections(c, name)


def heading(settings: type, where: str, more: str) -> str:
    """The name of a class, where it stands, and what it says of itself."""
    words = " ".join((settings.__doc__ or "").split("\n\n")[0].split())
    place = f", at `{where}`" if where else ""
    return f"### {settings.__name__}{place}\n{words}{more}\n"


def meanings_of_all(settings: type) -> dict[str, str]:
    """Of every field, those that a class inherits included."""
    found: dict[str, str] = {}
    for c in reversed(settings.__mro__):
        if dataclasses.is_dataclass(c):
            found |= meanings_of(c)
    return found


def type_of(hint: Any) -> str:
    """A type as a reader of YAML takes it."""
    if typing.get_origin(hint) is Literal:
        return " or ".join(f"`{value}`" for value in typing.get_args(hint))
    if typing.get_origin(hint) is tuple:
        return f"list of {typing.get_args(hint)[0].__name__}"
    return getattr(hint, "__name__", str(hint)) if not typing.get_args(hint) else escaped(str(hint))


def code(value: Any) -> str:
    """A value as YAML has it."""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value}`"


def escaped(text: str) -> str:
    """Text that may stand in a cell of a table."""
    return text.replace("|", "\\|").replace("\n", " ")
