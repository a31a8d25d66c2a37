"""Two decoders in one file: `python -m train.tools.join --bare small --seeing WEIGHTS --out small.npz`.

One that never saw normals, asked where none is known, and one trained to read them (`network.two_decoders`), behind
the encoder that both have: codes do not depend on which of them is asked.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np

from more2_jax.network.prior import Prior, load_prior, save_prior
from more2_jax.network.two_decoders import without_normals
from train.run.program import run
from train.run.start import one_decoder


def main(bare: str, seeing: str, out: Path) -> None:
    """Writes weights in half precision, as they are shipped.

    Args:
        bare: name of shipped weights, or a file; of two decoders the one that reads no normals.
        seeing: weights that `train.prior` with `train: decoder` made from those.
        out: the .npz to write; its name becomes the weights'.
    """
    prior = joined(load_prior(bare), load_prior(seeing))
    save_prior(dataclasses.replace(prior, name=out.stem), out)
    print(f"{out}: {sum(x.size for x in jax.tree.leaves(prior.params)):,} parameters")


def joined(bare: Prior, seeing: Prior) -> Prior:
    """A prior with both decoders. Raises ValueError unless they differ in nothing but the reading of normals."""
    bare, seeing = one_decoder(bare, normals=False), one_decoder(seeing, normals=True)
    same = dataclasses.replace(bare.config, draws=seeing.config.draws)  # which no weights depend on
    if not seeing.config.decoder.normals or same != without_normals(seeing.config):
        raise ValueError(
            f"{bare.name!r} and {seeing.name!r} are of other settings; needed ones that differ in decoder.normals alone"
        )
    codes = [jax.tree.leaves(p.params["encoder"]) for p in (bare, seeing)]
    if not all(np.array_equal(a, b) for a, b in zip(*codes, strict=True)):
        raise ValueError(f"{bare.name!r} and {seeing.name!r} have other encoders; needed the same weights")
    params = seeing.params | {"bare_decoder": bare.params["decoder"]}
    return dataclasses.replace(
        seeing, params=params, config=dataclasses.replace(seeing.config, bare_decoder=True)
    )


if __name__ == "__main__":
    run(main)
