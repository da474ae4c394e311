"""Autoregressive dynamics: p(s'|s, a) = prod_i p(s'_i | s, a, s'_<i), then reward and continuation given (s, a, s')."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from oat_gym.ope._fqe_network import Architecture, Layers, forward
from oat_gym.ope._model_data import MIN_VARIANCE, Moves, Ranges, Split, tensor
from oat_gym.ope._model_ensemble import one_hot_draw
from oat_gym.ope._model_training import Fitted, Fitting, fit, member_layers

FloatArray = npt.NDArray[np.float64]
LOG_STD = (-4.0, 2.0)
"""Bounds of the log standard deviation of a z-scored variable."""


@dataclass(frozen=True)
class Variable:
    """One factor: a Gaussian column or a categorical block of the change, the reward or the continuation.

    Attributes:
        categories: number of categories, 0 for a Gaussian.
        start: first of its columns among those of the changes.
        given: number of columns of the changes, from the first on, that it is conditioned on.
    """

    categories: int
    start: int
    given: int


def variables(moves: Moves) -> tuple[Variable, ...]:
    """Return the factors in order: state variables by column, the reward, the continuation where episodes end."""
    blocks = dict(moves.layout.categorical)
    starts = sorted((*moves.layout.continuous, *blocks))
    state = [Variable(blocks[start] - start if start in blocks else 0, start, start) for start in starts]
    width = moves.layout.width
    return (*state, Variable(0, width, width), *((Variable(2, width, width),) if moves.ends else ()))


class FactorTask:
    """All factors of a member at a time, on the same rows: negative log-likelihoods of V networks a group.

    A network sees (s, a) and the changes of the columns before its own; the others are zero.
    """

    def __init__(self, moves: Moves, factors: tuple[Variable, ...], *, hidden: tuple[int, ...], device: str) -> None:
        self.copies, width = len(factors), moves.inputs.shape[1]
        self._x = tensor(np.concatenate((moves.inputs, moves.changes), axis=1), device)
        columns = np.arange(self._x.shape[1])
        self._mask = tensor(np.stack([(columns < width + f.given) for f in factors]).astype(np.float64), device)[
            :, None
        ]
        targets = [_targets(moves, factor, number == len(factors) - 1) for number, factor in enumerate(factors)]
        self._targets = tensor(np.stack(targets), device)
        self._heads = max(2, *(f.categories for f in factors))
        sizes = torch.tensor([f.categories for f in factors], device=device)
        self._categorical = (sizes > 0)[:, None, None]
        # Of the reward only the mean is used, which least squares learns best.
        plain = [f.categories == 0 and f.start == moves.layout.width for f in factors]
        self._plain = torch.tensor(plain, device=device)[:, None]
        self._absent = torch.arange(self._heads, device=device) >= sizes.clamp(min=1)[:, None]
        gaussian = np.array([f.categories == 0 for f in factors])
        spread = np.where(gaussian, np.stack(targets).var(axis=1), 1.0)
        self._spread = tensor(np.where(spread > MIN_VARIANCE, spread, 1.0), device)
        self.architecture = Architecture(self._x.shape[1], hidden, self._heads)

    def inputs(self, rows: Tensor) -> Tensor:
        """Return (G * V, B, inputs)."""
        chosen = self._x[rows][:, None] * self._mask
        return chosen.view(-1, *chosen.shape[2:])

    def slope(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return the derivative of the negative log-likelihood, of a Gaussian times its standard deviation.

        The factor keeps rows that are predicted well from outweighing all others (beta = 0.5 of Seitzer et al., 2022).
        """
        raw, target = self._split(heads, rows)
        mean, log_std, inside = _gaussian(raw)
        log_std = torch.where(self._plain, 0.0, log_std)
        scaled = (mean - target) * (-log_std).exp()
        smooth = torch.zeros_like(raw)
        smooth[..., 0] = scaled
        smooth[..., 1] = torch.where(inside & ~self._plain, log_std.exp() * (1.0 - scaled.square()), 0.0)
        return torch.where(self._categorical, self._residual(raw, target), smooth).view_as(heads)

    def loss(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return the negative log-likelihood of each factor."""
        raw, target = self._split(heads, rows)
        mean, log_std, _ = _gaussian(raw)
        log_std = torch.where(self._plain, 0.0, log_std)
        gaussian = log_std + 0.5 * (mean - target).square() * (-2 * log_std).exp()
        chosen = self._logits(raw).log_softmax(dim=-1)
        index = target.long().clamp(0, raw.shape[-1] - 1).unsqueeze(-1)
        categorical = -chosen.gather(-1, index).squeeze(-1)
        return torch.where(self._categorical.squeeze(-1), categorical, gaussian).view(heads.shape[:2])

    def squared_error(self, heads: Tensor, rows: Tensor) -> Tensor:
        """Return the squared error of each factor's mean over its variance (constants: 1; categories: half Brier's)."""
        raw, target = self._split(heads, rows)
        gaussian = (raw[..., 0] - target).square() / self._spread[:, None]
        brier = 0.5 * self._residual(raw, target).square().sum(dim=-1)
        return torch.where(self._categorical.squeeze(-1), brier, gaussian).view(heads.shape[:2])

    def _split(self, heads: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        raw = heads.view(len(rows), self.copies, rows.shape[1], self._heads)
        return raw, self._targets[:, rows].transpose(0, 1)

    def _logits(self, raw: Tensor) -> Tensor:
        return raw.masked_fill(self._absent[:, None], -1e9)

    def _residual(self, raw: Tensor, target: Tensor) -> Tensor:
        """Return probabilities minus the one-hot category (zeros for Gaussians, whose targets are no categories)."""
        hit = torch.arange(self._heads, device=raw.device) == target.unsqueeze(-1)
        return self._logits(raw).softmax(dim=-1) - hit.to(raw.dtype)


@dataclass(frozen=True)
class AutoregressiveModel:
    """E members of one seed; state variables are drawn one after another, the reward is the conditional mean.

    Attributes:
        factors: the factors.
        layers: of each factor, E networks.
        moves: scales and ranges.
        errors: held-out errors of state and reward.
        device: torch device.
    """

    factors: tuple[Variable, ...]
    layers: tuple[Layers, ...]
    moves: Moves
    errors: tuple[float, float]
    device: str

    @property
    def members(self) -> int:
        """E."""
        return len(self.layers[0][0][0])

    @property
    def ranges(self) -> Ranges:
        """Of the data."""
        return self.moves.ranges

    @torch.no_grad()
    def advance(
        self, states: FloatArray, actions: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return next states (E, P, n, D), rewards (E, P, n) and probabilities of going on (E, P, n)."""
        shape = states.shape[:3]
        flat = np.concatenate((states, actions), axis=3).reshape(len(states), shape[1] * shape[2], -1)
        inputs = tensor(self.moves.scales[0](flat), self.device)
        width, n_state = inputs.shape[2], len(self.factors) - 1 - int(self.moves.ends)
        x = torch.cat((inputs, inputs.new_zeros(*inputs.shape[:2], self.moves.layout.width)), dim=2)
        for factor, layers in zip(self.factors[:n_state], self.layers, strict=False):
            raw, size = forward(layers, x)[-1], max(factor.categories, 1)
            drawn = _draw(raw.view(*shape, -1), factor, rng)
            x[..., width + factor.start : width + factor.start + size] = drawn.view(*x.shape[:2], size)
        changes = x[..., width:].cpu().numpy().astype(np.float64).reshape(*shape, -1)
        raw = forward(self.layers[n_state], x)[-1][..., :1]
        rewards = self.moves.scales[2].inverse(raw.cpu().numpy().astype(np.float64)).reshape(shape)
        going = np.ones_like(rewards)
        if self.moves.ends:
            goes_on = forward(self.layers[-1], x)[-1][..., :2].softmax(dim=-1)[..., 1]
            going = goes_on.cpu().numpy().astype(np.float64).reshape(shape)
        return self.moves.next_states(states, changes), rewards, going


