"""Action values Q(s, a) of target policies: what every form of FQE returns and what doubly robust estimators take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import IntArray
from oat_gym.errors import ConfigurationError
from oat_gym.ope.estimator import Diagnostics
from oat_gym.ope.problem import Problem, flatten_policies
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]


@runtime_checkable
class QFunction(Protocol):
    """Action values of P policies in environment units."""

    def q(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        """Return Q(s, a), (P, n).

        Args:
            states: (n, D) features of the states.
            actions: features of the actions: (n, A), the same for all policies, or (P, n, A).
            remaining: (n,) number of steps whose rewards still count, from 0; None without a horizon.
        """
        ...


@dataclass(frozen=True)
class FittedQ:
    """What one seed's fit gave: the function, and as in `Estimates` its values, replicates and diagnostics."""

    function: QFunction
    values: FloatArray
    replicates: FloatArray
    diagnostics: tuple[Diagnostics, ...]


@dataclass(frozen=True)
class Choices:
    """Actions of the policies at n states with weights, so that E_{a~pi} f(s, a) = sum_j weights_j f(s, actions_j).

    `actions` is (J, n, A), the same for all policies, or (J, P, n, A); `weights` (P, n, J) sum to 1.
    """

    actions: FloatArray
    weights: FloatArray

    def __len__(self) -> int:
        """Return J."""
        return len(self.actions)


def action_choices(problem: Problem, observations: Batch, *, draws: int, rng: np.random.Generator) -> Choices:
    """Return all K actions with their probabilities where these are known, else sampled actions of equal weight.

    One action is enough where every policy is deterministic, else `draws` are drawn.
    """
    probabilities = problem.policy_probabilities(observations)
    if probabilities is not None:
        n_actions = probabilities.shape[2]
        one_hot = np.broadcast_to(np.eye(n_actions)[:, None], (n_actions, probabilities.shape[1], n_actions))
        return Choices(one_hot, probabilities)
    actions = problem.policy_samples(observations, 1, rng=rng)
    mean = flatten_policies(problem.policies.mean(observations), problem.data.flat_actions, len(problem.policies))
    if draws > 1 and not np.array_equal(actions[0], mean):
        actions = np.concatenate((actions, problem.policy_samples(observations, draws - 1, rng=rng)))
    return Choices(actions, np.full((*mean.shape[:2], len(actions)), 1.0 / len(actions)))


def expected_q(function: QFunction, states: FloatArray, choices: Choices, remaining: IntArray | None) -> FloatArray:
    """Return V(s) = E_{a~pi} Q(s, a), (P, n)."""
    total = np.zeros(choices.weights.shape[:2])
    for j, actions in enumerate(choices.actions):
        total += choices.weights[:, :, j] * function.q(states, actions, remaining)
    return total


def step_weights(gamma: float, horizon: int) -> FloatArray:
    """Return (horizon + 1,): sum_{t < h} gamma^t for h = 0, 1, ..., horizon."""
    return np.concatenate(([0.0], np.cumsum(np.power(gamma, np.arange(horizon, dtype=np.float64)))))


def value_scale(problem: Problem) -> float:
    """Return the value of a reward of 1 at every step: sum of gamma^t up to the horizon, or without end.

    Without a horizon and discount it is the length of the longest episode.

    Raises:
        ConfigurationError: for gamma = 1 without a horizon where an episode does not terminate.
    """
    if problem.horizon is not None:
        return float(step_weights(problem.gamma, problem.horizon)[-1])
    if problem.gamma < 1.0:
        return 1.0 / (1.0 - problem.gamma)
    last = problem.data.offsets[1:] - 1
    if not problem.data.steps.terminated[last].all():
        raise ConfigurationError(
            "gamma = 1 without a horizon needs data whose every episode terminates, and some are truncated here: give "
            "a horizon, or a gamma below 1."
        )
    return float(problem.data.lengths.max())
