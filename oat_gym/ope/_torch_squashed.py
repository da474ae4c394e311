"""What torch does not say of squashed distributions: where their middle is, and how actions at the edge are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor
from torch.distributions import (
    AffineTransform,
    ComposeTransform,
    Distribution,
    Independent,
    Transform,
    TransformedDistribution,
    constraints,
)
from torch.distributions.transforms import IndependentTransform

from oat_gym.ope._densities import INSIDE


def center_of(distribution: Distribution) -> Tensor | None:
    """Return the mean, else the mode, else (of transformed ones) the base's center transformed; None without any."""
    for name in ("mean", "mode"):
        try:
            return getattr(distribution, name)
        except NotImplementedError:
            continue
    if isinstance(distribution, Independent):
        return center_of(distribution.base_dist)
    if not isinstance(distribution, TransformedDistribution):
        return None
    center = center_of(distribution.base_dist)
    return None if center is None else _push(center, distribution.transforms)


def inside_of(distribution: Distribution, actions: Tensor) -> Tensor:
    """Return actions that are no closer to the ends of a tanh than `INSIDE`, where the distribution has one.

    Affine maps may follow the tanh. The actions of other distributions are returned as they are.
    """
    if isinstance(distribution, Independent):
        return inside_of(distribution.base_dist, actions)
    if not isinstance(distribution, TransformedDistribution):
        return actions
    parts = _parts(distribution.transforms)
    last = next((number for number in range(len(parts))[::-1] if not isinstance(parts[number], AffineTransform)), None)
    if last is None or not _is_tanh(parts[last]):
        return actions
    ends = [_push(torch.full_like(actions, end), parts[last + 1 :]) for end in (INSIDE - 1, 1 - INSIDE)]
    return torch.maximum(torch.minimum(actions, torch.maximum(*ends)), torch.minimum(*ends))


def _parts(transforms: Sequence[Transform]) -> list[Transform]:
    """Return the transforms that make up others, in the order in which they are applied."""
    found: list[Transform] = []
    for transform in transforms:
        if isinstance(transform, ComposeTransform):
            found += _parts(transform.parts)
        elif isinstance(transform, IndependentTransform):
            found += _parts([transform.base_transform])
        else:
            found.append(transform)
    return found


def _is_tanh(transform: Transform) -> bool:
    """Return whether it maps onto (-1, 1), as torch's tanh does and those that agents' libraries have of their own."""
    codomain = transform.codomain
    return isinstance(codomain, constraints.interval) and (codomain.lower_bound, codomain.upper_bound) == (-1.0, 1.0)


def _push(values: Tensor, transforms: Sequence[Transform]) -> Tensor:
    for transform in transforms:
        values = cast(Tensor, transform(values))
    return values
