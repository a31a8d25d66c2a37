"""What workers are asked in tests: importable by processes that know nothing of the tests."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4


@dataclass(frozen=True)
class Square:
    """Squares numbers and says where. In `folder` it marks every attempt; some tasks go wrong in their own ways."""

    folder: Path

    def __call__(self):
        (self.folder / f"made_{os.getpid()}").touch()
        return self.square

    def square(self, task):
        tries = len(list(self.folder.glob(f"task_{task}_*")))
        (self.folder / f"task_{task}_{tries}").touch()
        if task == "dies once" and tries == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        if task == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if task == "leaves":
            os._exit(3)
        if task == "bad":
            raise ValueError("two\nlines")
        if task == "mistake":
            raise KeyError("unforeseen")
        if task == "sleeps" or (task == "sleeps once" and tries == 0):
            time.sleep(60)
        return (task**2 if isinstance(task, int) else task), os.getpid()


class Counted:
    """Notes in `folder` every time that it is unpacked."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __setstate__(self, state):
        self.__dict__.update(state)
        (self.folder / f"unpacked_{os.getpid()}_{uuid4().hex}").touch()


def times_ten(shared: Counted, number: int) -> tuple[int, int]:
    """The number ten times, and who says so. ValueError for numbers below zero."""
    if number < 0:
        raise ValueError(f"{number} in {shared.folder.name}")
    return 10 * number, os.getpid()
