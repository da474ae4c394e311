"""Policies: what an estimator asks of one, and several evaluated together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError
from oat_gym.spaces import Batch, map_tree

FloatArray = npt.NDArray[np.float64]


@runtime_checkable
class Policy(Protocol):
    """A policy pi(a|s) on batches of the dataset's spaces; n is the number of observations of a batch.

    A policy is deterministic where `sample` returns `mean`; its `log_prob` may still be that of the distribution it
    was trained with, which importance sampling needs.
    """

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> Batch:
        """Return n actions drawn from pi(.|s)."""
        ...

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,), minus infinity where an action is impossible."""
        ...

    def mean(self, observations: Batch) -> Batch:
        """Return the mean actions, for discrete actions the most probable ones: n actions."""
        ...


@runtime_checkable
class DiscretePolicy(Policy, Protocol):
    """A policy over a `Discrete` action space with known probabilities: estimators then take exact expectations."""

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, number of actions), rows that sum to 1."""
        ...


Policies = Mapping[str, Policy] | Sequence[Policy] | Policy
"""What `ope.evaluate` takes: a policy, several, or several by name."""


@dataclass(frozen=True)
class PolicySet:
    """P target policies that are evaluated together; every result has a leading axis of P.

    >>> from oat_gym.ope import PolicySet, TabularPolicy
    >>> pair = PolicySet.of({"left": TabularPolicy([[1.0, 0.0]]), "either": TabularPolicy([[0.5, 0.5]])})
    >>> pair.names, pair.probabilities(np.zeros(1, dtype=int)).shape
    (('left', 'either'), (2, 1, 2))
    """

    names: tuple[str, ...]
    policies: tuple[Policy, ...]

    def __post_init__(self) -> None:
        if not self.policies or len(self.names) != len(self.policies):
            raise ConfigurationError(f"A PolicySet takes one name a policy, got {self.names!r} for {self.policies!r}.")
        if len(set(self.names)) != len(self.names):
            raise ConfigurationError(f"Policies need different names, got {', '.join(self.names)}.")
        for name, policy in zip(self.names, self.policies, strict=True):
            if not isinstance(policy, Policy):
                raise ConfigurationError(f"Policy {name!r} must have sample, log_prob and mean, got {policy!r}.")

    @classmethod
    def of(cls, policies: Policies | PolicySet) -> PolicySet:
        """Return the set of one policy, several, or several by name; the others are called "policy-0", "policy-1"..."""
        if isinstance(policies, PolicySet):
            return policies
        if isinstance(policies, Mapping):
            return cls(tuple(policies), tuple(policies.values()))
        several = tuple(policies) if isinstance(policies, Sequence) else (policies,)
        return cls(tuple(f"policy-{number}" for number in range(len(several))), several)

    def __len__(self) -> int:
        """Return P."""
        return len(self.policies)

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> Batch:
        """Return actions drawn from each policy, leaves (P, n, ...)."""
        return _stack([policy.sample(observations, rng=rng) for policy in self.policies])

    def mean(self, observations: Batch) -> Batch:
        """Return the mean actions of each policy, leaves (P, n, ...)."""
        return _stack([policy.mean(observations) for policy in self.policies])

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s) of the same n actions under each policy, (P, n)."""
        rows = [np.asarray(policy.log_prob(observations, actions), dtype=np.float64) for policy in self.policies]
        return np.stack(rows)

    def probabilities(self, observations: Batch) -> FloatArray | None:
        """Return pi(a|s) of every discrete action, (P, n, K); None where a policy does not know them."""
        rows: list[FloatArray] = []
        for policy in self.policies:
            if not isinstance(policy, DiscretePolicy):
                return None
            rows.append(np.asarray(policy.probabilities(observations), dtype=np.float64))
        return np.stack(rows)


def _stack(batches: list[Batch]) -> Batch:
    def join(*leaves: Any) -> npt.NDArray[Any]:
        return np.stack(leaves)

    return map_tree(join, batches[0], *batches[1:])