def fit_autoregressive(
    moves: Moves, split: Split, fitting: Fitting, *, seeds: Sequence[int]
) -> tuple[AutoregressiveModel, ...]:
    """Train the factors of all members and seeds; they do not depend on any policy.

    Raises:
        TrainingError: if training diverges.
    """
    factors = variables(moves)
    task = FactorTask(moves, factors, hidden=fitting.hidden, device=fitting.device)
    fitted = fit(task, split, fitting, seeds=seeds, part="dynamics")
    return tuple(_of_seed(moves, factors, fitted, fitting, number) for number in range(len(seeds)))


def _of_seed(
    moves: Moves, factors: tuple[Variable, ...], fitted: Fitted, fitting: Fitting, number: int
) -> AutoregressiveModel:
    count, size = len(factors), fitting.ensemble * len(factors)
    first, n_state = number * size, count - 1 - int(moves.ends)
    layers = [member_layers(fitted.layers, slice(first + v, first + size, count)) for v in range(count)]
    error = fitted.error[first : first + size].reshape(-1, count).mean(axis=0)
    return AutoregressiveModel(
        factors, tuple(layers), moves, (float(error[:n_state].mean()), float(error[n_state])), fitting.device
    )


def _targets(moves: Moves, factor: Variable, last: bool) -> FloatArray:
    if factor.start < moves.layout.width:
        own = moves.changes[:, factor.start : factor.start + max(factor.categories, 1)]
        return own.argmax(axis=1).astype(np.float64) if factor.categories else own[:, 0]
    return moves.going if last and moves.ends else moves.rewards[:, 0]


def _gaussian(raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, bounded log standard deviation, and whether that is inside its bounds."""
    mean, free = raw[..., 0], raw[..., 1]
    return mean, free.clamp(*LOG_STD), (free > LOG_STD[0]) & (free < LOG_STD[1])


def _draw(raw: Tensor, factor: Variable, rng: np.random.Generator) -> Tensor:
    """Return (E, P, n, columns) draws of one factor, with the same random numbers for each of P."""
    if factor.categories:
        probabilities = raw[..., : factor.categories].softmax(dim=-1).cpu().numpy().astype(np.float64)
        drawn = one_hot_draw(probabilities, rng)
    else:
        mean, log_std, _ = (part.cpu().numpy() for part in _gaussian(raw))
        noise = rng.standard_normal((len(mean), 1, mean.shape[2]))
        drawn = (mean + np.exp(log_std) * noise)[..., None]
    return torch.from_numpy(drawn).to(raw)
