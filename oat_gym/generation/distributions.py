"""Diagonal Gaussians, categoricals, and heads that mix both over the columns of a feature matrix."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from oat_gym.spaces import Layout

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class Gaussian(NamedTuple):
    """A diagonal Gaussian: `mean` and `scale` (standard deviation), both (..., d)."""

    mean: Tensor
    scale: Tensor


def gaussian_from(output: Tensor, floor: float) -> Gaussian:
    """Return the Gaussian of a layer's output (..., 2d): linear mean, softplus scale above `floor`."""
    mean, raw = output.chunk(2, dim=-1)
    return Gaussian(mean, softplus(raw) + floor)


def gaussian_log_prob(gaussian: Gaussian, x: Tensor) -> Tensor:
    """Return the log-density of each entry of `x`, shape (..., d)."""
    return -0.5 * ((x - gaussian.mean) / gaussian.scale).square() - gaussian.scale.log() - _HALF_LOG_TWO_PI


def gaussian_kl(q: Gaussian, p: Gaussian) -> Tensor:
    """Return KL(q || p) of diagonal Gaussians in closed form, summed over the last axis."""
    ratio = (q.scale / p.scale).square()
    distance = ((q.mean - p.mean) / p.scale).square()
    return 0.5 * (ratio + distance - 1 - ratio.log()).sum(-1)


_FAR_TAIL = -1e6
"""Standard deviations below which log_ndtr has no gradient in float32: what bounds of 1e18, meant as none, lead to."""


def censored_log_prob(gaussian: Gaussian, x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the log-likelihood of each entry of a Gaussian variable that is clipped to [low, high].

    Inside the bounds it is the Gaussian log-density. On a bound (or beyond it, which an environment would clip) it is
    the log of the probability mass that the clipping puts there. Infinite bounds censor nothing.
    """
    # Tails of infinite bounds are never selected, but their gradients must be finite all the same.
    safe_low, safe_high = torch.nan_to_num(low, neginf=0.0), torch.nan_to_num(high, posinf=0.0)
    below = torch.special.log_ndtr(((safe_low - gaussian.mean) / gaussian.scale).clamp(min=_FAR_TAIL))
    above = torch.special.log_ndtr(((gaussian.mean - safe_high) / gaussian.scale).clamp(min=_FAR_TAIL))
    inside = gaussian_log_prob(gaussian, x)
    return torch.where(x <= low, below, torch.where(x >= high, above, inside))


def bernoulli_log_prob(logit: Tensor, x: Tensor) -> Tensor:
    """Return log p(x) of Bernoulli variables x in {0, 1} given their logits."""
    return x * logit - softplus(logit)


@dataclass(frozen=True)
class MixedHead:
    """The distribution of one row of features: independent Gaussians and categoricals, as a `Layout` says.

    A layer's output of `width` columns holds the means, the raw scales and the logits, in this order.

    Attributes:
        layout: what the columns of a row mean.
        floor: least scale of the Gaussians.
    """

    layout: Layout
    floor: float

    @property
    def width(self) -> int:
        """Number of outputs that the layer before must have."""
        return 2 * len(self.layout.continuous) + len(self._category_columns)

    def gaussian(self, output: Tensor) -> Gaussian:
        """Return the Gaussian of the real-valued columns, (..., number of them)."""
        return gaussian_from(output[..., : 2 * len(self.layout.continuous)], self.floor)

    def log_prob(self, output: Tensor, x: Tensor) -> Tensor:
        """Return the log-likelihood (...) of rows `x` (..., layout.width)."""
        total = self.categorical_log_prob(output, x)
        if self.layout.continuous:
            total = total + gaussian_log_prob(self.gaussian(output), self.continuous(x)).sum(-1)
        return total

    def categorical_log_prob(self, output: Tensor, x: Tensor) -> Tensor:
        """Return the log-probability (...) of the one-hot blocks of `x`; zero where there are none."""
        if not self.layout.categorical:
            return torch.zeros(x.shape[:-1], dtype=output.dtype, device=output.device)
        one_hot = x[..., self._category_columns]
        # The logits of impossible (padding) categories are never read here, so no infinity meets a zero.
        log_probabilities = self._log_probabilities(output)[..., self._places[0], self._places[1]]
        return (one_hot * log_probabilities).sum(-1)

    def continuous(self, x: Tensor) -> Tensor:
        """Return the real-valued columns of `x`."""
        return x if len(self.layout.continuous) == self.layout.width else x[..., list(self.layout.continuous)]

    def sample(self, output: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return rows (..., layout.width) drawn from the head; without a generator, means and most likely categories.

        Noise is drawn on the CPU, so that every device sees the same.
        """
        rows = output.new_zeros((*output.shape[:-1], self.layout.width))
        if self.layout.continuous:
            mean, scale = self.gaussian(output)
            rows[..., list(self.layout.continuous)] = (
                mean if generator is None else mean + scale * noise_like(mean, generator)
            )
        if self.layout.categorical:
            rows[..., self._category_columns] = self.sample_categories(output, generator)
        return rows

    def sample_categories(self, output: Tensor, generator: torch.Generator | None) -> Tensor:
        """Return one-hot blocks (..., number of one-hot columns); without a generator, the most likely categories."""
        scores = self._log_probabilities(output)
        if generator is not None:
            # The largest of log p plus Gumbel noise is a draw from p.
            exponential = torch.empty(scores.shape, dtype=scores.dtype).exponential_(generator=generator)
            scores = scores - exponential.log().to(scores.device)
        chosen = torch.nn.functional.one_hot(scores.argmax(-1), scores.shape[-1])
        return chosen[..., self._places[0], self._places[1]].to(output.dtype)

    def _log_probabilities(self, output: Tensor) -> Tensor:
        """Log-probabilities (..., blocks, largest block), minus infinity at padding."""
        logits = output[..., 2 * len(self.layout.continuous) :]
        sizes = [stop - start for start, stop in self.layout.categorical]
        table = logits.new_full((*logits.shape[:-1], len(sizes), max(sizes)), -math.inf)
        table[..., self._places[0], self._places[1]] = logits
        return table.log_softmax(-1)

    @cached_property
    def _category_columns(self) -> list[int]:
        return [column for start, stop in self.layout.categorical for column in range(start, stop)]

    @cached_property
    def _places(self) -> tuple[list[int], list[int]]:
        """Block and category of each one-hot column."""
        blocks = [block for block, (start, stop) in enumerate(self.layout.categorical) for _ in range(start, stop)]
        return blocks, [category for start, stop in self.layout.categorical for category in range(stop - start)]


def noise_like(x: Tensor, generator: torch.Generator) -> Tensor:
    """Return standard normal noise of the shape of `x`, drawn on the CPU by `generator`."""
    return torch.randn(x.shape, generator=generator, dtype=x.dtype).to(x.device)
