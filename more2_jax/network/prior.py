"""The prior: encoder, decoder and their weights; initialize, save, load, encode, query."""

from __future__ import annotations

import dataclasses
import json
from contextlib import nullcontext
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Float

from more2_jax.config import PriorConfig, from_dict
from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.points import cleared, farthest_rows
from more2_jax.network.code_draws import draws, mean_code
from more2_jax.network.decoder import Decoder, ObjectField
from more2_jax.network.encoder import Encoder, neighbor_counts
from more2_jax.network.row_map import in_blocks
from more2_jax.network.two_decoders import decoder_weights, knows_normals, without_normals
from more2_jax.types import Anchors, Embedding, PointCloud, pytree
from more2_jax.whole_file import whole_file

FORMAT = 1  # of weight files


@pytree
class Prior:
    """Trained weights of encoder and decoder, and their settings."""

    params: dict[str, Any]
    config: PriorConfig = flax.struct.field(pytree_node=False)
    name: str = flax.struct.field(pytree_node=False, default="unnamed")


def init_prior(config: PriorConfig, key: Array, name: str = "random") -> Prior:
    """Random weights. Raises ValueError if a block would choose from fewer points than `neighbors`."""
    _, shapes = _shapes(config)
    e, (encoder_key, decoder_key) = config.encoder, jax.random.split(key)
    points, mask = jnp.zeros((e.points, 3)), jnp.ones(e.points, bool)
    # Weights depend on the shapes of the inputs alone: compiled, nothing is computed of them.
    embedding = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    encoder = jax.jit(Encoder(e, keep=config.decoder.local_blocks).init)(encoder_key, points, mask)
    decoder = jax.jit(Decoder(config).init)(decoder_key, embedding, points[:1])
    params = {"encoder": dict(encoder["params"]), "decoder": dict(decoder["params"])}
    if config.bare_decoder:
        bare = jax.jit(Decoder(without_normals(config)).init)(decoder_key, embedding, points[:1])
        params["bare_decoder"] = dict(bare["params"])
    return Prior(params=params, config=config, name=name)


@cache
def _shapes(config: PriorConfig) -> tuple[dict[str, Any], Embedding]:
    """Shapes and dtypes of all weights, and of the embedding of one cloud; computes nothing.

    Raises ValueError if a block would choose from fewer points than `neighbors`, or there is no draw.
    """
    e = config.encoder
    if config.draws < 1:
        raise ValueError(f"{config.draws} draws of a cloud; needed one or more")
    if (least := min(neighbor_counts(e, e.points))) < e.neighbors:
        raise ValueError(f"{e.points} points leave a block {least}; needed {e.neighbors} neighbors or more")
    key = jax.eval_shape(lambda: jax.random.key(0))
    points, one = (jax.ShapeDtypeStruct((n, 3), jnp.float32) for n in (e.points, 1))
    mask = jax.ShapeDtypeStruct((e.points,), bool)
    encoder = Encoder(e, keep=config.decoder.local_blocks)
    embedding, of_encoder = jax.eval_shape(encoder.init_with_output, key, points, mask)
    seen = jax.ShapeDtypeStruct((config.decoder.surface_points, 3), jnp.float32)
    embedding = jax.eval_shape(
        with_surface, embedding, seen, jax.ShapeDtypeStruct(seen.shape[:1], bool), seen
    )
    decoders = {"decoder": config} | (
        {"bare_decoder": without_normals(config)} if config.bare_decoder else {}
    )
    of_decoders = {
        k: jax.eval_shape(Decoder(c).init, key, embedding, one)["params"] for k, c in decoders.items()
    }
    return {"encoder": of_encoder["params"]} | of_decoders, embedding


def encode_ordered(
    prior: Prior,
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    normals: Float[Array, "n 3"] | None = None,
    train: bool = False,
) -> Embedding:
    """Φ of one cloud already in farthest-point order, `points_read` rows, unit normals where known; differentiable.

    `train`: products with weights are as precise as JAX's default on the device, not fully: rounding is less than a
    batch's noise.
    """
    c = prior.config
    encoder = Encoder(c.encoder, keep=c.decoder.local_blocks)
    # What the decoder sees of the surface beside them is no input of the encoder, whose codes it leaves as they are.
    first = slice(c.encoder.points if c.decoder.surface_points else None)
    ahead = points[first], mask[first], None if normals is None else normals[first]
    with nullcontext() if train else jax.default_matmul_precision("highest"):
        code: Embedding = encoder.apply({"params": prior.params["encoder"]}, *ahead)  # type: ignore[assignment]
    if not c.decoder.surface_points:
        return code
    last = slice(c.decoder.surface_points)
    return with_surface(code, points[last], mask[last], None if normals is None else normals[last])


