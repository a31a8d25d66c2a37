"""The published checkpoint's names and layouts of weights, and ours (paper §3.1)."""

from __future__ import annotations

import re
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import unflatten_dict

from more2_jax.config import DecoderConfig, EncoderConfig, PriorConfig
from more2_jax.network.prior import Prior, check_shapes

PREFIX = "network_dict."
# Published name → ours. Published matrices are (out, in), ours (in, out).
RULES = (
    (r"encoder\.V_list\.(\d+)\.lin\.weight", r"encoder/block_\1/value/kernel"),
    (r"encoder\.V_list\.(\d+)\.act\.lin_dir\.weight", r"encoder/block_\1/value/direction"),
    (r"encoder\.K_list\.(\d+)\.lin\.weight", r"encoder/block_\1/key/kernel"),
    (r"encoder\.K_list\.(\d+)\.act\.lin_dir\.weight", r"encoder/block_\1/key/direction"),
    (r"encoder\.Q_list\.(\d+)\.lin\.weight", r"encoder/block_\1/query/kernel"),
    (r"encoder\.Q_list\.(\d+)\.act\.lin_dir\.weight", r"encoder/block_\1/query/direction"),
    (r"encoder\.conv_c\.lin\.weight", "encoder/head/kernel"),
    (r"encoder\.conv_c\.act\.lin_dir\.weight", "encoder/head/direction"),
    (r"encoder\.fc_inv\.weight", "encoder/invariant"),
    (r"encoder\.fc_center\.fc0\.lin\.weight", "encoder/center/inner/kernel"),
    (r"encoder\.fc_center\.fc0\.act\.lin_dir\.weight", "encoder/center/inner/direction"),
    (r"encoder\.fc_center\.lin1\.weight", "encoder/center/residual"),
    (r"encoder\.fc_center\.shortcut\.weight", "encoder/center/shortcut"),
    (r"encoder\.fc_center\.act2\.lin_dir\.weight", "encoder/center/direction"),
    (r"decoder\.lin(\d+)\.weight_v", r"decoder/layer_\1/direction"),
    (r"decoder\.lin(\d+)\.weight_g", r"decoder/layer_\1/gain"),
    (r"decoder\.lin(\d+)\.bias", r"decoder/layer_\1/bias"),
    (r"decoder\.lin(\d+)\.weight", r"decoder/layer_\1/kernel"),
)


def prior_from_published(weights: Mapping[str, np.ndarray], name: str) -> Prior:
    """Converts published weights (`network_dict.encoder.…`, `network_dict.decoder.…`) to a `Prior`.

    Widths are read off the arrays. Raises ValueError on a name that is not known or missing, or a shape that
    does not fit.
    """
    flat: dict[str, np.ndarray] = {}
    for key, value in weights.items():
        if key.startswith(PREFIX):
            flat[_our_name(key.removeprefix(PREFIX))] = np.asarray(value, np.float32)
    if not flat:
        raise ValueError(f"no array is named {PREFIX}…; needed a published checkpoint's model_state_dict")
    config = _config(flat)
    ours = {k: jnp.asarray(_layout(k, v)) for k, v in flat.items()}
    prior = Prior(params=unflatten_dict(ours, sep="/"), config=config, name=name)
    check_shapes(prior, name)
    return prior


def _our_name(published: str) -> str:
    linear_blocks = 2  # global contexts are counted from the first attention block
    if found := re.fullmatch(r"encoder\.global_conv_list\.(\d+)\.(lin|act\.lin_dir)\.weight", published):
        leaf = "kernel" if found[2] == "lin" else "direction"
        return f"encoder/block_{int(found[1]) + linear_blocks}/context/{leaf}"
    for pattern, ours in RULES:
        if found := re.fullmatch(pattern, published):
            return found.expand(ours)
    raise ValueError(f"unknown weights {PREFIX}{published}; needed the published encoder-decoder")


def _layout(name: str, value: np.ndarray) -> np.ndarray:
    if name.endswith(("/gain", "/bias")):
        return value.reshape(-1)
    return np.ascontiguousarray(value.T)


def _config(flat: Mapping[str, np.ndarray]) -> PriorConfig:
    blocks = sorted(int(k.split("/")[1][6:]) for k in flat if k.endswith("value/kernel"))
    layers = [k for k in flat if re.fullmatch(r"decoder/layer_\d+/gain", k)]
    try:
        widths = tuple(flat[f"encoder/block_{i}/value/kernel"].shape[0] for i in blocks)
        code = flat["encoder/invariant"].shape[0]
        hidden = flat["decoder/layer_0/bias"].shape[0]
    except KeyError as missing:
        raise ValueError(f"weights {missing} are missing; needed the published encoder-decoder") from missing
    encoder = EncoderConfig(widths=widths, code=code)
    return PriorConfig(encoder=encoder, decoder=DecoderConfig(hidden=hidden, layers=len(layers)))
