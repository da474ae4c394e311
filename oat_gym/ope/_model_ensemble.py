"""The ensemble of dynamics models: networks of (s, a) for the state change, the reward and the continuation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym.ope._fqe_network import Architecture, Layers, forward
from oat_gym.ope._model_data import MIN_VARIANCE, Moves, Ranges, Split, tensor
from oat_gym.ope._model_training import Fitted, Fitting, fit, member_layers

FloatArray = npt.NDArray[np.float64]
Blocks = tuple[tuple[int, int], ...]


class MeanTask:
    """Columns whose means are learned: squared error, cross-entropy for one-hot blocks, and for a single probability.

    In all three the loss has the derivative (mean - target) with respect to the heads.
    """

    copies = 1

    def __init__(
        self,
        inputs: FloatArray,
        targets: FloatArray,
        *,
        blocks: Blocks = (),
        probability: bool = False,
        hidden: tuple[int, ...],
        device: str,
    ) -> None:
        self._inputs, self._targets = tensor(inputs, device), tensor(targets, device)
        self._blocks, self._probability = blocks, probability
        spread = targets.var(axis=0)
        varies = spread > MIN_VARIANCE
        self._weight = tensor(varies / np.where(varies, spread, 1.0) / max(int(varies.sum()), 1), device)
        self.architecture = Architecture(inputs.shape[1], hidden, targets.shape[1])

    def inputs(self, rows: Tensor) -> Tensor:
        """Return (K, B, inputs)."""
        return self._inputs[rows]

    def slope(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return mean - target."""
        return means(heads, self._blocks, probability=self._probability) - self._targets[rows]

    def loss(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return the mean over varying columns of the squared error over the variance (of one-hot ones: Brier's)."""
        return self.squared_error(heads, rows)

    def squared_error(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return the mean over the columns that vary of the squared error over the variance."""
        return self.slope(heads, rows).square() @ self._weight


def means(heads: Tensor, blocks: Blocks, *, probability: bool) -> Tensor:
    """Return the means that heads stand for: probabilities of one-hot blocks, or of one event."""
    if probability:
        return heads.sigmoid()
    if not blocks:
        return heads
    result = heads.clone()
    for start, stop in blocks:
        result[..., start:stop] = heads[..., start:stop].softmax(dim=-1)
    return result


@dataclass(frozen=True)
class EnsembleModel:
    """E members of one seed. Continuous columns move by the mean change, one-hot blocks are drawn.

    Attributes:
        changes: layers of the state change, fitted where the episode goes on.
        rewards: layers of the reward.
        going: layers of the probability of going on; None where no step, or every one, terminates.
        moves: scales and ranges.
        errors: held-out errors of state and reward, 1 for predicting the mean.
        device: torch device.
    """

    changes: Layers
    rewards: Layers
    going: Layers | None
    moves: Moves
    errors: tuple[float, float]
    device: str

    @property
    def members(self) -> int:
        """E."""
        return len(self.rewards[0][0])

    @property
    def ranges(self) -> Ranges:
        """Of the data."""
        return self.moves.ranges

    @torch.no_grad()
    def advance(
        self, states: FloatArray, actions: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return next states (E, P, n, D), rewards (E, P, n) and probabilities of going on (E, P, n)."""
        blocks, shape = self.moves.layout.categorical, states.shape[:3]
        inputs = np.concatenate((states, actions), axis=3).reshape(len(states), shape[1] * shape[2], -1)
        x = tensor(self.moves.scales[0](inputs), self.device)
        changes = _numpy(means(forward(self.changes, x)[-1], blocks, probability=False)).reshape(*shape, -1)
        for start, stop in blocks:
            changes[..., start:stop] = one_hot_draw(changes[..., start:stop], rng)
        rewards = self.moves.scales[2].inverse(_numpy(forward(self.rewards, x)[-1])).reshape(shape)
        going = np.full(shape, self.moves.going.max())
        if self.going is not None:
            going = _numpy(forward(self.going, x)[-1].sigmoid()).reshape(shape)
        return self.moves.next_states(states, changes), rewards, going


def fit_ensemble(moves: Moves, split: Split, fitting: Fitting, *, seeds: Sequence[int]) -> tuple[EnsembleModel, ...]:
    """Train the members of all seeds; they do not depend on any policy.

    Raises:
        TrainingError: if training diverges.
    """
    hidden, device, size = fitting.hidden, fitting.device, fitting.ensemble
    state = MeanTask(moves.inputs, moves.changes, blocks=moves.layout.categorical, hidden=hidden, device=device)
    changes = fit(state, split.where((moves.going > 0) | (moves.going.max() == 0)), fitting, seeds=seeds, part="state")
    rewards = fit(
        MeanTask(moves.inputs, moves.rewards, hidden=hidden, device=device), split, fitting, seeds=seeds, part="reward"
    )
    going: Fitted | None = None
    if moves.ends and moves.going.any():
        event = MeanTask(moves.inputs, moves.going[:, None], probability=True, hidden=hidden, device=device)
        going = fit(event, split, fitting, seeds=seeds, part="continuation")
    parts = [slice(k * size, (k + 1) * size) for k in range(len(seeds))]
    return tuple(
        EnsembleModel(
            member_layers(changes.layers, part),
            member_layers(rewards.layers, part),
            None if going is None else member_layers(going.layers, part),
            moves,
            (float(changes.error[part].mean()), float(rewards.error[part].mean())),
            device,
        )
        for part in parts
    )


def one_hot_draw(probabilities: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return one-hot draws (E, P, n, C) from probabilities (E, P, n, C), with the same random numbers for each of P."""
    edges = probabilities.cumsum(axis=-1)
    members, _, n, _ = edges.shape
    codes = (rng.random((members, 1, n, 1)) * edges[..., -1:] >= edges).sum(axis=-1)
    return np.eye(edges.shape[-1])[codes.clip(max=edges.shape[-1] - 1)]


def _numpy(values: Tensor) -> npt.NDArray[np.float64]:
    return values.cpu().numpy().astype(np.float64)
