"""K perceptrons of one shape, with a backward pass written out: all members in each product, no graph of operations.

A layer's weights of all members are contiguous, (K, inputs, outputs), and all layers lie in one vector, so that a
product writes its gradient where the optimiser reads it. No gradient is taken with respect to the inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

HIDDEN_VARIANCE = 1.0 / 3.0
LAST_VARIANCE = 0.01
"""First weights are uniform with variance `scale / inputs`: the initialisation of DOPE's critics."""


@dataclass(frozen=True)
class Architecture:
    """Sizes of one member: `inputs` columns, ReLU layers of `hidden` units, `heads` outputs."""

    inputs: int
    hidden: tuple[int, ...]
    heads: int

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(inputs, outputs) of each layer."""
        sizes = (self.inputs, *self.hidden, self.heads)
        return tuple(pairwise(sizes))

    @property
    def size(self) -> int:
        """Number of weights of one member."""
        return sum((rows + 1) * columns for rows, columns in self.layers)


Layers = list[tuple[Tensor, Tensor]]
"""(weight (K, inputs, outputs), bias (K, 1, outputs)) of each layer, as views of one vector."""


def views(flat: Tensor, architecture: Architecture, members: int) -> Layers:
    """Return the layers that lie in `flat`, a vector of `members * architecture.size` numbers."""
    layers: Layers = []
    start = 0
    for rows, columns in architecture.layers:
        weight = flat[start : start + members * rows * columns].view(members, rows, columns)
        start += weight.numel()
        bias = flat[start : start + members * columns].view(members, 1, columns)
        start += bias.numel()
        layers.append((weight, bias))
    return layers


def first_weights(architecture: Architecture, generators: Sequence[torch.Generator], copies: int) -> Tensor:
    """Return a vector for `len(generators) * copies` members: one draw of each generator, `copies` times.

    Policies that start from the same weights differ at the end by what they do, not by their first weights.
    """
    parts: list[Tensor] = []
    last = len(architecture.layers) - 1
    for number, (rows, columns) in enumerate(architecture.layers):
        limit = (3.0 * (LAST_VARIANCE if number == last else HIDDEN_VARIANCE) / rows) ** 0.5
        drawn = [torch.empty(rows, columns).uniform_(-limit, limit, generator=g) for g in generators]
        parts.append(torch.stack(drawn).repeat_interleave(copies, dim=0).flatten())
        parts.append(torch.zeros(len(generators) * copies * columns))
    return torch.cat(parts)


def forward(layers: Layers, x: Tensor) -> list[Tensor]:
    """Return the inputs x (K, B, inputs), the output of each hidden layer, and the heads (K, B, heads)."""
    outputs = [x]
    for weight, bias in layers[:-1]:
        outputs.append(torch.baddbmm(bias, outputs[-1], weight).relu_())
    weight, bias = layers[-1]
    outputs.append(torch.baddbmm(bias, outputs[-1], weight))
    return outputs


def backward(layers: Layers, outputs: list[Tensor], upstream: Tensor, gradient: Layers) -> None:
    """Write the gradient of sum(upstream * heads) with respect to all weights into `gradient`.

    Args:
        layers: the weights.
        outputs: what `forward` returned.
        upstream: (K, B, heads) derivative of the loss with respect to the heads.
        gradient: views as `layers`, overwritten.
    """
    for number in reversed(range(len(layers))):
        below = outputs[number]
        torch.bmm(below.transpose(1, 2), upstream, out=gradient[number][0])
        torch.sum(upstream, dim=1, keepdim=True, out=gradient[number][1])
        if number:
            upstream = torch.bmm(upstream, layers[number][0].transpose(1, 2)).mul_(below.sign())