def with_surface(
    code: Embedding,
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    normals: Float[Array, "n 3"] | None = None,
) -> Embedding:
    """The code, and as its last anchors the observed points of the same frame, which have no features."""
    surface = Anchors(
        offset=jnp.where(mask[:, None], points - code.center, 0.0),
        features=None,
        mask=mask,
        normal=jnp.zeros_like(points) if normals is None else jnp.where(mask[:, None], normals, 0.0),
    )
    return dataclasses.replace(code, anchors=(*code.anchors, surface))


def anchor_levels(config: PriorConfig) -> int:
    """How many levels of anchors an embedding has."""
    return len(config.decoder.local_blocks) + bool(config.decoder.surface_points)


def points_read(config: PriorConfig) -> int:
    """How many points of a cloud an embedding is made of; the encoder reads the first of them."""
    return max(config.encoder.points, config.decoder.surface_points)


def encode_one(
    prior: Prior,
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    normals: Float[Array, "n 3"] | None = None,
) -> Embedding:
    """Φ of one cloud: farthest-point sampling to the encoder's input size, then the network; differentiable.

    With `draws` in the prior's settings, the mean over so many draws of the cloud.
    """
    points = cleared(points, mask)

    def code(some: Bool[Array, " n"]) -> Embedding:
        index, real = farthest_rows(points, some, points_read(prior.config))
        return encode_ordered(prior, points[index], real, None if normals is None else normals[index])

    if prior.config.draws == 1:
        return code(mask)
    return mean_code(jax.vmap(code)(draws(points, mask, prior.config.draws, prior.config.encoder.points)))


@jax.jit
def _encode_many(
    prior: Prior, points: Float[Array, "b n 3"], mask: Bool[Array, "b n"], normals: Float[Array, "b n 3"]
) -> Embedding:
    return jax.vmap(partial(encode_one, prior))(points, mask, normals)


def encode(prior: Prior, cloud: PointCloud) -> Embedding:
    """Encodes a batch of clouds (from `pad_clouds`): Φ(sRX + t) = (F_inv, R·F_eqv, s·F_s, sR·F_c + t), paper §3.1.

    Returns a batch of embeddings. `center` is in meters relative to `origin`, which is the cloud's. Points, mask
    and weights may be traced. Normals go to the decoder with the anchors; the four codes depend on positions alone.
    Raises ValueError for points that are no batch of clouds, a mask or normals of another shape, and a cloud that
    is known to have no real point.
    """
    points, mask = cloud.points, cloud.mask
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(f"encode got points of shape {points.shape}; needed (batch, n, 3)")
    if mask.shape != points.shape[:2]:
        raise ValueError(f"encode got a mask of shape {mask.shape}; needed {points.shape[:2]}, as the points")
    if not isinstance(mask, Tracer) and (empty := np.flatnonzero(~np.asarray(mask).any(-1))).size:
        raise ValueError(f"clouds {empty.tolist()} have no points; encode needs at least one each")
    # Zeros, not None: clouds with and without normals share a compiled program.
    normals = jnp.zeros_like(points) if cloud.normals is None else cloud.normals
    if normals.shape != points.shape:
        raise ValueError(f"encode got normals of shape {normals.shape}; needed {points.shape}, as the points")
    return dataclasses.replace(_encode_many(prior, points, mask, normals), origin=cloud.origin)


def check_embedding(prior: Prior, embedding: Embedding, who: str) -> None:
    """Raises ValueError unless the decoder can be asked about the embedding, which another encoder may have made."""
    needed, got = anchor_levels(prior.config), len(embedding.anchors)
    if got != needed:
        raise ValueError(
            f"{who} got embeddings with {got} levels of anchors; the decoder of prior {prior.name!r} needed {needed}, "
            "as its own encoder makes"
        )


@full_precision
def object_field(prior: Prior, embedding: Embedding) -> ObjectField:
    """Folds one object's code into the decoder; then `field_sdf` is cheap for many points."""
    weights = decoder_weights(prior.params, prior.config, knows_normals(embedding))
    return Decoder(prior.config).apply({"params": weights}, embedding, method="field")  # type: ignore[return-value]


