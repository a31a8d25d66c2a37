"""A function over many inputs: in order, whoever computes; what all share goes to each process once."""

import pytest
from places import ROOT
from worker_tasks import Counted, times_ten

from train.furniture.parallel_map import Workers


def shares_once(folder, workers):
    """Held for a team of two processes."""
    with workers as pool:
        found = list(pool.map_shared(times_ten, range(12)))
        assert list(pool.map(abs, [-3, 2])) == [3, 2]
        with pytest.raises(ValueError, match=f"^-1 in {folder.name}$"):
            list(pool.map_shared(times_ten, [1, -1, 2]))
    assert [value for value, _ in found] == [10 * n for n in range(12)]
    unpacked = [path.name.split("_")[1] for path in folder.glob("unpacked_*")]
    assert {str(pid) for _, pid in found} <= set(unpacked)
    assert len(unpacked) == len(set(unpacked)) <= 2


def test_what_is_shared_goes_to_each_process_once(tmp_path):
    shares_once(tmp_path, Workers(2, shared=Counted(tmp_path)))


@pytest.mark.slow
def test_what_is_shared_goes_to_each_process_of_a_cluster_once(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT / 'tests/support'}")  # for the nodes
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    try:
        shares_once(tmp_path, Workers(ray_address=cluster.address, shared=Counted(tmp_path)))
    finally:
        cluster.shutdown()
