"""The commands `more2 prior …`, as the command line reads them; `priors.py` has what they do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitSubcommandPrefixes, Positional, subcommand

from more2_jax.cli import priors


@dataclass(frozen=True)
class PriorList:
    """The weights inside the package.

    Example: more2 prior list
    """

    def __call__(self) -> int:
        priors.list_shipped()
        return 0


@dataclass(frozen=True)
class PriorInfo:
    """What a weight file holds.

    Example: more2 prior info small
    """

    name: Positional[str]
    """Name of shipped weights, or a file."""

    def __call__(self) -> int:
        priors.info(self.name)
        return 0


@dataclass(frozen=True)
class PriorImport:
    """The published PyTorch checkpoint converted, in full precision; runs no code from the file.

    Example: more2 prior import published.pt published.npz
    """

    checkpoint: Positional[Path]
    """A checkpoint with the published names under model_state_dict."""
    out: Positional[Path]
    """The weight file to write; a new .npz."""

    def __call__(self) -> int:
        priors.import_published(self.checkpoint, self.out)
        return 0


@dataclass(frozen=True)
class PriorCheck:
    """Largest deviations of converted weights from a reference's outputs; exit 0 only if all are below 1e-5.

    Example: more2 prior check published.pt reference.npz
    """

    checkpoint: Positional[Path]
    """A checkpoint; or, alone, a reference that holds the weights too."""
    reference: Positional[Path | None] = None
    """NPZ of points, queries, F_inv, F_eqv, F_s, F_c and sdf."""

    def __call__(self) -> int:
        return priors.check(self.checkpoint, self.reference)


@dataclass(frozen=True)
class PriorCommand:
    """Weights: shipped, the published checkpoint converted, your own.

    Example: more2 prior list
    """

    action: OmitSubcommandPrefixes[
        Annotated[PriorList, subcommand("list")]
        | Annotated[PriorInfo, subcommand("info")]
        | Annotated[PriorImport, subcommand("import")]
        | Annotated[PriorCheck, subcommand("check")]
    ]

    def __call__(self) -> int:
        return self.action()