@full_precision
def field_sdf(prior: Prior, field: ObjectField, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Signed distance at points of the embedding's local frame; canonical units, negative inside."""
    weights = {"params": decoder_weights(prior.params, prior.config, field.known)}
    decoder = Decoder(prior.config)
    return in_blocks(lambda some: decoder.apply(weights, field, some, method="distance"), points)  # type: ignore[return-value]


def sdf_one(prior: Prior, embedding: Embedding, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Ψ for one object: signed distance at local points, canonical units (meters are the value × F_s)."""
    return field_sdf(prior, object_field(prior, embedding), points)


@jax.jit
def _sdf_many(prior: Prior, embedding: Embedding, points: Float[Array, "b n 3"]) -> Float[Array, "b n"]:
    return jax.vmap(partial(sdf_one, prior))(embedding, points)


def sdf(
    prior: Prior, embedding: Embedding, points: Float[Array | np.ndarray, "b n 3"]
) -> Float[Array, "b n"]:
    """Signed distances of a batch of objects at points in each scan's frame (meters), canonical units.

    Negative inside (paper §3.1); multiply by `embedding.scale` for meters. Points, embedding and weights may be traced.
    Points are shifted to the embedding's origin in their own precision (float64 on the host), then evaluated in the
    embedding's. Raises ValueError on shapes that differ, and on embeddings that the decoder does not take.
    """
    check_embedding(prior, embedding, "sdf")
    if points.ndim != 3 or points.shape[-1] != 3 or points.shape[:1] != embedding.scale.shape:
        raise ValueError(
            f"sdf got points {points.shape} for {embedding.scale.shape} objects; needed (objects, n, 3)"
        )
    if embedding.origin is not None:
        points = points - embedding.origin[:, None]
    local = jnp.asarray(points, embedding.scale.dtype)
    return _sdf_many(prior, dataclasses.replace(embedding, origin=None), local)


def save_prior(prior: Prior, path: str | Path, half: bool = True) -> None:
    """Writes weights and settings as one .npz (half precision unless `half` is False), whole or not at all."""
    flat = flatten_dict(jax.device_get(prior.params), sep="/")
    kind = np.float16 if half else np.float32
    header = json.dumps({"format": FORMAT, "name": prior.name, "config": dataclasses.asdict(prior.config)})
    arrays: dict[str, Any] = {k: np.asarray(v, kind) for k, v in flat.items()}
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, __header__=np.array(header), **arrays)


def load_prior(name: str | Path) -> Prior:
    """Loads shipped weights by name (`small`) or a file that `save_prior` wrote; ValueError says what is wrong."""
    path = _locate(name)
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file["__header__"]))
            flat = {k: jnp.asarray(file[k], jnp.float32) for k in file.files if k != "__header__"}
    except (KeyError, ValueError, OSError, EOFError) as error:
        raise ValueError(
            f"{path}: not a more2_jax weight file ({error}); `more2 prior import` makes one"
        ) from error
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: weight format {header.get('format')!r}; needed {FORMAT}")
    config = from_dict(PriorConfig, header["config"], where=str(path))
    prior = Prior(params=unflatten_dict(flat, sep="/"), config=config, name=header["name"])
    check_shapes(prior, str(path))
    return prior


def prior_name(name: str | Path) -> str:
    """The name that the weights `name` have, of which their scenes tell; they are not loaded. ValueError as there."""
    path = _locate(name)
    try:
        with np.load(path, allow_pickle=False) as file:
            return json.loads(str(file["__header__"]))["name"]
    except (KeyError, ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: not a more2_jax weight file ({error})") from error


def _flat(params: dict[str, Any]) -> dict[str, Any]:
    return dict(flatten_dict(params, sep="/"))


def _locate(name: str | Path) -> Path:
    shipped = Path(str(resources.files("more2_jax"))) / "assets" / "weights" / f"{name}.npz"
    if shipped.is_file():
        return shipped
    if Path(name).is_file():
        return Path(name)
    raise ValueError(f"prior {str(name)!r}: neither shipped ({', '.join(shipped_priors())}) nor a file")


def shipped_priors() -> list[str]:
    """Names of the weights inside the package."""
    folder = Path(str(resources.files("more2_jax"))) / "assets" / "weights"
    return sorted(p.stem for p in folder.glob("*.npz"))


def check_shapes(prior: Prior, where: str) -> None:
    """Raises ValueError, naming the first array that is missing, unknown or of another shape."""
    model, _ = _shapes(prior.config)
    needed, got = ({k: jnp.shape(v) for k, v in _flat(tree).items()} for tree in (model, prior.params))
    for name in sorted(needed | got):
        if needed.get(name) != got.get(name):
            raise ValueError(f"{where}: weights {name} have shape {got.get(name)}; needed {needed.get(name)}")
