"""`more2` in a process that is killed: by itself as it changes the disk, or from outside after a time.

Scenes are made by `stages_by_mask`, so that what takes time is what is written.
"""

import io
import os
import signal
import sys
from contextlib import ExitStack, contextmanager, redirect_stdout
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import SimpleNamespace
from unittest.mock import patch

from inline_team import Inline
from stages_by_mask import stages_by_mask

from more2_jax.cli import batch
from more2_jax.cli.main import main
from more2_jax.network import prior

CHANGES = ("os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.truncate")  # events that Python tells of
WRITES = os.O_WRONLY | os.O_RDWR
PRELOADED = (
    "more2_jax.cli.main",
    "more2_jax.export.glb",
    "more2_jax.report",
    "more2_jax.scans.read_scan",
    "more2_jax.scene",
    "more2_jax.storage.waiting_meshes",
    "typeguard",
)


@contextmanager
def without_network(weights):
    """Commands make scenes by masks in this process, say nothing, and write tables as CSV; `weights` are read."""
    with ExitStack() as stack:
        stack.enter_context(stages_by_mask())
        stack.enter_context(patch.object(batch, "team_of", lambda *_: Inline()))
        stack.enter_context(patch.object(prior, "load_prior", lambda _: weights))
        stack.enter_context(patch.dict(sys.modules, {"pyarrow": None}))
        yield stack.enter_context(redirect_stdout(io.StringIO()))


def started(words: list[str], dies_at: int | None = None):
    """A process that does what `more2 words` does, and what tells how it changed the disk, once it ends.

    It is killed before change number `dies_at`, from 0; where that opens a file to write, right after. Each is a
    copy of one process that has imported everything: most of a command's time would be that.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=command, args=(words, dies_at, theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def command(words: list[str], dies_at: int | None, told: Connection) -> None:
    """What the process does."""
    changes = list[str]()

    def count(event: str, arguments: tuple) -> None:
        opened = event == "open" and isinstance(arguments[0], str | os.PathLike) and arguments[2] & WRITES
        if opened or event in CHANGES:
            changes.append(event)
            if len(changes) - 1 == dies_at:
                if opened:  # the file is there, and nothing in it
                    os.open(arguments[0], arguments[2], 0o644)
                os.kill(os.getpid(), signal.SIGKILL)

    sys.dont_write_bytecode = True
    with without_network(SimpleNamespace(name="tiny")):
        sys.addaudithook(count)
        code = main(words)
        told.send(changes)
    sys.exit(code)
