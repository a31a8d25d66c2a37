"""Two Ray nodes on this machine, 40 scenes, one actor killed in the middle: nothing lost, nothing twice."""

import json
import os
import signal
import threading
import time

import psutil
import pytest
from command_line import FEW_STEPS, boxes, scan_file
from places import ROOT

from more2_jax.cli.main import main

SCENES = 40
KILLED_AFTER = 12  # scenes that are begun


def actors():
    """Processes of the actors that work, by the pid of the node they are on."""
    found = {}
    for process in psutil.process_iter(["cmdline", "ppid"]):
        if (process.info["cmdline"] or [""])[0].startswith("ray::Desk"):
            found.setdefault(process.info["ppid"], []).append(process.pid)
    return found


def manifest(place, prior):
    """Writes scenes.csv with its scans and settings; the scenes' names."""
    for name, shift in (("a", 0.0), ("b", 0.3)):
        scan_file(place / f"{name}.ply", *boxes(shift))
    (place / "quick.yaml").write_text(FEW_STEPS)
    names = [f"room_{k:02d}" for k in range(SCENES)]
    rows = [f"{n},a.ply;b.ply,quick.yaml,{prior}" for n in names]
    (place / "scenes.csv").write_text("\n".join(["name,scans,config,prior", *rows]) + "\n")
    return names


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_forty_scenes_on_two_nodes_of_which_an_actor_is_killed(tmp_path, tiny, capsys, monkeypatch):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # for the nodes
    monkeypatch.setenv("RAY_worker_niceness", "0")  # else it takes for ever beside anything
    names = manifest(tmp_path, tiny)
    out, seen = tmp_path / "all", []

    def kill_one():
        while len(list(out.glob("room_*"))) < KILLED_AFTER:
            time.sleep(0.2)
        seen.append(actors())
        os.kill(next(iter(seen[0].values()))[0], signal.SIGKILL)

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        began = time.perf_counter()
        code = main(["batch", str(tmp_path / "scenes.csv"), "--out", str(out), "--ray", cluster.address])
        seconds = time.perf_counter() - began
        killer.join(10)
    finally:
        cluster.shutdown()
    told = capsys.readouterr()
    print(f"{SCENES} scenes, {seconds:.0f} s, actors by node {seen}\n{told.out}")
    assert len(seen) == 1 and len(seen[0]) == 2 and all(len(pids) == 1 for pids in seen[0].values())
    assert code == 0 and told.err == ""
    said = [line.split()[1] for line in told.out.splitlines() if line.startswith("row ")]
    assert sorted(map(int, said)) == list(range(1, SCENES + 1))  # each once
    assert f"{SCENES} scenes done, 0 were finished before, 0 failed" in told.out
    # The seconds aside, all folders are the same scene, ended once, with nothing left beside them.
    contents = [json.loads((out / n / "scene.json").read_text()) for n in names]
    assert {json.dumps({**c, "timing_s": None}) for c in contents} == {
        json.dumps({**contents[0], "timing_s": None})
    }
    assert all((out / n / "run.log").read_text().count("objects over 2 scans; seconds") == 1 for n in names)
    assert [p.name for p in out.iterdir() if p.name.startswith(".")] == []
