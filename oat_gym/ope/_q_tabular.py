"""Action values by dynamic programming on the empirical model: FQE without approximation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError, InvalidDataError

FloatArray = npt.NDArray[np.float64]
MAX_UNSUPPORTED = 0.01
"""Largest probability of coming to pairs that the data does not hold that passes without a warning."""
UNSUPPORTED = "does what the data does not hold (unsupported_mass), where it is taken to do what the data holds instead"


@dataclass(frozen=True)
class EmpiricalModel:
    """The model of S states and A actions that transitions are an exact sample of.

    Attributes:
        visits: (S, A) weight of the transitions from each pair.
        rewards: (S, A) mean rewards, 0 where there is no visit.
        source: (m,) pair s * A + a of each distinct transition that goes on.
        target: (m,) its next state.
        probability: (m,) its probability; over the rows of a pair these sum to one minus that of terminating.
    """

    visits: FloatArray
    rewards: FloatArray
    source: IntArray
    target: IntArray
    probability: FloatArray

    def expect(self, values: FloatArray) -> FloatArray:
        """Return sum_s' P(s'|s, a) values(s'), (S, A): zero after termination and for pairs that were never seen."""
        parts = self.probability * values[self.target]
        return _sums(self.source, parts, self.visits.size).reshape(self.visits.shape)

    def chain(self, policy: FloatArray) -> FloatArray:
        """Return (S, S) probabilities of going on from s to s' under a policy (S, A)."""
        states = len(self.visits)
        index = self.source // self.visits.shape[1] * states + self.target
        parts = self.probability * policy.ravel()[self.source]
        return _sums(index, parts, states**2).reshape(states, states)


def empirical_model(
    states: IntArray,
    actions: IntArray,
    rewards: FloatArray,
    next_states: IntArray,
    terminated: BoolArray,
    *,
    weights: FloatArray | None = None,
    shape: tuple[int, int],
) -> EmpiricalModel:
    """Return the empirical model of n transitions.

    Args:
        states: (n,) states s, 0 to S-1.
        actions: (n,) actions a, 0 to A-1.
        rewards: (n,) rewards.
        next_states: (n,) states s'; of no effect where terminated.
        terminated: (n,) true where the episode ended in a terminal state.
        weights: (n,) how often each transition counts, not negative; None: once.
        shape: (S, A).

    >>> model = empirical_model(
    ...     np.array([0, 0]), np.array([1, 1]), np.array([1.0, 3.0]), np.array([0, 1]), np.array([False, True]),
    ...     shape=(2, 2)
    ... )
    >>> model.rewards[0], model.expect(np.array([1.0, 1.0]))[0]
    (array([0., 2.]), array([0. , 0.5]))
    """
    weights = np.ones(len(rewards)) if weights is None else weights
    pairs, size = states * shape[1] + actions, shape[0] * shape[1]
    visits = _sums(pairs, weights, size)
    share = np.divide(weights, visits[pairs], out=np.zeros(len(pairs)), where=visits[pairs] > 0)
    going = ~terminated & (share > 0)
    distinct, inverse = np.unique(pairs[going] * shape[0] + next_states[going], return_inverse=True)
    return EmpiricalModel(
        visits=visits.reshape(shape),
        rewards=_sums(pairs, share * rewards, size).reshape(shape),
        source=distinct // shape[0],
        target=distinct % shape[0],
        probability=_sums(inverse, share[going], len(distinct)),
    )


def supported_policy(model: EmpiricalModel, policy: FloatArray) -> FloatArray:
    """Return a policy (S, A) kept to the actions that the data holds in each state.

    Their probabilities are scaled to sum to one; where the policy takes none of them, it acts as the data does. To
    count what is not known as 0 would make a policy that leaves the data the best of all where rewards are negative,
    and the worst where they are positive. Rows of states that no transition leaves are zero: nothing is known there.

    >>> model = empirical_model(
    ...     np.array([0, 0, 1]), np.array([0, 1, 1]), np.zeros(3), np.array([1, 1, 0]), np.zeros(3, dtype=bool),
    ...     shape=(3, 3)
    ... )
    >>> supported_policy(model, np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    array([[0.4, 0.6, 0. ],
           [0. , 1. , 0. ],
           [0. , 0. , 0. ]])
    """
    kept = np.where(model.visits > 0, policy, 0.0)
    kept = np.where(kept.sum(axis=1, keepdims=True) > 0, kept, model.visits)
    total = kept.sum(axis=1, keepdims=True)
    return np.divide(kept, total, out=np.zeros_like(kept), where=total > 0)


def infinite_values(model: EmpiricalModel, policy: FloatArray, gamma: float) -> FloatArray:
    """Return V (S,) of a policy (S, A): the solution of V = sum_a pi (r + gamma P V).

    Raises:
        InvalidDataError: if there is none (gamma = 1, and the policy never ends from some state).
    """
    rewards = (policy * model.rewards).sum(axis=1)
    matrix = np.eye(len(rewards)) - gamma * model.chain(policy)
    try:
        values = np.linalg.solve(matrix, rewards)
    except np.linalg.LinAlgError:
        values = np.full_like(rewards, np.nan)
    if not np.isfinite(values).all() or np.abs(matrix @ values - rewards).max() > 1e-6 * (1 + np.abs(rewards).max()):
        raise InvalidDataError(
            "The values have no solution: with gamma = 1 the policy stays for ever in states of the data that never "
            "terminate. Give a horizon, or a gamma below 1."
        )
    return values


def finite_values(model: EmpiricalModel, policy: FloatArray, gamma: float, horizon: int) -> FloatArray:
    """Return V (horizon + 1, S): values with h = 0, 1, ..., horizon steps to go, by backward recursion."""
    rewards, chain = (policy * model.rewards).sum(axis=1), gamma * model.chain(policy)
    values = np.zeros((horizon + 1, len(rewards)))
    for h in range(1, horizon + 1):
        values[h] = rewards + chain @ values[h - 1]
    return values


def unsupported_mass(
    model: EmpiricalModel, policy: FloatArray, initial: FloatArray, gamma: float, horizon: int | None
) -> float:
    """Return the discounted probability that a policy, from `initial` (S,), comes to a pair that was never seen.

    `supported_policy` then stands in for the policy. A state that no transition leaves counts as such a pair, and the
    value holds nothing of what comes after it.
    """
    unseen = (policy * (model.visits == 0)).sum(axis=1)
    chain = gamma * model.chain(policy)
    if horizon is None:
        return float(np.linalg.solve(np.eye(len(unseen)) - chain, unseen) @ initial)
    values = np.zeros_like(unseen)
    for _ in range(horizon):
        values = unseen + chain @ values
    return float(values @ initial)


@dataclass(frozen=True)
class TabularQ:
    """Exact action values in an empirical model; states and actions come as one-hot features.

    An action that the data does not hold in a state is worth V there, so that the mean of Q under the policy is that
    under `supported_policy`. `values` is V, (P, S), or with a horizon H (P, H + 1, S).
    """

    model: EmpiricalModel
    values: FloatArray
    gamma: float

    def q(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        """Return Q(s, a), (P, n) (see `QFunction`)."""
        if (self.values.ndim == 3) != (remaining is not None):
            raise ConfigurationError("remaining steps are given where the values have a horizon, and only there.")
        state = states.argmax(axis=1)
        action = np.broadcast_to(actions.argmax(axis=-1), (len(self.values), len(state)))
        rows = [self._pairs(v, state, a, remaining) for v, a in zip(self.values, action, strict=True)]
        return np.stack(rows)

    def _pairs(self, values: FloatArray, state: IntArray, action: IntArray, remaining: IntArray | None) -> FloatArray:
        if remaining is None:
            return self._table(values, values)[state, action]
        result = np.zeros(len(state))
        for h in np.unique(remaining[remaining > 0]):
            table = self._table(values[h - 1], values[h])
            chosen = remaining == h
            result[chosen] = table[state[chosen], action[chosen]]
        return result

    def _table(self, after: FloatArray, own: FloatArray) -> FloatArray:
        """Return (S, A) action values from the values (S,) of next states and of the states themselves."""
        table = self.model.rewards + self.gamma * self.model.expect(after)
        return np.where(self.model.visits > 0, table, own[:, None])


def _sums(index: IntArray, values: FloatArray, size: int) -> FloatArray:
    return np.bincount(index, values, minlength=size).astype(np.float64)
