"""Records in another frame or another unit: every quantity of a record says how it changes (`types.quantity`)."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jaxtyping import Float

from more2_jax.geometry.full_precision import full_precision
from more2_jax.geometry.poses import Pose

Record = TypeVar("Record")
Scalar = Float[Array, ""] | float


def transform(record: Record, T_b_a: jaxlie.SE3 | Pose) -> Record:
    """The record of frame a in frame b; one record, `vmap` for batches.

    Positions of a record with an origin are relative to it: the origin moves, they turn. Raises TypeError where a
    record has a quantity that cannot be moved or does not say how it moves.
    """
    R, shift = rotation_and_translation(T_b_a)
    return _moved(record, R, shift)


def rescale(record: Record, factor: Scalar) -> Record:
    """The record in other units of length, about the zero of its frame. Raises TypeError as `transform` does."""
    changes = {n: _rescaled(kind, v, factor, n) for n, kind, v in quantities(record) if v is not None}
    return dataclasses.replace(record, **changes)  # type: ignore[type-var]


def quantities(record: Any) -> list[tuple[str, str, Any]]:
    """Name, kind and value of a record's fields. Raises TypeError where one does not say what it is."""
    found = []
    for f in dataclasses.fields(record):
        if "quantity" not in f.metadata:
            raise TypeError(
                f"{type(record).__name__}.{f.name} does not say how it moves; needed `quantity(...)`"
            )
        found.append((f.name, f.metadata["quantity"], getattr(record, f.name)))
    return found


@full_precision
def rotation_and_translation(T: jaxlie.SE3 | Pose) -> tuple[Any, Any]:
    """The 3×3 matrix and the shift of a pose, whichever form it has."""
    if isinstance(T, jaxlie.SE3):
        return T.rotation().as_matrix(), T.translation()
    return T[:3, :3], T[:3, 3]


def _moved(record: Any, R: Any, shift: Any) -> Any:
    fields = quantities(record)
    about_origin = any(kind == "origin" and value is not None for _, kind, value in fields)
    changes = {}
    for name, kind, value in fields:
        if value is None or kind in ("invariant", "length"):
            continue
        if kind == "record":
            inner = (
                np.zeros(3) if about_origin and not isinstance(shift, Array) else shift * (not about_origin)
            )
            parts = tuple(_moved(v, R, inner) for v in (value if isinstance(value, tuple) else (value,)))
            changes[name] = parts if isinstance(value, tuple) else parts[0]
        elif kind in ("position", "origin"):
            stays = kind == "position" and about_origin
            changes[name] = _like(value, _turned(value, R) + (0.0 if stays else shift))
        elif kind in ("offset", "direction"):
            changes[name] = _like(value, _turned(value, R))
        elif kind == "columns":
            changes[name] = _like(value, _turned(value.swapaxes(-1, -2), R).swapaxes(-1, -2))
        else:
            raise TypeError(f"{type(record).__name__}.{name} ({kind}) cannot be moved")
    return dataclasses.replace(record, **changes)


def _rescaled(kind: str, value: Any, factor: Scalar, name: str) -> Any:
    if kind in ("position", "offset", "length", "axis-aligned"):
        return value * factor
    if kind == "record":
        return (
            tuple(rescale(v, factor) for v in value) if isinstance(value, tuple) else rescale(value, factor)
        )
    if kind == "pose":
        return jaxlie.SE3.from_rotation_and_translation(value.rotation(), value.translation() * factor)
    if kind == "covariance":
        unit = jnp.where(jnp.arange(6) < 3, factor, 1.0)
        return value * unit * unit[:, None]
    if kind == "origin":
        raise TypeError(
            f"{name}: a record about an origin is rescaled in its local frame; needed origin None"
        )
    return value


def _turned(rows: Any, R: Any) -> Any:
    """Row vectors turned: R x of each."""
    if isinstance(rows, np.ndarray) and isinstance(R, np.ndarray):
        return rows @ R.T
    return jnp.matmul(rows, R.T, precision="highest")


def _like(before: Any, after: Any) -> Any:
    """The new values in the precision of the old ones."""
    return after.astype(before.dtype)
