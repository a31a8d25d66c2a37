"""Scenes worked on at the same time: as many as asked for, in order, the next chunk read meanwhile."""

import threading
import time
from types import SimpleNamespace

import jax
import pytest

from eval.end_to_end import on_all_devices
from eval.harness.options import Options
from eval.harness.runs import chunks, read_ahead


@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_that_many_work_at_once_and_the_order_stays(at_once):
    busy, most, lock = [0], [0], threading.Lock()

    def one(scene):
        with lock:
            busy[0] += 1
            most[0] = max(most[0], busy[0])
        time.sleep(0.05 * (5 - scene))
        with lock:
            busy[0] -= 1
        return [{"scene": scene}]

    found = on_all_devices(one, [0, 1, 2, 3, 4], at_once)
    assert [r["scene"] for (r,) in found] == [0, 1, 2, 3, 4]
    assert most[0] == at_once * jax.local_device_count()


class Letters:
    """A data set whose scenes are their names; remembers what was read."""

    def __init__(self):
        self.seen = []

    def read(self, name):
        self.seen.append(name)
        return SimpleNamespace(first_scans=lambda visits: name)


@pytest.mark.parametrize("names", [[], ["a"], ["a", "b"], ["a", "b", "c", "d", "e"]])
def test_chunks_are_read_once_and_in_order(names, tmp_path):
    data = Letters()
    options = Options(data=tmp_path, out=tmp_path, chunk=2)
    parts = list(chunks(names, options.chunk))
    got = list(read_ahead(SimpleNamespace(data=data), options, parts))
    assert [n for part, _ in got for n in part] == names == data.seen
    assert [s for _, scenes in got for s in scenes] == names and all(len(part) <= 2 for part, _ in got)


@pytest.mark.parametrize(("devices", "scenes"), [(1, 4), (4, 4), (8, 8)])
def test_a_chunk_has_a_scene_for_every_device(monkeypatch, tmp_path, devices, scenes):
    monkeypatch.setattr(jax, "local_device_count", lambda: devices)
    assert Options(data=tmp_path, out=tmp_path).chunk == scenes
    assert Options(data=tmp_path, out=tmp_path, chunk=2).chunk == 2
