"""Every task has one outcome, whatever happens to the processes; what goes wrong costs only its own task."""

import subprocess
import sys
import time

import psutil
import pytest
from places import ROOT
from worker_tasks import Square

from more2_jax.workers.dealing import Answer, Lost, work_through
from more2_jax.workers.local import LocalTeam

TASKS = [0, 1, "bad", 2, "dies once", 3, "mistake", "dies", 4, "leaves", 5]


def outcomes(folder, tasks, size):
    return list(work_through(tasks, LocalTeam(Square(folder), size)))


@pytest.mark.parametrize("size", [1, 3])
def test_what_goes_wrong_costs_its_own_task_alone(tmp_path, size, capfd):
    found = outcomes(tmp_path, TASKS, size)
    assert sorted(map(str, (o.task for o in found))) == sorted(map(str, TASKS))  # each once
    told = {o.task: o for o in found}
    assert {n: told[n].answer.value[0] for n in range(6)} == {n: n * n for n in range(6)}
    assert told["bad"].answer == Answer(error="two lines")
    assert told["mistake"].answer == Answer(error="KeyError: 'unforeseen'")
    assert "Traceback" in capfd.readouterr().err  # of the mistake, which is ours
    assert (told["dies once"].answer.value[0], told["dies once"].tries) == ("dies once", 2)
    assert told["dies"].answer.error == "its process ended 2 times (killed by SIGKILL)"
    assert told["leaves"].answer.error == "its process ended 2 times (exit code 3)"
    attempts = {str(t): len(list(tmp_path.glob(f"task_{t}_*"))) for t in TASKS}
    twice = {"dies once", "dies", "leaves"}
    assert attempts == {str(t): 2 if t in twice else 1 for t in TASKS}


def test_workers_stay_alive_over_tasks_and_no_more_are_started(tmp_path):
    found = outcomes(tmp_path, list(range(20)), 2)
    assert len({o.answer.value[1] for o in found}) <= 2
    assert len(list(tmp_path.glob("made_*"))) <= 2
    few = tmp_path / "few"
    few.mkdir()
    outcomes(few, [1], 8)
    assert len(list(few.glob("made_*"))) == 1
    assert outcomes(few, [], 3) == []


LATE = [0, "sleeps", 1, "sleeps once", 2]


def held_to_the_limit(found, folder):
    """What takes too long is ended and tried once more; who is in time is left alone."""
    assert sorted(map(str, (o.task for o in found))) == sorted(map(str, LATE))  # each once
    told = {o.task: o for o in found}
    assert {n: (told[n].answer.value[0], told[n].tries) for n in range(3)} == {
        n: (n * n, 1) for n in range(3)
    }
    assert told["sleeps"].answer.error == "its process ended 2 times (not done within 0.025 minutes)"
    assert (told["sleeps once"].answer.value[0], told["sleeps once"].tries) == ("sleeps once", 2)
    assert len(list(folder.glob("task_sleeps_*"))) == 2


def test_a_worker_over_the_limit_is_ended_and_its_task_tried_once_more(tmp_path):
    held_to_the_limit(list(work_through(LATE, LocalTeam(Square(tmp_path), 2, limit_s=1.5))), tmp_path)
    left = psutil.Process().children(recursive=True)
    assert not [p for p in left if "spawn_main" in " ".join(p.cmdline())]


def test_workers_end_with_a_caller_that_stops_listening(tmp_path):
    for _ in work_through([1, "sleeps", "sleeps"], LocalTeam(Square(tmp_path), 2)):
        break
    left = psutil.Process().children(recursive=True)
    assert not [p for p in left if "spawn_main" in " ".join(p.cmdline())]


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    code = (
        "import sys; sys.path[:0] = ['tests/support']\n"
        "from pathlib import Path\n"
        "from worker_tasks import Square\n"
        "from more2_jax.workers.dealing import work_through\n"
        "from more2_jax.workers.local import LocalTeam\n"
        "if __name__ == '__main__':\n"
        "    list(work_through(['sleeps', 'sleeps'], LocalTeam(Square(Path(sys.argv[1])), 2)))\n"
    )
    program = tmp_path / "program.py"
    program.write_text(code)
    environment = {"PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, str(program), str(tmp_path)], cwd=ROOT, env=environment)
    deadline = time.monotonic() + 60
    while len(list(tmp_path.glob("made_*"))) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    workers = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.wait()
    _, alive = psutil.wait_procs(workers, timeout=20)
    assert len(workers) >= 2 and alive == []


class Scripted:
    """A team of which one worker is lost whenever the script says so."""

    def __init__(self, size, losses):
        self.size, self.losses, self.started, self.having, self.ended = size, list(losses), 0, {}, []

    def start(self):
        self.started += 1
        return self.started

    def give(self, worker, task):
        assert worker not in self.having
        self.having[worker] = task

    def wait(self):
        worker, task = next(iter(self.having.items()))
        del self.having[worker]
        lost = self.losses.pop(0) if self.losses else False
        return [(worker, Lost(reason="gone") if lost else Answer(value=task))]

    def dismiss(self, worker):
        self.ended.append(worker)

    def close(self):
        self.closed = True


@pytest.mark.parametrize("losses", [[], [1], [0, 1, 1], [1] * 5, [1] * 100])
@pytest.mark.parametrize("size", [1, 3])
def test_each_task_has_one_outcome_however_many_workers_are_lost(losses, size):
    team = Scripted(size, losses)
    found = list(work_through(range(7), team))
    assert sorted(o.task for o in found) == list(range(7)) and team.closed
    assert all(o.answer == Answer(value=o.task) for o in found if not o.answer.error)
    assert sum(o.tries for o in found) == 7 + sum(o.tries == 2 for o in found)
    # A worker is started in place of one that is lost only if there is a task for it.
    assert team.started <= min(size, 7) + len([1 for lost in losses if lost])


@pytest.mark.slow
def test_actors_of_a_cluster_do_the_same(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    from more2_jax.workers.ray_cluster import RayTeam

    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT / 'tests/support'}")  # for the actors
    found = list(work_through(TASKS, RayTeam(Square(tmp_path), "local", 2)))
    assert sorted(map(str, (o.task for o in found))) == sorted(map(str, TASKS))
    told = {o.task: o for o in found}
    assert {n: told[n].answer.value[0] for n in range(6)} == {n: n * n for n in range(6)}
    assert told["bad"].answer == Answer(error="two lines")
    assert (told["dies once"].answer.value[0], told["dies once"].tries) == ("dies once", 2)
    assert "its process ended 2 times (ActorDiedError)" in told["dies"].answer.error
    assert len(list(tmp_path.glob("made_*"))) <= 2 + 5  # as many as died, and no more


@pytest.mark.slow
def test_an_actor_over_the_limit_is_ended_and_its_task_tried_once_more(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    from more2_jax.workers.ray_cluster import RayTeam

    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT / 'tests/support'}")  # for the actors
    held_to_the_limit(list(work_through(LATE, RayTeam(Square(tmp_path), "local", 2, limit_s=1.5))), tmp_path)


def test_no_cluster_is_one_line():
    pytest.importorskip("ray")
    from more2_jax.workers.ray_cluster import RayTeam

    with pytest.raises(ValueError, match=r"--ray 127.0.0.1:1: no cluster there"):
        RayTeam(print, "127.0.0.1:1")
