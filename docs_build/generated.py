"""All pages that are made from the code, by their path below docs/."""

from __future__ import annotations

import functools

from docs_build.command_line_page import command_line_page
from docs_build.examples import example_pages
from docs_build.programs_page import programs_page
from docs_build.python_page import python_page
from docs_build.scene_json_page import scene_json_page
from docs_build.settings_page import settings_reference

# Pages and their titles in the navigation.
REFERENCE = {
    "reference/command_line.md": "Command line",
    "reference/programs.md": "Programs of training and evaluation",
    "reference/settings.md": "Settings",
    "reference/scene_json.md": "scene.json",
    "reference/python.md": "Python",
}
MAKERS = (command_line_page, programs_page, settings_reference, scene_json_page, python_page)


@functools.cache
def generated_pages() -> dict[str, str | bytes]:
    """Markdown and pictures. Raises ValueError where outputs of examples are not of their sources."""
    reference = {path: make() for path, make in zip(REFERENCE, MAKERS, strict=True)}
    return {**reference, **example_pages()}
