"""Policies over discrete actions whose probabilities are known."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope.policy import FloatArray, Policy
from oat_gym.spaces import Batch, tree_length

IntArray = npt.NDArray[np.int64]
_ROUNDING = 1e-6  # how far a row of probabilities may be from 1


class CategoricalPolicy(ABC):
    """Base of policies over a `Discrete` action space that know their probabilities; subclasses give `probabilities`.

    Sampling inverts the cumulative probabilities with one uniform number for each observation.
    """

    @abstractmethod
    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, K), rows that sum to 1."""

    @property
    def first_action(self) -> int:
        """The number of the first action (`Discrete.start`)."""
        return 0

    def sample(self, observations: Batch, *, rng: np.random.Generator) -> IntArray:
        """Return actions (n,) drawn from pi(.|s)."""
        rows = self.probabilities(observations)
        return draw(rows, rng) + self.first_action

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (n,), minus infinity for actions of probability zero.

        Raises:
            InvalidDataError: if an action is outside the space.
        """
        rows = self.probabilities(observations)
        taken = check_codes(actions, rows.shape[1], first=self.first_action, what="actions")
        return safe_log(rows[np.arange(len(taken)), taken])

    def mean(self, observations: Batch) -> IntArray:
        """Return the most probable actions, (n,); the first of equals."""
        return self.probabilities(observations).argmax(axis=1) + self.first_action


class TabularPolicy(CategoricalPolicy):
    """A table of probabilities for `Discrete` observations and actions.

    >>> policy = TabularPolicy([[0.25, 0.75], [1.0, 0.0]])
    >>> policy.log_prob(np.array([0, 1]), np.array([1, 1])).round(3).tolist()
    [-0.288, -inf]
    """

    def __init__(self, probabilities: npt.ArrayLike, *, first_state: int = 0, first_action: int = 0) -> None:
        """Check and copy the table.

        Args:
            probabilities: (S, K) pi(a|s): rows are states, columns actions.
            first_state: the number of the first state (`Discrete.start`).
            first_action: the number of the first action.

        Raises:
            ConfigurationError: if rows are not probabilities. States and actions outside the table raise
                `InvalidDataError` when the policy is evaluated.
        """
        table = np.array(probabilities, dtype=np.float64)
        if table.ndim != 2 or not table.size:
            raise ConfigurationError(f"TabularPolicy takes a (states, actions) table, got shape {table.shape}.")
        check_rows(table, "TabularPolicy: state")
        table.setflags(write=False)
        self._table, self._first_state, self._first_action = table, first_state, first_action

    @property
    def table(self) -> FloatArray:
        """(S, K) the table, read-only."""
        return self._table

    @property
    def first_state(self) -> int:
        """The number of the first state."""
        return self._first_state

    @property
    def first_action(self) -> int:
        """The number of the first action."""
        return self._first_action

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, K), for states (n,)."""
        states = check_codes(observations, len(self._table), first=self._first_state, what="states")
        return self._table[states]

    @property
    def architecture(self) -> Hashable:
        """Size of the table and first numbers."""
        return self._table.shape, self._first_state, self._first_action

    @classmethod
    def stack(cls, policies: Sequence[TabularPolicy]) -> TabularStack:
        """Return tables of one size as one."""
        return TabularStack(policies[0], np.stack([policy.table for policy in policies]))


@dataclass(frozen=True, eq=False)
class TabularStack:
    """Q tables of one size, `tables` (Q, S, K); `first` is one of the policies, for the numbering."""

    first: TabularPolicy
    tables: FloatArray

    def sample(self, observations: Batch, *, rngs: Sequence[np.random.Generator]) -> IntArray:
        """Return actions (Q, n)."""
        states = self._states(observations)
        drawn = [draw(table[states], rng) for table, rng in zip(self.tables, rngs, strict=True)]
        return np.stack(drawn) + self.first.first_action

    def log_prob(self, observations: Batch, actions: Batch) -> FloatArray:
        """Return log pi(a|s), (Q, n)."""
        taken = check_codes(actions, self.tables.shape[2], first=self.first.first_action, what="actions")
        return safe_log(self.tables[:, self._states(observations), taken])

    def mean(self, observations: Batch) -> IntArray:
        """Return the most probable actions, (Q, n)."""
        return self.tables.argmax(axis=2)[:, self._states(observations)] + self.first.first_action

    def _states(self, observations: Batch) -> IntArray:
        return check_codes(observations, self.tables.shape[1], first=self.first.first_state, what="states")


