"""The published layers' operations in PyTorch, and a worker that times them: see eval/speed.py.

Run by whatever interpreter has torch; imports nothing of this project. Reads a line of settings as JSON, then
`forward` or `step` a line; answers every one with its wall and its thread seconds.
"""

from __future__ import annotations

import json
import sys
import time

import torch  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]
from torch.nn.functional import linear  # pyright: ignore[reportMissingImports]

LEAK = 0.2


def normalized(x: Tensor) -> Tensor:
    """Squared lengths of all channels sum to 1; x is (…, 3, channels)."""
    length = x.norm(dim=-2, keepdim=True)
    return x / length.clamp_min(1e-12) * (length / length.norm(dim=-1, keepdim=True).clamp_min(1e-12))


def relu(q: Tensor, k: Tensor) -> Tensor:
    """VN-LeakyReLU of q along k."""
    k = k / k.norm(dim=-2, keepdim=True).clamp_min(1e-12)
    along = (q * k).sum(dim=-2, keepdim=True)
    return q - along * k + nn.functional.leaky_relu(along, LEAK) * k


class VNLA(nn.Module):
    """VN-Linear, then VN-LeakyReLU along a learned direction."""

    def __init__(self, inputs: int, outputs: int, directions: int | None = None) -> None:
        super().__init__()
        self.kernel = nn.Linear(inputs, outputs, bias=False)
        self.direction = nn.Linear(outputs, directions or outputs, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        q = self.kernel(x)
        return relu(q, self.direction(q))


class Block(nn.Module):
    """One block: VNLA of the graph feature, pooled by mean or by attention with the global context."""

    def __init__(self, before: int, width: int, index: int, settings: dict) -> None:
        super().__init__()
        self.k, self.head = settings["neighbors"], settings["head_channels"]
        self.first, self.attends = index == 0, index >= settings["linear_blocks"]
        self.value = VNLA(3 if self.first else 2 * before, width)
        if self.attends:
            self.query, self.key = VNLA(before, width), VNLA(2 * before, width)
            self.context = VNLA(2 * width, width)

    def graph(self, query: Tensor, source: Tensor) -> Tensor:
        """[f_j − f_i, f_i] (b, n, k, 3, c) of the nearest in feature space."""
        with torch.no_grad():
            index = torch.cdist(query.flatten(2), source.flatten(2)).topk(self.k, largest=False)[1]
        batch = torch.arange(len(source))[:, None, None]
        other = source[batch, index]
        own = query[:, :, None].expand_as(other)
        if not self.first:
            return torch.cat([other - own, own], dim=-1)
        unit = own / own.norm(dim=-2, keepdim=True).clamp_min(1e-12)
        return torch.cat([torch.cross(unit, other, dim=-2), other - own, own], dim=-1)

    def forward(self, query: Tensor, source: Tensor) -> Tensor:
        graph = self.graph(query, source)
        value = self.value(graph)
        if not self.attends:
            return value.mean(dim=2)
        product = normalized(self.query(query))[:, :, None] * normalized(self.key(graph))
        by_head = product.unflatten(-1, (-1, self.head)).sum(dim=(-3, -1)) / (3 * self.head) ** 0.5
        share = by_head.softmax(dim=2).repeat_interleave(self.head, dim=-1)
        mixed = (share[..., None, :] * value).sum(dim=2)
        return self.context(torch.cat([mixed, mixed.mean(dim=1, keepdim=True).expand_as(mixed)], dim=-1))


class Encoder(nn.Module):
    """Φ of a batch of clouds in farthest-point order, so that thinning takes the first rows."""

    def __init__(self, settings: dict) -> None:
        super().__init__()
        widths, code = settings["widths"], settings["code"]
        self.thinning = dict(zip(settings["downsample_blocks"], settings["downsample_factors"], strict=True))
        before = [1, *widths[:-1]]
        self.blocks = nn.ModuleList(
            Block(b, w, i, settings) for i, (b, w) in enumerate(zip(before, widths, strict=True))
        )
        self.head, self.invariant = VNLA(widths[-1], code, 1), nn.Linear(code, code, bias=False)
        self.inner, self.residual = VNLA(code, code // 2), nn.Linear(code // 2, 1, bias=False)
        self.shortcut, self.direction = nn.Linear(code, 1, bias=False), nn.Linear(1, 1, bias=False)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        mean = points.mean(dim=1)
        features = (points - mean[:, None])[..., None]
        for i, block in enumerate(self.blocks):
            features = block(features[:, : features.shape[1] // self.thinning.get(i, 1)], features)
        x = self.head(features).mean(dim=1)
        eqv = normalized(x)
        q = self.residual(self.inner(x)) + self.shortcut(x)
        center = mean + relu(q, self.direction(q))[..., 0]
        return (normalized(self.invariant(x)) * eqv).sum(dim=-2), eqv, x.norm(dim=-2).mean(dim=-1), center


class Decoder(nn.Module):
    """Ψ: the code of an object beside every query, weight normalization, one skip."""

    def __init__(self, code: int, hidden: int, layers: int, skip: int, narrow: bool) -> None:
        super().__init__()
        self.skip, inputs = skip, 2 * code + 1
        outputs = [hidden - inputs if narrow and i == skip - 1 else hidden for i in range(layers)]
        widths = [inputs, *outputs]
        widened = [w + inputs if i == skip else w for i, w in enumerate(widths[:-1])]
        norm = nn.utils.parametrizations.weight_norm
        self.hidden = nn.ModuleList(norm(nn.Linear(a, b)) for a, b in zip(widened, widths[1:], strict=True))
        self.last = nn.Linear(hidden, 1)

    def forward(self, code: tuple[Tensor, Tensor, Tensor, Tensor], points: Tensor) -> Tensor:
        inv, eqv, scale, center = code
        q = (points - center[:, None]) / scale[:, None, None]
        inputs = [inv[:, None].expand(-1, q.shape[1], -1), q @ eqv, q.norm(dim=-1, keepdim=True)]
        h = inputs = torch.cat(inputs, dim=-1)
        for i, layer in enumerate(self.hidden):
            h = torch.relu(layer(torch.cat([h, inputs], dim=-1) if i == self.skip else h))
        return torch.tanh(linear(h, self.last.weight, self.last.bias))[..., 0]


def main() -> None:
    """Serves timings until the input ends."""
    settings = json.loads(sys.stdin.readline())
    torch.set_num_threads(settings["threads"])
    # On a GPU both frameworks multiply as fast as float32 allows, which is TF32.
    if on_gpu := torch.cuda.is_available():
        torch.set_default_device("cuda")
        torch.set_float32_matmul_precision("high")
    torch.manual_seed(0)
    encoder, decoder = (
        Encoder(settings["encoder"]),
        Decoder(settings["encoder"]["code"], **settings["decoder"]),
    )
    points = torch.tensor(settings["points"])
    queries, truth = torch.tensor(settings["queries"]), torch.tensor(settings["sdf"])
    adam = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=1e-4)

    def forward() -> None:
        with torch.no_grad():
            encoder(points)

    def encoder_step() -> None:
        encoder.zero_grad()
        torch.stack([(x**2).sum() for x in encoder(points)]).sum().backward()

    def step() -> None:
        adam.zero_grad()
        (decoder(encoder(points), queries) - truth).abs().mean().backward()
        adam.step()

    jobs = {"forward": forward, "encoder_step": encoder_step, "step": step}
    print(json.dumps({"version": torch.__version__}), flush=True)
    for line in sys.stdin:
        wall, cpu = time.perf_counter(), time.process_time()
        jobs[line.strip()]()
        if on_gpu:
            torch.cuda.synchronize()
        print(json.dumps([time.perf_counter() - wall, time.process_time() - cpu]), flush=True)


if __name__ == "__main__":
    main()
