"""The pages: their Python runs, their commands parse, their links lead somewhere, none is long, the site builds."""

from __future__ import annotations

import functools
import importlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path

import jax
import pytest
import tyro
from guide_pages import BLOCK, blocks, commands
from markdown.extensions.toc import slugify
from places import ROOT

from docs_build.generated import generated_pages
from more2_jax.cli.main import Command
from more2_jax.scans.demo import demo_scan_paths
from more2_jax.types import LivingScene

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
AT_THE_ROOT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
MOST_WORDS = 1500  # of a page, by `wc -w`; a longer one is two pages
MADE_OF_FIGURES = re.compile(r"<!-- figures: .*?<!-- end of figures -->", re.DOTALL)  # by `eval.docs_figures`
WRITTEN_BY_PROGRAMS = {"reference/census.md"}
LINK = re.compile(r"\]\(([^)\s#]*)(?:#([^)\s]*))?\)")
PROGRAM = re.compile(r"python -m ((?:train|eval)\.[\w.]+)")
RUN_ELSEWHERE = {"gradients.md"}  # tests/test_docs.py runs it, and looks at the gradient
SHELL_WORDS = {"python3", "pip", "source", "export", "bash", ".venv/bin/pip"}


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture(scope="session", autouse=True)
def _compiled_once(tmp_path_factory):
    """Pages share compiled programs within the session, or wherever all tests do."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", before or str(tmp_path_factory.mktemp("compiled")))
    yield
    jax.config.update("jax_compilation_cache_dir", before)


WITH_PYTHON = [p for p in PAGES if p.name not in RUN_ELSEWHERE and "python" in dict(blocks(p))]
README = ROOT / "README.md"


@pytest.mark.parametrize("page", WITH_PYTHON, ids=named)
def test_the_python_of_a_page_runs_and_prints_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    fenced, ran = blocks(page), 0
    for k, (language, body) in enumerate(fenced):
        if language != "python":
            continue
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(compile(body, f"{named(page)}, block {k}", "exec"), names)
        ran += 1
        if k + 1 < len(fenced) and fenced[k + 1][0] == "text":
            assert printed.getvalue().strip() == fenced[k + 1][1].strip()
    assert ran


@pytest.mark.slow
def test_the_python_of_the_readme_finds_the_objects_of_two_scans_again(tmp_path, monkeypatch):
    for path in demo_scan_paths()[:2]:
        shutil.copy(path, tmp_path)  # as scan_0.ply and scan_1.ply
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(dict(blocks(README))["python"], names)
    scene = names["scene"]
    assert isinstance(scene, LivingScene)
    assert len(scene.changes) == 1
    assert len(scene.changes[0].moved) == 5


@pytest.mark.parametrize("page", [p for p in [*AT_THE_ROOT, *PAGES] if commands(p)], ids=named)
def test_the_commands_of_a_page_parse(page):
    for line in commands(page):
        words = shlex.split(line, comments=True)
        if words[0] == "more2":
            parse_more2(words[1:])
        elif match := PROGRAM.search(line):
            parse_program(match[1], words[3:])
        else:
            assert words[0] in SHELL_WORDS, line


def parse_more2(argv: list[str]) -> None:
    """What the command line makes of the words; exits where it refuses them."""
    options = (tyro.conf.OmitArgPrefixes,)
    assert tyro.cli(Command, args=argv, prog="more2", config=options) is not None  # type: ignore[arg-type]


def parse_program(module: str, argv: list[str]) -> None:
    """A program's arguments, through its own `main`, which is not run."""
    main = importlib.import_module(module).main
    called = []

    @functools.wraps(main)
    def recorded(*args, **kwargs):
        called.append((args, kwargs))

    tyro.cli(recorded, args=argv)
    assert len(called) == 1


@pytest.mark.parametrize(
    ("parse", "words"),
    [
        (parse_more2, "run a.ply --out b --nonsense"),
        (functools.partial(parse_program, "train.tools.census"), "--shard"),
    ],
)
def test_a_flag_that_does_not_exist_is_noticed(parse, words, capsys):
    with pytest.raises(SystemExit):
        parse(words.split())


def content(page: Path) -> str:
    """Of a page, or of one that the docs build makes."""
    made = generated_pages().get(page.relative_to(DOCS).as_posix()) if page.is_relative_to(DOCS) else None
    return made if isinstance(made, str) else page.read_text(encoding="utf-8")


def exists(path: Path) -> bool:
    """Whether a file is there, or will be in the docs build."""
    return path.exists() or (
        path.is_relative_to(DOCS) and path.relative_to(DOCS).as_posix() in generated_pages()
    )


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as the site makes them."""
    text = BLOCK.sub("", content(page))
    words = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", h) for h in re.findall(r"^#+ (.+)$", text, re.MULTILINE)]
    return {slugify(h, "-") for h in words}


@pytest.mark.parametrize("page", [*AT_THE_ROOT, *PAGES], ids=named)
def test_links_lead_somewhere(page):
    for target, anchor in LINK.findall(BLOCK.sub("", page.read_text(encoding="utf-8"))):
        if "://" in target:
            continue
        path = (page.parent / target).resolve() if target else page
        assert exists(path), target
        assert not anchor or anchor in anchors(path), f"{target}#{anchor}"


@pytest.mark.parametrize("page", [*AT_THE_ROOT[:2], *PAGES], ids=named)
def test_no_page_is_long(page):
    name = page.relative_to(DOCS).as_posix() if page.is_relative_to(DOCS) else page.name
    words = len(MADE_OF_FIGURES.sub("", page.read_text(encoding="utf-8")).split())
    assert name in WRITTEN_BY_PROGRAMS or words <= MOST_WORDS, words


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    missing = [p.name for p in PAGES if f": {p.relative_to(DOCS).as_posix()}\n" not in navigation]
    assert missing == []


def test_the_readme_is_short_and_shows_picture_and_chart():
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 90
    assert {"docs/pictures/before_after.png", "docs/pictures/peers.png"} <= {t for t, _ in LINK.findall(text)}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built strictly: by `.ci/run`, which names its folder, or here."""
    if built := os.environ.get("BUILT_SITE"):
        return Path(built)
    pytest.importorskip("mkdocs", reason="needs the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, timeout=120)
    return folder


def test_the_site_builds_and_loads_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        html = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"(https?:[^\"]+)\"", html)
        assert loaded == [], page.name
    assert "add_scan" in (site / "reference" / "python.html").read_text(encoding="utf-8")
