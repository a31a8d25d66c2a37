"""`more2 prior list | info | import | check`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from more2_jax.cli.session import Session

if TYPE_CHECKING:
    from more2_jax.network.prior import Prior

LARGEST_DEVIATION = 1e-5  # relative to each array's largest value


def list_shipped() -> None:
    """Prints the weights inside the package."""
    from more2_jax.network.prior import load_prior, shipped_priors

    names = shipped_priors()
    table = Table("name", "parameters", "code", "points")
    for name in names:
        prior = load_prior(name)
        encoder = prior.config.encoder
        table.add_row(escape(name), f"{count(prior):,}", str(encoder.code), str(encoder.points))
    session = Session()
    session.show(table) if names else session.say(
        "no weights are shipped; `more2 prior import` converts some"
    )


def info(name: str) -> None:
    """Prints what a weight file holds."""
    from more2_jax.config import to_yaml
    from more2_jax.network.prior import load_prior

    prior = load_prior(name)
    Session().say(f"{prior.name}: {count(prior):,} parameters\n{to_yaml(prior.config)}".rstrip())


def count(prior: Prior) -> int:
    """Number of parameters."""
    import jax

    return sum(leaf.size for leaf in jax.tree.leaves(prior.params))


def import_published(checkpoint: Path, out: Path) -> None:
    """Converts a published PyTorch checkpoint, in full precision; no torch, no code from the file."""
    from more2_jax.network.prior import save_prior
    from more2_jax.network.published_weights import prior_from_published
    from more2_jax.network.torch_checkpoint import read_checkpoint

    if out.suffix != ".npz":
        raise ValueError(f"{out}: suffix {out.suffix!r}; needed .npz")
    if out.exists():
        raise ValueError(f"{out}: exists; needed a new file")
    prior = prior_from_published(read_checkpoint(checkpoint), out.stem)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_prior(prior, out, half=False)
    widths = dataclasses.asdict(prior.config.encoder)["widths"]
    Session().say(
        f"wrote {out}: {count(prior):,} parameters, encoder widths {list(widths)}; use it with --prior {out}"
    )


def check(checkpoint: Path, reference: Path | None) -> int:
    """Prints how far weights are from a reference; 0 if all five arrays are below 1e-5, else 1.

    With one file, it is the reference and holds the weights too.
    """
    from more2_jax.network.parity import check_prior, read_reference, weights_of_reference
    from more2_jax.network.torch_checkpoint import read_checkpoint

    session = Session()
    arrays = read_reference(checkpoint if reference is None else reference)
    weights = weights_of_reference(arrays) if reference is None else read_checkpoint(checkpoint)
    deviations = check_prior(weights, arrays)
    for name, value in deviations.items():
        session.say(f"{name:6} {value:.2e}")
    good = all(value < LARGEST_DEVIATION for value in deviations.values())
    session.say(f"{'all' if good else 'NOT all'} below {LARGEST_DEVIATION:.0e} of the array's largest value")
    return 0 if good else 1
