"""A team that works in this process, where programs are compiled already; by default that of `more2 batch`."""

from collections import deque

from more2_jax.cli import batch
from more2_jax.workers.dealing import Desk


class Inline:
    """One worker: this process. `tasks` names what it was given."""

    size = 1

    def __init__(self, maker=None):
        self.desk, self.having, self.tasks = Desk(maker or batch.SceneMaker()), deque(), []

    def start(self):
        return 1

    def give(self, worker, task):
        self.having.append(task)
        self.tasks.append(getattr(task, "name", task))

    def wait(self):
        return [(1, self.desk.answer(self.having.popleft()))]

    def dismiss(self, worker):
        pass

    def close(self):
        pass
