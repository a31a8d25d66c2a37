"""One program on all devices of all hosts: batches are split by rows, everything else is on every device."""

from __future__ import annotations

import os
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

T = TypeVar("T")
ROWS = "rows"  # of a batch: the one axis of the mesh
IN_ENVIRONMENT = ("JAX_COORDINATOR_ADDRESS", "COORDINATOR_ADDRESS")


def connect(coordinator: str, processes: int, process: int) -> None:
    """Joins the other processes of this run; before anything else asks JAX for a device.

    With `coordinator` (host:port of process 0) by the arguments; without, by the environment if
    JAX_COORDINATOR_ADDRESS is set ("auto" there leaves it all to JAX, which knows Slurm, MPI and cloud TPUs);
    otherwise this process is alone. Raises ValueError if `process` is not one of `processes`.
    """
    if coordinator:
        if not 0 <= process < processes:
            raise ValueError(f"process {process} of {processes}; needed 0 to {processes - 1}")
        jax.distributed.initialize(coordinator, processes, process)
        meet()
        return
    address = next((os.environ[name] for name in IN_ENVIRONMENT if os.environ.get(name)), "")
    if address == "auto":
        del os.environ["JAX_COORDINATOR_ADDRESS"]
        jax.distributed.initialize()
    elif address:
        count, me = os.environ.get("JAX_PROCESS_COUNT"), os.environ.get("JAX_PROCESS_ID")
        jax.distributed.initialize(address, int(count) if count else None, int(me) if me else None)
    meet()


def meet() -> None:
    """Exchanges something with the other processes as soon as they are there.

    On CPUs the first exchange opens the connections, and fails if another process comes to it over 30 seconds later;
    after that there is time. Between here and the first step every process reads, initialises and compiles for itself.
    """
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("connected")


def device_mesh(batch: int) -> Mesh:
    """All devices of all processes in a row. Raises ValueError unless they share `batch` evenly."""
    devices = np.array(jax.devices())
    if batch % devices.size:
        raise ValueError(f"a batch of {batch} on {devices.size} devices; needed a multiple")
    return Mesh(devices, (ROWS,))


def by_rows(mesh: Mesh) -> NamedSharding:
    """Every device has its share of the leading axis."""
    return NamedSharding(mesh, PartitionSpec(ROWS))


def everywhere(mesh: Mesh, tree: T) -> T:
    """Puts a whole copy of every array on every device; all processes must hold the same."""
    sharding = NamedSharding(mesh, PartitionSpec())

    def put(x: jax.Array | np.ndarray) -> jax.Array:
        if jax.process_count() == 1:
            return jax.device_put(x, sharding)
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, sharding, lambda part: host[part])

    return jax.tree.map(put, tree)


def here(tree: T) -> T:
    """The copy of this process' first device, for work that the processes do not share."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def is_first() -> bool:
    """True in the one process that writes logs, weights and pictures."""
    return jax.process_index() == 0


def agreed(of_first: bool) -> bool:
    """What the first process says; the clocks of hosts differ, and all must stop at the same step."""
    if jax.process_count() == 1:
        return of_first
    return bool(multihost_utils.broadcast_one_to_all(np.array(of_first)))
