"""`more2 doctor`: whether this installation works, for people and, as JSON, for programs."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import tempfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from more2_jax import __version__
from more2_jax.cli.self_test import SelfTest, self_test
from more2_jax.cli.session import Session, keep_compiled_programs, one_line

PACKAGE = "more2-jax"
MEMORY = Path("/proc/meminfo")  # of Linux
NOT_FOR_USERS = {"dev"}  # extras


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    more2: str
    python: str
    jax: str
    jaxlib: str
    devices: tuple[str, ...]
    cache: str  # where compiled programs are kept
    cache_writable: bool
    extras: dict[
        str, dict[str, str | None]
    ]  # by extra: version of each of its packages, None where it is missing
    free_memory_mb: int | None  # of the host; None where the system does not say
    self_test: SelfTest | None  # None where it failed
    problems: tuple[str, ...]  # in one line each; none: it works


def doctor(*, as_json: bool) -> int:
    """Prints what was found; returns 0, or 1 where there is a problem."""
    found = diagnose()
    if as_json:
        print(json.dumps(as_dict(found), indent=1))
    else:
        for line in told(found):
            Session().say(line)
    return 1 if found.problems else 0


def diagnose() -> Diagnosis:
    """Looks at everything, and runs the self-test."""
    problems = []
    keep_compiled_programs()
    import jax

    cache = str(jax.config.values["jax_compilation_cache_dir"])
    writable = is_writable(cache)
    if not writable:
        problems.append(
            f"cache {cache} cannot be written: every command compiles anew; MORE2_CACHE names another"
        )
    tested = None
    try:
        tested = self_test()
        if not tested.passed:
            problems.append("the self-test gives other numbers than it should")
    except Exception as error:  # a diagnosis tells of any failure
        problems.append(f"the self-test failed: {type(error).__name__}: {one_line(error)}")
    return Diagnosis(
        more2=__version__,
        python=platform.python_version(),
        jax=metadata.version("jax"),
        jaxlib=metadata.version("jaxlib"),
        devices=tuple(f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()),
        cache=cache,
        cache_writable=writable,
        extras=extras(),
        free_memory_mb=free_memory_mb(),
        self_test=tested,
        problems=tuple(problems),
    )


def is_writable(folder: str) -> bool:
    """Whether files can be made in a folder, which is made where it is missing; addresses (gs://…) are not tried."""
    if "://" in folder:
        return True
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def extras() -> dict[str, dict[str, str | None]]:
    """The optional parts of the package, with the version of each package that they need, None where it is missing."""
    try:
        stated = metadata.metadata(PACKAGE)
    except metadata.PackageNotFoundError:
        return {}  # a checkout that was not installed
    needs = [Requirement(text) for text in stated.get_all("Requires-Dist") or ()]
    names = [e for e in stated.get_all("Provides-Extra") or () if e not in NOT_FOR_USERS]
    return {extra: {name: version_of(name) for name in packages_of(extra, needs)} for extra in names}


def packages_of(extra: str, needs: list[Requirement]) -> list[str]:
    """The packages that an extra adds, those of the extras that it names included."""
    own = [
        r
        for r in needs
        if r.marker and r.marker.evaluate({"extra": extra}) and not r.marker.evaluate({"extra": ""})
    ]
    names = []
    for need in own:
        if canonicalize_name(need.name) == PACKAGE:
            names += [name for inner in sorted(need.extras) for name in packages_of(inner, needs)]
        else:
            names.append(need.name)
    return names


def version_of(package: str) -> str | None:
    """Of an installed package; None where it is missing."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def free_memory_mb() -> int | None:
    """Memory that new programs can have without swapping, 2**20 bytes; None where the system does not say."""
    if not MEMORY.is_file():
        return None
    lines = dict(line.split(":") for line in MEMORY.read_text(encoding="utf-8").splitlines() if ":" in line)
    return int(lines["MemAvailable"].split()[0]) // 1024 if "MemAvailable" in lines else None


def as_dict(found: Diagnosis) -> dict[str, Any]:
    """For JSON."""
    content = dataclasses.asdict(found)
    if found.self_test is not None:
        content["self_test"]["passed"] = found.self_test.passed
    return content


def told(found: Diagnosis) -> list[str]:
    """For people, a line each."""
    memory = "unknown" if found.free_memory_mb is None else f"{found.free_memory_mb:,} MiB"
    lines = [
        f"more2      {found.more2}, Python {found.python}",
        f"JAX        {found.jax}, jaxlib {found.jaxlib}",
        f"devices    {', '.join(found.devices)}",
        f"cache      {found.cache} ({'writable' if found.cache_writable else 'NOT writable'})",
        f"memory     {memory} free",
    ]
    for extra, packages in found.extras.items():
        missing = [name for name, version in packages.items() if version is None]
        have = ", ".join(f"{name} {version}" for name, version in packages.items() if version is not None)
        lines.append(f"extra      {extra}: {'missing ' + ', '.join(missing) if missing else have}")
    if (test := found.self_test) is not None:
        lines.append(
            f"self-test  {'passed' if test.passed else 'FAILED'} in {test.seconds:.1f} s: equivariance "
            f"{test.equivariance:.0e}, a known pose to {test.rotation_error_deg:.1f}° and "
            f"{100 * test.position_error_m:.1f} cm"
        )
    return [
        *lines,
        *(f"problem    {text}" for text in found.problems),
        "all is well" if not found.problems else "not well",
    ]
