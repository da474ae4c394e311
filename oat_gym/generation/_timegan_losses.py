"""The losses of TimeGAN (Yoon et al. 2019), each over what was recorded only. Pure functions of time-major tensors.

Masks are 1 where something was recorded. With series of one length every loss is that of the original; with unequal
lengths padding has no part in any of them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

SUPERVISED_WEIGHT = 100.0
MOMENT_WEIGHT = 100.0
RECOVERY_WEIGHT = 10.0
EMBEDDER_SUPERVISED_WEIGHT = 0.1

_VARIANCE_FLOOR = 1e-6  # of the original, inside the square roots of variances
_ROOT_FLOOR = 1e-12  # the square root of a loss of exactly zero has no finite gradient


def recovery_loss(x: Tensor, recovered: Tensor, entries: Tensor) -> Tensor:
    """Return the mean squared error of recorded entries; all arguments are (L, N, width)."""
    return ((x - recovered).square() * entries).sum() / entries.sum()


def supervised_loss(hidden: Tensor, supervised: Tensor, rows: Tensor) -> Tensor:
    """Return the mean squared error of the supervisor's next step: hidden (L, N, nodes) at t+1 against its output at t.

    `rows` is (L, N); pairs whose second row was not recorded do not count.
    """
    pairs = rows[1:]
    return ((hidden[1:] - supervised[:-1]).square() * pairs[..., None]).sum() / (pairs.sum() * hidden.shape[-1])


def real_loss(logits: Tensor, rows: Tensor) -> Tensor:
    """Return the mean cross-entropy of calling rows real; `logits` and `rows` are (L, N)."""
    return (softplus(-logits) * rows).sum() / rows.sum()


def fake_loss(logits: Tensor, rows: Tensor) -> Tensor:
    """Return the mean cross-entropy of calling rows generated."""
    return (softplus(logits) * rows).sum() / rows.sum()


def moment_loss(x: Tensor, generated: Tensor, entries: Tensor) -> Tensor:
    """Return the mean |difference of standard deviations| + |difference of means| of each time and column.

    Both are taken over the series of the minibatch. Times that fewer series reach count for less (as many times as
    series), and standard deviations need two series.
    """
    count = entries.sum(1)
    mean, variance = _moments(x, entries, count)
    generated_mean, generated_variance = _moments(generated, entries, count)
    spread = ((generated_variance + _VARIANCE_FLOOR).sqrt() - (variance + _VARIANCE_FLOOR).sqrt()).abs()
    several = count * (count > 1)
    means = ((generated_mean - mean).abs() * count).sum() / count.sum()
    return (spread * several).sum() / several.sum() + means


def generator_loss(
    unsupervised: Tensor, unsupervised_e: Tensor, supervised: Tensor, moments: Tensor, gamma: float
) -> Tensor:
    """Return the generator's and supervisor's joint loss, U + gamma U_e + 100 sqrt(S) + 100 V."""
    root = (supervised + _ROOT_FLOOR).sqrt()
    return unsupervised + gamma * unsupervised_e + SUPERVISED_WEIGHT * root + MOMENT_WEIGHT * moments


def embedder_loss(recovery: Tensor, supervised: Tensor | None = None) -> Tensor:
    """Return the embedder's and recovery's loss, 10 sqrt(MSE), in the joint phase with 0.1 S."""
    loss = RECOVERY_WEIGHT * (recovery + _ROOT_FLOOR).sqrt()
    return loss if supervised is None else loss + EMBEDDER_SUPERVISED_WEIGHT * supervised


def _moments(x: Tensor, entries: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance (L, width) over series of what was recorded."""
    some = count.clamp(min=1.0)
    mean = (x * entries).sum(1) / some
    return mean, ((x - mean[:, None]).square() * entries).sum(1) / some


def is_finite(loss: Tensor) -> bool:
    """Whether a loss is a number."""
    return bool(torch.isfinite(loss))
