"""Action values linear in features of (s, a): least-squares temporal differences, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from oat_gym.episodes import BoolArray, IntArray
from oat_gym.errors import ConfigurationError
from oat_gym.ope._deviation import deviation
from oat_gym.ope._q_function import Choices

FloatArray = npt.NDArray[np.float64]
Degree = Literal[1, 2]


@dataclass(frozen=True)
class FeatureMap:
    """phi(s, a): z-scored columns, their products for degree 2, and 1; a block for each discrete action.

    A one-hot state keeps its own columns (their sum is the constant), so that with discrete actions the features are
    the indicators of the pairs and the values are exact.
    """

    center: FloatArray
    scale: FloatArray
    degree: Degree
    discrete: bool
    one_hot: bool

    @classmethod
    def of(
        cls, states: FloatArray, actions: FloatArray, *, degree: Degree, discrete: bool, one_hot: bool
    ) -> FeatureMap:
        """Take the z-scores of n states (n, D) and, unless discrete, actions (n, A)."""
        x = states if discrete else np.concatenate((states, actions), axis=1)
        center, scale = (np.zeros(x.shape[1]), np.ones(x.shape[1])) if one_hot else (x.mean(axis=0), deviation(x))
        return cls(center, np.where(scale > 0, scale, 1.0), degree, discrete, one_hot)

    def __call__(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return (n, d) features."""
        x = states if self.discrete else np.concatenate((states, actions), axis=1)
        parts = [(x - self.center) / self.scale]
        if self.degree == 2:
            first, second = np.triu_indices(x.shape[1])
            parts.append(parts[0][:, first] * parts[0][:, second])
        if not (self.one_hot and self.discrete):
            parts.append(np.ones((len(x), 1)))
        features = np.concatenate(parts, axis=1)
        if not self.discrete:
            return features
        return (actions[:, :, None] * features[:, None, :]).reshape(len(x), -1)

    def expected(self, states: FloatArray, choices: Choices, policy: int) -> FloatArray:
        """Return E_{a~pi} phi(s, a), (n, d)."""
        if self.discrete and len(choices) == choices.actions.shape[-1]:
            return self(states, choices.weights[policy])  # the features are linear in the one-hot action
        total: FloatArray | float = 0.0
        for j, actions in enumerate(choices.actions):
            chosen = actions if actions.ndim == 2 else actions[policy]
            total = total + choices.weights[policy, :, j, None] * self(states, chosen)
        return np.asarray(total)


def infinite_weights(
    features: FloatArray,
    next_features: FloatArray,
    rewards: FloatArray,
    *,
    gamma: float,
    ridge: float,
    weights: FloatArray,
) -> FloatArray:
    """Return theta (d,) of LSTD-Q (Lagoudakis and Parr, 2003): phi' w (phi - gamma phi_next) theta = phi' w r.

    Args:
        features: (n, d) phi(s, a).
        next_features: (n, d) E_{a'~pi} phi(s', a'), zero where the episode terminated.
        rewards: (n,).
        gamma: discount.
        ridge: added to the diagonal, times the sum of the weights.
        weights: (n,) of the rows.
    """
    left = (weights[:, None] * features).T
    return _solve(left @ (features - gamma * next_features), left @ rewards, ridge * weights.sum())


def finite_weights(
    features: FloatArray,
    next_features: FloatArray,
    rewards: FloatArray,
    *,
    gamma: float,
    ridge: float,
    weights: FloatArray,
    horizon: int,
) -> FloatArray:
    """Return theta (horizon + 1, d): with h steps to go the least-squares fit of r + gamma V at h - 1."""
    left = (weights[:, None] * features).T
    columns = np.concatenate(((left @ rewards)[:, None], gamma * left @ next_features), axis=1)
    solved = _solve(left @ features, columns, ridge * weights.sum())
    theta = np.zeros((horizon + 1, features.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # divergence is found and reported by the caller
        for h in range(1, horizon + 1):
            theta[h] = solved[:, 0] + solved[:, 1:] @ theta[h - 1]
    return theta


def _solve(matrix: FloatArray, right: FloatArray, ridge: float) -> FloatArray:
    """Solve with `ridge` on the diagonal; without, the least-norm solution (features may depend on each other)."""
    if ridge > 0:
        return np.linalg.solve(matrix + ridge * np.eye(len(matrix)), right).astype(np.float64)
    return np.linalg.lstsq(matrix, right, rcond=1e-12)[0].astype(np.float64)


@dataclass(frozen=True)
class LinearQ:
    """Linear action values; `theta` is (P, d), or with a horizon H (P, H + 1, d)."""

    features: FeatureMap
    theta: FloatArray

    def q(self, states: FloatArray, actions: FloatArray, remaining: IntArray | None) -> FloatArray:
        """Return Q(s, a), (P, n) (see `QFunction`)."""
        if (self.theta.ndim == 3) != (remaining is not None):
            raise ConfigurationError("remaining steps are given where the values have a horizon, and only there.")
        rows: list[FloatArray] = []
        shared = self.features(states, actions) if actions.ndim == 2 else None
        for p, theta in enumerate(self.theta):
            phi = self.features(states, actions[p]) if shared is None else shared
            rows.append(phi @ theta if remaining is None else (phi * theta[remaining]).sum(axis=1))
        return np.stack(rows)


def masked(next_features: FloatArray, terminated: BoolArray) -> FloatArray:
    """Return next features that are zero after termination."""
    return np.where(terminated[:, None], 0.0, next_features)
