"""Slow plain forms of the network's equations, float64 NumPy, one cloud at a time; they share no code with it.

Weights go by their published names (`network_dict.encoder.…`, (out, in)); features are (n, channels, 3).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

ENCODER, DECODER = "network_dict.encoder.", "network_dict.decoder."
THINNING = {2: 2, 4: 4, 5: 4}  # on entering these blocks, by these factors
FIRST_ATTENTION, NEIGHBORS, HEAD, SCALE, LEAK = 2, 16, 16, 64000.0, 0.2
Weights = Mapping[str, np.ndarray]


def linear(weight: np.ndarray, x: np.ndarray) -> np.ndarray:
    return weight.astype(np.float64) @ x


def vnla(weights: Weights, name: str, x: np.ndarray) -> np.ndarray:
    """q = Wx, k = Uq; where ⟨q, k⟩ < 0, all but `LEAK` of the part of q along k is removed."""
    q = linear(weights[f"{name}.lin.weight"], x)
    return vn_leaky_relu(weights[f"{name}.act.lin_dir.weight"], q)


def vn_leaky_relu(direction: np.ndarray, q: np.ndarray) -> np.ndarray:
    k = linear(direction, q)
    length = np.linalg.norm(k, axis=-1, keepdims=True)
    k = np.divide(k, length, out=np.zeros_like(k), where=length > 0)
    along = (q * k).sum(axis=-1, keepdims=True)
    return q - along * k + np.where(along >= 0, along, LEAK * along) * k


def channel_normalize(x: np.ndarray) -> np.ndarray:
    """Unit direction of every channel times its share of the norm over the channels."""
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    direction = np.divide(x, length, out=np.zeros_like(x), where=length > 0)
    return direction * length / np.sqrt((length**2).sum(axis=-2, keepdims=True))


def farthest_from_first(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of farthest-point sampling from index 0."""
    nearest, chosen = np.full(len(points), np.inf), [0]
    while len(chosen) < count:
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen)


def nearest_by_feature(query: np.ndarray, source: np.ndarray, k: int) -> np.ndarray:
    index = [np.argsort(((source - q) ** 2).sum(axis=(1, 2)), kind="stable")[:k] for q in query]
    return np.array(index)


def graph_feature(query: np.ndarray, source: np.ndarray, k: int, first: bool) -> np.ndarray:
    """[f_j − f_i, f_i] over the k nearest in feature space; in the first block [x̂_i × x_j, …] before."""
    other = source[nearest_by_feature(query, source, k)]
    own = np.broadcast_to(query[:, None], other.shape)
    if not first:
        return np.concatenate([other - own, own], axis=2)
    unit = own / np.linalg.norm(own, axis=-1, keepdims=True)
    return np.concatenate([np.cross(unit, other), other - own, own], axis=2)


def attention(weights: Weights, i: int, query: np.ndarray, graph: np.ndarray) -> np.ndarray:
    """Softmax over neighbors of ⟨Q, K⟩ / √(3·16) a head, weighted sum of V, then the global context."""
    q = channel_normalize(vnla(weights, f"{ENCODER}Q_list.{i}", query))
    k = channel_normalize(vnla(weights, f"{ENCODER}K_list.{i}", graph))
    v = vnla(weights, f"{ENCODER}V_list.{i}", graph)
    mixed = np.zeros((len(q), v.shape[2], 3))
    for h in range(0, v.shape[2], HEAD):
        head = slice(h, h + HEAD)
        logit = (q[:, None, head] * k[:, :, head]).sum(axis=(2, 3)) / np.sqrt(3 * HEAD)
        share = np.exp(logit) / np.exp(logit).sum(axis=1, keepdims=True)
        mixed[:, head] = (share[..., None, None] * v[:, :, head]).sum(axis=1)
    context = np.broadcast_to(mixed.mean(axis=0), mixed.shape)
    return vnla(
        weights, f"{ENCODER}global_conv_list.{i - FIRST_ATTENTION}", np.concatenate([mixed, context], axis=1)
    )


