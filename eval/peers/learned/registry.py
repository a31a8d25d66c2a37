"""The peers by name: their networks, losses and samples, and the files that hold their weights."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import Array
from jaxtyping import Float

from eval.peers.learned.conv_onet import ConvONet, upright_occupancy_loss
from eval.peers.learned.geotransformer import GeoTransformer, superpoint_loss
from eval.peers.learned.rpmnet import RPMNet, registration_loss
from eval.peers.learned.vn_dgcnn import VNDGCNN, matching_loss
from eval.peers.learned.vn_onet import VNONet, occupancy_loss
from train.shards.sampling import TrainingSample

Params = Any  # a tree of arrays
Loss = Callable[[nn.Module, Params, TrainingSample, Array], Float[Array, ""]]
Task = Literal["matching", "registration", "reconstruction"]
TASKS: tuple[Task, ...] = get_args(Task)

FORMAT = 1  # of weight files
SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True, kw_only=True)
class LearnedPeer:
    """One network, and how it is trained."""

    title: str  # in tables
    task: Task  # that it is trained for
    network: nn.Module
    loss: Loss
    points: int  # of a cloud
    batch: int  # shapes a step, two partial clouds each
    learning_rate: float = 1e-3
    also: tuple[Task, ...] = ()  # tables that its network serves without being trained for them

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tables that it may stand in."""
        return (self.task, *self.also)


PEERS: Mapping[str, LearnedPeer] = {
    "vn_dgcnn": LearnedPeer(
        title="VN-DGCNN, small",
        task="matching",
        network=VNDGCNN(),
        loss=matching_loss,
        points=256,
        batch=12,
    ),
    "vn_onet": LearnedPeer(
        title="VN-ONet, small",
        task="reconstruction",
        network=VNONet(),
        loss=occupancy_loss,
        points=256,
        batch=8,
        also=("matching",),
    ),
    "conv_onet": LearnedPeer(
        title="ConvONet, small",
        task="reconstruction",
        network=ConvONet(),
        loss=upright_occupancy_loss,
        points=384,
        batch=8,
    ),
    "rpmnet": LearnedPeer(
        title="RPM-Net, small",
        task="registration",
        network=RPMNet(),
        loss=registration_loss,
        points=128,
        batch=12,
    ),
    "geotransformer": LearnedPeer(
        title="GeoTransformer, small",
        task="registration",
        network=GeoTransformer(),
        loss=superpoint_loss,
        points=256,
        batch=12,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Training:
    """How weights came about."""

    steps: int
    minutes: float  # of processor time, after compiling
    shapes: int  # to draw from
    clouds: int  # drawn
    loss: float  # mean of the last hundredth of the steps


@dataclass(frozen=True, kw_only=True)
class Trained:
    """A peer with its weights."""

    name: str
    params: Params
    training: Training

    @property
    def peer(self) -> LearnedPeer:
        """What the weights are of."""
        return PEERS[self.name]


def peer_named(name: str) -> LearnedPeer:
    """The peer. Raises ValueError if there is none of that name."""
    if name not in PEERS:
        raise ValueError(f"no learned peer {name!r}; there are {', '.join(PEERS)}")
    return PEERS[name]


def start(name: str, seed: int) -> Params:
    """Random weights."""
    peer = peer_named(name)
    clouds = jnp.zeros((1, 2, peer.points, 3)), jnp.ones((1, 2, peer.points), bool)
    queries = jnp.zeros((1, 2, 1, 3))
    given = (clouds[0][0, 0], clouds[1][0, 0])
    extra = {"matching": (), "registration": given, "reconstruction": (queries[0, 0],)}[peer.task]
    return jax.jit(peer.network.init)(jax.random.key(seed), *given, *extra)


def save(trained: Trained, path: Path) -> None:
    """Writes weights in half precision, with what they are of and how they came about."""
    header = {"format": FORMAT, "peer": trained.name, "training": asdict(trained.training)}
    flat = flatten_dict(jax.device_get(trained.params), sep="/")
    arrays: dict[str, Any] = {k: np.asarray(v, np.float16) for k, v in flat.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, __header__=np.array(json.dumps(header)), **arrays)


def load(given: str) -> Trained:
    """Weights by the name of a peer that is shipped, or from a file of `eval.peers.learned.train`.

    Raises ValueError if there is no such name or file, if the file holds no weights, or those of another network.
    """
    path = Path(given) if given.endswith(".npz") else SHIPPED / f"{given}.npz"
    if not path.suffix == ".npz" or (path.parent == SHIPPED and given not in shipped()):
        raise ValueError(
            f"no learned peer {given!r} is shipped; there are {', '.join(shipped())}, or a file .npz"
        )
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["__header__"]))
            flat = {k: np.asarray(file[k], np.float32) for k in file.files if k != "__header__"}
        name, training = header["peer"], Training(**header["training"])
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no weights of a learned peer ({error})") from error
    params = unflatten_dict(flat, sep="/")
    _check(peer_named(name), name, params, path)
    return Trained(name=name, params=jax.tree.map(jnp.asarray, params), training=training)


def shipped() -> list[str]:
    """Names of peers whose weights lie beside this module."""
    return [name for name in PEERS if (SHIPPED / f"{name}.npz").exists()]


def _check(peer: LearnedPeer, name: str, params: Params, path: Path) -> None:
    needed = jax.eval_shape(partial(start, name), 0)
    shapes = [jax.tree.map(lambda x: tuple(x.shape), tree) for tree in (needed, params)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"{path}: weights of another form of {peer.title}; train it anew")


def of_task(given: tuple[str, ...], task: Task) -> list[Trained]:
    """The peers that were asked for. Raises ValueError as `load`, and if one does not do `task`."""
    found = [load(g) for g in given]
    for one in found:
        if task not in one.peer.tasks:
            does = " and ".join(one.peer.tasks)
            raise ValueError(f"{one.peer.title} is of {does}; needed a peer of {task}")
    return found


def stated(given: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """What a run says of them: by title, a digest of the weights. Nothing where none was asked for."""
    digests = {}
    for one in map(load, given):
        content = b"".join(np.ascontiguousarray(x).tobytes() for x in jax.tree.leaves(one.params))
        digests[one.peer.title] = hashlib.sha256(content).hexdigest()[:12]
    return {"learned": digests} if digests else {}


def parameters(params: Params) -> int:
    """How many numbers are learned."""
    return sum(x.size for x in jax.tree.leaves(params))
