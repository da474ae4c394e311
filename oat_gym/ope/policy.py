"""Policies: what an estimator asks of one, and several evaluated together."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

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


class PolicyStack(Protocol):
    """Q policies evaluated in one product; every result has a leading axis of Q."""

    def sample(self, observations: Batch, *, rngs: Sequence[np.random.Generator]) -> Batch:
        """Return actions, leaves (Q, n, ...); policy q draws from `rngs[q]` what it would draw alone."""
        ...

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s) of the same n actions under each policy, (Q, n)."""
        ...

    def mean(self, observations: Batch) -> Batch:
        """Return the mean actions, leaves (Q, n, ...)."""
        ...


@runtime_checkable
class RepeatingStack(PolicyStack, Protocol):
    """A stack that can draw several actions in a state from one evaluation of its policies."""

    def samples(self, observations: Batch, *, rngs: Sequence[Sequence[np.random.Generator]]) -> Batch:
        """Return actions, leaves (Q, J, n, ...): the j-th are what `sample` draws from `rngs[j]`."""
        ...


@runtime_checkable
class StackablePolicy(Policy, Protocol):
    """A policy that can be evaluated in one product with others of its architecture."""

    @property
    def architecture(self) -> Hashable:
        """What policies must have in common to be stacked."""
        ...

    @classmethod
    def stack(cls, policies: Sequence[Self]) -> PolicyStack:
        """Return one computation for policies of one architecture."""
        ...


Policies = Mapping[str, Policy] | Sequence[Policy] | Policy
"""What `ope.evaluate` takes: a policy, several, or several by name."""


@dataclass(frozen=True)
class PolicySet:
    """P target policies that are evaluated together; every result has a leading axis of P.

    Policies of one architecture (`StackablePolicy`) are evaluated in one batched product, the others one by one.

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
        """Return actions drawn from each policy, leaves (P, n, ...).

        Each policy has a generator of its own, all in one state, seeded by one draw from `rng` (`streams`): what a
        policy draws depends neither on its place in the set, nor on the others, nor on what is stacked.
        """
        rngs = streams(rng, len(self))
        return self._together(lambda numbers, stack: stack.sample(observations, rngs=[rngs[p] for p in numbers]))

    def samples(self, observations: Batch, count: int, *, rng: np.random.Generator) -> Batch:
        """Return what so many calls of `sample` return, leaves (P, count, n, ...).

        A `RepeatingStack` is evaluated once for all of them.
        """
        rngs = [streams(rng, len(self)) for _ in range(count)]

        def drawn(numbers: tuple[int, ...], stack: PolicyStack) -> Batch:
            own = [[each[p] for p in numbers] for each in rngs]
            if isinstance(stack, RepeatingStack):
                return stack.samples(observations, rngs=own)
            several = _join([stack.sample(observations, rngs=each) for each in own])
            return map_tree(lambda leaf: leaf.swapaxes(0, 1), several)

        return self._together(drawn)

    def mean(self, observations: Batch) -> Batch:
        """Return the mean actions of each policy, leaves (P, n, ...)."""
        return self._together(lambda _, stack: stack.mean(observations))

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s) of the same n actions under each policy, (P, n)."""
        return self._together(lambda _, stack: stack.log_prob(observations, actions))

    def probabilities(self, observations: Batch) -> FloatArray | None:
        """Return pi(a|s) of every discrete action, (P, n, K); None where a policy does not know them."""
        rows: list[FloatArray] = []
        for policy in self.policies:
            if not isinstance(policy, DiscretePolicy):
                return None
            rows.append(np.asarray(policy.probabilities(observations), dtype=np.float64))
        return np.stack(rows)

    @cached_property
    def _groups(self) -> tuple[tuple[tuple[int, ...], PolicyStack], ...]:
        """The policies (by number) that are evaluated together, and their computation."""
        alike: dict[Hashable, list[int]] = {}
        for number, policy in enumerate(self.policies):
            stackable = isinstance(policy, StackablePolicy)
            alike.setdefault((type(policy), policy.architecture) if stackable else number, []).append(number)
        return tuple((tuple(numbers), _stacked([self.policies[p] for p in numbers])) for numbers in alike.values())

    def _together(self, evaluate: Callable[[tuple[int, ...], PolicyStack], Batch]) -> Batch:
        """Evaluate every group and put the results in the policies' order."""
        if len(self._groups) == 1:
            return evaluate(*self._groups[0])
        rows: dict[int, Batch] = {}
        for numbers, stack in self._groups:
            result = evaluate(numbers, stack)
            rows |= {p: map_tree(lambda leaf, row=row: leaf[row], result) for row, p in enumerate(numbers)}
        return _join([rows[p] for p in range(len(self))])


@dataclass(frozen=True)
class _Alone:
    """One policy as a stack of one."""

    policy: Policy

    def sample(self, observations: Batch, *, rngs: Sequence[np.random.Generator]) -> Batch:
        return _join([self.policy.sample(observations, rng=rngs[0])])

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        return np.asarray(self.policy.log_prob(observations, actions), dtype=np.float64)[None]

    def mean(self, observations: Batch) -> Batch:
        return _join([self.policy.mean(observations)])


def streams(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    """Return the generators that the policies of a set draw from, all in one state.

    The one state is on purpose: the random numbers that policies have in common cancel in the differences between
    their values. What a policy draws depends neither on its place in the set nor on the others.
    """
    seed = int(rng.integers(0, 2**63 - 1))
    return [np.random.default_rng(seed) for _ in range(count)]


def _stacked(policies: list[Policy]) -> PolicyStack:
    alike = [policy for policy in policies if isinstance(policy, StackablePolicy)]
    return type(alike[0]).stack(alike) if len(alike) > 1 else _Alone(policies[0])


def _join(batches: list[Batch]) -> Batch:
    def join(*leaves: Any) -> npt.NDArray[Any]:
        return np.stack(leaves)

    return map_tree(join, batches[0], *batches[1:])
