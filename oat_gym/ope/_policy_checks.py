"""Whether policies act in the space of the data: checked before anything is fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym._rng import derive
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.logged import Logged
from oat_gym.ope.policy import DiscretePolicy, Policy, PolicySet
from oat_gym.spaces import Batch, get_leaf, iter_leaf_spaces, map_tree

PROBED = 8
"""Logged observations, evenly spread, at which policies without an `action_space` are asked for an action."""


def check_policies(policies: PolicySet, data: Logged) -> None:
    """Raise where a policy does not act in the data's action space.

    Kinds, shapes and numbers of actions are compared, not bounds and dtypes. A policy that does not say its
    `action_space` is asked for a few actions; one whose `sample` is not implemented (only its probabilities are known)
    is let pass.

    Raises:
        ConfigurationError: for a policy whose `action_space` is another.
        InvalidDataError: for a policy that returns actions of another form.
    """
    space = data.flat_actions.space
    for name, policy in zip(policies.names, policies.policies, strict=True):
        own = getattr(policy, "action_space", None)
        if isinstance(own, spaces.Space):
            if _form(own) != _form(space):
                raise ConfigurationError(
                    f"Policy {name!r} acts in {own}, the data in {space}: kind, shape and numbers of actions must be "
                    "the same. Evaluate policies that were made for this data's actions."
                )
        else:
            _probe(name, policy, data)


def _form(space: spaces.Space[Any]) -> dict[tuple[str | int, ...], tuple[Any, ...]]:
    """Return what two spaces must have in common, by place inside a Dict or Tuple."""
    return {path: _of_leaf(leaf) for path, leaf in iter_leaf_spaces(space)}


def _of_leaf(leaf: spaces.Space[Any]) -> tuple[Any, ...]:
    kind = next((each for each in (spaces.Box, spaces.Discrete, spaces.MultiDiscrete) if isinstance(leaf, each)), None)
    numbers = (np.ravel(getattr(leaf, name, 0)).tolist() for name in ("n", "nvec", "start"))
    return kind or type(leaf), leaf.shape or (), *numbers


def _probe(name: str, policy: Policy, data: Logged) -> None:
    rows = np.unique(np.linspace(0, len(data.steps) - 1, PROBED).astype(np.int64))
    observations: Batch = map_tree(lambda leaf: leaf[rows], data.steps.observations)
    space = data.flat_actions.space
    if isinstance(policy, DiscretePolicy) and isinstance(space, spaces.Discrete):
        shape = np.shape(policy.probabilities(observations))
        if shape != (len(rows), int(space.n)):
            raise InvalidDataError(
                f"Policy {name!r} returned probabilities of shape {shape} for {len(rows)} observations; "
                f"({len(rows)}, {int(space.n)}) is expected, the data acts in {space}."
            )
    try:
        actions = policy.sample(observations, rng=derive(0, "policy checks"))
    except NotImplementedError:
        return
    for path, leaf in iter_leaf_spaces(space):
        _check_actions(name, actions, path, leaf, n=len(rows))


def _check_actions(name: str, actions: Batch, path: tuple[str | int, ...], leaf: spaces.Space[Any], *, n: int) -> None:
    try:
        values = np.asarray(get_leaf(actions, path))
    except (KeyError, IndexError, TypeError):
        raise InvalidDataError(f"Policy {name!r} returned actions without a part {path!r}, {leaf}.") from None
    size = int(np.prod(leaf.shape or (), dtype=int))
    if values.ndim == 0 or len(values) != n or values.size != n * size:
        raise InvalidDataError(
            f"Policy {name!r} returned actions of shape {values.shape} for {n} observations; "
            f"({', '.join(map(str, (n, *(leaf.shape or ()))))}) is expected, the data acts in {leaf}."
        )
    check_finite_actions(name, values.reshape(n, -1))
    wrong = [] if isinstance(leaf, spaces.Box) else [each for each in values if not _holds(leaf, each)]
    if wrong:
        raise InvalidDataError(f"Policy {name!r} returned the action {wrong[0]}, which is not in {leaf}, the data's.")


def _holds(leaf: spaces.Space[Any], action: npt.NDArray[Any]) -> bool:
    """Return whether a discrete space holds an action, whatever the dtype that it has."""
    whole = action.reshape(leaf.shape or ()).astype(leaf.dtype)
    return bool((whole == action.reshape(whole.shape)).all()) and bool(leaf.contains(whole[()]))


def check_finite_actions(name: str, actions: npt.NDArray[Any]) -> None:
    """Raise `InvalidDataError` where actions (n, A) that a policy returned are not finite."""
    bad = int((~np.isfinite(actions)).any(axis=1).sum())
    if bad:
        raise InvalidDataError(
            f"Policy {name!r} returned NaN actions, or infinite ones, in {bad} of {len(actions)} states. Repair the "
            "policy: nothing can be fitted to such actions."
        )
