"""One process at a time works on a living scene; a second is told which one does.

The lock is on `.NAME.lock` beside the folder `NAME`, which a save replaces as a whole. The operating system frees it
with the process, however that ends; the file is removed by who lets go, or by the next one after a process was killed.
Where a file system knows no locks (some network mounts), or the system has no flock (Windows), nothing is held.
"""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
_held = threading.local()


@contextmanager
def scene_lock(folder: str | Path) -> Iterator[None]:
    """Holds the living scene `folder` against all others; a thread that holds it may take it again.

    Raises ValueError, naming process and host, if another holds it.
    """
    folder = Path(folder).resolve()
    mine: set[Path] = _held.__dict__.setdefault("folders", set())
    if folder in mine or fcntl is None:
        yield
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.with_name(f".{folder.name}.lock")
    held = _acquired(path, folder)
    mine.add(folder)
    try:
        yield
    finally:
        mine.discard(folder)
        if held is not None:
            path.unlink(missing_ok=True)
            os.close(held)


def _acquired(path: Path, folder: Path) -> int | None:
    """The descriptor that holds the lock; None where the file system has none."""
    assert fcntl is not None
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is(file, path):
                _sign(file, path)
                return file
        except BlockingIOError as error:
            holder = os.pread(file, 500, 0).decode(errors="replace").strip() or "another process"
            os.close(file)
            raise ValueError(f"{folder}: {holder} works on it; needed a scene that nobody writes") from error
        except OSError as error:
            os.close(file)
            if error.errno in NO_LOCKS:
                return None
            raise
        os.close(file)  # who held it before has removed it meanwhile


def _sign(file: int, path: Path) -> None:
    """Says in the file who holds it; a disk that is full is refused here, before any work."""
    text = f"process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%Y-%m-%d %H:%M:%S%z')}\n"
    try:
        os.ftruncate(file, 0)
        os.write(file, text.encode())
    except OSError as error:
        path.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def _is(file: int, path: Path) -> bool:
    """Whether the path still names this file."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False
