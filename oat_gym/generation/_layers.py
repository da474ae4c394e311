"""Layers of K networks of one shape at a time: every weight has a leading member axis.

K small networks (PST sets, learning rates) cost little more than one, since a small layer's time is overhead. All
weights of a member lie in one row of a (K, P) matrix, so that an optimiser's step is a handful of operations.
"""

from __future__ import annotations

import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch
from torch import Tensor

Weights = Mapping[str, Tensor]
"""Weights by name: `<layer>.weight` (K, inputs, outputs) and `<layer>.bias` (K, 1, outputs)."""

Shapes = Mapping[str, tuple[int, int]]
"""Shape of each weight of one member, in the order in which they are stored."""


def layer_shapes(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of an affine layer."""
    return {f"{name}.weight": (inputs, outputs), f"{name}.bias": (1, outputs)}


def mlp_shapes(name: str, inputs: int, hidden: Sequence[int], outputs: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of a multi-layer perceptron."""
    sizes = [inputs, *hidden, outputs]
    shapes: dict[str, tuple[int, int]] = {}
    for index in range(len(sizes) - 1):
        shapes |= layer_shapes(f"{name}.{index}", sizes[index], sizes[index + 1])
    return shapes


def lstm_shapes(name: str, inputs: int, nodes: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of an LSTM layer: `<name>.input` for the inputs, `<name>.hidden` for the hidden state."""
    return layer_shapes(f"{name}.input", inputs, 4 * nodes) | {f"{name}.hidden.weight": (nodes, 4 * nodes)}


def initial_weights(shapes: Shapes, generator: torch.Generator) -> Tensor:
    """Return one member's first weights, a (P,) vector: Glorot-uniform weights, zero biases, LSTM forget gates at 1."""
    parts: list[Tensor] = []
    for name, (rows, columns) in shapes.items():
        values = torch.zeros((rows, columns), dtype=torch.float32)
        if name.endswith(".weight"):
            limit = (6.0 / (rows + (columns // 4 if _is_lstm(name) else columns))) ** 0.5
            values.uniform_(-limit, limit, generator=generator)
        elif _is_lstm(name):
            values[:, columns // 4 : columns // 2] = 1.0
        parts.append(values.flatten())
    return torch.cat(parts)


def unpack(flat: Tensor, shapes: Shapes) -> dict[str, Tensor]:
    """Return the weights by name of a (K, P) matrix, as views."""
    sizes = [rows * columns for rows, columns in shapes.values()]
    parts = torch.split(flat, sizes, dim=1)
    return {name: part.view(-1, *shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}


def linear(weights: Weights, name: str, x: Tensor) -> Tensor:
    """Apply an affine layer to `x` (K, ..., inputs)."""
    weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    out = torch.baddbmm(bias, x.reshape(x.shape[0], -1, x.shape[-1]), weight)
    return out.view(*x.shape[:-1], weight.shape[-1])


def mlp(weights: Weights, name: str, x: Tensor) -> Tensor:
    """Apply a perceptron with ReLU between its layers and a linear last one."""
    last = sum(1 for key in weights if key.startswith(f"{name}.") and key.endswith(".weight")) - 1
    for index in range(last):
        x = linear(weights, f"{name}.{index}", x).relu()
    return linear(weights, f"{name}.{last}", x)


def lstm_step(gates: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
    """Return (hidden, cell) of an LSTM from its four gates (input, forget, output, candidate), (K, N, 4 nodes)."""
    nodes = cell.shape[-1]
    opened = gates[..., : 3 * nodes].sigmoid()
    candidate = gates[..., 3 * nodes :].tanh()
    write, keep, read = opened.chunk(3, dim=-1)
    cell = torch.addcmul(keep * cell, write, candidate)
    return read * cell.tanh(), cell


class Adam:
    """Adam (Kingma and Ba, 2015) on a (K, P) matrix, with a learning rate and a gradient norm limit for each member.

    torch's optimiser has one learning rate for a whole matrix and clips by one norm; here members must not interact.
    """

    def __init__(self, flat: Tensor, learning_rates: Tensor, *, clip: float, decay: float = 1.0) -> None:
        self._rates, self._clip, self._decay = learning_rates[:, None].clone(), clip, decay
        self._first, self._second = torch.zeros_like(flat), torch.zeros_like(flat)
        self._change = torch.empty_like(flat)  # kept: new memory for a large network takes longer than its numbers
        self._updates = 0

    def step(self, flat: Tensor, gradient: Tensor) -> None:
        """Update `flat` in place; `gradient` is clipped in place."""
        norm = gradient.norm(dim=1, keepdim=True)
        gradient.mul_((self._clip / norm).clamp(max=1.0))
        self._updates += 1
        self._first.lerp_(gradient, 0.1)
        self._second.mul_(0.999).addcmul_(gradient, gradient, value=0.001)
        first_share, second_share = 1 - 0.9**self._updates, 1 - 0.999**self._updates
        scale = torch.div(self._second, second_share, out=self._change).sqrt_().add_(1e-8)
        flat.sub_(torch.div(self._first, scale, out=self._change).mul_(self._rates / first_share))
        self._rates.mul_(self._decay)


@dataclass
class _Threads:
    """The number of torch's threads before the first of the blocks that are open now, which run on one thread."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    blocks: int = 0
    before: int = 1


_threads = _Threads()


@contextmanager
def one_thread() -> Generator[None, None, None]:
    """Run torch on one thread inside the block; the last of several open blocks restores the setting, which is global.

    The layers are too small to share out, and the results must not depend on the number of threads.
    """
    with _threads.lock:
        if not _threads.blocks:
            _threads.before = torch.get_num_threads()
            torch.set_num_threads(1)
        _threads.blocks += 1
    try:
        yield
    finally:
        with _threads.lock:
            _threads.blocks -= 1
            if not _threads.blocks:
                torch.set_num_threads(_threads.before)


def _is_lstm(name: str) -> bool:
    return ".input." in name or ".hidden." in name
