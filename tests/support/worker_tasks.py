"""What workers are asked in tests: importable by processes that know nothing of the tests."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


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