def encode(weights: Weights, points: np.ndarray) -> dict[str, np.ndarray]:
    """Φ of one cloud (n, 3), as given: F_inv (c,), F_eqv (c, 3), F_s, F_c (3,)."""
    points = points.astype(np.float64)
    mean = points.mean(axis=0)
    xyz = points - mean
    features = xyz[:, None]
    for i in range(sum(k.startswith(f"{ENCODER}V_list") for k in weights) // 2):
        kept = (
            farthest_from_first(xyz, len(xyz) // THINNING.get(i, 1)) if i in THINNING else np.arange(len(xyz))
        )
        query = features[kept]
        graph = graph_feature(query, features, NEIGHBORS, first=i == 0)
        if i < FIRST_ATTENTION:
            features = vnla(weights, f"{ENCODER}V_list.{i}", graph).mean(axis=1)
        else:
            features = attention(weights, i, query, graph)
        xyz = xyz[kept]
    x = vnla(weights, f"{ENCODER}conv_c", features).mean(axis=0)
    eqv = channel_normalize(x)
    return {
        "F_inv": (channel_normalize(linear(weights[f"{ENCODER}fc_inv.weight"], x)) * eqv).sum(axis=-1),
        "F_eqv": eqv,
        "F_s": SCALE * np.linalg.norm(x, axis=-1).mean(),
        "F_c": mean + SCALE * _center(weights, x),
    }


def _center(weights: Weights, x: np.ndarray) -> np.ndarray:
    name = f"{ENCODER}fc_center."
    residual = linear(weights[f"{name}lin1.weight"], vnla(weights, f"{name}fc0", x))
    q = residual + linear(weights[f"{name}shortcut.weight"], x)
    return vn_leaky_relu(weights[f"{name}act2.lin_dir.weight"], q)[0]


def decode(weights: Weights, code: Mapping[str, np.ndarray], points: np.ndarray, skip: int = 4) -> np.ndarray:
    """Ψ at points (n, 3) of the code's frame: [F_inv, ⟨F_eqv, q⟩, |q|] through every layer, nothing folded."""
    q = (points - code["F_c"]) / code["F_s"]
    inv = np.broadcast_to(code["F_inv"], (len(q), len(code["F_inv"])))
    inputs = np.concatenate([inv, q @ code["F_eqv"].T, np.linalg.norm(q, axis=1, keepdims=True)], axis=1)
    layers = sum(k.startswith(DECODER) and k.endswith("weight_v") for k in weights)
    h = inputs
    for i in range(layers):
        h = np.concatenate([h, inputs], axis=1) if i == skip else h
        v = weights[f"{DECODER}lin{i}.weight_v"].astype(np.float64)
        g = weights[f"{DECODER}lin{i}.weight_g"].reshape(-1, 1)
        h = np.maximum(
            h @ (g * v / np.linalg.norm(v, axis=1, keepdims=True)).T + weights[f"{DECODER}lin{i}.bias"], 0
        )
    last = weights[f"{DECODER}lin{layers}.weight"].astype(np.float64)
    return np.tanh(h @ last[0] + weights[f"{DECODER}lin{layers}.bias"][0])


def outputs(weights: Weights, points: np.ndarray, queries: np.ndarray) -> dict[str, np.ndarray]:
    """All five outputs for a batch of clouds and queries, stacked."""
    codes = [encode(weights, cloud) for cloud in points]
    sdf = [
        decode(weights, code, query.astype(np.float64)) for code, query in zip(codes, queries, strict=True)
    ]
    return {name: np.stack([code[name] for code in codes]) for name in codes[0]} | {"sdf": np.stack(sdf)}


def random_weights(
    widths: tuple[int, ...], code: int, hidden: int, seed: int, layers: int = 8
) -> dict[str, np.ndarray]:
    """Random weights of unit gain by the published names; the scale in F_s and F_c is large for them."""
    rng = np.random.default_rng(seed)
    shapes = _encoder_shapes(widths, code)
    n = 2 * code + 1
    for i in range(layers):
        rows = hidden - n if i == 3 else hidden
        shapes[f"{DECODER}lin{i}.weight_v"] = (rows, n if i == 0 else hidden)
        shapes[f"{DECODER}lin{i}.weight_g"] = (rows, 1)
        shapes[f"{DECODER}lin{i}.bias"] = (rows,)
    shapes |= {f"{DECODER}lin{layers}.weight": (1, hidden), f"{DECODER}lin{layers}.bias": (1,)}
    weights = {k: rng.normal(size=s) / np.sqrt(s[-1]) for k, s in shapes.items()}
    for k, w in weights.items():
        if k.endswith("weight_g"):
            weights[k] = np.sqrt(2.0) * (1 + 0.1 * w)
    return {k: w.astype(np.float32) for k, w in weights.items()}


def _encoder_shapes(widths: tuple[int, ...], code: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}

    def add(name: str, inputs: int, width: int, directions: int | None = None) -> None:
        shapes[f"{ENCODER}{name}.lin.weight"] = (width, inputs)
        shapes[f"{ENCODER}{name}.act.lin_dir.weight"] = (directions or width, width)

    for i, width in enumerate(widths):
        before = widths[i - 1]
        add(f"V_list.{i}", 2 * before if i else 3, width)
        if i >= FIRST_ATTENTION:
            add(f"Q_list.{i}", before, width)
            add(f"K_list.{i}", 2 * before, width)
            add(f"global_conv_list.{i - FIRST_ATTENTION}", 2 * width, width)
    add("conv_c", widths[-1], code, directions=1)
    add("fc_center.fc0", code, code // 2)
    shapes[f"{ENCODER}fc_inv.weight"] = (code, code)
    shapes[f"{ENCODER}fc_center.lin1.weight"] = (1, code // 2)
    shapes[f"{ENCODER}fc_center.shortcut.weight"] = (1, code)
    shapes[f"{ENCODER}fc_center.act2.lin_dir.weight"] = (1, 1)
    return shapes
