"""The hook of mkdocs: puts generated pages into the docs build, and into the navigation where mkdocs.yml does not."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # of the code beside the pages, wherever mkdocs starts

from mkdocs.config.defaults import MkDocsConfig  # noqa: E402
from mkdocs.exceptions import PluginError  # noqa: E402
from mkdocs.structure.files import File, Files  # noqa: E402

from docs_build.generated import REFERENCE, generated_pages  # noqa: E402


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Names in the navigation what it does not name itself."""
    named = set(pages_in(config.nav or []))
    pages = generated_pages_or_stop()
    reference = [{title: path} for path, title in REFERENCE.items() if path not in named]
    examples = [path for path in pages if path.startswith("examples/") and path.endswith(".md")]
    for title, entries in (("Reference", reference), ("Examples", [p for p in examples if p not in named])):
        if entries and config.nav is not None:
            section_of(config.nav, title).extend(entries)
    return config


def section_of(nav: list[Any], title: str) -> list[Any]:
    """The entries of a section of the navigation, which is made at its end where there is none."""
    for entry in nav:
        if isinstance(entry, dict) and title in entry:
            return entry[title]
    nav.append({title: []})
    return nav[-1][title]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages and their pictures, in place of files of their names."""
    for path, content in generated_pages_or_stop().items():
        if (typed := files.get_file_from_path(path)) is not None:
            files.remove(typed)
        files.append(File.generated(config, path, content=content))
    return files


def generated_pages_or_stop() -> dict[str, str | bytes]:
    """The pages; ends the build, in one line, where outputs of examples are old."""
    try:
        return generated_pages()
    except ValueError as error:
        raise PluginError(str(error)) from None


def pages_in(nav: Any) -> list[str]:
    """The pages that a navigation names, at any depth."""
    if isinstance(nav, str):
        return [nav]
    return [page for entry in (nav.values() if isinstance(nav, dict) else nav) for page in pages_in(entry)]
