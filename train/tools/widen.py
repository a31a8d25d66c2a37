"""Starts a wide prior from a trained narrow one: `python -m train.tools.widen --prior small --config … --out wide.npz`.

Codes and distances stay what they were (to rounding, where points, neighbors and thinning are equal), so training goes
on instead of beginning anew. New channels begin in one of two ways: with incoming weights of zero, where what they hold
would change neighbors or norms, or with outgoing weights of zero elsewhere. The other side is random, so gradients
reach every channel. A new layer of the decoder begins as the identity, which ReLU leaves alone.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import Array

from more2_jax.config import DecoderConfig, PriorConfig, load_config
from more2_jax.network.prior import Prior, init_prior, load_prior, save_prior
from train.run.program import run
from train.run.settings import TrainingRun
from train.run.start import one_decoder

Weights = dict[str, np.ndarray]
Parts = Sequence[tuple[int, int]]  # widths, before and after, of what stands side by side in a matrix' rows


@dataclasses.dataclass(frozen=True)
class Kept:
    """What share of its random start a weight keeps, by the channels that it leads from and to."""

    old_to_new: float = 1.0
    new_to_old: float | np.ndarray = 1.0  # one number, or one a row
    new_to_new: float = 1.0


FREE = Kept()
SILENT = Kept(old_to_new=0.0)  # new outputs are zero, as the new inputs are
UNHEARD = Kept(new_to_old=0.0)  # new inputs are not zero, but old outputs do not depend on them
CLOSED = Kept(0.0, 0.0, 0.0)  # both
# A new head's query is zero. Were its key zero too, neither would ever have a gradient; a key of this size
# changes the norm by which all keys are divided by 1e-4 of it.
FAINT = Kept(old_to_new=0.01)

# A weight's name in the encoder: how many parts stand side by side in its rows, and what new channels begin with. What
# a block gives has to be zero in new channels (its neighbors are chosen by them), what an attention block mixes not.
RULES = (
    (r"first/value/kernel", 1, SILENT),
    (r"linear/value/kernel", 2, SILENT),
    (r"(first|linear)/value/direction", 1, FREE),
    (r"attention/value/kernel", 2, FREE),
    (r"attention/query/kernel", 1, SILENT),
    (r"attention/query/direction", 1, FREE),
    (r"attention/key/kernel", 2, FAINT),
    (r"attention/(key|value)/direction", 1, UNHEARD),
    (r"attention/context/kernel", 2, CLOSED),
    (r"attention/context/direction", 1, FREE),
    (r"head/kernel|invariant", 1, SILENT),
    (r"head/direction", 1, FREE),
    (r"center/inner/kernel|center/shortcut", 1, FREE),
    (r"center/inner/direction|center/residual", 1, UNHEARD),
    (r"center/direction", 1, FREE),
)


def main(prior: str, config: Path, out: Path, seed: int = 0) -> None:
    """Writes weights for `python -m train.prior --warm-start`.

    Args:
        prior: name of shipped weights, or a file.
        config: YAML whose `model` is at least as wide and deep everywhere.
        out: the .npz to write, in full precision; its name becomes the weights'.
        seed: of the new channels' weights.
    """
    wide = widen(load_prior(prior), load_config(config, TrainingRun).model, jax.random.key(seed))
    save_prior(dataclasses.replace(wide, name=out.stem), out, half=False)
    print(f"{out}: {sum(x.size for x in jax.tree.leaves(wide.params)):,} parameters")


def widen(prior: Prior, config: PriorConfig, key: Array) -> Prior:
    """A prior of `config` that gives the codes (new channels zero) and distances of `prior`.

    To rounding, and where `points`, `neighbors` and `downsample_factors` are equal. Raises ValueError, naming the
    setting, where `config` is narrower or of another structure.
    """
    prior = one_decoder(prior, config.decoder.normals)
    check(prior.config, config)
    # F_s is a mean over the channels of the code, new ones included.
    more = config.encoder.code / prior.config.encoder.code
    scale = prior.config.encoder.output_scale * more
    config = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, output_scale=scale))
    fresh, known = (_flat(params) for params in (init_prior(config, key).params, prior.params))
    wide = decoder_weights(fresh, known, prior.config, config)
    for name, old in known.items():
        if name.startswith("encoder/"):
            wide[name] = encoder_weights(name, fresh[name], old, config.encoder.linear_blocks, more)
        elif name.startswith("decoder/local_"):
            wide[name] = lookup_weights(fresh[name], old)
    params = unflatten_dict({k: jnp.asarray(v, jnp.float32) for k, v in wide.items()}, sep="/")
    return Prior(params=params, config=config, name=prior.name)


def _flat(params: dict[str, Any]) -> Weights:
    return {k: np.asarray(v) for k, v in flatten_dict(params, sep="/").items()}


def grown(fresh: np.ndarray, known: np.ndarray, rows: Parts, columns: Parts, kept: Kept) -> np.ndarray:
    """`known` within `fresh`, of whose own numbers `kept` remains."""
    row, column = positions(rows), positions(columns)
    old_row, old_column = np.isin(np.arange(fresh.shape[0]), row), np.isin(np.arange(fresh.shape[1]), column)
    from_old = np.where(old_column, 0.0, kept.old_to_new)
    from_new = np.where(old_column, np.reshape(kept.new_to_old, (-1, 1)), kept.new_to_new)
    wide = fresh * np.where(old_row[:, None], from_old, from_new)
    wide[np.ix_(row, column)] = known
    return wide


def positions(parts: Parts) -> np.ndarray:
    """Where the old channels are, each part having grown at its end."""
    starts = np.cumsum([0, *(after for _, after in parts[:-1])])
    return np.concatenate([s + np.arange(before) for s, (before, _) in zip(starts, parts, strict=True)])


def encoder_weights(
    name: str, fresh: np.ndarray, known: np.ndarray, linear_blocks: int, more: float
) -> np.ndarray:
    """One matrix of the encoder, widened; `more` is what the constant of F_s and F_c was multiplied by."""
    name = name.removeprefix("encoder/")
    if block := re.match(r"block_(\d+)", name):
        kind = "first" if block[1] == "0" else "linear" if int(block[1]) < linear_blocks else "attention"
        name = name.replace(block[0], kind)
    count, kept = next((count, kept) for pattern, count, kept in RULES if re.fullmatch(pattern, name))
    rows = [(len(known) // count, len(fresh) // count)] * count
    wide = grown(fresh, known, rows, [(known.shape[1], fresh.shape[1])], kept)
    # Both lead from the code to F_c's offset, which that constant multiplies.
    return wide / more if name in ("center/inner/kernel", "center/shortcut") else wide


def lookup_weights(fresh: np.ndarray, known: np.ndarray) -> np.ndarray:
    """A matrix of a look-up, whose inputs are multiplied by the root of their number; or its bandwidths."""
    if known.ndim == 1:
        return known
    share = np.sqrt(len(known) / len(fresh))
    columns = [(known.shape[1], fresh.shape[1])]
    return grown(fresh, share * known, [(len(known), len(fresh))], columns, FREE)


def decoder_weights(fresh: Weights, known: Weights, old: PriorConfig, new: PriorConfig) -> Weights:
    """The decoder's dense layers, by the names of `fresh`."""
    before, after = old.decoder, new.decoder
    hidden, code = (before.hidden, after.hidden), (old.encoder.code, new.encoder.code)
    # The query's distance, and what is looked up.
    rest = len(known["decoder/layer_0/direction"]) - 2 * code[0]
    inputs = [code, code, (rest, rest)]
    ratios = old.inv_gain / new.inv_gain, old.eqv_gain / new.eqv_gain, 1.0
    gains = np.repeat(ratios, (code[0], code[0], rest))
    heard = np.ones(2 * code[1] + rest)  # new channels of the code are zero
    unheard = np.zeros(after.hidden)  # new hidden units are not
    wide: Weights = {}
    for layer in range(after.layers):
        kernel, bias = known_layer(known, before, source_layer(layer, before, after))
        rows, kept = [hidden], unheard
        if layer == 0:
            rows, kept = inputs, heard
        elif layer == after.skip_layer:
            rows, kept = [hidden, *inputs], np.concatenate([unheard, heard])
        if layer in (0, after.skip_layer):
            kernel[-len(gains) :] *= gains[:, None]
        name = f"decoder/layer_{layer}"
        kernel = grown(fresh[f"{name}/direction"], kernel, rows, [hidden], Kept(new_to_old=kept))
        wide |= {f"{name}/direction": kernel, f"{name}/gain": np.linalg.norm(kernel, axis=0)}
        wide[f"{name}/bias"] = np.concatenate([bias, np.zeros(after.hidden - before.hidden)])
    source, target = f"decoder/layer_{before.layers}", f"decoder/layer_{after.layers}"
    kernel = grown(fresh[f"{target}/kernel"], known[f"{source}/kernel"], [hidden], [(1, 1)], UNHEARD)
    return wide | {f"{target}/kernel": kernel, f"{target}/bias": known[f"{source}/bias"]}


