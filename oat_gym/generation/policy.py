"""What chooses the actions of a roll-out."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt


@runtime_checkable
class ActionPolicy(Protocol):
    """A stochastic policy on flat features. A cloned `BehaviorModel` is one; a user's policy may be another.

    >>> class Uniform:
    ...     def sample(self, observations, *, rng):
    ...         return rng.uniform(-1, 1, size=(len(observations), 2))
    ...
    ...     def log_prob(self, observations, actions):
    ...         return np.full(len(observations), -2 * np.log(2))
    >>> isinstance(Uniform(), ActionPolicy)
    True
    """

    def sample(
        self, observations: npt.NDArray[np.floating[Any]], *, rng: np.random.Generator
    ) -> npt.NDArray[np.floating[Any]]:
        """Return one action (n, action width) for each of the observations (n, state width)."""
        ...

    def log_prob(
        self, observations: npt.NDArray[np.floating[Any]], actions: npt.NDArray[np.floating[Any]]
    ) -> npt.NDArray[np.floating[Any]]:
        """Return log pi(a|s), shape (n,)."""
        ...
