"""One program on all devices of all hosts: batches are split by rows, everything else is on every device.

On CPUs a device is a core: most loops of a step run on one thread, so cores share rows better than loops.
"""

from __future__ import annotations

import os
from contextlib import suppress
from importlib.metadata import version
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

T = TypeVar("T")
ROWS = "rows"  # of a batch: the one axis of the mesh
IN_ENVIRONMENT = ("JAX_COORDINATOR_ADDRESS", "COORDINATOR_ADDRESS")
# Loops in registers of 512 bits, where a CPU has such: 4 % of a step (docs/developing/notebook/speed_layers.md). XLA
# stops at flags that it does not know: only versions that have it are told.
VECTOR_WIDTH, KNOWS_VECTOR_WIDTH = "xla_cpu_prefer_vector_width", ("0.10.",)
CHOSEN_BY_FLAG = "xla_force_host_platform_device_count"


def shares(batch: int, cores: int) -> int:
    """The most devices, one a core at most, that share the rows of a batch evenly."""
    return max(n for n in range(1, min(batch, cores) + 1) if batch % n == 0)


def device_a_core(batch: int, coordinator: str = "") -> None:
    """Divides the CPU into devices that share `batch`; before anything else asks JAX for a device.

    Their programs use wide registers (`wide_vectors`); those on accelerators do not run there. The devices stay as they
    are for a process among several, which may share their cores; where XLA_FLAGS or JAX_NUM_CPU_DEVICES have chosen;
    and where JAX has its devices already.
    """
    wide_vectors()
    among_several = coordinator or any(os.environ.get(name) for name in IN_ENVIRONMENT)
    if not (among_several or chosen_by_user()):
        with suppress(RuntimeError):  # what JAX says when it is too late
            jax.config.update("jax_num_cpu_devices", shares(batch, cores()))


def wide_vectors() -> None:
    """Has XLA's programs for CPUs use the widest registers; before anything asks JAX for a device."""
    given = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(KNOWS_VECTOR_WIDTH) and VECTOR_WIDTH not in given:
        os.environ["XLA_FLAGS"] = f"{given} --{VECTOR_WIDTH}=512".strip()


def chosen_by_user() -> bool:
    """Whether the environment says how many devices a CPU is."""
    return "JAX_NUM_CPU_DEVICES" in os.environ or CHOSEN_BY_FLAG in os.environ.get("XLA_FLAGS", "")


def cores() -> int:
    """That this process may use; on systems that do not tell, all there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    after that there is time. Between here and the first step every process reads, initializes and compiles for itself.
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


def to_read(mesh: Mesh, tree: T) -> T:
    """As `everywhere`, for what is gigabytes and never written: the devices of a CPU look at the same memory."""
    cpu = mesh.devices.flat[0].platform == "cpu"
    return everywhere(mesh, jax.tree.map(np.asarray, tree) if cpu else tree)


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