def source_layer(layer: int, before: DecoderConfig, after: DecoderConfig) -> int | None:
    """Which old layer a layer was; None if it is new: the last ones ahead of the skip, and of all."""
    if layer < after.skip_layer:
        return layer if layer < before.skip_layer else None
    found = layer - after.skip_layer + before.skip_layer
    return found if found < before.layers else None


def known_layer(known: Weights, config: DecoderConfig, layer: int | None) -> tuple[np.ndarray, np.ndarray]:
    """A hidden layer's kernel, weight normalization applied, and its bias; the identity for a new one."""
    if layer is None:
        return np.eye(config.hidden), np.zeros(config.hidden)
    direction, gain, bias = (known[f"decoder/layer_{layer}/{k}"] for k in ("direction", "gain", "bias"))
    return direction * (gain / np.linalg.norm(direction, axis=0)), bias


SAME = {
    "encoder": ("linear_blocks", "head_channels", "leak", "downsample_blocks"),
    "decoder": ("local_blocks", "local_channels", "bandwidths"),
}


def check(old: PriorConfig, new: PriorConfig) -> None:
    """Raises ValueError, naming the first setting that stands in the way of widening `old` to `new`."""
    for part, names in SAME.items():
        for name in names:
            was, wanted = getattr(getattr(old, part), name), getattr(getattr(new, part), name)
            if wanted != was:
                raise ValueError(f"widening: {part}.{name} is {wanted}; needed {was}, as in the narrow prior")
    if old.decoder.narrow_skip or new.decoder.narrow_skip:
        raise ValueError("widening: decoder.narrow_skip is true; needed false in both priors")
    e, d = new.encoder, new.decoder
    if len(e.widths) != len(old.encoder.widths):
        raise ValueError(f"widening: encoder.widths has {len(e.widths)}; needed {len(old.encoder.widths)}")
    if odd := [w for w in e.widths[e.linear_blocks :] if w % e.head_channels]:
        raise ValueError(f"widening: encoder.widths has {odd[0]}; needed multiples of {e.head_channels}")
    least = {
        **{f"encoder.widths[{i}]": (w, old.encoder.widths[i]) for i, w in enumerate(e.widths)},
        "encoder.code": (e.code, old.encoder.code),
        "decoder.hidden": (d.hidden, old.decoder.hidden),
        "decoder.skip_layer": (d.skip_layer, old.decoder.skip_layer),
        "decoder.layers after the skip": (
            d.layers - d.skip_layer,
            old.decoder.layers - old.decoder.skip_layer,
        ),
    }
    for name, (wanted, was) in least.items():
        if wanted < was:
            raise ValueError(f"widening: {name} is {wanted}; needed {was} or more")


if __name__ == "__main__":
    run(main)