@dataclass(frozen=True)
class UniformPolicy(CategoricalPolicy):
    """Every action of a `Discrete` space with the same probability, whatever the observation.

    >>> UniformPolicy(spaces.Discrete(4)).probabilities(np.zeros((1, 2))).tolist()
    [[0.25, 0.25, 0.25, 0.25]]
    """

    action_space: spaces.Discrete

    def __post_init__(self) -> None:
        check_discrete(self.action_space, "UniformPolicy")

    @property
    def first_action(self) -> int:
        """The number of the first action."""
        return int(self.action_space.start)

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return 1/K for each action, (n, K)."""
        n_actions = int(self.action_space.n)
        return np.full((tree_length(observations), n_actions), 1.0 / n_actions)


@dataclass(frozen=True)
class EpsilonGreedyPolicy(CategoricalPolicy):
    """Another policy's most probable action with probability 1 - epsilon, else any action with equal probability.

    With epsilon 0 it gives a deterministic policy (a `FunctionPolicy`, say) known probabilities, 0 and 1.

    Attributes:
        policy: its `mean` is the greedy action.
        action_space: a `Discrete` space.
        epsilon: share of uniform actions, 0 to 1.

    Raises:
        ConfigurationError: if epsilon is no probability or the space not `Discrete`.

    >>> from oat_gym.ope import FunctionPolicy
    >>> greedy = FunctionPolicy(lambda observation: int(observation[0] > 0), action_space=spaces.Discrete(2))
    >>> soft = EpsilonGreedyPolicy(greedy, spaces.Discrete(2), epsilon=0.1)
    >>> soft.probabilities(np.array([[1.0], [-1.0]])).round(2).tolist()
    [[0.05, 0.95], [0.95, 0.05]]
    """

    policy: Policy
    action_space: spaces.Discrete
    epsilon: float = 0.0

    def __post_init__(self) -> None:
        check_discrete(self.action_space, "EpsilonGreedyPolicy")
        if not 0.0 <= self.epsilon <= 1.0:
            raise ConfigurationError(f"epsilon must be a number from 0 to 1, got {self.epsilon!r}.")

    @property
    def first_action(self) -> int:
        """The number of the first action."""
        return int(self.action_space.start)

    def probabilities(self, observations: Batch) -> FloatArray:
        """Return pi(a|s) of each action, (n, K)."""
        n_actions = int(self.action_space.n)
        greedy = check_codes(self.policy.mean(observations), n_actions, first=self.first_action, what="greedy actions")
        rows = np.full((len(greedy), n_actions), self.epsilon / n_actions)
        rows[np.arange(len(greedy)), greedy] += 1.0 - self.epsilon
        return rows


def check_rows(rows: FloatArray, what: str) -> None:
    """Raise `ConfigurationError` unless every row of (n, K) holds probabilities that sum to 1."""
    good = (rows >= 0).all(axis=1) & (np.abs(rows.sum(axis=1) - 1.0) <= _ROUNDING)
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise ConfigurationError(
            f"{what} {row} has probabilities {rows[row].tolist()} (sum {rows[row].sum():.6g}); they must be "
            "non-negative and sum to 1."
        )


def check_codes(values: Batch, size: int, *, first: int, what: str) -> IntArray:
    """Return whole numbers (n,) counted from zero, or raise `InvalidDataError`."""
    codes = np.asarray(values)
    if codes.ndim != 1 or codes.dtype.kind not in "iu":
        raise InvalidDataError(f"{what} must be whole numbers of shape (n,), got {codes.dtype} of shape {codes.shape}.")
    codes = codes.astype(np.int64) - first
    if len(codes) and not (codes.min() >= 0 and codes.max() < size):
        bad = codes[(codes < 0) | (codes >= size)][0] + first
        raise InvalidDataError(f"{what} go from {first} to {first + size - 1}, got {bad}.")
    return codes


def check_discrete(space: object, who: str) -> None:
    """Raise `ConfigurationError` unless `space` is a `Discrete` space."""
    if not isinstance(space, spaces.Discrete):
        raise ConfigurationError(f"{who} takes a Discrete action space, got {space!r}.")


def draw(rows: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return one category for each row of probabilities (n, K), by inverting their sums."""
    edges = rows.cumsum(axis=1)
    edges /= edges[:, -1:]  # a last edge just below 1 would leave numbers above it
    return (rng.random(len(rows))[:, None] >= edges).sum(axis=1)


def safe_log(probabilities: FloatArray) -> FloatArray:
    """Return the logarithm, minus infinity at zero, without a warning."""
    return np.log(probabilities, where=probabilities > 0, out=np.full(probabilities.shape, -np.inf))
