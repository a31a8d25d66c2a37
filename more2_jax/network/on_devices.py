"""What a program closes over, weights above all, brought to each device once, not at every call."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
from jax.core import Tracer

Tree = Any  # of arrays
Device = Any  # `jax.Device`, which checkers take for a variable
Copies = dict[Device, jax.Array]

_COPIES: dict[int, Copies] = {}  # of arrays that are alive, by identity
_LOCK = threading.RLock()  # collecting garbage, which may begin anywhere, forgets copies


def devices_at_hand() -> list[Device]:
    """The local devices, or the one that `jax.default_device` names in this thread."""
    chosen = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return [chosen] if isinstance(chosen, jax.Device) else jax.local_devices()


def at_hand(tree: Tree) -> Tree:
    """Arrays on the first of `devices_at_hand`, copied there the first time they are asked for."""
    (first, *_) = devices_at_hand()
    return jax.tree.map(lambda x: copied(x, first), tree)


def call_on(device: Device, function: Callable[[Tree], Tree], rows: Tree) -> Tree:
    """`function` of rows on one of the local devices; where there is no other, as it is."""
    if jax.local_device_count() == 1:
        return function(rows)
    return placed(function, device)(jax.device_put(rows, device))


def placed(function: Callable[[Tree], Tree], device: Device) -> Callable[[Tree], Tree]:
    """`function` with the arrays of a `partial`'s arguments on `device`; as it is where it is no `partial`.

    Copies live as long as the arrays that they are of.
    """
    if not isinstance(function, partial):
        return function
    args = jax.tree.map(lambda x: copied(x, device), function.args)
    return partial(function.func, *args, **function.keywords)


def copied(x: Any, device: Device) -> Any:
    """An array on one device as it is on another, copied there the first time; anything else as it is."""
    if not isinstance(x, jax.Array) or isinstance(x, Tracer) or x.devices() == {device}:
        return x
    with _LOCK:
        if id(x) not in _COPIES:
            _COPIES[id(x)] = {}
            weakref.finalize(x, _forget, id(x))
        copies = _COPIES[id(x)]
        if device not in copies:
            copies[device] = jax.device_put(x, device)
        return copies[device]


def _forget(identity: int) -> None:
    with _LOCK:
        _COPIES.pop(identity, None)
