"""The forms of a cloned policy: what a network's output says about an action."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import softplus

from oat_gym.generation.distributions import (
    Gaussian,
    MixedHead,
    censored_log_prob,
    gaussian_from,
    gaussian_log_prob,
    noise_like,
)
from oat_gym.spaces import Layout

Density = Literal["gaussian", "censored", "tanh-gaussian", "mixture", "categorical"]

_CONSTANT = 1e-6  # a column whose spread is below this share of its size is constant up to float32 rounding

INSIDE = 1e-4
"""How far inside the bounds tanh-Gaussians read actions (as DOPE does), in halves of the range.

Targets and clones share it, since their densities at saturated actions are divided by each other.
"""
LOG_STD = (-5.0, 2.0)
"""Range of a tanh-Gaussian's log standard deviation (DOPE's)."""


@dataclass(frozen=True)
class ActionHead:
    """The distribution of flat actions for K networks.

    Real columns are standardised by `center` and `scale` first: mean and standard deviation of the data or, for the
    tanh-Gaussian, middle and half of the range. One-hot blocks are categoricals. All log-likelihoods are in the units
    of the actions as given.

    Attributes:
        layout: columns of an action.
        density: the form for the real columns.
        components: of a mixture.
        floor: least scale of a Gaussian, standardised.
        center: (K, 1, C), of the C real columns.
        scale: (K, 1, C).
        low: (C,) bounds of the real columns, infinite where there are none.
        high: (C,).
    """

    layout: Layout
    density: Density
    components: int
    floor: float
    center: Tensor
    scale: Tensor
    low: Tensor
    high: Tensor

    @property
    def width(self) -> int:
        """Number of a network's outputs."""
        return self._n_real + self._categories.width

    def member(self, number: int) -> ActionHead:
        """Return the head of one network."""
        part = slice(number, number + 1)
        return replace(self, center=self.center[part].clone(), scale=self.scale[part].clone())

    def log_prob(self, output: Tensor, actions: Tensor) -> Tensor:
        """Return the log-likelihood (K, m) of actions (K, m, layout width) under outputs (K, m, `width`)."""
        total = self._categories.categorical_log_prob(output[..., self._n_real :], actions)
        if not self.layout.continuous:
            return total
        return total + self._real_log_prob(output[..., : self._n_real], actions[..., list(self.layout.continuous)])

    def sample(self, output: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return actions (1, m, layout width) inside the bounds; without a generator, their means."""
        actions = output.new_zeros((*output.shape[:-1], self.layout.width))
        if self.layout.continuous:
            standard = self._standard_sample(output[..., : self._n_real], generator)
            values = standard * self.scale + self.center
            actions[..., list(self.layout.continuous)] = torch.maximum(torch.minimum(values, self.high), self.low)
        if self.layout.categorical:
            columns = [column for start, stop in self.layout.categorical for column in range(start, stop)]
            actions[..., columns] = self._categories.sample_categories(output[..., self._n_real :], generator)
        return actions

    @property
    def _n_real(self) -> int:
        """Outputs that describe the real columns."""
        columns = len(self.layout.continuous)
        return self.components * (2 * columns + 1) if self.density == "mixture" and columns else 2 * columns

    @property
    def _categories(self) -> MixedHead:
        return MixedHead(Layout(self.layout.width, (), self.layout.categorical), self.floor)

    def _real_log_prob(self, output: Tensor, actions: Tensor) -> Tensor:
        standard, jacobian = (actions - self.center) / self.scale, self.scale.log()
        if self.density == "tanh-gaussian":
            return (tanh_gaussian_log_prob(tanh_gaussian_from(output), standard) - jacobian).sum(-1)
        if self.density == "mixture":
            log_weights, gaussians = mixture_from(output, self.components, self.floor)
            return mixture_log_prob(log_weights, gaussians, standard) - jacobian.sum(-1)
        gaussian = gaussian_from(output, self.floor)
        if self.density == "censored":
            low, high = ((bound - self.center) / self.scale for bound in (self.low, self.high))
            inside = (standard > low) & (standard < high)
            return (censored_log_prob(gaussian, standard, low, high) - jacobian * inside).sum(-1)
        return (gaussian_log_prob(gaussian, standard) - jacobian).sum(-1)

    def _standard_sample(self, output: Tensor, generator: torch.Generator | None) -> Tensor:
        if self.density == "mixture":
            log_weights, gaussians = mixture_from(output, self.components, self.floor)
            if generator is None:
                return (log_weights.exp()[..., None] * gaussians.mean).sum(-2)
            exponential = torch.empty(log_weights.shape).exponential_(generator=generator).to(output.device)
            chosen = (log_weights - exponential.log()).argmax(-1)[..., None, None]
            chosen = chosen.expand(*chosen.shape[:-1], gaussians.mean.shape[-1])
            mean, scale = (part.gather(-2, chosen).squeeze(-2) for part in gaussians)
            return mean + scale * noise_like(mean, generator)
        squashed = self.density == "tanh-gaussian"
        mean, scale = tanh_gaussian_from(output) if squashed else gaussian_from(output, self.floor)
        values = mean if generator is None else mean + scale * noise_like(mean, generator)
        return values.tanh() if squashed else values


def tanh_gaussian_from(output: Tensor) -> Gaussian:
    """Return the Gaussian before the tanh of outputs (..., 2d): linear mean, log standard deviation in `LOG_STD`."""
    mean, raw = output.chunk(2, dim=-1)
    low, high = LOG_STD
    return Gaussian(mean, (low + 0.5 * (high - low) * (raw.tanh() + 1)).exp())


def tanh_gaussian_log_prob(gaussian: Gaussian, x: Tensor) -> Tensor:
    """Return the log-density of each entry x in (-1, 1) of the tanh of a Gaussian variable.

    Entries closer to -1 or 1 than `INSIDE` are read as if they were there.
    """
    x = x.clamp(-1 + INSIDE, 1 - INSIDE)
    return gaussian_log_prob(gaussian, x.atanh()) - torch.log1p(-x.square())


def mixture_from(output: Tensor, components: int, floor: float) -> tuple[Tensor, Gaussian]:
    """Return log weights (..., M) and diagonal Gaussians (..., M, d) of outputs (..., M (2d + 1))."""
    log_weights = output[..., :components].log_softmax(-1)
    mean, raw = output[..., components:].unflatten(-1, (components, -1)).chunk(2, dim=-1)
    return log_weights, Gaussian(mean, softplus(raw) + floor)


def mixture_log_prob(log_weights: Tensor, gaussians: Gaussian, x: Tensor) -> Tensor:
    """Return the log-density (...) of rows x (..., d) under a mixture of diagonal Gaussians."""
    each = gaussian_log_prob(gaussians, x[..., None, :]).sum(-1)
    return torch.logsumexp(log_weights + each, dim=-1)


def standardizer(density: Density, actions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return center and scale (C,) of the real columns, from actions (n, C) and bounds (C,).

    Columns that never change get scale 1.
    """
    if density == "tanh-gaussian":
        return (low + high) / 2, (high - low) / 2
    center, spread = actions.mean(0), actions.std(0, correction=0)
    constant = spread <= _CONSTANT * actions.abs().amax(0)
    return center, torch.where(constant, torch.ones_like(spread), spread)
