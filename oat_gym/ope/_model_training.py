"""Supervised training of K networks side by side, each keeping the weights of its least held-out loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym._rng import derive, torch_generator
from oat_gym.errors import TrainingError
from oat_gym.generation._layers import one_thread
from oat_gym.ope._fqe_network import Architecture, Layers, backward, first_weights, forward, views
from oat_gym.ope._model_data import Split
from oat_gym.progress import ProgressCallback

FloatArray = npt.NDArray[np.float64]
LOOKS = 20
"""How often the held-out loss is taken."""
CHUNK = 64
"""Updates whose rows are drawn at a time."""
BLOCK = 256
"""Held-out rows of a network that are evaluated at a time."""


@dataclass(frozen=True)
class Fitting:
    """How the networks are trained; see `ModelBased`."""

    hidden: tuple[int, ...]
    updates: int
    batch_size: int
    learning_rate: float
    weight_decay: float
    ensemble: int
    device: str
    progress: ProgressCallback
    name: str


class Task(Protocol):
    """What networks learn. G groups of rows make K = G * copies networks, copies fastest."""

    copies: int
    architecture: Architecture

    def inputs(self, rows: Tensor) -> Tensor:
        """Return (K, B, inputs) for rows (G, B)."""
        ...

    def slope(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return (K, B, heads): the derivative of each row's loss with respect to the heads."""
        ...

    def loss(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return (K, B): the loss by which weights are kept."""
        ...

    def squared_error(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return (K, B): squared error of the mean prediction, of the size 1 for predicting the training mean."""
        ...


@dataclass(frozen=True)
class Fitted:
    """Layers of K networks, and (K,) held-out mean squared errors."""

    layers: Layers
    error: FloatArray


@torch.no_grad()
def fit(task: Task, split: Split, fitting: Fitting, *, seeds: Sequence[int], part: str) -> Fitted:
    """Train by AdamW at a rate that falls linearly; a network keeps the weights of its least held-out loss.

    Raises:
        TrainingError: if a held-out loss is never finite.
    """
    device = fitting.device
    streams = [derive(seed, "model", part, member) for seed in seeds for member in range(fitting.ensemble)]
    flat = torch.nn.Parameter(
        first_weights(task.architecture, [torch_generator(rng) for rng in streams], task.copies).to(device)
    )
    members = len(streams) * task.copies
    flat.grad = torch.zeros_like(flat)
    layers, gradient = views(flat.data, task.architecture, members), views(flat.grad, task.architecture, members)
    optimizer = torch.optim.AdamW([flat], lr=fitting.learning_rate, weight_decay=fitting.weight_decay, fused=True)
    held = torch.from_numpy(split.held).to(device)
    best = torch.full((members,), torch.inf, device=device)
    kept = [(weight.clone(), bias.clone()) for weight, bias in layers]
    queue: list[Tensor] = []
    with one_thread():
        for done in range(1, fitting.updates + 1):
            if not queue:
                queue = _draw(split, streams, fitting)
            rows = queue.pop()
            outputs = forward(layers, task.inputs(rows))
            backward(layers, outputs, task.slope(outputs[-1], rows) / fitting.batch_size, gradient)
            for group in optimizer.param_groups:  # to zero: small biases of a step add up over a roll-out
                group["lr"] = fitting.learning_rate * (1.0 - (done - 1) / fitting.updates)
            optimizer.step()
            if done % max(fitting.updates // LOOKS, 1) == 0 or done == fitting.updates:
                _keep(layers, kept, best, _held_mean(task, layers, held, error=False))
                fitting.progress(f"{fitting.name}: {part}", done, fitting.updates)
        if not bool(torch.isfinite(best).all()):
            raise TrainingError(
                f"The {part} model diverged: its held-out loss is not finite. Lower learning_rate, or check the data "
                "for extreme values."
            )
        error = _held_mean(task, kept, held, error=True)
    return Fitted(kept, error.cpu().numpy().astype(np.float64))


def member_layers(layers: Layers, chosen: slice) -> Layers:
    """Return the layers of some of the networks, with memory of their own."""
    return [(weight[chosen].contiguous().clone(), bias[chosen].contiguous().clone()) for weight, bias in layers]


def _draw(split: Split, streams: Sequence[np.random.Generator], fitting: Fitting) -> list[Tensor]:
    shape = (CHUNK, fitting.batch_size)
    drawn = [rows[rng.integers(len(rows), size=shape)] for rng, rows in zip(streams, split.training, strict=True)]
    return list(torch.from_numpy(np.stack(drawn, axis=1)).to(fitting.device).unbind(0))


def _keep(layers: Layers, kept: Layers, best: Tensor, loss: Tensor) -> None:
    better = loss < best  # false for a loss that is no number
    best[better] = loss[better]
    for (weight, bias), (kept_weight, kept_bias) in zip(layers, kept, strict=True):
        kept_weight[better], kept_bias[better] = weight[better], bias[better]


def _held_mean(task: Task, layers: Layers, held: Tensor, *, error: bool) -> Tensor:
    """Return (K,) mean held-out loss or squared error."""
    parts: list[Tensor] = []
    for start in range(0, held.shape[1], BLOCK):
        rows = held[:, start : start + BLOCK]
        heads = forward(layers, task.inputs(rows))[-1]
        parts.append(task.squared_error(heads, rows) if error else task.loss(heads, rows))
    return torch.cat(parts, dim=1).mean(dim=1)
